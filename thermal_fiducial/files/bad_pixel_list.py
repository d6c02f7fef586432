"""Lists of bad pixels: a text file with one "column row" per line; ``#`` starts a comment."""

from pathlib import Path
import re

import numpy as np

from thermal_fiducial.core.types import IntArray
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.reading import TEXT_LIMIT_BYTES, text_lines

_WHOLE = re.compile(r'[0-9]{1,6}')


def load_bad_pixels(path: str | Path) -> IntArray:
    """Pixels (N, 2) as column, row.

    Raises
    ------
    InputError
        Unreadable, or a line that is not two non-negative integers.
    """
    try:
        lines = list(text_lines(path, TEXT_LIMIT_BYTES))
    except InputError as error:
        raise InputError(f'bad pixel list {error}') from None
    pixels = [_pixel(path, number, line) for number, line in lines if line.partition('#')[0].strip()]
    return np.array(pixels, dtype=np.int64).reshape(-1, 2)


def _pixel(path: str | Path, number: int, line: str) -> tuple[int, int]:
    words = line.partition('#')[0].replace(',', ' ').split()
    if len(words) != 2 or not all(_WHOLE.fullmatch(word) for word in words):
        raise InputError(f'bad pixel list {path}, line {number}: {line[:60]!r} is not "column row"')
    return int(words[0]), int(words[1])
