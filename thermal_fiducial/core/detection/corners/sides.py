"""The sides of markers in the image, and the pixels across them.

A side is straight in normalised image coordinates, a gentle curve in the raw image. Columns of whole pixels cross it,
or rows, whichever cross it more squarely. No pixel is interpolated, so noise stays white.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np

from thermal_fiducial.core.geometry import se3
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.types import BoolArray, Float32Array, FloatArray, IntArray

#: Corners between which the sides lie: top and bottom from left to right, left and right from the top down.
STARTS, ENDS = np.array([0, 3, 0, 1]), np.array([1, 2, 3, 2])
_OPPOSITE = np.array([1, 0, 3, 2])
#: A curved side is a quartic through five of its points, at these shares of it.
NODES = np.linspace(0.0, 1.0, 5)
# Pixels of the image that a side must have on both sides, and by how many a curve may pass the nodes it goes through.
_BOTH_SIDES, _BEYOND_NODES = 3, 3.0


@dataclass(frozen=True, slots=True)
class Sides:
    """The E = 4 N sides of N markers in m parts each, and C columns of M pixels across every part."""

    #: (C, m, E) share of the side at which a column crosses it
    t: FloatArray
    #: (C, m, E) which columns lie in the image and repeat no other
    fresh: BoolArray
    #: (M, C, m, E) distance of each pixel from the side, inward [px]
    distance: Float32Array
    #: (M, C, m, E) place of each pixel in the flat image
    pixel: IntArray
    #: (M, C, m, E) whether it lies in the image; None: all do
    inside: BoolArray | None
    #: (m, E, 2) unit normal inward, in the middle of each part
    normal: FloatArray
    #: (E,) distance of the opposite side [px]
    across: FloatArray
    #: (E,) length [px]
    along: FloatArray


def sides_of(x: FloatArray, camera: Camera, shape: tuple[int, ...], cells: int, columns: int, half: int) -> Sides:
    """Sides of quadrilaterals (N, 4, 2) in normalised coordinates.

    Parameters
    ----------
    shape : height and width of the image
    cells : m equal parts of a side
    columns : C in each of them
    half : number of pixels of a column on either side; M = 2 half + 1
    """
    nodes = _nodes(x, camera)
    middle = nodes[:, 2]
    opposite = middle.reshape(-1, 4, 2).take(_OPPOSITE, axis=1).reshape(-1, 2) - middle
    return columns_across(nodes, opposite, shape, cells, columns, half)


def columns_across(
    nodes: FloatArray, opposite: FloatArray, shape: tuple[int, ...], cells: int, columns: int, half: int
) -> Sides:
    """Columns across E sides, or across other edges.

    Parameters
    ----------
    nodes : (E, 5, 2) pixels of five points on each, from end to end
    opposite : (E, 2) from their middles to the opposite sides, inward [px]
    shape, cells, columns, half : as of :func:`sides_of`
    """
    span = nodes[:, 4] - nodes[:, 0]
    steep = np.abs(span[:, 1]) > np.abs(span[:, 0])
    share, weights = _parts(cells, columns)
    by_column = (2, columns, cells, len(nodes))
    (along, rate), (across, climb) = (
        (weights @ np.where(upright, nodes[..., 1].T, nodes[..., 0].T)).reshape(by_column)
        for upright in (steep, ~steep)
    )
    # From where the columns should be it is at most half a pixel to a whole one: over that the side is straight.
    whole, slope = np.rint(along), climb / rate
    ahead = whole - along
    centre = across + slope * ahead
    # On which side of the line the opposite one lies: of a steeply tilted square it may lie mostly further along.
    turn = span[:, 0] * opposite[:, 1] - span[:, 1] * opposite[:, 0]
    inward = np.sign(turn * np.where(steep, -span[:, 1], span[:, 0]))
    pitch = inward / np.sqrt(1.0 + slope * slope)
    normal = _normals(pitch[columns // 2], slope[columns // 2], steep)
    base, offsets = np.rint(centre), np.arange(-half, half + 1)[:, None, None, None]
    fresh, inside = _seen(whole, base, steep, nodes, shape, half)
    off, rise = ((base - centre) * pitch).astype(np.float32), pitch.astype(np.float32)
    across_stride, along_stride = np.where(steep, 1, shape[1]), np.where(steep, shape[1], 1)
    pixel = (base * across_stride + whole * along_stride).astype(np.int64)
    return Sides(
        share + ahead / rate,
        fresh,
        rise * offsets.astype(np.float32) + off,
        pixel + across_stride * offsets,
        inside,
        normal,
        np.abs((opposite * normal[cells // 2]).sum(axis=-1)),
        np.sqrt((span * span).sum(axis=-1)),
    )


def _nodes(x: FloatArray, camera: Camera) -> FloatArray:
    """Pixels (4 N, 5, 2) of five points on every side of quadrilaterals (N, 4, 2), normalised."""
    weight = se3.perspective(x)
    start, end = x.take(STARTS, axis=1), x.take(ENDS, axis=1)
    ratio = (weight.take(ENDS, axis=1) / weight.take(STARTS, axis=1))[..., None]
    share = NODES * ratio / (1.0 + NODES * (ratio - 1.0))
    points = start[:, :, None] + share[..., None] * (end - start)[:, :, None]
    return camera.distort(points).reshape(-1, len(NODES), 2)


@cache
def _parts(cells: int, columns: int) -> tuple[FloatArray, FloatArray]:
    """Shares (C, m, 1) of a side where columns cross it; weights (2 C m, 5) of nodes in the places and derivatives."""
    share = ((np.arange(columns)[:, None] + 0.5) / columns + np.arange(cells)) / cells
    powers = np.arange(len(NODES))
    at = share.reshape(-1, 1) ** powers
    rate = np.zeros_like(at)
    rate[:, 1:] = powers[1:] * at[:, :-1]
    return share[..., None], np.concatenate([at, rate]) @ np.linalg.inv(np.vander(NODES, increasing=True))


def _normals(pitch: FloatArray, slope: FloatArray, steep: BoolArray) -> FloatArray:
    """Unit normals (m, E, 2) of sides whose part across the way that these run, by rows or columns, is ``pitch``."""
    leaning = -slope * pitch
    normal = np.empty((*pitch.shape, 2))
    normal[..., 0], normal[..., 1] = np.where(steep, pitch, leaning), np.where(steep, leaning, pitch)
    return normal


def _seen(
    whole: FloatArray, base: FloatArray, steep: BoolArray, nodes: FloatArray, shape: tuple[int, ...], half: int
) -> tuple[BoolArray, BoolArray | None]:
    """Which columns (C, m, E) lie in the image, repeating no other, and which of their pixels (M, C, m, E) do."""
    fresh = np.ones(whole.shape, dtype=bool)
    np.not_equal(whole[1:], whole[:-1], out=fresh[1:])
    np.not_equal(whole[0, 1:], whole[-1, :-1], out=fresh[0, 1:])
    margin = half + _BEYOND_NODES
    last = nodes[..., 0].max() - shape[1], nodes[..., 1].max() - shape[0]
    if nodes.min() >= margin and max(last) <= -1.0 - margin:
        return fresh, None
    far, end = np.where(steep[:, None], shape[::-1], shape).T - 1.0
    fresh &= (whole >= 0.0) & (whole <= end) & (base >= _BOTH_SIDES) & (base <= far - _BOTH_SIDES)
    place = base + np.arange(-half, half + 1)[:, None, None, None]
    return fresh, (place >= 0.0) & (place <= far)
