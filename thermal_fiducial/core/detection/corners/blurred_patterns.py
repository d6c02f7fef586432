"""Model of a marker's whole pattern as the camera shows it, and its residuals in an image.

A pattern is sampled on a grid in the marker's own coordinates [cells], where cells are separable: the blur of its
columns and that of its rows are products. A blur that is oblique there, as that of a tilted marker and of motion, has a
correlation c besides, and a Gaussian with it is exp(c d2/dxdy) of one without.

Straight lines are bent by the lens: between its corners a marker is displaced by a cubic polynomial of the places in
it.

All that is linear is part of the model. The warm surface and the sheet before it each have a temperature that is linear
across the marker, so level and contrast are. The surface may be warmest in its middle, and may end one cell outside the
marker; and smoke in front makes the level a little quadratic.
"""

from functools import cache
import math
from typing import NamedTuple

import cv2
import numpy as np

from thermal_fiducial.core.detection.patterns import MOST_AT_ONCE
from thermal_fiducial.core.detection.prediction.frame import without_tails
from thermal_fiducial.core.geometry.camera import Camera, ImagePoints
from thermal_fiducial.core.geometry.se3 import bilinear, seen_between
from thermal_fiducial.core.types import Float32Array, FloatArray, TINY

#: How far samples reach beyond the sides [cells].
_RING = 0.5
# Place of the end of the warm surface outside the sides [cells].
_SURFACE_ENDS = 1.0
#: Parameters of a fit: u of the corners and v of them, blur, and amounts of the linear terms; the first of these is the
#: contrast.
CORNERS, BLUR, LINEAR = slice(0, 8), 8, slice(9, None)
#: Places among the linear terms, and among the parameters, of what is uneven by little: the bowl of the warm surface
#: and the curvatures of the level; their values at the corners.
UNEVEN = slice(4, 8)
UNEVEN_AMOUNTS = slice(LINEAR.start + UNEVEN.start, LINEAR.start + UNEVEN.stop)
UNEVEN_AT_CORNERS = np.array([0.5, 0.25, 0.25, 0.25])
# Places among the linear terms of the gradients of the contrast, of the bowl, and of what gain control adds.
_GRADIENTS, _BOWL, _OF_GAIN_CONTROL = slice(1, 3), UNEVEN.start, slice(UNEVEN.stop, None)
# Cumulative standard normal distribution, by a table.
_FARTHEST = 6.0
_Z = np.linspace(-_FARTHEST, _FARTHEST, 2401)
_BELOW = np.array([0.5 * math.erfc(-z / math.sqrt(2.0)) for z in _Z.tolist()])
# Places along a side where it is computed how the lens bends, and the weights of the corners in the nodes of the grid
# of them, rows first. With three a side, as a parabola has, markers of 22 px are 0.1 px too large behind a lens of 72
# degrees that shortens distances from the middle of the image by a fifth.
_NODES = np.linspace(0.0, 1.0, 4)
_BETWEEN_CORNERS = bilinear(*(axis.ravel() for axis in np.meshgrid(_NODES, _NODES)))
_AT_CORNERS = [0, 3, 15, 12]


class PatternGrid(NamedTuple):
    """Samples of a marker with m x m cells, S along each axis, P = S * S."""

    #: (S,) [cells]
    along: FloatArray
    #: (4, P) of :func:`bilinear`
    weights: Float32Array
    #: (16, P) of the nodes where the bends of the lens are known
    between_nodes: Float32Array
    #: (P, 3 or 6) orthonormal backgrounds
    background: Float32Array
    #: (2, P) places from the middle, in sides, and their squared distances (P,) from there
    middle: Float32Array
    bowl: Float32Array
    #: (3, P) quadratic functions of these places: the curvatures of a level
    curvatures: Float32Array
    #: samples of a cell
    density: int
    #: whether contrast is linear across the marker, else constant
    graded: bool

    def without_background(self, values: Float32Array) -> Float32Array:
        """Values (..., P) at the samples without their background."""
        return np.asarray(values - (values @ self.background) @ self.background.T)


@cache
def pattern_grid(cells: int, density: int, *, bent: bool = False) -> PatternGrid:
    """Grid with so many samples along a cell.

    The background is linear, and so is the contrast; if ``bent`` the background is quadratic, the contrast constant.
    """
    along = (np.arange(round(density * (cells + 2.0 * _RING))) + 0.5) / density - _RING
    a, b = (axis.ravel() / cells for axis in np.meshgrid(along, along))
    linear = [np.ones_like(a), a, b]
    background = np.linalg.qr(np.stack([*linear, a * a, a * b, b * b] if bent else linear, axis=1))[0]
    weights, middle = bilinear(a, b).astype(np.float32), np.stack([a, b]).astype(np.float32) - np.float32(0.5)
    curvatures = np.stack([middle[0] * middle[0], middle[0] * middle[1], middle[1] * middle[1]])
    bowl = curvatures[0] + curvatures[2]
    nodes = (_of_nodes(b)[:, None] * _of_nodes(a)).reshape(-1, a.size).astype(np.float32)
    background = background.astype(np.float32)
    return PatternGrid(along, weights, nodes, background, middle, bowl, curvatures, density, graded=not bent)


def _of_nodes(share: FloatArray) -> FloatArray:
    """Weights (4, P) of the nodes of a side in the cubic polynomial through them, at places ``share`` (P,)."""
    others = [np.delete(_NODES, index) for index in range(len(_NODES))]
    return np.stack(
        [np.prod((share[:, None] - other) / (node - other), axis=1) for node, other in zip(_NODES, others, strict=True)]
    )


class PatternView(NamedTuple):
    """Image of Q markers, and the motion in it."""

    image: Float32Array
    #: (Q, 2, 3) maps from pixels to lag tails, which are removed; None: none are
    to_tails: FloatArray | None = None
    #: (Q, 2) standard deviation of the motion blur, along the motion [px]; None: no motion
    motion: FloatArray | None = None
    #: whether its values are a nonlinear function of the counts
    displayed: bool = False
    #: (2, Q, 16) of :func:`lens_bends`; None: straight lines are straight in the image
    bends: FloatArray | None = None

    def gray(self, quads: FloatArray, grid: PatternGrid) -> Float32Array:
        """Values (Q, P) at the samples of markers in ``quads`` (Q, 4, 2)."""
        places = seen_between(quads, grid.weights)
        if self.bends is not None:
            places += self.bends.astype(np.float32) @ grid.between_nodes
        shown = self._at(places)
        if self.to_tails is not None:
            maps = self.to_tails.transpose(1, 2, 0)[..., None].astype(np.float32)
            tails = maps[:, 0] * places[0] + maps[:, 1] * places[1] + maps[:, 2]
            shown = without_tails(shown, self._at(tails))
        # Small numbers for sums in single precision.
        return np.asarray(shown - shown[:, :1])

    def _at(self, places: Float32Array) -> Float32Array:
        samples = places.shape[2]
        u, v = places.reshape(2, -1, samples if samples <= MOST_AT_ONCE else math.isqrt(samples))
        shown = cv2.remap(self.image, u, v, cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(shown, dtype=np.float32).reshape(places.shape[1:])


def lens_bends(corners: ImagePoints, camera: Camera) -> FloatArray:
    """How the lens displaces the nodes between the corners (Q, 4) of markers, (2, Q, 16) [px]."""
    uv = camera.distort(np.moveaxis(seen_between(corners.x, _BETWEEN_CORNERS), 0, -1))
    return np.asarray(np.moveaxis(uv, -1, 0) - seen_between(uv[:, _AT_CORNERS], _BETWEEN_CORNERS))


class PatternModel(NamedTuple):
    """Blurred patterns of Q markers, (Q, P) each."""

    value: Float32Array
    #: (2, Q, P) derivatives along columns and rows [1/cell]
    slopes: Float32Array
    #: derivative by the blur [1/px]
    wider: Float32Array


class PatternResiduals(NamedTuple):
    """Q markers at their corners: how pixels differ from patterns, and what would change that."""

    corners_px: FloatArray
    #: (Q,) [px]
    blur: FloatArray
    #: (Q, 2, 2) derivatives of places in the marker [cells] by pixels
    to_cells: FloatArray
    #: (Q, S, m) weights of cells at samples along rows and along columns
    x: Float32Array
    y: Float32Array
    #: (Q, P) gray levels, and these without the pattern; no background in either
    samples: Float32Array
    rest: Float32Array
    #: (Q, L) amounts of the linear terms, the first of them the contrast
    amounts: FloatArray
    #: (Q, 9 + L, P) derivatives by the corners' u and v, by blur, and by the L linear terms, with background
    J: Float32Array
    grid: PatternGrid

    def sampled_at(self, view: PatternView, quads: FloatArray) -> 'PatternResiduals':
        """The same at corners ``quads`` (Q, 4, 2) so near that the patterns on the markers stay."""
        samples = self.grid.without_background(view.gray(quads, self.grid))
        amounts, rest = _fitted(-self.J[:, LINEAR], samples)
        return self._replace(corners_px=quads, samples=samples, rest=rest, amounts=amounts)

    def information(self) -> FloatArray:
        """Information (Q, 9 + L, 9 + L) of samples with a variance of 1, whatever the background."""
        hidden = self.J @ self.grid.background
        return np.asarray(self.J @ self.J.swapaxes(1, 2) - hidden @ hidden.swapaxes(1, 2), dtype=np.float64)

    @property
    def contrast(self) -> FloatArray:
        """White minus black (Q,), in the middle of the marker."""
        return self.amounts[:, 0]

    @property
    def pixels(self) -> FloatArray:
        """Pixels (Q,) that the samples cover."""
        (xu, xv), (yu, yv) = np.moveaxis(self.to_cells, 0, -1)
        return np.asarray(self.samples.shape[1] / self.grid.density**2 / np.abs(xu * yv - xv * yu))


def linearised(
    view: PatternView, quads: FloatArray, blur: FloatArray, white: FloatArray, grid: PatternGrid
) -> PatternResiduals:
    """The fit of ``white`` cells (Q, m, m), seen with ``blur`` (Q,) [px], at corners ``quads`` (Q, 4, 2)."""
    count, cells = white.shape[:2]
    to_cells = _to_cells(quads, cells)
    of_optics = to_cells @ to_cells.swapaxes(1, 2)
    if not grid.graded:
        # Outlines that are aligned are as oblique as they are inaccurate, and their blur is none of the optics.
        of_optics = of_optics * np.eye(2)
    spread = (blur * blur)[:, None, None] * of_optics
    if view.motion is not None:
        moved = to_cells @ view.motion[..., None]
        spread = spread + moved @ moved.swapaxes(1, 2)
    x, y = _weights(grid.along, cells, np.sqrt(np.einsum('qii->iq', spread)))
    model = _model(x, y, white, *(part.astype(np.float32) for part in (spread, blur, of_optics)))
    samples = grid.without_background(view.gray(quads, grid))
    terms = grid.without_background(_linear_terms(model, spread, grid, cells, displayed=view.displayed))
    amounts, rest = _fitted(terms, samples)
    contrast = _contrast(amounts.astype(np.float32), model, grid, displayed=view.displayed)
    # Steps of an alignment are long: what of the slopes looks like background is not trusted.
    slopes = model.slopes if grid.graded else grid.without_background(model.slopes)
    by_px = to_cells.swapaxes(1, 2).astype(np.float32) @ (slopes * contrast).swapaxes(0, 1)
    J = np.empty((count, LINEAR.start + terms.shape[1], samples.shape[1]), dtype=np.float32)
    np.multiply(by_px[:, :, None], grid.weights, out=J[:, CORNERS].reshape(count, 2, 4, -1))
    J[:, BLUR], J[:, LINEAR] = -contrast * model.wider, -terms
    return PatternResiduals(quads, blur, to_cells, x[:, 0], y[:, 0], samples, rest, amounts, J, grid)


def _fitted(terms: Float32Array, samples: Float32Array) -> tuple[FloatArray, Float32Array]:
    """Amounts (Q, L) of linear terms (Q, L, P) in gray levels (Q, P), and what they leave of these."""
    products = np.asarray(terms @ terms.swapaxes(1, 2), dtype=np.float64) + TINY * np.eye(terms.shape[1])
    amounts = np.linalg.solve(products, terms @ samples[..., None])
    rest = samples - (terms.swapaxes(1, 2) @ amounts.astype(np.float32))[..., 0]
    return np.asarray(amounts[..., 0]), np.asarray(rest)


def _contrast(amounts: Float32Array, model: PatternModel, grid: PatternGrid, *, displayed: bool) -> Float32Array:
    """White minus black (Q, P or 1) where the samples are, by the amounts (Q, L) of the linear terms."""
    if not grid.graded:
        return amounts
    contrast = amounts[:, :1] + amounts[:, _GRADIENTS] @ grid.middle + amounts[:, _BOWL, None] * grid.bowl
    if displayed:
        contrast += amounts[:, _OF_GAIN_CONTROL] * (1.0 + 2.0 * model.value)
    return np.asarray(contrast)


def _model(
    x: Float32Array,
    y: Float32Array,
    white: FloatArray,
    spread: Float32Array,
    blur: Float32Array,
    of_optics: Float32Array,
) -> PatternModel:
    """Patterns, 0 for white and -1 for black, with a blur of covariance ``spread`` (Q, 2, 2) [cells^2].

    Parameters
    ----------
    x, y : (Q, 3, S, m) of :func:`_weights` along rows and along columns
    of_optics : (Q, 2, 2) derivative of ``spread`` by the variance of the optics
    """
    count, orders, samples, cells = x.shape
    black = (white - 1.0).astype(np.float32)
    # All derivatives down and across by two products: numpy takes longer to call than to multiply.
    drawn = y.reshape(count, -1, cells) @ black @ x.reshape(count, -1, cells).swapaxes(1, 2)
    shown = drawn.reshape(count, orders, samples, orders, samples).transpose(1, 3, 0, 2, 4)
    (value, by_x, by_xx), (by_y, by_xy, by_xxy), (by_yy, by_xyy, by_xxyy) = shown.reshape(orders, orders, count, -1)
    c = spread[:, :1, 1]
    shape = value + c * (by_xy + np.float32(0.5) * c * by_xxyy)
    slopes = np.stack([by_x + c * by_xxy, by_y + c * by_xyy])
    # Blur spreads a pattern as heat does: its derivative by a variance is half its curvature.
    wider = of_optics[:, :1, 0] * by_xx + of_optics[:, 1:, 1] * by_yy + np.float32(2.0) * of_optics[:, :1, 1] * by_xy
    return PatternModel(shape, slopes, blur[:, None] * wider)


def _linear_terms(
    model: PatternModel, spread: FloatArray, grid: PatternGrid, cells: int, *, displayed: bool
) -> Float32Array:
    """Linear terms (Q, L, P): the pattern; where the contrast is graded its gradients, and end and bowl of the surface.

    The bowl shows through the white cells alone, what curves the level is before all cells. In a picture for a display
    also what a quadratic function of the counts adds between black and white.
    """
    if not grid.graded:
        return model.value[:, None]
    # Of a blurred product with a linear function: the gradient of what is blurred moves with it.
    displaced = (spread / cells).astype(np.float32) @ model.slopes.swapaxes(0, 1)
    graded = model.value[:, None] * grid.middle + displaced
    outside = np.array([-_SURFACE_ENDS, cells + _SURFACE_ENDS])
    x, y = _between(outside, grid.along, np.sqrt(np.einsum('qii->iq', spread)))
    surface = (y[:, :, None] * x[:, None]).reshape(len(spread), 1, -1)
    bowl = grid.bowl * (1.0 + model.value) + 2.0 * (grid.middle * displaced).sum(axis=1)
    level = np.broadcast_to(grid.curvatures, (len(spread), *grid.curvatures.shape))
    terms = [model.value[:, None], graded, surface, bowl[:, None], level]
    if displayed:
        terms.append((model.value * (1.0 + model.value))[:, None])
    return np.concatenate(terms, axis=1)


def _between(ends: FloatArray, along: FloatArray, blur: FloatArray) -> Float32Array:
    """Share (..., S) of a stretch between two ``ends`` (2,) at places ``along`` (S,), for ``blur`` (...) [cells]."""
    below = np.interp((ends[:, None] - along) / blur[..., None, None], _Z, _BELOW)
    return np.asarray(below[..., 1, :] - below[..., 0, :], dtype=np.float32)


def _to_cells(quads: FloatArray, cells: int) -> FloatArray:
    """Mean derivatives (Q, 2, 2) of places in markers [cells] by pixels."""
    across = quads[:, 1] - quads[:, 0] + quads[:, 2] - quads[:, 3]
    down = quads[:, 3] - quads[:, 0] + quads[:, 2] - quads[:, 1]
    to_px = np.stack([across, down], axis=-1) / (2.0 * cells)
    area = np.linalg.det(to_px)
    collapsed = np.abs(area) < TINY
    to_px[collapsed] = np.eye(2)
    return np.asarray(np.linalg.inv(to_px))


def _weights(along: FloatArray, cells: int, blur: FloatArray) -> Float32Array:
    """Weights of cells at places ``along`` (S,) for ``blur`` (...) [cells], and two derivatives, (..., 3, S, m)."""
    width = blur[..., None, None]
    # So far off nothing is left, but no number in single precision is too small.
    z = np.clip((np.arange(cells + 1) - along[:, None]) / width, -_FARTHEST, _FARTHEST)
    density = np.exp(-0.5 * z * z) / (math.sqrt(2.0 * math.pi) * width)
    return np.diff(np.stack([np.interp(z, _Z, _BELOW), -density, -z * density / width], axis=-3)).astype(np.float32)
