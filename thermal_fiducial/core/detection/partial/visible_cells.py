"""Likeness of a partially visible marker to its pattern, by its visible cells.

At such short distances the array's shading and a heater's gradient vary as much across a marker as a faint pattern
does. Therefore not the cells are correlated with the pattern, but the steps between neighbouring visible cells, the
white ring around the border included.
"""

import numpy as np

from thermal_fiducial.core.detection.patterns import CELL_SAMPLES, Decoder, sampled
from thermal_fiducial.core.types import BoolArray, Float32Array, FloatArray, TINY

# Samples closer to the border of the image than this count as invisible [px].
_BORDER_PX = 1.0
# Least number of steps that are compared, and least sum of their squares in the pattern.
_FEWEST, _LEAST_PATTERN = 12, 2.0


class VisibleCells:
    """Patterns of a dictionary with their white surroundings, for correlation of any subset of their cells."""

    def __init__(self, decoder: Decoder) -> None:
        grids = decoder.patterns(np.arange(decoder.count), np.zeros(decoder.count, dtype=np.int64))
        cells = decoder.cells + 2
        place = np.arange(cells**2).reshape(cells, cells)
        # The P pairs of neighbours, side by side and one above the other.
        self._first = np.concatenate([place[:, :-1].ravel(), place[:-1].ravel()])
        self._second = np.concatenate([place[:, 1:].ravel(), place[1:].ravel()])
        beside = (np.arange(len(self._first)) < cells * (cells - 1)).astype(np.float64)
        self._slope = np.stack([beside, 1.0 - beside], axis=1)
        ringed = np.pad(grids, ((0, 0), (1, 1), (1, 1)), constant_values=1.0)
        self._steps = self._between(ringed.reshape(len(grids), -1))
        share = ((np.arange(cells)[:, None] - 1.0 + CELL_SAMPLES) / decoder.cells).ravel()
        #: indices of the bits among the C cells
        self.bits = place[2:-2, 2:-2].ravel()
        b, a = np.meshgrid(share, share, indexing='ij')
        order = np.arange(len(share) ** 2).reshape(cells, 3, cells, 3).swapaxes(1, 2).ravel()
        #: (9 C, 2) shares of the sides at which the C cells are sampled, nine times each
        self.places = np.stack([a, b], axis=-1).reshape(-1, 2)[order]

    def correlation(self, image: Float32Array, px: FloatArray, marker_id: int) -> FloatArray:
        """Correlation (O,) of cells whose samples are at pixels (O, 9 C, 2) with the upright pattern of a marker.

        An even slope is taken out of both. Where too few steps or too little of the pattern are visible, it is 0.
        """
        values, visible = _means(image, px)
        weight = (visible[:, self._first] & visible[:, self._second]).astype(np.float64)
        number = weight @ self._slope + TINY
        steps, pattern = weight * self._between(values), weight * self._steps[marker_id]
        rise, own = steps @ self._slope, pattern @ self._slope
        ss = np.sum(steps * steps, axis=1) - np.sum(rise * rise / number, axis=1)
        sp = np.sum(steps * pattern, axis=1) - np.sum(rise * own / number, axis=1)
        pp = np.sum(pattern * pattern, axis=1) - np.sum(own * own / number, axis=1)
        enough = (number.sum(axis=1) >= _FEWEST) & (pp > _LEAST_PATTERN)
        return np.where(enough, sp / np.sqrt(np.maximum(ss, TINY) * np.maximum(pp, _LEAST_PATTERN)), 0.0)

    def _between(self, values: FloatArray) -> FloatArray:
        """Steps (..., P) between neighbouring cells (..., C)."""
        return np.asarray(values[..., self._second] - values[..., self._first])


def _means(image: Float32Array, px: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Mean counts (O, C) of nine samples in a row each at pixels (O, 9 C, 2), and which are in view."""
    height, width = image.shape
    with np.errstate(invalid='ignore'):
        inside: BoolArray = np.asarray((px >= _BORDER_PX) & (px <= (width - 1 - _BORDER_PX, height - 1 - _BORDER_PX)))
        inside = np.asarray(inside.all(axis=-1))
    places = np.where(inside[..., None], px, 0.0).astype(np.float32)
    counts = sampled(image, np.ascontiguousarray(np.moveaxis(places, -1, 0)))
    shape = len(px), -1, 9
    return counts.reshape(shape).mean(axis=-1, dtype=np.float64), np.asarray(inside.reshape(shape).all(axis=-1))
