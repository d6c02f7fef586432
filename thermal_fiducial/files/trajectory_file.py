"""TUM trajectories: ``timestamp tx ty tz qx qy qz qw`` a line, stamps exact to the nanosecond."""

from collections.abc import Iterable
from decimal import Decimal, InvalidOperation
import math
from pathlib import Path

import numpy as np

from thermal_fiducial.core.types import FloatArray, IntArray, SECOND_NS
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.reading import text_lines
from thermal_fiducial.files.writing import write_text

# Range of int64 nanoseconds [s]: the year 2262.
_LATEST_S = 9_200_000_000
# Limit of a position [m], as in the messages.
_LARGEST = 1e5
# Two hours at 200 Hz have 140 MB.
_LIMIT_BYTES = 500_000_000


def tum_line(stamp_ns: int, position: Iterable[float], orientation_xyzw: Iterable[float]) -> str:
    """One line without newline: stamp and values with nine decimals."""
    seconds, rest = divmod(int(stamp_ns), SECOND_NS)
    values = ' '.join(f'{float(value):.9f}' for value in (*position, *orientation_xyzw))
    return f'{seconds}.{rest:09d} {values}'


def save_tum(path: str | Path, stamps_ns: Iterable[int], positions: FloatArray, quaternions: FloatArray) -> None:
    """Write poses: stamps (N,), positions (N, 3) [m], quaternions x y z w (N, 4).

    Raises
    ------
    InputError
        The file cannot be written.
    """
    lines = [tum_line(*pose) for pose in zip(stamps_ns, positions, quaternions, strict=True)]
    write_text(path, ''.join(line + '\n' for line in lines))


def load_tum(path: str | Path) -> tuple[IntArray, FloatArray, FloatArray]:
    """Stamps [ns] (N,), positions (N, 3) [m] and unit quaternions x y z w (N, 4) of a TUM file.

    Values may be separated by blanks or commas; lines that start with ``#`` are comments.

    Raises
    ------
    InputError
        Unreadable, empty, a line other than eight finite numbers, a zero quaternion, decreasing stamps, or a heading
        that has the quaternion in another order.
    """
    numbers: list[int] = []
    rows: list[tuple[int, list[float]]] = []
    for number, line in text_lines(path, _LIMIT_BYTES):
        if line[0] == '#':
            _require_w_last(path, number, line)
        else:
            numbers.append(number)
            rows.append(_row(path, number, line))
    if not rows:
        raise InputError(f'{path}: no poses')
    stamps = np.array([stamp for stamp, _ in rows], dtype=np.int64)
    back = np.flatnonzero(np.diff(stamps) < 0)
    if len(back):
        raise InputError(f'{path} line {numbers[back[0] + 1]}: the stamp goes back')
    values = np.array([row for _, row in rows])
    quaternions = values[:, 3:]
    return stamps, values[:, :3], quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)


def _require_w_last(path: str | Path, number: int, comment: str) -> None:
    """Raise InputError for a heading of columns that has qw before qx: values are known by their places."""
    names = comment.lstrip('# ').replace(',', ' ').split()
    if {'qw', 'qx'} <= set(names) and names.index('qw') < names.index('qx'):
        raise InputError(f'{path} line {number}: qw before qx; a pose is timestamp tx ty tz qx qy qz qw')


def _row(path: str | Path, number: int, line: str) -> tuple[int, list[float]]:
    words = line.replace(',', ' ').split()
    try:
        seconds, values = Decimal(words[0]), [float(word) for word in words[1:]]
        is_stamp = abs(seconds) < _LATEST_S
    except (IndexError, InvalidOperation, ValueError):
        raise InputError(f'{path} line {number}: not numbers') from None
    if not is_stamp:
        raise InputError(f'{path} line {number}: {words[0][:40]} is no stamp')
    if len(values) != 7 or not all(abs(value) < _LARGEST for value in values):
        raise InputError(f'{path} line {number}: {len(words)} values, or no real ones; a pose has 8')
    if math.hypot(*values[3:]) < 1e-6:
        raise InputError(f'{path} line {number}: a quaternion of no length')
    return int((seconds * SECOND_NS).to_integral_value()), values
