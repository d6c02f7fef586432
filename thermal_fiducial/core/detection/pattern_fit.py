"""Fit of whole patterns: corners of small markers in pictures for a display, and alignment of inaccurate outlines.

No side of a marker whose cells are hardly wider than the blur can be measured by itself, and no cell shows its own
gray. So the blurred pattern is fitted to the pixels: Gauss-Newton on corners and blur, with contrast and a background.

The share of the variance that the pattern leaves is the evidence. A square with any other content leaves a share below
r with a probability of the order of r^(v/2), where v is the number of independent values that the fit leaves free, at
most one a bit: -v/2 log r is the log-likelihood ratio of the marker over such a square.
"""

from functools import cache
import math
from typing import NamedTuple

import cv2
import numpy as np

from thermal_fiducial.core.detection.corner_errors import OF_PATTERN_PX
from thermal_fiducial.core.detection.frame import Frame
from thermal_fiducial.core.detection.known_markers import FoundMarkers
from thermal_fiducial.core.detection.patterns import Decoder
from thermal_fiducial.core.detection.refined_corners import RefinedCorners
from thermal_fiducial.core.geometry.se3 import bilinear, diagonals, seen_between, sides_px
from thermal_fiducial.core.types import BoolArray, Float32Array, FloatArray, IntArray, TINY

# Cells below which the whole pattern is fitted, as they are hardly wider than the blur of their sides [px].
_WIDEST_CELL_PX = 2.5
# Bound on the number of false markers in a picture, were all of it squares with a black border around random bits.
_FALSE_MARKERS = 0.01
# Samples along a cell, and how far they reach beyond the sides [cells].
_SAMPLES, _RING = 3, 0.5
# Damping: share of the information's diagonal that is added to it. Steps of a fit, and of an alignment.
_DAMPING, _STEPS, _OF_ALIGNMENT = 0.1, 5, 3
# Blur of the pattern in an alignment, so wide that it reaches an edge half a cell away [cells].
_WIDE = 0.25
# Smoothing of the image for it, in pixels and at most in cells; least width of cells [px].
_SMOOTHING_PX, _SMOOTHING, _LEAST_CELL_PX = 1.0, 0.4, 0.5
# Longest step of a corner [cells] and of the blur, and range of the blur, both in blurs of the optics.
_LONGEST, _LONGEST_BLUR, _BLURS = 0.6, 0.15, (0.5, 2.0)
# Parameters of a fit: corners, blur, contrast, background. A fit to something that is not there makes use of fewer of
# them, as outlines bound the corners: with 9 the evidence in textures is alike from 5 to 12 px, with 5 higher below 8.
_PARAMETERS, _OF_CHANCE = 13, 9
# Least share of the variance that counts as left: no model is better.
_LEAST = 1e-6
# Cumulative standard normal distribution, by a table.
_Z = np.linspace(-6.0, 6.0, 2401)
_BELOW = np.array([0.5 * math.erfc(-z / math.sqrt(2.0)) for z in _Z.tolist()])


class PatternFit(NamedTuple):
    """Fits of Q markers."""

    #: (Q, 4, 2) [px]
    corners_px: FloatArray
    #: (Q, 4, 2, 2) [px^2]
    covariances: FloatArray
    #: (Q,) white minus black, and standard deviation of a pixel about the model [counts]
    contrast: FloatArray
    noise: FloatArray
    #: (Q,) log-likelihood ratio over a square with other content, and over the likeliest other marker or turn
    evidence: FloatArray
    lead: FloatArray


class _Grid(NamedTuple):
    """Samples of a marker with m x m cells, S along each axis."""

    #: (S,) [cells]
    along: FloatArray
    #: (4, S * S) of :func:`bilinear`
    weights: Float32Array
    #: (S * S, 3 or 6) orthonormal backgrounds
    background: FloatArray

    def without_background(self, values: FloatArray) -> FloatArray:
        """Values (..., S * S) at the samples without their background."""
        return np.asarray(values - (values @ self.background) @ self.background.T)


class _CellWeights(NamedTuple):
    """Weights (Q, S, m) of cells at samples along an axis, and their first and second derivatives by place."""

    value: FloatArray
    slope: FloatArray
    curvature: FloatArray


class _PatternResiduals(NamedTuple):
    """Q markers at their corners: how pixels differ from patterns, and what would change that."""

    corners_px: FloatArray
    #: (Q,) [px]
    blur: FloatArray
    #: (Q, 2, 2) derivatives of places in the marker [cells] by pixels
    to_cells: FloatArray
    #: of cells along rows and along columns
    x: _CellWeights
    y: _CellWeights
    #: (Q, P) gray levels, and these without the pattern; no background in either
    seen: FloatArray
    rest: FloatArray
    #: (Q,)
    contrast: FloatArray
    #: (Q, 10, P) derivatives by the corners' u and v, by blur, by contrast
    J: FloatArray

    @property
    def pixels(self) -> FloatArray:
        """Pixels (Q,) that the samples cover."""
        return np.asarray(self.seen.shape[1] / _SAMPLES**2 / np.abs(np.linalg.det(self.to_cells)))


@cache
def _grid(cells: int, *, bent: bool = False) -> _Grid:
    """Samples over a background that is linear, or quadratic if ``bent``."""
    along = (np.arange(round(_SAMPLES * (cells + 2.0 * _RING))) + 0.5) / _SAMPLES - _RING
    a, b = (axis.ravel() / cells for axis in np.meshgrid(along, along))
    linear = [np.ones_like(a), a, b]
    background = np.linalg.qr(np.stack([*linear, a * a, a * b, b * b] if bent else linear, axis=1))[0]
    return _Grid(along, bilinear(a, b).astype(np.float32), background)


def too_small_for_sides(corners_px: FloatArray, cells: int) -> BoolArray:
    """Which markers (N, 4, 2) have sides in a picture that are not measured by themselves."""
    return np.asarray(sides_px(corners_px) < _WIDEST_CELL_PX * cells)


def fitted_patterns(
    frame: Frame, found: FoundMarkers, shown_px: FloatArray, decoder: Decoder, blur_px: float
) -> tuple[IntArray, RefinedCorners]:
    """Places of the small markers among those ``found`` (N,) whose patterns are there, and their corners.

    Parameters
    ----------
    shown_px : (N, 4, 2) corners in the image, with lag tails, accurate to half a cell
    blur_px : standard deviation of the blur of optics and pixels
    """
    small = np.flatnonzero(too_small_for_sides(shown_px, decoder.cells))
    if len(small) == 0:
        return small, RefinedCorners.none()
    fit = fit_patterns(frame.image, shown_px[small], found.ids[small], decoder, blur_px)
    good = _evident(fit, found.expected[small], frame, decoder)
    covariances = fit.covariances[good] + OF_PATTERN_PX**2 * np.eye(2)
    contrast, noise = fit.contrast[good], fit.noise[good]
    corners = RefinedCorners(
        fit.corners_px[good], covariances, contrast, noise, np.zeros(len(noise)), np.ones(len(noise), dtype=bool)
    )
    return small[good], corners


def _evident(fit: PatternFit, expected: BoolArray, frame: Frame, decoder: Decoder) -> BoolArray:
    """Which fits (N,) are evidence enough, of all markers and places that might be one by chance."""
    height, width = frame.image.shape
    places = np.where(expected, 1.0, height * width / np.maximum(sides_px(fit.corners_px) ** 2, 1.0))
    tried = 4.0 * decoder.count * places
    return np.asarray((fit.evidence > np.log(tried / _FALSE_MARKERS)) & (fit.lead > -math.log(_FALSE_MARKERS)))


def fit_patterns(image: Float32Array, quads: FloatArray, ids: IntArray, decoder: Decoder, blur_px: float) -> PatternFit:
    """Fits of the markers ``ids`` (Q,), upright in ``quads`` (Q, 4, 2), which are accurate to half a cell.

    Parameters
    ----------
    image : (height, width) gray levels
    blur_px : standard deviation of the blur of optics and pixels
    """
    white, blur = decoder.seen(ids, np.zeros_like(ids)), np.full(len(ids), blur_px)
    grid = _grid(decoder.cells)
    for _ in range(_STEPS):
        quads, blur = _stepped(_linearised(image, quads, blur, white, grid), blur_px)
    return _judged(_linearised(image, quads, blur, white, grid), ids, decoder, blur_px)


def aligned(image: Float32Array, quads: FloatArray, ids: IntArray, turns: IntArray, decoder: Decoder) -> FloatArray:
    """Inaccurate outlines (Q, 4, 2), moved to where the patterns of their markers are.

    The outline of a faint marker may have a corner or two wrong by up to a cell.

    Parameters
    ----------
    image : (height, width) counts
    ids, turns : (Q,) markers, and the quarter turns in which the outlines show them
    """
    white, grid = decoder.seen(ids, turns), _grid(decoder.cells, bent=True)
    cell = np.maximum(diagonals(quads) / (math.sqrt(2.0) * decoder.cells), _LEAST_CELL_PX)
    smoothing = min(_SMOOTHING_PX, _SMOOTHING * float(np.median(cell)))
    smooth = np.asarray(cv2.GaussianBlur(image, (0, 0), smoothing), dtype=np.float32)
    blur = wide = _WIDE * cell
    for _ in range(_OF_ALIGNMENT):
        quads, blur = _stepped(_linearised(smooth, quads, blur, white, grid), wide)
    return quads


def _linearised(
    image: Float32Array, quads: FloatArray, blur: FloatArray, white: FloatArray, grid: _Grid
) -> _PatternResiduals:
    """The fit of ``white`` cells (Q, m, m), seen with ``blur`` (Q,), at corners ``quads`` (Q, 4, 2)."""
    count, cells = white.shape[:2]
    black = white - 1.0
    to_cells = _to_cells(quads, cells)
    widths = np.sqrt((to_cells * to_cells).sum(axis=-1))
    x, y = (_weights(grid.along, cells, blur * widths[:, axis]) for axis in (0, 1))

    def pattern(down: FloatArray, across: FloatArray) -> FloatArray:
        shown = (down @ black @ across.swapaxes(1, 2)).reshape(count, -1)
        return grid.without_background(shown)

    places = seen_between(quads, grid.weights)
    gray = cv2.remap(image, places[0], places[1], cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REPLICATE)
    seen = grid.without_background(np.asarray(gray, dtype=np.float64))
    value = pattern(y.value, x.value)
    contrast = (seen * value).sum(axis=1) / np.maximum((value * value).sum(axis=1), TINY)
    slopes = np.stack([pattern(y.value, x.slope), pattern(y.slope, x.value)], axis=1)
    by_px = to_cells.swapaxes(1, 2) @ slopes * contrast[:, None, None]
    # Blur spreads a pattern as heat does: its derivative by a variance is half its curvature.
    variances = blur[:, None] * widths**2
    wider = variances[:, :1] * pattern(y.value, x.curvature) + variances[:, 1:] * pattern(y.curvature, x.value)
    J = np.empty((count, 10, value.shape[1]))
    J[:, :8] = (by_px[:, :, None] * grid.weights).reshape(count, 8, -1)
    J[:, 8], J[:, 9] = -contrast[:, None] * wider, -value
    rest = seen - contrast[:, None] * value
    return _PatternResiduals(quads, blur, to_cells, x, y, seen, rest, contrast, grid.without_background(J))


def _to_cells(quads: FloatArray, cells: int) -> FloatArray:
    """Mean derivatives (Q, 2, 2) of places in markers [cells] by pixels."""
    across = quads[:, 1] - quads[:, 0] + quads[:, 2] - quads[:, 3]
    down = quads[:, 3] - quads[:, 0] + quads[:, 2] - quads[:, 1]
    to_px = np.stack([across, down], axis=-1) / (2.0 * cells)
    area = np.linalg.det(to_px)
    collapsed = np.abs(area) < TINY
    to_px[collapsed] = np.eye(2)
    return np.asarray(np.linalg.inv(to_px))


def _weights(along: FloatArray, cells: int, blur: FloatArray) -> _CellWeights:
    """Weights of cells at places ``along`` (S,) for ``blur`` (Q,) [cells]."""
    width = blur[:, None, None]
    z = (np.arange(cells + 1) - along[:, None]) / width
    density = np.exp(-0.5 * z * z) / math.sqrt(2.0 * math.pi)
    return _CellWeights(np.diff(np.interp(z, _Z, _BELOW)), -np.diff(density) / width, -np.diff(z * density) / width**2)


def _stepped(at: _PatternResiduals, blur_px: float | FloatArray) -> tuple[FloatArray, FloatArray]:
    """Corners (Q, 4, 2) and blur (Q,) after a step."""
    information = at.J @ at.J.swapaxes(1, 2)
    diagonal = np.einsum('qii->qi', information)
    diagonal *= 1.0 + _DAMPING
    # Keeps the system solvable where the image has no gradient in some direction.
    diagonal += TINY * (1.0 + diagonal.max(axis=1, keepdims=True))
    step = -np.linalg.solve(information, at.J @ at.rest[..., None])[..., 0]
    longest = _LONGEST / np.sqrt(np.abs(np.linalg.det(at.to_cells)))[:, None]
    corners = at.corners_px + np.clip(step[:, :8], -longest, longest).reshape(-1, 2, 4).swapaxes(1, 2)
    wider = np.clip(step[:, 8], -_LONGEST_BLUR * blur_px, _LONGEST_BLUR * blur_px)
    return corners, np.clip(at.blur + wider, _BLURS[0] * blur_px, _BLURS[1] * blur_px)


def _judged(at: _PatternResiduals, ids: IntArray, decoder: Decoder, blur_px: float) -> PatternFit:
    """Covariances and evidence."""
    # What blur averages over: its noise-equivalent area.
    independent = at.pixels / (4.0 * math.pi * np.minimum(at.blur, blur_px) ** 2)
    free = np.clip(independent - _OF_CHANCE, 0.0, (decoder.cells - 2) ** 2)
    left = 1.0 - _explained(at, decoder)
    own = np.maximum(left[np.arange(len(ids)), 4 * ids], _LEAST)
    left[np.arange(len(ids)), 4 * ids] = 1.0
    other = np.maximum(left.min(axis=1), _LEAST)
    content = np.maximum(_content(at, decoder.cells), _LEAST)
    # Neighbouring pixels that the model misses, it misses together: as many residuals as there are independent values.
    samples = at.seen.shape[1]
    variance = (at.rest * at.rest).mean(axis=1) * independent / np.maximum(independent - _PARAMETERS, 1.0)
    information = at.J @ at.J.swapaxes(1, 2)
    trace = np.trace(information, axis1=1, axis2=2)
    information += (TINY * (1.0 + trace))[:, None, None] * np.eye(information.shape[1])
    covariance = np.linalg.inv(information)[:, :8, :8] * (variance * samples / at.pixels)[:, None, None]
    of_corners = covariance.reshape(-1, 2, 4, 2, 4).diagonal(axis1=2, axis2=4).transpose(0, 3, 1, 2)
    return PatternFit(
        at.corners_px,
        of_corners,
        at.contrast,
        np.sqrt(variance),
        0.5 * free * np.log(content / own),
        0.5 * free * np.log(other / own),
    )


def _content(at: _PatternResiduals, cells: int) -> FloatArray:
    """Share (Q,) of the variance that a border around a plain square, each of any gray, leaves: that of the bits."""
    inner = np.pad(np.ones((cells - 2, cells - 2)), 1)
    squares = np.stack([np.ones((cells, cells)), inner])
    shown = at.y.value[:, None] @ squares @ at.x.value.swapaxes(1, 2)[:, None]
    shown = _grid(cells).without_background(shown.reshape(len(at.seen), 2, -1))
    product = shown @ at.seen[..., None]
    explained = product.swapaxes(1, 2) @ np.linalg.solve(shown @ shown.swapaxes(1, 2) + TINY * np.eye(2), product)
    return np.asarray(1.0 - explained[:, 0, 0] / np.maximum((at.seen * at.seen).sum(axis=1), TINY))


def _explained(at: _PatternResiduals, decoder: Decoder) -> FloatArray:
    """Shares (Q, 4 M) of the variance that each marker's pattern explains in each turn, at the same corners."""
    cells = decoder.cells
    black = decoder.black
    flat = black.reshape(len(black), -1)
    background = _grid(cells).background.T.reshape(3, len(_grid(cells).along), -1)
    shares = np.empty((len(at.seen), len(black)))
    for row, (seen, x, y) in enumerate(zip(at.seen, at.x.value, at.y.value, strict=True)):
        product = flat @ (y.T @ seen.reshape(background.shape[1:]) @ x).ravel()
        size = ((y.T @ y) @ black @ (x.T @ x)).reshape(len(black), -1)
        size = (size * flat).sum(axis=1) - ((flat @ (y.T @ background @ x).reshape(3, -1).T) ** 2).sum(axis=1)
        shares[row] = product * product / np.maximum(size * (seen @ seen), TINY)
    return shares
