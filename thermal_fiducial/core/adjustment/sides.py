"""The sides of markers in the image, and the pixels across them.

A side is straight in normalised image coordinates, a gentle curve in the raw image. Columns of whole pixels cross it,
or rows, whichever cross it more squarely. No pixel is interpolated, so noise stays white.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np

from thermal_fiducial.core import geometry
from thermal_fiducial.core.camera import Camera
from thermal_fiducial.core.types import BoolArray, Float32Array, FloatArray, IntArray

#: Corners between which the sides lie: top and bottom from left to right, left and right from the top down.
STARTS, ENDS = np.array([0, 3, 0, 1]), np.array([1, 2, 3, 2])
_OPPOSITE = np.array([1, 0, 3, 2])
# A curved side is a quartic through five of its points, at these shares of it.
_NODES = np.linspace(0.0, 1.0, 5)
_A = np.concatenate([_NODES, _NODES, np.zeros(5), np.ones(5)])
_B = np.concatenate([np.zeros(5), np.ones(5), _NODES, _NODES])
# Pixels of the image that a side must have on both sides.
_BOTH_SIDES = 3


@dataclass(frozen=True, slots=True)
class Sides:
    """The 4 sides of each of N markers, E = 4 N, and K columns of M pixels each across every one."""

    #: (E, K) share of the side at which a column crosses it
    t: FloatArray
    #: (E, K) which columns lie in the image and repeat no other
    fresh: BoolArray
    #: (E, K, M) distance of each pixel from the side, inward [px]
    distance: Float32Array
    #: (E, K, M) place of each pixel in the flat image
    pixel: IntArray
    #: (E, K, M) whether it lies in the image; None: all do
    inside: BoolArray | None
    #: (E, K, 2) unit normal inward
    normal: FloatArray
    #: (E,) distance of the opposite side [px]
    across: FloatArray
    #: (E,) length [px]
    along: FloatArray


def sides_of(x: FloatArray, camera: Camera, shape: tuple[int, ...], columns: int, half: int) -> Sides:
    """Sides of quadrilaterals (N, 4, 2) in normalised coordinates.

    Parameters
    ----------
    shape : height and width of the image
    columns : K of them on a side
    half : number of pixels of a column on either side; M = 2 half + 1
    """
    nodes = _nodes(x, camera)
    span, middle = nodes[:, 4] - nodes[:, 0], nodes[:, 2]
    steep = np.abs(span[:, 1]) > np.abs(span[:, 0])
    by_side = steep[:, None]
    along, across = np.where(by_side, nodes[..., 1], nodes[..., 0]), np.where(by_side, nodes[..., 0], nodes[..., 1])
    whole = np.rint(along @ _weights(columns))
    t, centre, slope = _curve(along, across, whole)
    opposite = middle.reshape(-1, 4, 2)[:, _OPPOSITE].reshape(-1, 2) - middle
    # On which side of the line the opposite one lies: of a steeply tilted square it may lie mostly further along.
    turn = span[:, 0] * opposite[:, 1] - span[:, 1] * opposite[:, 0]
    inward = np.sign(turn * np.where(steep, -span[:, 1], span[:, 0]))
    pitch = inward[:, None] / np.sqrt(1.0 + slope * slope)
    leaning = -slope * pitch
    normal = np.empty((*pitch.shape, 2))
    normal[..., 0], normal[..., 1] = np.where(by_side, pitch, leaning), np.where(by_side, leaning, pitch)
    base, offsets = np.rint(centre), np.arange(-half, half + 1)
    fresh, inside = _seen(whole, base, steep, shape, half)
    off, rise = ((base - centre) * pitch).astype(np.float32), pitch.astype(np.float32)
    across_stride, along_stride = np.where(by_side, 1, shape[1]), np.where(by_side, shape[1], 1)
    pixel = (base * across_stride + whole * along_stride).astype(np.int64)
    return Sides(
        t,
        fresh,
        rise[..., None] * offsets.astype(np.float32) + off[..., None],
        pixel[..., None] + (across_stride * offsets)[:, None],
        inside,
        normal,
        np.abs(np.sum(opposite * normal[:, columns // 2], axis=-1)),
        np.sqrt(np.sum(span * span, axis=-1)),
    )


def _nodes(x: FloatArray, camera: Camera) -> FloatArray:
    """Pixels (4 N, 5, 2) of five points on every side of quadrilaterals (N, 4, 2), normalised."""
    points = np.moveaxis(geometry.in_quadrilaterals(x, _A, _B), 0, -1)
    return camera.distort(points).reshape(-1, len(_NODES), 2)


@cache
def _weights(columns: int) -> FloatArray:
    """Weights (5, K) of the nodes at the middles of equal parts."""
    at = np.vander((np.arange(columns) + 0.5) / columns, len(_NODES), increasing=True)
    return np.asarray((at @ np.linalg.inv(np.vander(_NODES, increasing=True))).T)


def _curve(along: FloatArray, across: FloatArray, whole: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Shares, places across and their slopes, (E, K) each, where curves through nodes (E, 5) pass ``whole`` (E, K)."""
    middle, scale = 0.5 * (along[:, :1] + along[:, 4:]), 2.0 / (along[:, 4:] - along[:, :1])
    values = np.empty((*along.shape, 2))
    values[..., 0], values[..., 1] = _NODES, across
    polynomial = np.linalg.solve(_powers((along - middle) * scale), values)
    at = _powers((whole - middle) * scale)
    t, centre = np.moveaxis(at @ polynomial, -1, 0)
    rising = polynomial[:, 1:, 1] * (np.arange(1.0, 5.0) * scale)
    return t, centre, (at[..., :4] @ rising[..., None])[..., 0]


def _powers(s: FloatArray) -> FloatArray:
    """The powers (..., 5) from the zeroth of values (...)."""
    powers = np.empty((*s.shape, 5))
    square = s * s
    powers[..., 0], powers[..., 1], powers[..., 2] = 1.0, s, square
    powers[..., 3], powers[..., 4] = square * s, square * square
    return powers


def _seen(
    whole: FloatArray, base: FloatArray, steep: BoolArray, shape: tuple[int, ...], half: int
) -> tuple[BoolArray, BoolArray | None]:
    """Which columns (E, K) lie in the image and repeat no other, and which of their pixels (E, K, M) lie in it."""
    far, end = np.where(steep[:, None], shape[::-1], shape).T[..., None] - 1.0
    fresh = (whole >= 0.0) & (whole <= end) & (base >= _BOTH_SIDES) & (base <= far - _BOTH_SIDES)
    fresh[:, 1:] &= whole[:, 1:] != whole[:, :-1]
    if np.all((base >= half) & (base <= far - half)):
        return fresh, None
    place = base[..., None] + np.arange(-half, half + 1)
    return fresh, (place >= 0.0) & (place <= far[..., None])
