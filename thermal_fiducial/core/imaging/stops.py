"""When a stream of frames stands still: repeated frames, the closed shutter, and what settles after either.

Shutter behaviour follows the FLIR Tau 2 user's manual: during a flat-field correction (FFC, under half a second) a
digital stream repeats the last frame, shows the shutter, or pauses, depending on the driver.
"""

from collections import deque

import cv2
import numpy as np

from thermal_fiducial.core.imaging.bad_pixels import pixel_noise
from thermal_fiducial.core.types import Counts


class Pauses:
    """How often the camera shows something new, and which new frames after a longer pause may still hold old counts.

    A driver may send each frame several times. The period is the median of the last intervals between new frames, so
    that neither a shutter event nor the beat of two clocks (a frame now and then stands for two ticks of the driver)
    changes it. Frames are counted by their stamps: late ones from before the pause have nothing to settle.
    """

    #: Of a Tau 2 at full rate: until a second frame has come.
    ASSUMED_NS = 33_333_333
    INTERVALS = 9
    #: Periods without anything new that are a pause. A frame that was lost makes two of one, an FFC of 0.35 s
    #: is 2.6 of the slowest cameras (7.5 Hz).
    LONG = 2.5

    def __init__(self) -> None:
        self._newest_ns: int | None = None
        self._intervals_ns: deque[int] = deque(maxlen=self.INTERVALS)
        self._left = 0
        self._paused_ns = self._settled_ns = 0

    def add_new(self, stamp_ns: int) -> bool:
        """Take in a frame that shows something new; whether it may still hold old counts all the same."""
        # Late ones say nothing of the rate.
        if self._newest_ns is not None and stamp_ns > self._newest_ns:
            self._intervals_ns.append(stamp_ns - self._newest_ns)
        self._newest_ns = stamp_ns if self._newest_ns is None else max(stamp_ns, self._newest_ns)
        if stamp_ns < self._paused_ns:
            return False
        if self._left == 0:
            return stamp_ns < self._settled_ns
        self._left -= 1
        self._settled_ns = max(stamp_ns, self._settled_ns)
        return True

    def add_old(self, stamp_ns: int, settling: int) -> None:
        """Take in a frame that shows nothing new; after a longer pause withhold the next ``settling`` that do.

        A few repeated frames are a driver that runs faster than the camera. After a longer pause the first new frame
        may still hold old counts: in the bolometers, which lag, and in the driver's buffers.
        """
        period = (
            sorted(self._intervals_ns)[(len(self._intervals_ns) - 1) // 2] if self._intervals_ns else self.ASSUMED_NS
        )
        if self._newest_ns is not None and stamp_ns - self._newest_ns > self.LONG * period:
            self._paused_ns, self._left = max(stamp_ns, self._paused_ns), settling


class FreezeDetector:
    """Recognises repeated counts: noise never lets two frames of a living bolometer array agree."""

    ROW_STEP = 8
    # So many rows repeated are a frame torn between old and new. Eight bits may be too coarse to show the noise, so
    # there a row may repeat without being old, but not all of them.
    TORN = 0.25
    TORN_8_BIT = 0.999

    def __init__(self) -> None:
        # As many as a driver has buffers: one that gets nothing new may send them in turn.
        self._recent: deque[Counts] = deque(maxlen=4)

    def repeats(self, image: Counts, *, coarse: bool) -> bool:
        """Whether an image, or a good part of it, was sent before; ``coarse``: it came as 8 bits."""
        sample = image[:: self.ROW_STEP].copy()
        torn = self.TORN_8_BIT if coarse else self.TORN
        repeated = any(_repeated_rows(sample, earlier) > torn for earlier in self._recent)
        if not repeated:
            self._recent.append(sample)
        return repeated


def _repeated_rows(sample: Counts, earlier: Counts) -> float:
    """Share of the rows that repeat, of those that could change: clipped ones at the end of the scale can't."""
    # Of rows with noise hardly any begin alike; the others need no look at the rest.
    same = sample[:, 0] == earlier[:, 0]
    same[same] = np.all(sample[same] == earlier[same], axis=1)
    if not same.any():
        return 0.0
    clipped = sample.max(axis=1) == sample.min(axis=1)
    return float(np.mean(same if clipped.all() else same[~clipped]))


class ShutterDetector:
    """Recognises the closed shutter: from one frame to the next all structure is gone."""

    FLAT_SIGMAS = 4.0
    COLLAPSE = 0.25
    # The longest that a shutter stays closed; after it a flat picture is taken for a flat scene.
    LONGEST_NS = 1_500_000_000
    SMOOTHING = 0.2
    # Fewer pixels have too few patches (8x8 px) to distinguish structure from noise.
    LEAST_PIXELS = 50 * 64

    def __init__(self) -> None:
        self._live_structure: float | None = None
        self._closed_ns: int | None = None

    def closed(self, stamp_ns: int, image: Counts) -> bool:
        """Whether an image shows the shutter."""
        if image.size < self.LEAST_PIXELS:
            return False
        structure = _structure(image)
        before = self._live_structure
        collapsed = before is not None and structure < self.COLLAPSE * before
        if collapsed and structure < self.FLAT_SIGMAS * pixel_noise(image):
            self._closed_ns = stamp_ns if self._closed_ns is None else self._closed_ns
            if stamp_ns - self._closed_ns < self.LONGEST_NS:
                return True
            before = None
        self._closed_ns = None
        self._live_structure = structure if before is None else before + self.SMOOTHING * (structure - before)
        return False


def _structure(image: Counts) -> float:
    """Steps between neighbouring patches [counts]: the tenth largest, so that a small marker is enough.

    The median takes out bad pixels, the mean most of the noise.
    """
    patches = cv2.resize(cv2.medianBlur(np.ascontiguousarray(image[::4, ::4]), 3), None, fx=0.5, fy=0.5)
    steps = np.abs(np.diff(patches.astype(np.int32), axis=0)).ravel()
    steps = np.concatenate([steps, np.abs(np.diff(patches.astype(np.int32), axis=1)).ravel()])
    return float(np.partition(steps, -10)[-10])
