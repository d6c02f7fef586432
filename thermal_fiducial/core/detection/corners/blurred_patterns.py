"""Model of a marker's whole pattern as the camera shows it.

A pattern is sampled on a grid in the marker's own coordinates [cells], where cells are separable: the blur of its
columns and that of its rows are products. A blur that is oblique there, as that of a tilted marker and of motion, has a
correlation c besides, and a Gaussian with it is exp(c d2/dxdy) of one without. Bolometers forget exponentially: where
lag tails are not removed, the pattern lags behind by an age that is a mixture of Gaussians.

Straight lines are bent by the lens: between its corners a marker is displaced by a cubic polynomial of the places in
it.

All that is linear is part of the model. The warm surface and the sheet before it each have a temperature that is linear
across the marker, so level and contrast are. The surface may be warmest in its middle, and may end one cell outside the
marker; and smoke in front makes the level a little quadratic. The gray levels of a display are a polynomial of fourth
order of the blurred counts, and there the contrast is one of third order of the place: smoke lets through a share of
the warmth that may change by several times within a marker.
"""

from functools import cache
import math
from typing import NamedTuple

import cv2
import numpy as np

from thermal_fiducial.core.detection.prediction.frame import lag_tail_places, Saturation, without_tails
from thermal_fiducial.core.geometry.camera import Camera, ImagePoints, inverse_2x2
from thermal_fiducial.core.geometry.reprojection import bilinear, seen_between
from thermal_fiducial.core.types import BoolArray, Float32Array, FloatArray, IntArray, TINY

# Place of the end of the warm surface outside the sides [cells].
_SURFACE_ENDS = 1.0
#: Parameters of a fit: u of the corners and v of them, blur, and amounts of the linear terms; the first of these is the
#: contrast.
CORNERS, BLUR, LINEAR = slice(0, 8), 8, slice(9, None)
#: Places among the linear terms of those whose amounts are known to be small: three curvatures of the level, the bowl
#: of the warm surface, and in pictures for a display six more curves of the contrast and what bends the gray scale.
SMALL = slice(7, None)
#: Largest values in a marker of the three curvatures and the seven curves.
LARGEST_OF_LEVEL, LARGEST_OF_CURVES = np.full(3, 0.25), np.array([0.5, 0.25, 0.25, 0.125, 0.125, 0.125, 0.125])
#: Amounts of what bends the gray scale of a display. After a plateau equalisation markers of 27 px in motion are 0.046,
#: 0.032, 0.027 and 0.027 px off with one to four, those of 40 px 0.17, 0.10, 0.076 and 0.073 px.
BENDS = 3
# Places among the linear terms of the gradients of the contrast, of its curves, and of what bends the gray scale.
_GRADIENTS, _BOWL, _CURVES, _BENT = slice(1, 3), slice(10, 11), slice(10, 17), slice(17, 17 + BENDS)
# Cumulative standard normal distribution: where its table ends, and places of it in a standard deviation.
_FARTHEST, _PLACES = 6, 200
_BELOW = np.array(
    [
        0.5 * math.erfc(-place / _PLACES / math.sqrt(2.0))
        for place in range(-_FARTHEST * _PLACES, _FARTHEST * _PLACES + 1)
    ]
)
# Places along a side where it is computed how the lens bends, and the weights of the corners in the nodes of the grid
# of them, rows first. With three a side, as a parabola has, markers of 22 px are 0.1 px too large behind a lens of 72
# degrees that shortens distances from the middle of the image by a fifth.
_NODES = np.linspace(0.0, 1.0, 4)
_BETWEEN_CORNERS = bilinear(*(axis.ravel() for axis in np.meshgrid(_NODES, _NODES)))
_AT_CORNERS = [0, 3, 15, 12]


class Ages(NamedTuple):
    """An exponential response as a sum of Gaussians: (K,) what they weigh, mean and variance in time constants."""

    weights: FloatArray
    means: FloatArray
    variances: FloatArray

    @staticmethod
    def lasting(*lasts: float) -> 'Ages':
        """Of parts that last so long one after the other, in time constants."""
        lengths = np.array(lasts)
        begins = np.cumsum(lengths) - lengths
        weights = np.exp(-begins) * -np.expm1(-lengths)
        variances = 1.0 + lengths**2 / (np.expm1(lengths) * np.expm1(-lengths))
        return Ages(weights, begins + 1.0 - lengths / np.expm1(lengths), variances)


# Fitted with two parts, markers in 2 to 5 px of lag were 1.1 to 2.6 times as far off; with three they were as with four
# or 10 % farther, with five or more as with four.
_FOUR_AGES = Ages.lasting(0.6, 0.8, 1.4, 40.0)


class PatternGrid(NamedTuple):
    """Samples of a marker with m x m cells, S along each axis, P = S * S.

    They are ordered by patches, each around one of the n x n nodes of the pattern, where cells meet; n = m + 1.
    """

    #: (S,) [cells]
    along: FloatArray
    #: (4, P) of :func:`bilinear`
    weights: Float32Array
    #: (16, P) of the nodes where the bends of the lens are known
    between_nodes: Float32Array
    #: (P, 3 or 6) orthonormal backgrounds
    background: Float32Array
    #: (2, P) places from the middle, in sides
    middle: Float32Array
    #: (7, P) functions of these: squared distances from the middle, further quadratic and all cubic ones; and their
    #: slopes (2, 7, P)
    curves: Float32Array
    curve_slopes: Float32Array
    #: (6, P) functions of these places up to quadratic ones
    levels: Float32Array
    #: distance of the samples [cells]
    apart: float
    #: n, and samples along the sides of a patch
    lines: int
    density: int
    #: whether contrast is linear across the marker, else constant
    graded: bool

    def without_background(self, values: Float32Array) -> Float32Array:
        """Values (..., P) at the samples without their background."""
        return np.asarray(values - (values @ self.background) @ self.background.T)

    def by_patches(self, rows: Float32Array) -> Float32Array:
        """Values (..., P) of samples that are ordered by rows."""
        shape = rows.shape[:-1]
        parts = rows.reshape(*shape, self.lines, self.density, self.lines, self.density)
        return np.asarray(parts.swapaxes(-3, -2).reshape(*shape, -1))

    def by_rows(self, values: Float32Array) -> Float32Array:
        """Values (..., S, S) of samples (..., P)."""
        shape, samples = values.shape[:-1], len(self.along)
        parts = values.reshape(*shape, self.lines, self.lines, self.density, self.density)
        return np.asarray(parts.swapaxes(-3, -2).reshape(*shape, samples, samples))

    def patches(self, values: Float32Array) -> Float32Array:
        """Values (..., n * n, P / (n * n)) of samples (..., P)."""
        return values.reshape(*values.shape[:-1], -1, self.density**2)

    def apart_px(self, to_cells: FloatArray) -> FloatArray:
        """Distance (Q,) of samples [px], ``to_cells`` (Q, 2, 2) of :func:`cells_by_pixels`."""
        return np.asarray(self.apart / np.sqrt(np.abs(determinants(to_cells))))


def determinants(matrices: FloatArray) -> FloatArray:
    """Of matrices (Q, 2, 2), (Q,)."""
    return np.asarray(matrices[:, 0, 0] * matrices[:, 1, 1] - matrices[:, 0, 1] * matrices[:, 1, 0])


@cache
def pattern_grid(cells: int, density: int, nearer: int = 0, *, bent: bool = False) -> PatternGrid:
    """Grid with so many samples along a cell, ``nearer`` times twice as close to the lines between cells.

    The background is linear, and so is the contrast; if ``bent`` the background is quadratic, the contrast constant.
    """
    apart, lines = 1.0 / (density * 2**nearer), cells + 1
    along = (np.arange(lines)[:, None] + apart * (np.arange(density) - 0.5 * (density - 1))).ravel()
    column = np.broadcast_to(along.reshape(1, lines, 1, density), (lines, lines, density, density)) / cells
    a, b = column.ravel(), column.transpose(1, 0, 3, 2).ravel()
    linear = [np.ones_like(a), a, b]
    background = np.linalg.qr(np.stack([*linear, a * a, a * b, b * b] if bent else linear, axis=1))[0]
    weights, middle = bilinear(a, b).astype(np.float32), np.stack([a, b]).astype(np.float32) - np.float32(0.5)
    u, v = middle
    no, uu, uv, vv = np.zeros_like(u), u * u, u * v, v * v
    levels = np.stack([no + 1.0, u, v, uu, uv, vv])
    curves = np.stack([uu + vv, uu - vv, uv, u * uu, v * uu, u * vv, v * vv])
    by_u, by_v = [2.0 * u, 2.0 * u, v, 3.0 * uu, 2.0 * uv, vv, no], [2.0 * v, -2.0 * v, u, no, uu, 2.0 * uv, 3.0 * vv]
    slopes = np.stack([by_u, by_v])
    nodes = (_of_nodes(b)[:, None] * _of_nodes(a)).reshape(-1, a.size).astype(np.float32)
    background = background.astype(np.float32)
    return PatternGrid(
        along, weights, nodes, background, middle, curves, slopes, levels, apart, lines, density, graded=not bent
    )


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
    #: (Q, 4, 2) mean displacement of the corners by an exponential lag, with which the image shows them [px]; None: of
    #: none
    lag: FloatArray | None = None
    #: whether its values are a nonlinear function of the counts
    displayed: bool = False
    #: (Q, 2, 16) of :func:`lens_bends`; None: straight lines are straight in the image
    bends: FloatArray | None = None
    #: where the gray scale ends; None: nowhere, or it does not matter
    saturation: Saturation | None = None
    #: of the response, where it lags
    ages: Ages = _FOUR_AGES

    def only(self, which: IntArray) -> 'PatternView':
        """The view of some markers."""
        names = 'to_tails', 'motion', 'lag', 'bends'
        parts = {name: getattr(self, name) for name in names}
        return self._replace(**{name: part[which] for name, part in parts.items() if part is not None})

    def places(self, quads: FloatArray, grid: PatternGrid) -> tuple[Float32Array, Float32Array | None]:
        """Places (2, Q, P) of the samples of markers in ``quads`` (Q, 4, 2), and of lag tails that are removed."""
        places = seen_between(quads, grid.weights)
        if self.bends is not None:
            places += (self.bends.astype(np.float32) @ grid.between_nodes).swapaxes(0, 1)
        return places, None if self.to_tails is None else lag_tail_places(places, self.to_tails)

    def values(self, places: Float32Array, tails: Float32Array | None) -> Float32Array:
        """Values (Q, P) at samples, by :meth:`places`."""
        shown = self._at(places)
        if tails is None:
            return shown
        shown = without_tails(shown, self._at(tails))
        return shown if self.saturation is None else self.saturation.cut(shown)

    def known(self, places: Float32Array, tails: Float32Array | None) -> BoolArray:
        """Which samples (Q, P) are known, by :meth:`places`."""
        if self.saturation is None:
            return np.ones(places.shape[1:], dtype=np.bool_)
        return np.asarray(self.saturation.at(places) == 0.0 if tails is None else self.saturation.known(places, tails))

    def _at(self, places: Float32Array) -> Float32Array:
        u, v = places
        shown = cv2.remap(self.image, u, v, cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(shown, dtype=np.float32)


def lens_bends(corners: ImagePoints, camera: Camera) -> FloatArray:
    """How the lens displaces the nodes between the corners (Q, 4) of markers, (Q, 2, 16) [px]."""
    uv = camera.distort(np.moveaxis(seen_between(corners.x, _BETWEEN_CORNERS), 0, -1))
    return np.asarray(uv.swapaxes(1, 2) - seen_between(uv[:, _AT_CORNERS], _BETWEEN_CORNERS).swapaxes(0, 1))


class PatternModel(NamedTuple):
    """Blurred patterns of Q markers, 0 for white and -1 for black, (Q, P) each."""

    value: Float32Array
    #: (2, Q, P) derivatives along columns and rows [1/cell]
    slopes: Float32Array
    #: derivative by the blur [1/px]
    wider: Float32Array
    #: the warm surface, which may end outside the marker: 1 on it
    surface: Float32Array


def blurred(
    view: PatternView, to_cells: FloatArray, blur: FloatArray, white: FloatArray, grid: PatternGrid
) -> tuple[PatternModel, FloatArray]:
    """Patterns of ``white`` cells (Q, m, m), and the covariances (Q, 2, 2) of all their blur [cells^2].

    Parameters
    ----------
    to_cells : (Q, 2, 2) of :func:`cells_by_pixels`
    blur : (Q,) of the optics [px]
    """
    of_optics = to_cells @ to_cells.swapaxes(1, 2)
    if not grid.graded:
        # Outlines that are aligned are as oblique as they are inaccurate, and their blur is none of the optics.
        of_optics = of_optics * np.eye(2)
    spread = (blur * blur)[:, None, None] * of_optics
    if view.motion is not None:
        moved = to_cells @ view.motion[..., None]
        spread = spread + moved @ moved.swapaxes(1, 2)
    if view.lag is None:
        return _gaussian(grid.along, white, grid, spread, blur, of_optics), spread
    lag = to_cells @ view.lag.mean(axis=1)[..., None]
    by_lag = lag @ lag.swapaxes(1, 2)
    # Where it changes across the marker, parts are stretched, the oldest and most blurred ones the most.
    stretch = to_cells @ _by_cells(view.lag, white.shape[1]) * white.shape[1]
    # Of each age all markers, as one batch.
    later, parts = view.ages.means - 1.0, len(view.ages.means)
    then = grid.along - (later[:, None, None] * lag.swapaxes(0, 1)[:, None]).reshape(2, -1, 1)
    of_ages = (spread + view.ages.variances[:, None, None, None] * by_lag).reshape(-1, 2, 2)
    model = _gaussian(
        then, np.tile(white, (parts, 1, 1)), grid, of_ages, np.tile(blur, parts), np.tile(of_optics, (parts, 1, 1))
    )
    weights = view.ages.weights.astype(np.float32)
    value, slopes, wider, surface = (field.reshape(*field.shape[:-2], parts, len(white), -1) for field in model)
    stretched = (stretch.astype(np.float32) @ grid.middle).swapaxes(0, 1)
    farther = (weights * later.astype(np.float32)) @ (slopes * stretched[:, None]).sum(axis=0).reshape(parts, -1)
    value, slopes, wider, surface = (np.tensordot(weights, f, (0, -3)) for f in (value, slopes, wider, surface))
    return PatternModel(value - farther.reshape(value.shape), slopes, wider, surface), spread + by_lag


def _gaussian(
    along: FloatArray,
    white: FloatArray,
    grid: PatternGrid,
    spread: FloatArray,
    blur: FloatArray,
    of_optics: FloatArray,
) -> PatternModel:
    """Patterns with a blur of covariance ``spread`` (Q, 2, 2) [cells^2].

    Parameters
    ----------
    along : (S,) or (2, Q, S) places of the samples along rows and along columns [cells]
    of_optics : (Q, 2, 2) derivative of ``spread`` by the variance of the optics
    """
    count, cells = white.shape[:2]
    x, y = cell_weights(along, cells, spread).swapaxes(1, 2)
    black, c = (white - 1.0).astype(np.float32), spread[:, :1, 1].astype(np.float32)
    # All derivatives down and across, then what blur makes of them, in place: fresh memory takes as long as sums in it.
    shown = ((y @ black)[:, None] @ x.swapaxes(2, 3)).reshape(3, 3, count, -1)
    (value, by_x, by_xx), (by_y, by_xy, by_xxy), (by_yy, by_xyy, by_xxyy) = shown
    by_xxyy *= np.float32(0.5) * c
    by_xxyy += by_xy
    for shape, curved in ((value, by_xxyy), (by_x, by_xxy), (by_y, by_xyy)):
        curved *= c
        shape += curved
    # Blur spreads a pattern as heat does: its derivative by a variance is half its curvature.
    xx, yy, xy = (blur[:, None] * of_optics.reshape(count, 4)[:, [0, 3, 1]]).T[..., None].astype(np.float32)
    for curved, by_blur in ((by_xx, xx), (by_yy, yy), (by_xy, np.float32(2.0) * xy)):
        curved *= by_blur
    by_xx += by_yy
    by_xx += by_xy
    across, down = _between(np.array([-_SURFACE_ENDS, cells + _SURFACE_ENDS]), along, spread)
    surface = (down[:, :, None] * across[:, None]).reshape(count, -1)
    parts = grid.by_patches(np.stack([value, by_x, by_y, by_xx, surface]))
    return PatternModel(parts[0], parts[1:3], parts[3], parts[4])


def linear_terms(
    model: PatternModel, spread: FloatArray, grid: PatternGrid, cells: int, *, displayed: bool
) -> Float32Array:
    """Room for all derivatives (Q, 9 + L, P) that has the L linear terms in it.

    These are the pattern; where it is graded its gradients, surface's end, levels, and curves.
    The bowl of the surface shows through the white cells alone, what curves the level is before all cells. In a picture
    for a display the contrast has further curves, and there is what a polynomial of the counts adds between black and
    white.
    """
    value, number = model.value, len(grid.curves) if displayed else 1
    linear = 1 if not grid.graded else _BOWL.start + number + (BENDS if displayed else 0)
    J = np.empty((len(value), LINEAR.start + linear, value.shape[1]), dtype=np.float32)
    terms = J[:, LINEAR]
    if not grid.graded:
        terms[:, 0] = grid.without_background(value)
        return J
    # Of a blurred product with a linear function: the gradient of what is blurred moves with it.
    displaced = (spread / cells).astype(np.float32) @ model.slopes.swapaxes(0, 1)
    terms[:, 0] = value
    graded, curves = terms[:, _GRADIENTS], terms[:, _BOWL.start : _BOWL.start + number]
    # In place: fresh memory takes as long as what is computed in it.
    np.multiply(value[:, None], grid.middle, out=graded)
    graded += displaced
    # What lacks of the surface, not the surface: small numbers for sums in single precision.
    np.subtract(model.surface, 1.0, out=terms[:, _GRADIENTS.stop])
    terms[:, _GRADIENTS.stop + 1 : _BOWL.start] = grid.levels
    np.multiply(grid.curves[:number], (1.0 + value)[:, None], out=curves)
    for slopes, along in zip(grid.curve_slopes[:, :number], displaced.swapaxes(0, 1), strict=True):
        curves += slopes * along[:, None]
    if displayed:
        across, bent = 2.0 * value + 1.0, terms[:, _BENT]
        np.multiply(value, 1.0 + value, out=bent[:, 0])
        for before in range(BENDS - 1):
            np.multiply(across, bent[:, before], out=bent[:, before + 1])
    return J


def local_contrast(amounts: Float32Array, model: PatternModel, grid: PatternGrid, *, displayed: bool) -> Float32Array:
    """White minus black (Q, P or 1) where the samples are, by the amounts (Q, L) of the linear terms."""
    if not grid.graded:
        return amounts
    curves = amounts[:, _CURVES if displayed else _BOWL]
    contrast = amounts[:, :1] + amounts[:, _GRADIENTS] @ grid.middle + curves @ grid.curves[: curves.shape[1]]
    if displayed:
        across, (first, second, third) = 2.0 * model.value + 1.0, amounts[:, _BENT].T[..., None]
        squared = across * across
        # Of the terms above: as 4 v (1 + v) = across^2 - 1, they are polynomials of ``across``, whose slope is 2.
        contrast += first * across + second * (1.5 * squared - 0.5) + third * across * (2.0 * squared - 1.0)
    return np.asarray(contrast)


def _between(ends: FloatArray, along: FloatArray, spread: FloatArray) -> Float32Array:
    """Share (2, Q, S) of a stretch between two ``ends`` (2,) at places ``along`` (... S), for a blur [cells^2]."""
    below = _normal((ends[:, None] - along[..., None, :]) / _widths(spread))[1]
    return np.asarray(below[..., 1, :] - below[..., 0, :], dtype=np.float32)


def _widths(spread: FloatArray) -> FloatArray:
    """Standard deviations (2, Q, 1, 1) along rows and along columns, of covariances (Q, 2, 2)."""
    return np.asarray(np.sqrt(np.einsum('qii->iq', spread))[..., None, None])


def cells_by_pixels(quads: FloatArray, cells: int) -> FloatArray:
    """Mean derivatives (Q, 2, 2) of places in markers [cells] by pixels."""
    to_px = _by_cells(quads, cells)
    to_px[np.abs(determinants(to_px)) < TINY] = np.eye(2)
    return inverse_2x2(to_px)


def _by_cells(corners: FloatArray, cells: int) -> FloatArray:
    """Mean derivatives (Q, 2, 2) of what the corners (Q, 4, 2) have, by places in markers [1/cell]."""
    across = corners[:, 1] - corners[:, 0] + corners[:, 2] - corners[:, 3]
    down = corners[:, 3] - corners[:, 0] + corners[:, 2] - corners[:, 1]
    return np.asarray(np.stack([across, down], axis=-1) / (2.0 * cells))


def cell_weights(along: FloatArray, cells: int, spread: FloatArray) -> Float32Array:
    """Weights of cells along rows and along columns, and two derivatives, (2, Q, 3, S, m).

    Parameters
    ----------
    along : (S,) or (2, Q, S) places [cells]
    spread : (Q, 2, 2) covariance of the blur [cells^2]
    """
    width = _widths(spread)
    z, below, density = _normal((np.arange(cells + 1) - along[..., None]) / width)
    density /= width
    return np.diff(np.stack([below, -density, -z * density / width], axis=-3)).astype(np.float32)


def _normal(z: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Standard normal variables, not farther off than ``_FARTHEST``, their cumulative distribution and its density."""
    # So far off nothing is left, but no number in single precision is too small.
    z = np.clip(z, -_FARTHEST, _FARTHEST)
    density = np.exp(-0.5 * z * z) / math.sqrt(2.0 * math.pi)
    # From the nearest place of the table, to a millionth: numpy's interpolation takes many times as long.
    places = np.rint(z * _PLACES)
    nearest = _BELOW.take((places + _FARTHEST * _PLACES).astype(np.intp))
    return z, nearest + (z - places / _PLACES) * density, density
