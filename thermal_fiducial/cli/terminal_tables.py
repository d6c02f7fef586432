"""Tables on the console, whose words and numbers are never truncated."""

from collections.abc import Sequence

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

_WIDEST = 1000


def table_of(title: str, headers: Sequence[str], left: Sequence[str] = ()) -> Table:
    """An empty table, aligned to the right except for the columns named in ``left``."""
    table = Table(title=title or None, title_justify='left', box=box.SIMPLE_HEAD, pad_edge=False)
    for header in headers:
        # As a Text, since rich takes the unit in [mm] for a style.
        table.add_column(Text(header), justify='left' if header in left else 'right', overflow='fold')
    return table


def show(table: Table) -> None:
    """Print a table; in a narrow window with less padding, and if need be with lines longer than the window."""
    console = Console()
    if _least_width(console, table) > console.width:
        table.collapse_padding = True
    _set_widths(console, table)
    console.width = max(console.width, _least_width(console, table))
    console.print(table)


def fits(table: Table) -> bool:
    """Whether the window is wide enough for all words."""
    console = Console()
    return _least_width(console, table) <= console.width


def _set_widths(console: Console, table: Table) -> None:
    """Give each column its longest word, and share what is left among those with longer lines, headers last.

    Rich by itself narrows the widest column first, truncates its words, and prints beyond the window.
    """
    spare = console.width - _least_width(console, table)
    widths = [column.min_width or 0 for column in table.columns]
    cells = [[len(str(text)) for text in column.cells] for column in table.columns]
    headers = [len(str(column.header)) for column in table.columns]
    for wanted in (list(map(_longest, cells)), [max(_longest(own), h) for own, h in zip(cells, headers, strict=True)]):
        while spare > 0 and any(width < most for width, most in zip(widths, wanted, strict=True)):
            for index, width in enumerate(widths):
                if spare > 0 and width < wanted[index]:
                    widths[index] += 1
                    spare -= 1
    for column, width in zip(table.columns, widths, strict=True):
        column.width = width


def _longest(lengths: Sequence[int]) -> int:
    return max(lengths, default=0)


def _least_width(console: Console, table: Table) -> int:
    for column in table.columns:
        texts = [str(text) for text in (column.header, *column.cells)]
        words = texts[1:] + texts[0].split() if column.no_wrap else ' '.join(texts).split()
        column.min_width = max(map(len, words), default=0)
    # Measured in a window with room for all.
    return console.measure(table, options=console.options.update(width=_WIDEST)).minimum
