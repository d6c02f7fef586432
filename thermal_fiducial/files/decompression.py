"""Limits the decompression of bags, as 600 KB of zstd may expand to 20 GB of zeros.

rosbags expands chunks (mcap, ROS 1), messages and files (rosbag2) without a limit. It looks its decompressors up in
tables and modules, where :func:`bound_decompression` replaces them by limited ones.
"""

import bz2
from collections.abc import Callable, Iterator
from contextlib import contextmanager
import os
from typing import Any, BinaryIO

#: Largest accepted compression ratio; thermal images reach 4.
_LARGEST_RATIO = 200
#: Expanded size that is always accepted: small chunks, of empty messages say, may have a higher ratio.
_ALWAYS_BYTES = 32 << 20


def bound_decompression() -> None:
    """Let the readers of rosbags raise ValueError for data that expand beyond the limits."""
    from lz4.frame import LZ4FrameDecompressor
    from rosbags.rosbag1 import reader as ros1
    from rosbags.rosbag2 import reader as ros2
    from rosbags.rosbag2 import storage_mcap

    # Another version of the library may have its decompressors elsewhere; then there is no limit.
    module = vars(ros2).get('zstd')
    if module is None or isinstance(module, _BoundedZstd):
        return
    vars(ros2)['zstd'] = zstd = _BoundedZstd(module)
    getattr(storage_mcap, 'DECOMPRESSORS', {}).update(
        zstd=lambda data, _: zstd.decompress(data), lz4=lambda data, _: _expanded(LZ4FrameDecompressor, data)
    )
    getattr(ros1, 'decompressors', {}).update(
        lz4=lambda data: _expanded(LZ4FrameDecompressor, data), bz2=lambda data: _expanded(bz2.BZ2Decompressor, data)
    )


class _BoundedZstd:
    """The part of the module zstd that rosbags uses."""

    def __init__(self, zstd: Any) -> None:
        self._zstd = zstd

    def decompress(self, data: bytes) -> bytes:
        """Expand a message or chunk."""
        return _expanded(self._zstd.ZstdDecompressor, data)

    @contextmanager
    def open(self, file: BinaryIO, mode: str) -> 'Iterator[_BoundedFile]':
        """Expand a file."""
        with self._zstd.open(file, mode) as expanding:
            yield _BoundedFile(expanding, os.fstat(file.fileno()).st_size)


class _BoundedFile:
    """A file that is read once, sequentially."""

    def __init__(self, file: BinaryIO, compressed: int) -> None:
        self._file, self._compressed = file, compressed
        self._left = _limit(compressed)

    def read(self, size: int) -> bytes:
        """The next bytes."""
        data = self._file.read(size)
        self._left -= len(data)
        if self._left < 0:
            raise _too_much(self._compressed)
        return data


def _limit(compressed: int) -> int:
    return max(_ALWAYS_BYTES, _LARGEST_RATIO * compressed)


def _too_much(compressed: int) -> ValueError:
    return ValueError(f'{compressed} compressed bytes expand to more than {_limit(compressed)}')


def _expanded(decompressor: Callable[[], Any], data: bytes) -> bytes:
    """All zstd or lz4 frames of ``data``, expanded."""
    pieces, left, rest = [], _limit(len(data)), data
    while rest:
        frame = decompressor()
        pieces.append(frame.decompress(rest, left + 1))
        left -= len(pieces[-1])
        if left < 0:
            raise _too_much(len(data))
        if not frame.eof:
            raise ValueError(f'{len(data)} compressed bytes end too early')
        rest = frame.unused_data
    return b''.join(pieces)
