"""Bit patterns of n x n cells packed in 64-bit words, for the search of dictionaries.

Bit ``row * n + column`` of a word is cell (row, column); 1 is white, a hole.
"""

from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from thermal_fiducial.core.types import BoolArray, Gray, IntArray

Words: TypeAlias = npt.NDArray[np.uint64]
_ONE = np.uint64(1)


def unpack(words: Words, n: int) -> Gray:
    """Bits (N, n, n) of ``words`` (N,)."""
    shifts = np.arange(n * n, dtype=np.uint64)
    return ((words[:, None] >> shifts) & _ONE).astype(np.uint8).reshape(-1, n, n)


def pack(bits: Gray) -> Words:
    """Words (N,) of ``bits`` (N, n, n)."""
    n = bits.shape[-1]
    weights = _ONE << np.arange(n * n, dtype=np.uint64)
    return np.asarray(np.sum(bits.reshape(-1, n * n).astype(np.uint64) * weights, axis=1, dtype=np.uint64))


def rotate(words: Words, n: int) -> Words:
    """Words (N,) turned by 90 degrees counter-clockwise."""
    source = np.rot90(np.arange(n * n, dtype=np.uint64).reshape(n, n)).reshape(-1)
    turned = np.zeros_like(words)
    for target, origin in enumerate(source):
        turned |= ((words >> origin) & _ONE) << np.uint64(target)
    return turned


def rotations(words: Words, n: int) -> Words:
    """All four rotations (4, N) of ``words`` (N,)."""
    turned = [words]
    for _ in range(3):
        turned.append(rotate(turned[-1], n))
    return np.stack(turned)


def weight(words: Words) -> IntArray:
    """Number of set bits, any shape (the classic sum within growing fields)."""
    pairs = words - ((words >> _ONE) & np.uint64(0x5555555555555555))
    nibbles = (pairs & np.uint64(0x3333333333333333)) + ((pairs >> np.uint64(2)) & np.uint64(0x3333333333333333))
    octets = (nibbles + (nibbles >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return np.asarray((octets * np.uint64(0x0101010101010101)) >> np.uint64(56), dtype=np.int64)


def cuttable(words: Words, n: int) -> BoolArray:
    """Whether each of ``words`` (N,) is one piece of acrylic without holes that touch only at a point."""
    sound = ~_has_point_contact(words, n)
    sound[sound] = _in_one_piece(words[sound], n)
    return sound


def _columns(n: int, columns: range) -> int:
    return sum(1 << (row * n + column) for row in range(n) for column in columns)


def _has_point_contact(words: Words, n: int) -> BoolArray:
    """A window of 2 x 2 is a checkerboard when its rows differ in both columns and its columns in the upper row."""
    windows = np.uint64(_columns(n, range(n - 1)) & ((1 << n * (n - 1)) - 1))
    across, down = words ^ (words >> _ONE), words ^ (words >> np.uint64(n))
    return np.asarray((across & down & (down >> _ONE) & windows) != 0)


def _in_one_piece(words: Words, n: int) -> BoolArray:
    full = (1 << n * n) - 1
    left, right = _columns(n, range(1)), _columns(n, range(n - 1, n))
    border = np.uint64(left | right | (full >> n * (n - 1)) | (full & ~(full >> n)))
    not_left, not_right = np.uint64(full & ~left), np.uint64(full & ~right)
    row = np.uint64(n)
    acrylic = ~words & np.uint64(full)
    reached = acrylic & border
    while True:
        sideways = ((reached & not_right) << _ONE) | ((reached & not_left) >> _ONE)
        grown = (reached | sideways | (reached << row) | (reached >> row)) & acrylic
        if np.array_equal(grown, reached):
            return np.asarray(reached == acrylic)
        reached = grown
