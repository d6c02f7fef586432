"""Frames that a driver sends more than once: what that says of pauses of the camera."""

from collections import deque

from thermal_fiducial.core.frame_period import FramePeriod


class Pauses:
    """Period of new frames, and which new frames after a longer pause may still hold old counts.

    A driver may send each frame several times. The period is that of new frames: neither a shutter event nor the beat
    of two clocks (a frame now and then stands for two ticks of the driver) changes it. Frames are counted by their
    stamps: late ones from before the pause have nothing to settle.
    """

    #: Periods without anything new that are a pause. A frame that was lost makes two of one, an FFC of 0.35 s
    #: is 2.6 of the slowest cameras (7.5 Hz).
    LONG = 2.5

    def __init__(self) -> None:
        self._period = FramePeriod()
        #: whether old frames came since the last new one, and before each of the latest new ones
        self._old = False
        self._repeated: deque[bool] = deque(maxlen=FramePeriod.INTERVALS)
        self._paused = False
        self._left = 0
        self._paused_ns = self._settled_ns = 0

    def add_new(self, stamp_ns: int) -> bool:
        """Log a new frame; whether it may still hold old counts."""
        self._period.add(stamp_ns)
        self._repeated.append(self._old)
        self._old = self._paused = False
        if stamp_ns < self._paused_ns:
            return False
        if self._left == 0:
            return stamp_ns < self._settled_ns
        self._left -= 1
        self._settled_ns = max(stamp_ns, self._settled_ns)
        return True

    def add_old(self, stamp_ns: int, settling: int) -> None:
        """Log a repeated or shutter frame; after a longer pause the next ``settling`` new frames are withheld.

        A few repeated frames are a driver that runs faster than the camera. After a longer pause the first new frame
        may still hold old counts: in the bolometers, which lag, and in the driver's buffers.
        """
        self._old, newest_ns = True, self._period.newest_ns
        if newest_ns is not None and stamp_ns - newest_ns > self.LONG * self._period.ns:
            self._paused, self._paused_ns, self._left = True, max(stamp_ns, self._paused_ns), settling

    @property
    def repeating(self) -> bool:
        """Whether the driver repeats frames at present, as it is faster than the camera."""
        return not self._paused and len(self._repeated) == FramePeriod.INTERVALS and all(self._repeated)
