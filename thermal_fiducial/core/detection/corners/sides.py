"""The sides of markers in the image, columns of pixels across them, and the model of their values.

A side is straight in normalised image coordinates and slightly curved in the raw image. It is sampled by columns of
whole pixels, or by rows if these cross it at a larger angle. Pixels are not interpolated, so their noise stays white.
The model of a column is a blurred step from white to black. It ends before the next edge inside the marker.
"""

from dataclasses import dataclass
from functools import cache
import math
from typing import NamedTuple

import numpy as np

from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.geometry.reprojection import perspective
from thermal_fiducial.core.types import BoolArray, Float32Array, FloatArray, IntArray

#: Corners between which the sides lie: top and bottom from left to right, left and right from the top down.
STARTS, ENDS = np.array([0, 3, 0, 1]), np.array([1, 2, 3, 2])
OPPOSITE = np.array([1, 0, 3, 2])
#: A curved side is a quartic through five points at these shares of its length.
NODES = np.linspace(0.0, 1.0, 5)
# Half the length of columns: this many blurs and a pixel, within limits [px].
_REACHES, _SHORTEST, _LONGEST = 2.5, 4, 10
# Pixels of the image needed on both sides of a side; largest distance of a curve beyond its nodes [px].
_BOTH_SIDES, _BEYOND_NODES = 3, 3.0
# Approximation of the normal distribution by a hyperbolic tangent, good to 2e-4 (E. Page, "Approximations to the
# cumulative normal function and its inverse for use on a pocket calculator", 1977).
_LINEAR = 0.7988
_CUBIC = 0.04417 * _LINEAR
# The next edges inside the marker, and the end of the plate one cell outside, are not in the model: distance from them
# that is left out [blurs].
_EDGE_SHOWS = 2.0
# Least share of the side's step in a column: it falls off at the ends of the side.
_MOSTLY = 0.7


class Blur(NamedTuple):
    """Blur of sides [px]."""

    #: (E, m) and (E, 1) standard deviations across and along the sides
    across: FloatArray
    along: FloatArray


class EdgeModel(NamedTuple):
    """Blurred steps as the pixels across edges show them, (M, C, E, m) each."""

    #: share of white, up to a constant
    value: Float32Array
    #: its derivative by the distance from the edge [1/px]
    slope: Float32Array
    #: which pixels count
    counting: BoolArray


@dataclass(frozen=True, slots=True)
class Sides:
    """The E = 4 N sides of N markers in m parts each, and C columns of M pixels across every part."""

    #: (C, E, m) share of the side at which a column crosses it
    t: FloatArray
    #: (C, E, m) which columns lie in the image and are not duplicates
    fresh: BoolArray
    #: (M, C, E, m) distance of each pixel from the side, inward [px]
    distance: Float32Array
    #: (M, C, E, m) index of each pixel in the flat image
    pixel: IntArray
    #: (M, C, E, m) whether it lies in the image; None: all do
    inside: BoolArray | None
    #: (E, m, 2) unit normal inward, in the middle of each part
    normal: FloatArray
    #: (E, m) distance of the opposite side along the normals [px]
    across: FloatArray
    #: (E, 1) length [px]
    along: FloatArray
    #: (E, 2, 2) where they begin and end [px]
    ends: FloatArray


def sides_of(x: FloatArray, camera: Camera, shape: tuple[int, ...], cells: int, columns: int, blur_px: float) -> Sides:
    """Sides of quadrilaterals (N, 4, 2) in normalised coordinates.

    Parameters
    ----------
    shape : height and width of the image
    cells : m equal parts of a side
    columns : C in each of them
    blur_px : the widest: columns have pixels as far as it reaches on either side
    """
    weight = perspective(x)
    start, end = x.take(STARTS, axis=1), x.take(ENDS, axis=1)
    ratio = (weight.take(ENDS, axis=1) / weight.take(STARTS, axis=1))[..., None]
    share = NODES * ratio / (1.0 + NODES * (ratio - 1.0))
    points = start[:, :, None] + share[..., None] * (end - start)[:, :, None]
    nodes = camera.distort(points).reshape(-1, len(NODES), 2)
    middle = nodes[:, 2]
    opposite = middle.reshape(-1, 4, 2).take(OPPOSITE, axis=1).reshape(-1, 2) - middle
    return columns_across(nodes, opposite, shape, cells, columns, blur_px)


def columns_across(
    nodes: FloatArray, opposite: FloatArray, shape: tuple[int, ...], cells: int, columns: int, blur_px: float
) -> Sides:
    """Columns of pixels across E sides, or across other edges.

    Parameters
    ----------
    nodes : (E, 5, 2) pixels of five points on each, from end to end
    opposite : (E, 2) from their middles to the opposite sides, inward [px]
    shape, cells, columns, blur_px : as of :func:`sides_of`
    """
    span = nodes[:, 4] - nodes[:, 0]
    steep = (np.abs(span[:, 1]) > np.abs(span[:, 0]))[:, None]
    share, weights = _parts(cells, columns)
    # First the coordinate in which columns follow one another, then that along them.
    upright = np.where(steep[..., None], nodes[..., ::-1], nodes)
    opposite_upright = np.where(steep, opposite[:, ::-1], opposite)
    lines = upright.transpose(2, 0, 1)[:, None] @ weights
    (along, rate), (across, climb) = lines.reshape(2, 2, columns, len(nodes), cells)
    # Columns are rounded to whole pixels, by at most half a pixel: over that distance the side is straight.
    whole, slope = np.rint(along), climb / rate
    ahead = whole - along
    centre = across + slope * ahead
    # Within a part, the slope hardly changes. Inward is where the opposite side lies.
    slope = slope[columns // 2]
    inward = np.sign(opposite_upright[:, 1:] - slope * opposite_upright[:, :1])
    pitch = inward / np.sqrt(1.0 + slope * slope)
    normal = np.array([-slope * pitch, pitch])
    normal = np.where(steep, normal[::-1], normal).transpose(1, 2, 0)
    half = min(max(math.ceil(_REACHES * blur_px + 1.0), _SHORTEST), _LONGEST)
    base, offsets = np.rint(centre), np.arange(-half, half + 1)[:, None, None, None]
    fresh, inside = _in_image(whole, base, steep, nodes, shape, half)
    off, rise = ((base - centre) * pitch).astype(np.float32), pitch.astype(np.float32)
    # For each part, not for each side: numpy is slow where it repeats the few numbers of a row.
    parts_steep = np.repeat(steep, cells, axis=1)
    across_stride, along_stride = np.where(parts_steep, 1, shape[1]), np.where(parts_steep, shape[1], 1)
    pixel = (base * across_stride + whole * along_stride).astype(np.int64)
    return Sides(
        share + ahead / rate,
        fresh,
        rise * offsets.astype(np.float32) + off,
        pixel + across_stride * offsets,
        inside,
        normal,
        np.abs((normal @ opposite[..., None])[..., 0]),
        np.hypot(span[:, :1], span[:, 1:]),
        nodes[:, ::4],
    )


@cache
def _parts(cells: int, columns: int) -> tuple[FloatArray, FloatArray]:
    """Shares (C, 1, m) of a side where columns cross it; weights (2 C, 5, m) of nodes in the places and derivatives."""
    share = ((np.arange(columns)[:, None] + 0.5) / columns + np.arange(cells)) / cells
    powers = np.arange(len(NODES))
    at = share.reshape(-1, 1) ** powers
    rate = np.zeros_like(at)
    rate[:, 1:] = powers[1:] * at[:, :-1]
    weights = np.concatenate([at, rate]) @ np.linalg.inv(np.vander(NODES, increasing=True))
    return share[:, None], weights.reshape(2 * columns, cells, len(NODES)).swapaxes(1, 2)


def _in_image(
    whole: FloatArray, base: FloatArray, steep: BoolArray, nodes: FloatArray, shape: tuple[int, ...], half: int
) -> tuple[BoolArray, BoolArray | None]:
    """Which columns (C, E, m) lie in the image, repeating no other, and which of their pixels (M, C, E, m) do."""
    fresh = np.ones(whole.shape, dtype=bool)
    np.not_equal(whole[1:], whole[:-1], out=fresh[1:])
    np.not_equal(whole[0, :, 1:], whole[-1, :, :-1], out=fresh[0, :, 1:])
    margin = half + _BEYOND_NODES
    u, v = nodes.reshape(-1, 2).max(axis=0).tolist()
    if nodes.min() >= margin and max(u - shape[1], v - shape[0]) <= -1.0 - margin:
        return fresh, None
    far, end = np.where(steep, shape[::-1], shape).T[..., None] - 1.0
    fresh &= (whole >= 0.0) & (whole <= end) & (base >= _BOTH_SIDES) & (base <= far - _BOTH_SIDES)
    place = base + np.arange(-half, half + 1)[:, None, None, None]
    return fresh, (place >= 0.0) & (place <= far)


def blur_of(sides: Sides, optics: float, motion: FloatArray) -> Blur:
    """Blur of the sides of N markers by optics [px] and a motion (N, 2) [px]."""
    span = sides.ends[:, 1] - sides.ends[:, 0]
    by_side = np.repeat(motion, len(span) // len(motion), axis=0)
    across = (sides.normal @ by_side[..., None])[..., 0]
    along = (span * by_side).sum(axis=1, keepdims=True) / sides.along
    return Blur(np.hypot(optics, across), np.hypot(optics, along))


def model(sides: Sides, blur: Blur, inward: FloatArray, outward: FloatArray) -> EdgeModel:
    """Model of the sides of markers; ``inward``, ``outward`` (E, m): distances up to which pixels count [px]."""
    z = np.array([sides.t, 1.0 - sides.t], dtype=np.float32) * (sides.along / blur.along).astype(np.float32)
    # Blurred along the side, the share (C, E, m) of the step is less than 1 near the ends.
    own = np.asarray(0.5 * np.tanh(z * (z * z * _CUBIC + _LINEAR)).sum(axis=0), dtype=np.float32)
    value, slope = blurred_step(sides.distance, (1.0 / blur.across).astype(np.float32), -own)
    counting: BoolArray = np.asarray(sides.distance >= -outward.astype(np.float32))
    counting &= sides.distance <= inward.astype(np.float32)
    counting &= sides.fresh & (own > _MOSTLY)
    if sides.inside is not None:
        counting &= sides.inside
    return EdgeModel(value, slope, counting)


def free_distance(sides: Sides, width: FloatArray) -> FloatArray:
    """Distance (E, m) from the sides up to which no other edge shows, for blur of ``width`` (E, m) [px]."""
    return np.asarray(sides.across / sides.across.shape[1] - _EDGE_SHOWS * width)


def blurred_step(
    distance: Float32Array, sharpness: Float32Array, height: Float32Array
) -> tuple[Float32Array, Float32Array]:
    """A step from 0 to ``height`` at zero, and its derivative, blurred by a Gaussian of inverse width ``sharpness``."""
    half = np.float32(0.5) * height
    # In place: fresh memory takes as long as what is computed in it.
    z = distance * sharpness
    square = z * z
    step = np.asarray(square * _CUBIC, dtype=np.float32)
    step += _LINEAR
    step *= z
    np.tanh(step, out=step)
    slope = np.multiply(step, step, out=z)
    np.subtract(1.0, slope, out=slope)
    square *= 3.0 * _CUBIC
    square += _LINEAR
    slope *= square
    slope *= half * sharpness
    step += 1.0
    step *= half
    return step, slope
