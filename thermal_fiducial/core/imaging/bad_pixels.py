"""Dead, stuck and hot pixels of a bolometer array: detection in flight, and interpolation.

A pixel is bad when it stands out from all of its neighbours, or all but one. The scene cannot look like that: the point
spread of the lens distributes any hot point over neighbouring pixels, and on an edge or at the corner of a marker a
pixel has several neighbours of similar value.
"""

import cv2
import numpy as np

from thermal_fiducial.core.camera_frames import pixel_noise
from thermal_fiducial.core.types import BoolArray, Counts, IntArray
from thermal_fiducial.errors import InputError

# Least distance of a bad pixel from its neighbours, in multiples of their spread. A hot point of the scene, centred on
# a pixel behind a lens with a point spread of 0.6 px, reaches 4, but such points are few and carry no marker. The end
# of a fine line (roofs, masts in real frames) reaches 5 with respect to seven of its neighbours, so the limit is higher
# where one neighbour is excepted.
SPREADS_ALONE = 2
SPREADS_OF_TWO = 12

# Offsets of the neighbours (row, column).
_NEIGHBOURS = np.array([(row, column) for row in (-1, 0, 1) for column in (-1, 0, 1) if row or column])


class BadPixelFinder:
    """Finds pixels that do not follow the scene, from one frame in ``interval``.

    A frame votes for a pixel that exceeds (or falls below) its neighbours by ``SIGMAS`` times the noise and by
    a multiple of the neighbours' own spread; votes fade in the frames where it doesn't. A stuck pixel stands out as
    soon as the scene around it has changed.
    """

    VOTE = 4
    ENOUGH = 12
    SIGMAS = 8.0

    def __init__(self, shape: tuple[int, int], interval: int = 10) -> None:
        self._votes = np.zeros(shape, np.uint8)
        self._bad = np.zeros(shape, np.bool_)
        self._interval = interval
        self._frames = 0

    def add(self, counts: Counts) -> IntArray | None:
        """Add a live frame; returns the bad pixels (N, 2), column and row, if it may have changed them, else None."""
        self._frames += 1
        # All of the first frames are examined, so that bad pixels are found at once.
        if self._frames > self.ENOUGH // self.VOTE + 1 and self._frames % self._interval:
            return None
        noise = pixel_noise(counts)
        surroundings = np.asarray(cv2.medianBlur(counts, 3), np.uint16)
        outlying = _stands_out(counts, surroundings, self.SIGMAS * noise)
        self._votes -= self._votes > 0
        votes = self._votes.reshape(-1)
        votes[outlying] = np.minimum(votes[outlying] + self.VOTE + 1, 4 * self.ENOUGH)
        # Once bad, a pixel stays so until its last vote has faded.
        self._bad = (self._votes >= self.ENOUGH) | (self._bad & (self._votes > 0))
        rows, columns = np.divmod(np.flatnonzero(self._bad), counts.shape[1])
        return np.stack([columns, rows], axis=-1)


def _stands_out(counts: Counts, surroundings: Counts, margin_counts: float) -> IntArray:
    """Flat indices of the pixels outside the range of their neighbours by the margin and by their spread.

    ``surroundings``, the median of each pixel's neighbourhood, leaves few candidates.
    """
    width = counts.shape[1]
    # As whole numbers: numpy would make floating-point numbers of all pixels.
    candidates = np.flatnonzero(cv2.absdiff(counts, surroundings) > int(margin_counts))
    rows, columns = np.divmod(candidates, width)
    # Mirrored at the border, so that no pixel is its own neighbour.
    padded = cv2.copyMakeBorder(counts, 1, 1, 1, 1, cv2.BORDER_REFLECT_101)
    beside = padded.reshape(-1)[((rows + 1) * (width + 2) + columns + 1)[:, None] + _NEIGHBOURS @ (width + 2, 1)]
    beside = np.sort(beside.astype(np.int64), axis=1)
    value = counts.reshape(-1)[candidates].astype(np.int64)
    outlying = np.zeros(len(candidates), np.bool_)
    for excepted, spreads in ((0, SPREADS_ALONE), (1, SPREADS_OF_TWO)):
        for sign, ordered in ((1, beside), (-1, -beside[:, ::-1])):
            highest, lowest = ordered[:, 7 - excepted], ordered[:, excepted]
            outlying |= sign * value - highest > np.maximum(margin_counts, spreads * (highest - lowest))
    return np.asarray(candidates[outlying])


class BadPixelFiller:
    """Fills given pixels of every frame from their sound neighbours.

    Each is the median of these, so that an edge that passes a bad pixel keeps its place; inside of a cluster it is the
    nearest sound pixel.

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
        beside = np.clip(self.pixels[:, None, ::-1] + _NEIGHBOURS, 0, (height - 1, width - 1)) @ (width, 1)
        unsound = bad.reshape(-1)[beside]
        alone = unsound.all(axis=1)
        # Sound ones first, and again in place of the others, which hardly moves their median.
        sound_first = np.take_along_axis(beside, np.argsort(unsound, axis=1, kind='stable'), axis=1)
        number = np.maximum((~unsound).sum(axis=1, keepdims=True), 1)
        self._around = np.take_along_axis(sound_first, np.arange(len(_NEIGHBOURS)) % number, axis=1)
        if alone.any():
            self._around[alone] = _nearest_sound(bad, self._target[alone])[:, None]

    def fill(self, counts: Counts) -> None:
        """Replace the pixels of ``counts`` (a contiguous frame) in place."""
        if not len(self._target):
            return
        flat = counts.reshape(-1)
        # Half a count is rounded up.
        flat[self._target] = np.median(flat[self._around], axis=1) + 0.5


def _nearest_sound(bad: BoolArray, pixels: IntArray) -> IntArray:
    """Flat indices (N,) of the sound pixels nearest to ``pixels`` (N,)."""
    _, labels = cv2.distanceTransformWithLabels(
        bad.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    index, of_pixels = np.zeros(int(labels.max()) + 1, np.int64), labels.reshape(-1)
    sound = np.flatnonzero(~bad)
    index[of_pixels[sound]] = sound
    return np.asarray(index[of_pixels[pixels]])
