"""Identification of a partially visible marker by its visible cells.

At such short distances the array's shading and a heater's gradient vary as much across a marker as a faint pattern
does. Therefore not the cells are correlated with the patterns, but the steps between neighbouring visible cells, the
white ring around the border included.
"""

from typing import NamedTuple

import numpy as np

from thermal_fiducial.core.detection.patterns import CELL_SAMPLES, Decoder, sampled
from thermal_fiducial.core.types import BoolArray, Float32Array, FloatArray, TINY

# Samples closer to the border of the image than this count as invisible [px].
_BORDER_PX = 1.0
# Least number of steps that are compared, and least sum of their squares in the pattern.
_FEWEST, _LEAST_PATTERN = 12, 2.0


class CellMatch(NamedTuple):
    """Similarity of the visible cells to the predicted marker, and to others."""

    #: with the predicted pattern, negative where black and white are swapped
    correlation: float
    #: with the most similar other marker or rotation, as observed and in a perfect view
    runner_up: float
    perfect: float
    #: white minus black [counts]
    contrast: float
    #: number of visible cells, ring included, and the least number of them in which any other marker differs
    cells: int
    distance: int


class VisibleCells:
    """Patterns of a dictionary with their white surroundings, for correlation of any subset of their cells.

    Parameters
    ----------
    decoder : of the dictionary
    """

    def __init__(self, decoder: Decoder) -> None:
        grids = decoder.seen(np.arange(decoder.count)[:, None], np.arange(4)).reshape(-1, decoder.cells, decoder.cells)
        ringed = np.pad(grids, ((0, 0), (1, 1), (1, 1)), constant_values=1.0)
        cells = decoder.cells + 2
        place = np.arange(cells**2).reshape(cells, cells)
        # The P pairs of neighbours, side by side and one above the other.
        self._first = np.concatenate([place[:, :-1].ravel(), place[:-1].ravel()])
        self._second = np.concatenate([place[:, 1:].ravel(), place[1:].ravel()])
        beside = (np.arange(len(self._first)) < cells * (cells - 1)).astype(np.float64)
        self._slope = np.stack([beside, 1.0 - beside], axis=1)
        self._patterns = ringed.reshape(len(grids), -1)
        self._steps = self._between(self._patterns)
        share = ((np.arange(cells)[:, None] - 1.0 + CELL_SAMPLES) / decoder.cells).ravel()
        b, a = np.meshgrid(share, share, indexing='ij')
        order = np.arange(len(share) ** 2).reshape(cells, 3, cells, 3).swapaxes(1, 2).ravel()
        #: (9 C, 2) shares of the sides at which the C cells are sampled, nine times each
        self.places = np.stack([a, b], axis=-1).reshape(-1, 2)[order]

    def match(self, image: Float32Array, px: FloatArray, marker_id: int) -> FloatArray:
        """Correlation (O,) of cells whose samples are at pixels (O, 9 C, 2) with the upright pattern of a marker."""
        values, visible = _means(image, px)
        seen = visible[:, self._first] & visible[:, self._second]
        return self._correlations(self._between(values), self._steps[4 * marker_id], seen)[0]

    def likeness(self, image: Float32Array, px: FloatArray, marker_id: int, allowed: BoolArray) -> CellMatch:
        """Of cells whose samples are at pixels (9 C, 2) with a marker, among those ``allowed`` (M,)."""
        values, inside = _means(image, px[None])
        visible, steps = inside[0], self._between(values[0])
        seen = visible[self._first] & visible[self._second]
        others = np.repeat(allowed, 4)
        others[4 * marker_id] = False
        own, alternatives = self._steps[4 * marker_id], self._steps[others]
        correlation, contrast = self._correlations(steps, own, seen[None])
        compared = np.broadcast_to(seen, (len(alternatives), len(seen)))
        differ = (self._patterns[others] != self._patterns[4 * marker_id])[:, visible].sum(axis=1)
        return CellMatch(
            float(correlation[0]),
            float(np.abs(self._correlations(steps, alternatives, compared)[0]).max(initial=0.0)),
            float(np.abs(self._correlations(own, alternatives, compared)[0]).max(initial=0.0)),
            float(contrast[0]),
            int(visible.sum()),
            int(differ.min(initial=len(visible))),
        )

    def _between(self, values: FloatArray) -> FloatArray:
        """Steps (..., P) between neighbouring cells (..., C)."""
        return np.asarray(values[..., self._second] - values[..., self._first])

    def _correlations(
        self, steps: FloatArray, patterns: FloatArray, compared: BoolArray
    ) -> tuple[FloatArray, FloatArray]:
        """Correlations (O,) of steps and patterns, (O, P) or (P,) both, where ``compared`` (O, P), and the factors.

        An even slope is taken out of both. Where too few steps or too little of a pattern are left, there is none.
        """
        weight = compared.astype(np.float64)
        number = weight @ self._slope + TINY
        steps, patterns = weight * steps, weight * patterns
        rise, own = steps @ self._slope, patterns @ self._slope
        ss = np.sum(steps * steps, axis=1) - np.sum(rise * rise / number, axis=1)
        sp = np.sum(steps * patterns, axis=1) - np.sum(rise * own / number, axis=1)
        pp = np.sum(patterns * patterns, axis=1) - np.sum(own * own / number, axis=1)
        enough = (number.sum(axis=1) >= _FEWEST) & (pp > _LEAST_PATTERN)
        pp = np.maximum(pp, _LEAST_PATTERN)
        return np.where(enough, sp / np.sqrt(np.maximum(ss, TINY) * pp), 0.0), sp / pp


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
