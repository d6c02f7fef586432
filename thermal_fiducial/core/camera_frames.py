"""What the frames of a camera show of it: the period by their stamps; by their counts, noise and pattern of columns."""

from collections import deque
import math

import cv2
import numpy as np

from thermal_fiducial.core.types import Float32Array, Pixels, SIGMA_OF_MEDIAN

# Columns among which one is compared with their mean.
_COLUMNS = 9
# Rows whose steps are added up at once: they stay in the caches, in three fifths of the time of a whole frame's.
_ROWS = 64
# Mean of Gaussian noise clipped at one standard deviation moves by the share of it within, 0.68, of a small offset.
_CLIPPED = 1.0 / math.erf(math.sqrt(0.5))
# Steps [their noise] of which clipping leaves less than a twentieth; recorded frames of three cameras have a fifth in
# the mean, simulated ones a third. Largest number of rounds: with five, columns may differ by seven times their noise.
_PROPORTIONAL, _ROUNDS = 0.5, 5


def pixel_noise(counts: Pixels) -> float:
    """Standard deviation of pixel noise [counts]: median absolute difference of vertical neighbours, sparsely.

    Differences along a column do not contain the column pattern. With whole counts and noise below half a count the
    median may be 0; the result is half a count then.
    """
    rows = counts[4::16]
    below = counts[5::16]
    count = min(len(rows), len(below))
    difference = cv2.absdiff(rows[:count], below[:count])[:, ::3].ravel()
    middle = difference.size // 2
    # Whole numbers digit by digit, in a third of the time of a partition.
    ordered = np.sort(difference, kind='stable') if difference.dtype.kind == 'u' else np.partition(difference, middle)
    return max(float(ordered[middle]) * SIGMA_OF_MEDIAN / math.sqrt(2.0), 0.5)


def with_columns_corrected(counts: Float32Array, noise: float) -> Float32Array:
    """``counts`` without the fixed-pattern offsets of its columns from their neighbours, in place.

    The steps from column to column, clipped at their noise so that the scene has little influence, add up to the
    pattern. Of their sum, only what differs between neighbouring columns is certain. Of steps that are larger than
    their noise clipping leaves a part, which is taken out in turn (Newton's method for a Huber mean).
    """
    limit = np.float32(math.sqrt(2.0) * noise)
    for _ in range(_ROUNDS):
        steps = _mean_steps(counts, limit)
        offsets = np.pad(np.cumsum(steps, axis=1), ((0, 0), (1, 0)))
        np.subtract(counts, offsets - cv2.blur(offsets, (_COLUMNS, 1)), out=counts)
        if np.abs(steps).mean() < _PROPORTIONAL * limit:
            break
    return counts


def _mean_steps(counts: Float32Array, limit: np.float32) -> Float32Array:
    """Mean steps (1, width - 1) from each column to the next, of which each is clipped at ``limit``."""
    steps = np.zeros((1, counts.shape[1] - 1), dtype=np.float32)
    for rows in np.split(counts, range(_ROWS, len(counts), _ROWS)):
        clipped = cv2.subtract(rows[:, 1:], rows[:, :-1])
        np.clip(clipped, -limit, limit, out=clipped)
        steps += cv2.reduce(clipped, 0, cv2.REDUCE_SUM)
    return np.multiply(steps, _CLIPPED / len(counts), out=steps)


class FramePeriod:
    """Period of a camera's frames, for all that waits for a frame or counts lost ones.

    It is the median of the latest intervals between frames, so that lost frames and pauses do not change it.

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
