"""Tables on the console: no word of a header and no number is cut, however narrow the window."""

from collections.abc import Sequence

from rich import box
from rich.console import Console
from rich.table import Table

_WIDEST = 1000


def table_of(title: str, headers: Sequence[str], left: Sequence[str] = ()) -> Table:
    """An empty table; numbers to the right, the columns named in ``left`` to the left."""
    table = Table(title=title or None, title_justify='left', box=box.SIMPLE_HEAD, pad_edge=False)
    for header in headers:
        table.add_column(header, justify='left' if header in left else 'right', overflow='fold')
    return table


def show(table: Table) -> None:
    """Print a table; where the window is narrower than its words, closer, and at last lines run over."""
    console = Console()
    if _least_width(console, table) > console.width:
        table.collapse_padding = True
        # Else rich takes from the widest column, and cuts its words.
        for column in table.columns:
            column.width = column.min_width
    console.width = max(console.width, _least_width(console, table))
    console.print(table)


def fits(table: Table) -> bool:
    """Whether the window is wide enough for all its words."""
    console = Console()
    return _least_width(console, table) <= console.width


def _least_width(console: Console, table: Table) -> int:
    for column in table.columns:
        texts = [str(text) for text in (column.header, *column.cells)]
        words = texts[1:] + texts[0].split() if column.no_wrap else ' '.join(texts).split()
        column.min_width = max(map(len, words), default=0)
    # Measured as if there was room for all.
    return console.measure(table, options=console.options.update(width=_WIDEST)).minimum
