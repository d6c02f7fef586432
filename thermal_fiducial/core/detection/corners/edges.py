"""Model of the pixels across a marker's side: a blurred step from white to black, and the nearest edges behind it."""

import math

import numpy as np

from thermal_fiducial.core.detection.corners.sides import Sides
from thermal_fiducial.core.types import BoolArray, Float32Array, FloatArray, Gray

#: Neighbouring edges that the model knows: so many cells behind the side.
NEIGHBOURS = (1, 2)
# Cells narrower than this many blurs show their neighbours' edges in every profile.
_NARROW = 5.0
# Approximation of the normal distribution by a hyperbolic tangent, good to 2e-4 (E. Page, "Approximations to the
# cumulative normal function and its inverse for use on a pocket calculator", 1977).
_LINEAR, _CUBIC = 0.7988, 0.7988 * 0.04417
# The plate ends one cell outside, at an edge that the model does not know: so many blurs from it nothing of it shows;
# and what must be seen of the plate all the same [px].
_PLATE_EDGE_SHOWS, _LEAST_QUIET_PX = 1.5, 0.8
# Share of the side that a column must see: beyond its ends there is none.
_MOSTLY = 0.7


def edges_behind(bits: Gray) -> Float32Array:
    """Change of value, 0 black and 1 white, across the edges behind the sides of markers with ``bits`` (M, n, n).

    Returns
    -------
    (M, 4, m, 2) for the sides of :mod:`sides`, the m = n + 2 cells along each, and edges one and two cells inward.
    """
    return _changes(_inward(np.pad(bits.astype(np.float32), ((0, 0), (1, 1), (1, 1)))))


def edges_behind_border(bits: Gray) -> tuple[Float32Array, BoolArray]:
    """The same behind the inner edges of the border, those of n cells a side, as if black lay behind them too.

    Returns
    -------
    (M, 4, n, 2), and whether white lies behind them (M, 4, n), so that they are seen: as rises where sides are falls
    """
    inward = _inward(bits.astype(np.float32))
    return -_changes(inward), inward[:, :, 0] > 0.5


def _inward(grid: Float32Array) -> Float32Array:
    """Values (M, 4, n, m) of grids (M, m, m) by side, cells inward and cells along."""
    turned = np.swapaxes(grid, 1, 2)
    return np.stack([grid, grid[:, ::-1], turned, turned[:, ::-1]], axis=1)[:, :, : len(NEIGHBOURS) + 1]


def _changes(inward: Float32Array) -> Float32Array:
    return np.ascontiguousarray(np.moveaxis(np.diff(inward, axis=2), 2, 3))


def half_width(blur: float) -> int:
    """Pixels of a column on either side of an edge with a ``blur`` [px]."""
    return min(max(math.ceil(2.5 * blur + 1.0), 4), 10)


def blurs(normal: FloatArray, optics: float, lag_blur: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Blur (E,) across and along sides with normals (E, 2), of markers with a motion blur (N, 2) [px]."""
    u, v = normal[:, 0].reshape(len(lag_blur), -1), normal[:, 1].reshape(len(lag_blur), -1)
    across, along = lag_blur[:, :1] * u + lag_blur[:, 1:] * v, lag_blur[:, 1:] * u - lag_blur[:, :1] * v
    square = optics * optics
    return np.sqrt(square + across * across).ravel(), np.sqrt(square + along * along).ravel()


def model(
    sides: Sides, behind: Float32Array, blur: tuple[FloatArray, FloatArray]
) -> tuple[Float32Array, Float32Array, Float32Array]:
    """White's share of every pixel but for a constant, its derivative by distance, and the pixel's weight.

    Parameters
    ----------
    behind : (N, 4, m, 2) of :func:`edges_behind`
    blur : (E,) across and along the sides

    Returns
    -------
    (M, C, m, E) each
    """
    cells = behind.shape[2]
    cell = sides.across / cells
    own = _seen_along(sides, blur[1])
    fall = -own
    value, slope = blurred_step(sides.distance, (1.0 / blur[0]).astype(np.float32))
    value *= fall
    slope *= fall
    narrow = cell < _NARROW * blur[0]
    if narrow.any():
        _add_neighbours(value, slope, sides, np.flatnonzero(narrow), behind.reshape(-1, cells, len(NEIGHBOURS)), blur)
    reach = np.where(narrow, cell, cell - 2.0 * blur[0])
    quiet = np.minimum(reach, np.maximum(cell - _PLATE_EDGE_SHOWS * blur[0], _LEAST_QUIET_PX))
    weight = (sides.distance >= -quiet.astype(np.float32)) & (sides.distance <= reach.astype(np.float32))
    weight &= sides.fresh & (own > _MOSTLY)
    if sides.inside is not None:
        weight &= sides.inside
    return value, slope, weight.astype(np.float32)


def blurred_step(distance: Float32Array, sharpness: Float32Array) -> tuple[Float32Array, Float32Array]:
    """A step from 0 to 1 at zero, and its derivative, blurred by a Gaussian; ``sharpness`` is its inverse width."""
    z = distance * sharpness
    square = z * z
    bent = np.tanh(z * (square * _CUBIC + _LINEAR))
    slope = (1.0 - bent * bent) * (square * (1.5 * _CUBIC) + 0.5 * _LINEAR) * sharpness
    bent *= 0.5
    bent += 0.5
    return bent, np.asarray(slope, dtype=np.float32)


def _seen_along(sides: Sides, blur_along: FloatArray) -> Float32Array:
    """How much of its side a column (C, m, E) sees, blurred along it: less than 1 near its ends."""
    length = (sides.along / blur_along).astype(np.float32)
    t = sides.t.astype(np.float32)
    z = np.stack([t, 1.0 - t]) * length
    ends = np.tanh(z * (z * z * _CUBIC + _LINEAR))
    return np.asarray(0.5 * (ends[0] + ends[1]))


def _add_neighbours(
    value: Float32Array,
    slope: Float32Array,
    sides: Sides,
    which: np.ndarray,
    behind: Float32Array,
    blur: tuple[FloatArray, FloatArray],
) -> None:
    """Add to the model of the sides ``which`` what the edges ``behind`` (E, m, 2) contribute, blurred along."""
    cells = behind.shape[1]
    t = np.moveaxis(sides.t[..., which], -1, 0)[..., None]
    z = (t * cells - np.arange(cells + 1)) * (sides.along / (cells * blur[1]))[which, None, None, None]
    step = 0.5 * np.tanh(z * (z * z * _CUBIC + _LINEAR))
    amounts = np.moveaxis((step[..., :-1] - step[..., 1:]).astype(np.float32) @ behind[which, None], 0, -1)
    width = (sides.across / cells)[which].astype(np.float32)
    sharpness = (1.0 / blur[0])[which].astype(np.float32)
    for index, number in enumerate(NEIGHBOURS):
        share, rise = blurred_step(sides.distance[..., which] - number * width, sharpness)
        value[..., which] += amounts[:, :, index] * share
        slope[..., which] += amounts[:, :, index] * rise
