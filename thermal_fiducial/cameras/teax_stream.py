"""Frames out of the byte stream of a TeAx ThermalGrabber, which may lose bytes or hold garbage.

A frame is ``TEAX``, the number of 16-bit words as a little-endian uint32, and so many little-endian words. Pixels of
14 bits have both upper bits set (line and frame valid); all other words are blanking or a time stamp: with 640 x 512
pixels one before and one behind each row, and one first of all. So the width is the length of a run of pixels, and as
every other byte of a row is at least 0xC0, no frame can hold the magic: where it comes early, bytes are missing.

The layout follows flirpy's ``TeaxGrabber`` and the manufacturer's libthermalgrabber.
"""

from collections import Counter, deque

import numpy as np

from thermal_fiducial.cameras.source import CapturedFrame
from thermal_fiducial.core.types import Counts

MAGIC = b'TEAX'
_HEADER_BYTES = 8
_PIXEL_FLAGS, _COUNTS = 0xC000, 0x3FFF
#: Range of a frame's words: the smallest core is 160 x 120, none is larger than 1024 x 1024.
_SMALLEST, _LARGEST = 160 * 120, 1 << 20
#: Sizes of Tau 2 and Quark cores (width, height), for streams without blanking between the rows.
_KNOWN_SIZES = ((640, 512), (640, 480), (336, 256), (324, 256), (160, 128), (160, 120))


class TeaxStream:
    """Assembles complete frames from received bytes; everything else is dropped and counted.

    Parameters
    ----------
    size : (width, height) that frames must have; None: that of the first frame, until two in a row have another one
    events : where what is dropped is counted; None: a counter of its own
    """

    def __init__(self, size: tuple[int, int] | None = None, events: Counter[str] | None = None) -> None:
        self.events: Counter[str] = Counter() if events is None else events
        self._fixed = size is not None
        self._size = size
        self._other_size: tuple[int, int] | None = None
        self._buffer = bytearray()
        #: bytes of the buffer that hold no magic but a first one
        self._searched = 0
        #: bytes of the stream before the buffer
        self._dropped = 0
        #: (bytes of the stream so far, when they had come [ns])
        self._arrivals: deque[tuple[int, int]] = deque()

    def feed(self, data: bytes, stamp_ns: int) -> list[CapturedFrame]:
        """Frames that ``data`` completes; their stamps are the arrival times of their headers.

        Parameters
        ----------
        data : next bytes of the stream, of any number; none says that nothing had come until ``stamp_ns``
        stamp_ns : when the last of them had come
        """
        self._buffer += data
        self._arrivals.append((self._dropped + len(self._buffer), stamp_ns))
        frames: list[CapturedFrame] = []
        while self._skip_to_magic() and (length := self._frame_length()):
            payload = np.frombuffer(self._buffer[_HEADER_BYTES:length], '<u2')
            counts = self._accepted(_pixels(payload, self._size))
            if counts is not None:
                frames.append(CapturedFrame(self._stamp_of(self._dropped), counts))
            self._drop(length - _begun_magic(self._buffer, length))
        while len(self._arrivals) > 1 and self._arrivals[1][0] <= self._dropped:
            self._arrivals.popleft()
        return frames

    def _skip_to_magic(self) -> bool:
        """Whether the buffer begins with a header; what comes before one is dropped."""
        at = self._buffer.find(MAGIC)
        if at < 0:
            self._skip(max(0, len(self._buffer) - len(MAGIC) + 1))
            return False
        self._skip(at)
        return len(self._buffer) >= _HEADER_BYTES

    def _frame_length(self) -> int:
        """Bytes of the frame at the beginning of the buffer; 0 while it is incomplete.

        A frame that the next magic cuts short is dropped, and the next one looked at.
        """
        while len(self._buffer) >= _HEADER_BYTES:
            words = int.from_bytes(self._buffer[4:_HEADER_BYTES], 'little')
            length = _HEADER_BYTES + 2 * words
            plausible = _SMALLEST <= words <= _LARGEST
            following = self._following_magic(length) if plausible else -1
            if plausible and following < 0:
                return length if len(self._buffer) >= length else 0
            self.events['short frames' if plausible else 'scrambled frames'] += 1
            self._drop(following if plausible else len(MAGIC))
            if not self._skip_to_magic():
                break
        return 0

    def _following_magic(self, end: int) -> int:
        """Where in the buffer before ``end`` another magic is, -1 if there is none; no byte is looked at twice."""
        at = self._buffer.find(MAGIC, max(len(MAGIC), self._searched - len(MAGIC) + 1), end)
        self._searched = at if at >= 0 else min(len(self._buffer), end)
        return at

    def _accepted(self, counts: Counts | None) -> Counts | None:
        """``counts`` if they have the expected size, else None."""
        if counts is None:
            self.events['scrambled frames'] += 1
            return None
        height, width = counts.shape
        size = width, height
        confirmed = self._size is None or size == self._other_size
        self._other_size = size
        if confirmed and not self._fixed:
            self._size = size
        if size == self._size:
            return counts
        self.events['frames of another size'] += 1
        return None

    def _stamp_of(self, position: int) -> int:
        """Arrival time of the byte at ``position`` of the stream, interpolated between two reads."""
        before = self._arrivals[0]
        for after in self._arrivals:
            if after[0] > position:
                break
            before = after
        (start, start_ns), (end, end_ns) = before, after
        return start_ns + (end_ns - start_ns) * (position - start) // (end - start) if end > start else start_ns

    def _skip(self, count: int) -> None:
        if count:
            self.events['skipped bytes'] += count
            self._drop(count)

    def _drop(self, count: int) -> None:
        del self._buffer[:count]
        self._dropped += count
        self._searched = max(0, self._searched - count)


def _begun_magic(buffer: bytearray, end: int) -> int:
    """How many bytes before ``end`` may be the first of a magic: a word was lost, and the next header came early."""
    return next((count for count in (3, 2, 1) if buffer[end - count : end] == MAGIC[:count]), 0)


def _pixels(words: 'np.ndarray[tuple[int], np.dtype[np.uint16]]', size: tuple[int, int] | None) -> Counts | None:
    """(H, W) counts of a frame's words; None where its rows differ in length."""
    valid = words >= _PIXEL_FLAGS
    edges = np.flatnonzero(np.diff(valid, prepend=False, append=False))
    starts, lengths = edges[::2], edges[1::2] - edges[::2]
    if not lengths.size or np.any(lengths != lengths[0]):
        return None
    pitches = np.diff(starts)
    if pitches.size:
        if np.any(pitches != pitches[0]):
            return None
        rows = np.lib.stride_tricks.sliding_window_view(words, int(lengths[0]))[starts[0] : starts[-1] + 1 : pitches[0]]
        return np.bitwise_and(rows, _COUNTS, dtype=np.uint16)
    counts = np.bitwise_and(words[valid], _COUNTS, dtype=np.uint16)
    for width, height in _KNOWN_SIZES if size is None else (size, *_KNOWN_SIZES):
        if counts.size == width * height:
            return counts.reshape(height, width)
    return None
