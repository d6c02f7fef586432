"""Decoding by correlation: the most similar marker pattern of a dictionary for quadrilaterals in a frame.

A pattern is all cells of a marker, border and bits, each the mean of several pixels. Correlating the whole pattern
decodes markers at contrasts at which single bits could not be thresholded.
"""

from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import cv2
import numpy as np

from thermal_fiducial.core.detection.prediction.frame import without_tails
from thermal_fiducial.core.geometry.reprojection import bilinear, seen_between
from thermal_fiducial.core.types import BoolArray, Float32Array, FloatArray, Gray, IntArray, Pixels, Stacked, TINY

# Distance from a side at which black and white are compared [cells].
_OUTSIDE = 0.4
#: Largest number of rows, or of columns, of places that OpenCV interpolates at once.
MOST_AT_ONCE = 2**15 - 2
# Markers that are compared with all at a time: 30,000 among themselves would take gigabytes.
_AT_A_TIME = 256
# Correlation below which the surroundings need not be measured.
_SIMILAR = 0.5
#: Samples along a cell, in its middle, away from blurred edges.
CELL_SAMPLES = np.array([0.3, 0.5, 0.7])
# Samples across an edge between two cells, from its place [cells]. No edge is farther off than that: a bad pixel is.
_ACROSS = np.arange(-0.45, 0.5, 0.1)
_FARTHEST = 0.5


#: Offsets (9, 2) from a prediction that are tried [cells]; similarity, as a share of the best, that has no weight.
NEAR_CELLS = np.stack(np.meshgrid([-0.5, 0.0, 0.5], [-0.5, 0.0, 0.5]), axis=-1).reshape(-1, 2)
_UNLIKE = 0.8


def most_similar(similarity: FloatArray, places: FloatArray) -> FloatArray:
    """Position (N, 2) of the greatest similarity (N, P) between ``places`` (N, P, 2): a weighted centroid."""
    weight = np.maximum(similarity - _UNLIKE * similarity.max(axis=1, keepdims=True), 0.0)
    mean = np.einsum('np,npk->nk', weight, places)
    return np.asarray(mean / np.maximum(weight.sum(axis=1, keepdims=True), TINY))


@dataclass(frozen=True, slots=True, eq=False)
class Dictionary:
    """The markers that a detector looks for. OpenCV's own class of them crashes in 4.6 when it is made of patterns."""

    #: (M, n, n) of the markers, ID by ID: rows from the top, 1 for white, without the black border
    bits: Gray
    #: bit errors that still name a marker
    correctable: int

    @property
    def cells(self) -> int:
        """Cells along a side of a marker, the black border included."""
        return int(self.bits.shape[1]) + 2


def correctable_bits(bits: Gray) -> int:
    """Number of wrong bits that still leave the nearest of the markers (M, n, n), in any turn, certain.

    Half of what the smallest Hamming distance leaves.
    """
    flat = bits.reshape(len(bits), -1).astype(np.float32)
    turned = np.concatenate([np.rot90(bits, turn, axes=(1, 2)).reshape(len(bits), -1) for turn in range(4)])
    turned = turned.astype(np.float32)
    least = np.inf
    for first in range(0, len(flat), _AT_A_TIME):
        some = flat[first : first + _AT_A_TIME]
        # Bits that differ: set in the one and not in the other.
        distance = some.sum(axis=1)[:, None] + turned.sum(axis=1) - 2.0 * some @ turned.T
        np.fill_diagonal(distance[:, first:], np.inf)
        least = min(least, float(distance.min()))
    return max((int(least) - 1) // 2, 0)


def turned_alike(bits: Gray) -> BoolArray:
    """Which of the markers (M, n, n) look the same upside down, so that they show no pose."""
    return np.asarray((bits == np.rot90(bits, 2, axes=(1, 2))).all(axis=(1, 2)))


@dataclass(frozen=True, slots=True)
class Reading(Stacked):
    """Most similar markers of Q quadrilaterals, with the evidence for them."""

    #: (Q,) most similar ID
    ids: IntArray
    #: (Q,) quarter turns that make the first corner the marker's top-left
    turns: IntArray
    #: (Q,) correlation with the most similar pattern, negative where black and white are swapped
    correlation: FloatArray
    #: (Q,) correlation of the most similar other ID
    runner_up: FloatArray
    #: (Q,) white minus black [counts]
    contrast: FloatArray
    #: (Q,) bits on the wrong side of the middle between black and white
    bit_errors: IntArray
    #: (Q,) step from the black border to its white surroundings over the contrast, on the second worst side; 0 if the
    #: correlation is low
    surround: FloatArray

    def clear(self, correlation: float, margin: float, contrast: float = 0.0) -> BoolArray:
        """Which (Q,) have at least this correlation, margin over the runner-up, and contrast [counts]."""
        similarity = np.abs(self.correlation)
        distinct = (similarity >= correlation) & (similarity - self.runner_up >= margin)
        return np.asarray(distinct & (np.abs(self.contrast) >= contrast))


class PatternMatch(NamedTuple):
    """Most similar patterns of Q quadrilaterals."""

    #: (Q, m * m) contrast of the cells, without background
    values: Float32Array
    #: (Q,) four times the most similar ID, and the quarter turns
    best: IntArray
    #: (Q,) correlation with the best pattern, and with the most similar other ID
    correlation: FloatArray
    runner_up: FloatArray


class Decoder:
    """Patterns of a dictionary, ready for correlation.

    Parameters
    ----------
    bits : (M, n, n)
    correctable : number of wrong bits that still leave the nearest marker certain
    """

    def __init__(self, bits: Gray, correctable: int = 1) -> None:
        grid = np.pad(bits.astype(np.float64), ((0, 0), (1, 1), (1, 1)))
        #: numbers of markers, of cells along a side, and of wrong bits that still leave the nearest marker certain
        self.count, self.cells, self.correctable = len(grid), grid.shape[-1], correctable
        self._inner = np.pad(np.ones(bits.shape[1:], dtype=bool), 1).ravel()
        #: number of bits of a marker
        self.bits = int(self._inner.sum())
        #: (M,) which markers show a pose
        self.posed = ~turned_alike(bits)
        # Pattern k after `turn` steps: as it looks in a quadrilateral whose first corner is the marker's corner `turn`.
        self._grids = np.stack([np.rot90(grid, turn, axes=(1, 2)) for turn in range(4)], axis=1)
        detrend = self._detrend = _detrending(self.cells)
        detrended = self._grids.reshape(-1, self.cells**2) @ detrend
        patterns = detrended / np.maximum(np.linalg.norm(detrended, axis=1, keepdims=True), TINY)
        self._patterns = patterns.astype(np.float32)
        likeness = np.abs(patterns[::4] @ patterns.T).reshape(self.count, -1, 4).max(axis=-1)
        np.fill_diagonal(likeness, 0.0)
        #: (M,) margin of correlation of a perfect view of each marker over any other
        self.isolation = 1.0 - likeness.max(axis=1)
        border = self._inner @ detrend
        self._border = border / np.linalg.norm(border)
        self._beside_sides = _beside_sides(self.cells)
        self._across_edges = _across_edges(self.cells)
        self._samples, means = _cell_samples(self.cells)
        self._cells_of_samples = (means @ detrend).astype(np.float32)

    def read(
        self,
        image: Float32Array,
        quads: FloatArray,
        allowed: BoolArray | None = None,
        lag_tails: FloatArray | None = None,
    ) -> Reading:
        """Most similar pattern of each quadrilateral (Q, 4, 2) among those ``allowed`` (M,), or all.

        ``lag_tails`` (Q, 4, 2): where their corners are in the lag tails, which are removed.
        """
        if len(quads) == 0:
            nothing = np.zeros(0)
            none = nothing.astype(np.int64)
            return Reading(none, none, nothing, nothing, nothing, none, nothing)
        match = self.best_match(image, quads, allowed, lag_tails)
        steps = np.zeros((len(quads), 4))
        alike = np.flatnonzero(np.abs(match.correlation) >= _SIMILAR)
        if len(alike):
            steps[alike] = self._steps(image, quads[alike], None if lag_tails is None else lag_tails[alike])
        return self._judged(match, steps)

    def best_match(
        self, image: Pixels, quads: FloatArray, allowed: BoolArray | None = None, lag_tails: FloatArray | None = None
    ) -> PatternMatch:
        """Most similar patterns of quadrilaterals (Q, 4, 2), as :meth:`read`."""
        values = self._values(image, quads, lag_tails)
        spread = np.sqrt((values * values).sum(axis=1, keepdims=True))
        similar = (values / np.maximum(spread, np.float32(TINY))) @ self._patterns.T
        if allowed is not None and not allowed.all():
            similar[:, np.repeat(~allowed, 4)] = 0.0
        size = np.abs(similar)
        best, rows = size.argmax(axis=1), np.arange(len(quads))
        correlation = similar[rows, best].astype(np.float64)
        size.reshape(len(quads), -1, 4)[rows, best // 4] = 0.0
        return PatternMatch(values, best, correlation, size.max(axis=1).astype(np.float64))

    def correlation(self, image: Float32Array, quads: FloatArray, ids: IntArray) -> FloatArray:
        """Correlation (Q,) of quadrilaterals (Q, 4, 2) with the upright patterns of ``ids`` (Q,)."""
        values = self._values(image, quads)
        spread = np.maximum(np.sqrt(np.sum(values * values, axis=1)), np.float32(TINY))
        return np.asarray(np.sum(values * self._patterns[4 * ids], axis=1) / spread, dtype=np.float64)

    def off_grid(self, image: Float32Array, quads: FloatArray, ids: IntArray) -> FloatArray:
        """Distances (Q,) of the edges between cells from where upright markers ``ids`` (Q,) have them, rms [cells].

        By the area under the profile across each: whatever the blur, half of it is on either side of the edge.
        """
        counts = _counts_between(image, quads, None, self._across_edges)
        profiles = counts.reshape(len(quads), len(_ACROSS), len(CELL_SAMPLES), -1).mean(axis=2, dtype=np.float64)
        steps = np.concatenate([np.diff(self._grids[ids, 0], axis=1), np.diff(self._grids[ids, 1], axis=1)], axis=1)
        steps = steps.reshape(len(quads), -1)
        before, behind = profiles[:, 0], profiles[:, -1]
        edges = np.maximum(np.abs(steps).sum(axis=1), 1.0)
        contrast = (steps * (behind - before)).sum(axis=1) / edges
        safe = np.where(np.abs(contrast) < TINY, TINY, contrast)[:, None]
        off = (profiles.mean(axis=1) - 0.5 * (before + behind)) / safe * np.abs(steps)
        return np.asarray(np.sqrt((np.clip(off, -_FARTHEST, _FARTHEST) ** 2).sum(axis=1) / edges))

    def evidence(self, image: Float32Array, quads: FloatArray, ids: IntArray) -> FloatArray:
        """Log-likelihood ratios (Q,) of upright markers ``ids`` (Q,) in quadrilaterals (Q, 4, 2).

        Over squares with a border and anything else inside: a share below r of their variance is left by the pattern
        with a probability of the order of r^(v/2), where v is the number of bits.
        """
        values = self._values(image, quads).astype(np.float64)
        size = (values * values).sum(axis=1)
        by_marker, by_border = (values * self._patterns[4 * ids]).sum(axis=1), values @ self._border
        left, of_bits = size - by_marker**2, size - by_border**2
        return np.asarray(0.5 * self.bits * np.log(np.maximum(of_bits, TINY) / np.maximum(left, TINY)))

    def patterns(self, ids: IntArray, turns: IntArray) -> FloatArray:
        """Cells (Q, m, m), 1 for white, as quadrilaterals show markers whose corners they name ``turns`` late."""
        return np.asarray(self._grids[ids, turns])

    @property
    def black(self) -> FloatArray:
        """Cells (4 M, m, m) of all markers in all turns, 1 for black."""
        return 1.0 - self._grids.reshape(-1, self.cells, self.cells)

    def _judged(self, match: PatternMatch, steps: FloatArray) -> Reading:
        """Contrast and wrong bits of the best match; ``steps`` (Q, 4): from the border outwards on each side."""
        expected = self._grids.reshape(-1, self.cells**2)[match.best]
        shape = expected @ self._detrend
        contrast = np.sum(match.values * shape, axis=1) / np.maximum(np.sum(shape * shape, axis=1), TINY)
        safe = np.where(np.abs(contrast) < TINY, TINY, contrast)[:, None]
        # Cells on the scale from 0 for black to 1 for white.
        read = expected + (match.values - contrast[:, None] * shape) / safe
        wrong = (read > 0.5) != (expected > 0.5)
        return Reading(
            match.best // 4,
            match.best % 4,
            match.correlation,
            match.runner_up,
            contrast,
            np.sum(wrong & self._inner, axis=1),
            np.sort(steps / safe, axis=1)[:, 1],
        )

    def _steps(self, image: Float32Array, quads: FloatArray, lag_tails: FloatArray | None) -> FloatArray:
        """Mean counts just outside the sides minus those just inside (Q, 4)."""
        counts = _counts_between(image, quads, lag_tails, self._beside_sides)
        means = counts.reshape(len(quads), 2, 4, -1).mean(axis=-1)
        return np.asarray(means[:, 0] - means[:, 1], dtype=np.float64)

    def _values(self, image: Pixels, quads: FloatArray, lag_tails: FloatArray | None = None) -> Float32Array:
        """Mean counts (Q, m * m) of the cells of quadrilaterals (Q, 4, 2), without the background, as :meth:`read`."""
        counts = _counts_between(image, quads, lag_tails, self._samples)
        # Small numbers for sums in single precision.
        return np.asarray((counts - counts[:, :1]) @ self._cells_of_samples)


def shrunk(quads: FloatArray, cells: int, margin: float) -> FloatArray:
    """Outlines (Q, 4, 2) of the markers in white plates (Q, 4, 2) with such a ``margin`` [cells]."""
    return seen_between(quads, _in_plate(cells, margin)).transpose(1, 2, 0)


def _detrending(cells: int) -> FloatArray:
    """(m * m, m * m) by which values of cells, row by row, are freed of a quadratic background across the marker."""
    across = np.linspace(-1.0, 1.0, cells)
    x, y = np.tile(across, cells), np.repeat(across, cells)
    smooth = np.linalg.qr(np.stack([np.ones(x.size), x, y, x * x, x * y, y * y], axis=1))[0]
    return np.asarray(np.eye(x.size) - smooth @ smooth.T)


def _cell_samples(cells: int) -> tuple[Float32Array, FloatArray]:
    """Of :func:`bilinear`, (4, P): samples of all cells; and (P, m * m) by which the means of the cells follow."""
    share = ((np.arange(cells)[:, None] + CELL_SAMPLES) / cells).ravel()
    samples = bilinear(*(axis.ravel() for axis in np.meshgrid(share, share))).astype(np.float32)
    mean = np.kron(np.eye(cells), np.full((len(CELL_SAMPLES), 1), 1.0 / len(CELL_SAMPLES)))
    return samples, np.asarray(np.kron(mean, mean), dtype=np.float64)


def _across_edges(cells: int) -> Float32Array:
    """Of :func:`bilinear`, (4, P): places across the edges between cells, of a marker and as it is turned once."""
    along, across = (np.arange(cells) + CELL_SAMPLES[:, None]) / cells, (np.arange(1, cells) + _ACROSS[:, None]) / cells
    shape = len(_ACROSS), len(CELL_SAMPLES), cells - 1, cells
    u = np.broadcast_to(along[:, None], shape).reshape(*shape[:2], -1)
    v = np.broadcast_to(across[:, None, :, None], shape).reshape(*shape[:2], -1)
    return bilinear(*(np.concatenate(axes, axis=-1).ravel() for axes in ((u, 1.0 - v), (v, u)))).astype(np.float32)


def _beside_sides(cells: int) -> Float32Array:
    """Of :func:`bilinear`, (4, 8 m): places just outside the sides, then just inside."""
    t, apart, parts = (np.arange(cells) + 0.5) / cells, _OUTSIDE / cells, []
    for before, behind in ((-apart, 1.0 + apart), (apart, 1.0 - apart)):
        low, high = np.full(cells, before), np.full(cells, behind)
        parts.append(bilinear(np.concatenate([t, t, low, high]), np.concatenate([low, high, t, t])))
    return np.concatenate(parts, axis=-1).astype(np.float32)


@cache
def _in_plate(cells: int, margin: float) -> FloatArray:
    """Of :func:`bilinear`, (4, 4), for the corners of such a marker."""
    low, high = margin / (cells + 2.0 * margin), (cells + margin) / (cells + 2.0 * margin)
    return bilinear(np.array([low, high, high, low]), np.array([low, low, high, high]))


def _counts_between(
    image: Pixels, quads: FloatArray, lag_tails: FloatArray | None, weights: Float32Array
) -> Float32Array:
    """Counts (Q, P) at ``weights`` (4, P) of the corners of quadrilaterals (Q, 4, 2), without lag tails if given."""
    counts = sampled(image, seen_between(quads, weights))
    if lag_tails is None:
        return counts
    return without_tails(counts, sampled(image, seen_between(lag_tails, weights)))


def sampled(image: Pixels, places: Float32Array) -> Float32Array:
    """Values (Q, P) of the image at columns and rows (2, Q, P)."""
    u, v = places
    parts = [
        cv2.remap(image, u[part], v[part], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        for part in (slice(first, first + MOST_AT_ONCE) for first in range(0, len(u), MOST_AT_ONCE))
    ]
    return np.asarray(parts[0] if len(parts) == 1 else np.concatenate(parts), dtype=np.float32)
