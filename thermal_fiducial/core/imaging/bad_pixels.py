"""Dead, stuck and hot pixels of a bolometer array: detection in flight, and interpolation.

A pixel is bad when it stands out from all of its neighbours, or all but one. The scene cannot look like that: the point
spread of the lens distributes any hot point over neighbouring pixels, and on an edge or at the corner of a marker a
pixel has several neighbours of similar value.
"""

import cv2
import numpy as np

from thermal_fiducial.core.pixel_noise import pixel_noise
from thermal_fiducial.core.types import BoolArray, Counts, IntArray
from thermal_fiducial.errors import InputError

# Least distance of a bad pixel from its neighbours, in multiples of their spread. A hot point of the scene, centred on
# a pixel behind a lens with a point spread of 0.6 px, reaches 4, but such points are few and carry no marker. The end
# of a fine line (roofs, masts in real frames) reaches 5 with respect to seven of its neighbours, so the limit is higher
# where one neighbour is excepted.
SPREADS_ALONE = 2
SPREADS_OF_TWO = 12

# Opposite neighbours (row, column), near ones first: the pixel lies in the middle of each pair.
_PAIRS = np.array([(0, 1), (1, 0), (1, 1), (1, -1), (0, 2), (2, 0), (2, 2), (2, -2), (1, 2), (2, 1), (1, -2), (2, -1)])
_NEAR_PAIRS = 4
# Added to the difference of a far pair, so that it is used only if no near one is sound.
_FAR_PENALTY_COUNTS = 1 << 16


class _Window:
    """Constancy of pixels and changes of their surroundings over some frames."""

    def __init__(self, counts: Counts, surroundings: Counts) -> None:
        self._first, self._lowest, self._highest = counts.copy(), surroundings.copy(), surroundings.copy()
        # At the ends of the scale sound pixels keep their value too, for example at the corner of a clipped marker.
        #: pixels that have kept one value
        self.constant = (counts > counts.min()) & (counts < counts.max())
        self.frames = 0

    def add(self, counts: Counts, surroundings: Counts) -> None:
        """Take one frame, and the median of the surroundings of each of its pixels."""
        self.constant &= counts == self._first
        np.minimum(self._lowest, surroundings, out=self._lowest)
        np.maximum(self._highest, surroundings, out=self._highest)
        self.frames += 1

    def moved(self, margin_counts: float) -> BoolArray:
        """Pixels whose surroundings changed by more than a margin."""
        return np.asarray(cv2.subtract(self._highest, self._lowest) > margin_counts, np.bool_)


class BadPixelFinder:
    """Finds pixels that do not follow the scene, from one frame in ``interval``.

    A frame votes for a pixel that exceeds (or falls below) its neighbours by ``sigmas`` times the noise and by
    a multiple of the neighbours' own spread; votes fade in the frames where it doesn't. A pixel that keeps one value
    while the scene around it changes is stuck, whatever stands beside it.
    """

    VOTE = 4
    ENOUGH = 12
    WINDOW = 16

    def __init__(self, shape: tuple[int, int], interval: int = 10, sigmas: float = 8.0) -> None:
        self._votes = np.zeros(shape, np.uint8)
        self._stuck = np.zeros(shape, np.bool_)
        self._bad = np.zeros(shape, np.bool_)
        self._interval = interval
        self._sigmas = sigmas
        self._frames = 0
        self._window: _Window | None = None

    def add(self, counts: Counts) -> IntArray | None:
        """Add a live frame; returns the bad pixels (N, 2), column and row, if it may have changed them, else None."""
        self._frames += 1
        # All of the first frames are examined, so that bad pixels are found at once.
        if self._frames > self.ENOUGH // self.VOTE + 1 and self._frames % self._interval:
            return None
        noise = pixel_noise(counts)
        surroundings = np.asarray(cv2.medianBlur(counts, 3), np.uint16)
        outlying = _stands_out(counts, surroundings, self._sigmas * noise)
        self._votes -= self._votes > 0
        votes = self._votes.reshape(-1)
        votes[outlying] = np.minimum(votes[outlying] + self.VOTE + 1, 4 * self.ENOUGH)
        self._watch(counts, surroundings, self._sigmas * noise)
        # Once bad, a pixel stays so until its last vote has faded.
        self._bad = (self._votes >= self.ENOUGH) | (self._bad & (self._votes > 0)) | self._stuck
        rows, columns = np.divmod(np.flatnonzero(self._bad), counts.shape[1])
        return np.stack([columns, rows], axis=-1)

    def _watch(self, counts: Counts, surroundings: Counts, moved_counts: float) -> None:
        """Mark pixels that kept one value over a window in which the median of their surroundings moved."""
        window = self._window = self._window or _Window(counts, surroundings)
        window.add(counts, surroundings)
        if window.frames == self.WINDOW:
            # A scene at rest is no evidence: its pixels keep their state.
            self._stuck = np.where(window.moved(moved_counts), window.constant, self._stuck & window.constant)
            self._window = None


def _stands_out(counts: Counts, surroundings: Counts, margin_counts: float) -> IntArray:
    """Flat indices of the pixels outside the range of their neighbours by the margin and by their spread.

    ``surroundings``, the median of each pixel's neighbourhood, leaves few candidates.
    """
    width = counts.shape[1]
    candidates = np.flatnonzero(cv2.absdiff(counts, surroundings) > margin_counts)
    rows, columns = np.divmod(candidates, width)
    # Mirrored at the border, so that no pixel is its own neighbour.
    padded = cv2.copyMakeBorder(counts, 1, 1, 1, 1, cv2.BORDER_REFLECT_101)
    beside = padded.reshape(-1)[((rows + 1) * (width + 2) + columns + 1)[:, None] + _ring(width + 2)]
    beside = np.sort(beside.astype(np.int64), axis=1)
    value = counts.reshape(-1)[candidates].astype(np.int64)
    outlying = np.zeros(len(candidates), np.bool_)
    for excepted, spreads in ((0, SPREADS_ALONE), (1, SPREADS_OF_TWO)):
        for sign, ordered in ((1, beside), (-1, -beside[:, ::-1])):
            highest, lowest = ordered[:, 7 - excepted], ordered[:, excepted]
            outlying |= sign * value - highest > np.maximum(margin_counts, spreads * (highest - lowest))
    return np.asarray(candidates[outlying])


def _ring(stride: int) -> IntArray:
    """Flat offsets (8,) of the neighbours."""
    return np.array([row * stride + column for row in (-1, 0, 1) for column in (-1, 0, 1) if row or column])


class BadPixelFiller:
    """Fills given pixels of every frame from their sound neighbours.

    Each is the mean of that pair of opposite neighbours that differ least: the pair along an edge, so an edge that
    passes a bad pixel keeps its place.

    Parameters
    ----------
    pixels : (N, 2) column, row
    shape : height and width of the frames

    Raises
    ------
    InputError
        A pixel outside the frame, or more than a tenth of the frame.
    """

    def __init__(self, pixels: IntArray, shape: tuple[int, int]) -> None:
        pixels = np.asarray(pixels, dtype=np.int64).reshape(-1, 2)
        height, width = shape
        outside = np.any((pixels < 0) | (pixels >= (width, height)), axis=1)
        if np.any(outside):
            column, row = pixels[np.argmax(outside)]
            raise InputError(f'bad pixel {column} {row} lies outside the {width}x{height} frame')
        if 10 * len(pixels) > height * width:
            raise InputError(f'{len(pixels)} bad pixels are more than a tenth of the frame')
        bad = np.zeros(shape, np.bool_)
        bad[pixels[:, 1], pixels[:, 0]] = True
        rows, columns = np.nonzero(bad)
        self.pixels: IntArray = np.stack([columns, rows], axis=-1)
        self._target = rows * width + columns
        self._first, self._second, self._penalty = _sound_pairs(rows, columns, bad)

    def fill(self, counts: Counts) -> None:
        """Replace the pixels of ``counts`` (a contiguous frame) in place."""
        if not len(self._target):
            return
        flat = counts.reshape(-1)
        first, second = flat[self._first].astype(np.int32), flat[self._second].astype(np.int32)
        best = np.argmin(np.abs(first - second) + self._penalty, axis=1)[:, None]
        total = np.take_along_axis(first, best, axis=1) + np.take_along_axis(second, best, axis=1)
        flat[self._target] = (total[:, 0] + 1) // 2


def _sound_pairs(rows: IntArray, columns: IntArray, bad: BoolArray) -> tuple[IntArray, IntArray, IntArray]:
    """Flat indices (N, P) of the two ends of each pair, and a penalty (N, P) that keeps unsound pairs out."""
    height, width = bad.shape
    unsound = 1 << 20
    ends, usable = [], np.ones((len(rows), len(_PAIRS)), np.bool_)
    for sign in (1, -1):
        r, c = rows[:, None] + sign * _PAIRS[:, 0], columns[:, None] + sign * _PAIRS[:, 1]
        usable &= (r >= 0) & (r < height) & (c >= 0) & (c < width)
        r, c = np.clip(r, 0, height - 1), np.clip(c, 0, width - 1)
        usable &= ~bad[r, c]
        ends.append(r * width + c)
    penalty = np.where(usable, 0, unsound)
    penalty[:, _NEAR_PAIRS:] += _FAR_PENALTY_COUNTS
    # At the border and inside clusters no pair may be whole: the nearest sound pixel stands in for both ends.
    lone = ~usable.any(axis=1)
    if lone.any():
        ends[0][lone, 0] = ends[1][lone, 0] = _nearest_sound(bad, rows[lone], columns[lone])
        penalty[lone, 0] = 0
    return ends[0], ends[1], penalty


def _nearest_sound(bad: BoolArray, rows: IntArray, columns: IntArray) -> IntArray:
    """Flat indices of the sound pixels nearest to those at ``rows`` and ``columns``."""
    _, labels = cv2.distanceTransformWithLabels(
        bad.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    index = np.zeros(int(labels.max()) + 1, np.int64)
    sound = np.flatnonzero(~bad)
    index[labels.reshape(-1)[sound]] = sound
    return np.asarray(index[labels[rows, columns]])
