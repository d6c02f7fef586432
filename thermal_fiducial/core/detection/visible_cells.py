"""Which marker it is of which only some cells are in view.

So near, an array's shading and a heater's gradient change as much across a marker as a faint pattern does, and even
across a cell. So it is the steps across the lines between cells, the white ring round the border among them, that are
correlated with those of the patterns, as far as they are in view.
"""

from typing import NamedTuple

import numpy as np

from thermal_fiducial.core.detection.patterns import CELL_SAMPLES, Decoder, sampled
from thermal_fiducial.core.types import BoolArray, Float32Array, FloatArray

# Samples on either side of a line between cells, so far from it [cells].
_BESIDE = np.array([0.2, 0.35])
# Samples nearer to the border of the image are not seen [px].
_BORDER_PX = 1.0
# Least number of steps that are compared, least sum of their squares in the pattern, and what keeps steps in a single
# direction from a slope across it.
_FEWEST, _LEAST_PATTERN, _RIDGE = 12, 2.0, 1e-6
# Places one cell off.
_NEXT = [(right, down) for right in (-1, 0, 1) for down in (-1, 0, 1) if (right, down) != (0, 0)]


class CellMatch(NamedTuple):
    """How the visible cells look like the marker that is expected there."""

    #: with its pattern, negative where black and white are swapped
    correlation: float
    #: of the most similar other marker or turn, or of its own pattern one cell off; and how a perfect view would be
    runner_up: float
    perfect: float
    #: white minus black [counts]
    contrast: float
    #: number of cells in view, the ring's among them, and in how many of them no other marker is nearer
    cells: int
    distance: int

    @property
    def evidence(self) -> float:
        """Difference of chi square between the marker and the most similar other pattern."""
        left = max(1.0 - self.correlation**2, 1e-6)
        return self.cells * (self.correlation**2 - self.runner_up**2) / left


class VisibleCells:
    """Patterns of a dictionary with their white surroundings, ready for correlation of any of their cells.

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
        # Upright, one cell off.
        moved = np.stack([_moved(ringed[::4], *step).reshape(decoder.count, -1) for step in _NEXT])
        self._steps_beside = self._between(moved)
        share = ((np.arange(cells)[:, None] - 1.0 + CELL_SAMPLES) / decoder.cells).ravel()
        b, a = np.meshgrid(share, share, indexing='ij')
        order = np.arange(len(share) ** 2).reshape(cells, 3, cells, 3).swapaxes(1, 2).ravel()
        #: (9 C, 2) shares of the sides at which the C cells are sampled, nine times each
        self.places = np.stack([a, b], axis=-1).reshape(-1, 2)[order]
        #: (12 P, 2) the same of the P lines between neighbours, six times on either side
        self.line_places = _line_places(cells) / decoder.cells

    def match(self, image: Float32Array, px: FloatArray, marker_id: int) -> FloatArray:
        """Correlation (O,) of cells whose samples are at pixels (O, 9 C, 2) with the upright pattern of a marker."""
        values, visible = _means(image, px, 9)
        seen = visible[:, self._first] & visible[:, self._second]
        return self._correlations(self._between(values), self._steps[4 * marker_id], seen)[0]

    def likeness(self, image: Float32Array, px: FloatArray, marker_id: int, allowed: BoolArray) -> CellMatch:
        """Of what has its lines at pixels (12 P, 2) with a marker, among those ``allowed`` (M,)."""
        values, inside = _means(image, px[None], 6)
        values, seen = values.reshape(-1, 2), np.asarray(inside.reshape(-1, 2).all(axis=1))
        steps = values[:, 1] - values[:, 0]
        visible = np.zeros(self._patterns.shape[1], dtype=bool)
        visible[self._first[seen]] = visible[self._second[seen]] = True
        others = np.repeat(allowed, 4)
        others[4 * marker_id] = False
        own, beside = self._steps[4 * marker_id], self._steps_beside[:, marker_id]
        alternatives = np.concatenate([self._steps[others], np.nan_to_num(beside)])
        all_seen = np.broadcast_to(seen, (int(others.sum()), len(seen)))
        compared = np.concatenate([all_seen, seen & np.isfinite(beside)])
        correlation, contrast = self._correlations(steps, own, seen[None])
        differ = (self._patterns[others] != self._patterns[4 * marker_id])[:, visible].sum(axis=1)
        return CellMatch(
            float(correlation[0]),
            float(np.abs(self._correlations(steps, alternatives, compared)[0]).max()),
            float(np.abs(self._correlations(own, alternatives, compared)[0]).max()),
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
        number = weight @ self._slope + _RIDGE
        steps, patterns = weight * steps, weight * patterns
        rise, own = steps @ self._slope, patterns @ self._slope
        ss = np.sum(steps * steps, axis=1) - np.sum(rise * rise / number, axis=1)
        sp = np.sum(steps * patterns, axis=1) - np.sum(rise * own / number, axis=1)
        pp = np.sum(patterns * patterns, axis=1) - np.sum(own * own / number, axis=1)
        enough = (number.sum(axis=1) >= _FEWEST) & (pp > _LEAST_PATTERN)
        pp = np.maximum(pp, _LEAST_PATTERN)
        return np.where(enough, sp / np.sqrt(np.maximum(ss, 1e-12) * pp), 0.0), sp / pp


def _means(image: Float32Array, px: FloatArray, number: int) -> tuple[FloatArray, BoolArray]:
    """Mean counts (O, K) of so many samples in a row at pixels (O, number K, 2), and which are in view."""
    height, width = image.shape
    with np.errstate(invalid='ignore'):
        inside: BoolArray = np.asarray((px >= _BORDER_PX) & (px <= (width - 1 - _BORDER_PX, height - 1 - _BORDER_PX)))
        inside = np.asarray(inside.all(axis=-1))
    places = np.where(inside[..., None], px, 0.0).astype(np.float32)
    counts = sampled(image, np.ascontiguousarray(np.moveaxis(places, -1, 0)))
    shape = (len(px), -1, number)
    return counts.reshape(shape).mean(axis=-1, dtype=np.float64), np.asarray(inside.reshape(shape).all(axis=-1))


def _line_places(cells: int) -> FloatArray:
    """Places (12 P, 2), in cells from the marker's first, beside the lines between ``cells`` squared and their next."""
    before, line = np.meshgrid(np.arange(cells - 1), np.arange(cells))
    across = before[..., None, None, None] + np.stack([-_BESIDE, _BESIDE])[:, :, None]
    along = line[..., None, None, None] + CELL_SAMPLES - 1.0
    across, along = np.broadcast_arrays(across, along)
    beside = np.stack([across, along], axis=-1)
    above = np.swapaxes(beside[..., ::-1], 0, 1)
    return np.concatenate([beside.reshape(-1, 2), above.reshape(-1, 2)])


def _moved(grids: FloatArray, right: int, down: int) -> FloatArray:
    """Grids (M, m, m) moved by so many cells, NaN where nothing is known."""
    cells = grids.shape[1]
    moved = np.full_like(grids, np.nan)
    moved[:, max(down, 0) : cells + min(down, 0), max(right, 0) : cells + min(right, 0)] = grids[
        :, max(-down, 0) : cells + min(-down, 0), max(-right, 0) : cells + min(-right, 0)
    ]
    return moved
