"""CSV files line by line, with line numbers for error messages."""

from collections.abc import Iterator, Sequence
import csv
from pathlib import Path

from thermal_fiducial.errors import InputError
from thermal_fiducial.files.reading import text_lines

#: Largest file [bytes]: half a day of frames with eight markers each.
TABLE_LIMIT_BYTES = 1 << 30


def csv_rows(path: str | Path) -> Iterator[tuple[int, list[str]]]:
    """Number and cells of each line that is not blank.

    Raises
    ------
    InputError
        Unreadable, or not a text file.
    """
    for number, line in text_lines(path, TABLE_LIMIT_BYTES):
        # Line by line: an unclosed quotation mark ends with its line instead of swallowing the file.
        cells = next(csv.reader([line.replace('\r', ' ')])) if '"' in line else line.split(',')
        yield number, [cell.strip() for cell in cells]


def named_rows(path: str | Path, names: Sequence[str]) -> Iterator[tuple[int, list[str]]]:
    """Number of each line after the header, and its cells in the columns ``names``.

    Raises
    ------
    InputError
        As :func:`csv_rows`, a missing column, or a line that is too short.
    """
    rows = csv_rows(path)
    _, head = next(rows, (0, []))
    if missing := [name for name in names if name not in head]:
        raise InputError(f'{path}: line 1: no column {", ".join(missing)}')
    columns = [head.index(name) for name in names]
    for number, cells in rows:
        if len(cells) <= max(columns):
            raise InputError(f'{path}: line {number}: {len(cells)} values of {len(head)}')
        yield number, [cells[column] for column in columns]
