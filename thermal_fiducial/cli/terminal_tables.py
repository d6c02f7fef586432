"""Tables on the console: no word of a header is cut, however narrow the window."""

from collections.abc import Sequence

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text


def table_of(title: str, headers: Sequence[str], left: Sequence[str] = ()) -> Table:
    """An empty table; numbers to the right, the columns named in ``left`` to the left."""
    table = Table(title=title or None, title_justify='left', box=box.SIMPLE_HEAD, pad_edge=False)
    for header in headers:
        longest = max(map(len, header.split()))
        table.add_column(
            Text(header, overflow='fold'), justify='left' if header in left else 'right', min_width=longest
        )
    return table


def show(table: Table) -> None:
    """Print a table; where the window is narrower than its words, lines run over instead of losing some."""
    console = Console()
    console.width = max(console.width, console.measure(table).minimum)
    console.print(table)
