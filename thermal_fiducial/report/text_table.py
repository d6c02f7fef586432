"""A table of text, for page and terminal."""

from collections.abc import Sequence
from dataclasses import dataclass

#: Most columns of a table that stands beside another one.
_NARROW = 4


@dataclass(frozen=True)
class Table:
    """A title, column heads with units, and rows of cells; ``words``: left-aligned text columns."""

    title: str
    heads: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]
    words: tuple[str, ...] = ('unit', 'status', 'why')

    def is_text(self, column: int) -> bool:
        """Whether a column contains text; the first one always does."""
        return column == 0 or self.heads[column] in self.words

    @property
    def is_wide(self) -> bool:
        """Whether the table takes the width of the page."""
        return len(self.heads) > _NARROW

    def of(self, columns: Sequence[int]) -> 'Table':
        """The table with some of the columns."""
        rows = [tuple(row[column] for column in columns) for row in self.rows]
        return Table(self.title, tuple(self.heads[column] for column in columns), rows, self.words)


def number(value: float | None, digits: int = 3) -> str:
    """``value`` with ``digits`` significant digits, trailing zeros too, without exponent; counts (int) in full."""
    if value is None:
        return '–'
    if isinstance(value, int) or value == 0.0:
        return f'{value:.0f}'
    text = f'{value:#.{digits}g}'
    if 'e+' in text:
        return f'{value:.0f}'
    return f'{value:.6f}'.rstrip('0').rstrip('.') if 'e-' in text else text.rstrip('.')
