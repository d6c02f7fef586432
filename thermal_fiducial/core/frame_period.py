"""Period of a camera's frames by their stamps, for all that waits for a frame or counts lost ones."""

from collections import deque


class FramePeriod:
    """The median of the latest intervals between frames, so that lost frames and pauses do not change it.

    Of an even number it is the lower one: a pause makes intervals longer, nothing makes them shorter.
    """

    #: Of a Tau 2 at full rate: until a second frame has come.
    ASSUMED_NS = 33_333_333
    INTERVALS = 9

    def __init__(self) -> None:
        #: newest stamp; None before the first frame
        self.newest_ns: int | None = None
        self._intervals_ns: deque[int] = deque(maxlen=self.INTERVALS)

    def add(self, stamp_ns: int) -> None:
        """Log a frame; a late one is no measure of the period."""
        if self.newest_ns is not None and stamp_ns > self.newest_ns:
            self._intervals_ns.append(stamp_ns - self.newest_ns)
        self.newest_ns = stamp_ns if self.newest_ns is None else max(stamp_ns, self.newest_ns)

    @property
    def ns(self) -> int:
        """The period [ns]."""
        if not self._intervals_ns:
            return self.ASSUMED_NS
        return sorted(self._intervals_ns)[(len(self._intervals_ns) - 1) // 2]
