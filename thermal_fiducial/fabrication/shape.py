"""Shapes with axis-parallel edges: composed of rectangles, traced to closed contours.

All parts are made of rectangles (cells, bridges, frames, ears), so kerf compensation and the rounding of corners are
exact: an edge moves sideways, a corner becomes an arc.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from shapely.geometry import LinearRing

from thermal_fiducial.core.types import BoolArray, FloatArray
from thermal_fiducial.errors import InputError
from thermal_fiducial.fabrication.drawing import Contour

# Coordinates closer than this [mm] are the same edge: far below the precision of a cutter, far above rounding.
_SAME_EDGE_MM = 1e-7


@dataclass(frozen=True)
class Rectangle:
    """A rectangle of acrylic, or a rectangular hole [mm]."""

    x0: float
    y0: float
    x1: float
    y1: float
    acrylic: bool = True


def paint(rectangles: Sequence[Rectangle]) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Grid lines x (C + 1,) and y (R + 1,) [mm], and whether each cell (R, C) is acrylic; later rectangles win."""
    xs = _grid_lines([value for r in rectangles for value in (r.x0, r.x1)])
    ys = _grid_lines([value for r in rectangles for value in (r.y0, r.y1)])
    acrylic = np.zeros((len(ys) - 1, len(xs) - 1), dtype=np.bool_)
    for r in rectangles:
        c0, c1 = np.searchsorted(xs, (r.x0 - _SAME_EDGE_MM, r.x1 - _SAME_EDGE_MM))
        r0, r1 = np.searchsorted(ys, (r.y0 - _SAME_EDGE_MM, r.y1 - _SAME_EDGE_MM))
        acrylic[r0:r1, c0:c1] = r.acrylic
    return xs, ys, acrylic


def _grid_lines(values: list[float]) -> FloatArray:
    ordered = np.sort(np.asarray(values, dtype=np.float64))
    return np.asarray(ordered[np.concatenate([[True], np.diff(ordered) > _SAME_EDGE_MM])])


def trace(rectangles: Sequence[Rectangle]) -> list[FloatArray]:
    """Corners (N, 2) [mm] of each closed contour, in the direction that has acrylic on its left.

    Raises
    ------
    InputError
        Two pieces or two holes touch only at a point, which cannot be cut.
    """
    xs, ys, acrylic = paint(rectangles)
    following = _boundary_edges(np.pad(acrylic, 1))
    contours = []
    while following:
        start, vertex = next(iter(following.items()))
        del following[start]
        loop = [start]
        while vertex != start:
            loop.append(vertex)
            vertex = following.pop(vertex)
        corners = _without_collinear(np.array(loop))
        contours.append(np.stack([xs[corners[:, 0]], ys[corners[:, 1]]], axis=1))
    return contours


def _boundary_edges(acrylic: BoolArray) -> dict[tuple[int, int], tuple[int, int]]:
    """Successor of each vertex (column, row of grid lines) along the boundary; ``acrylic`` has an empty border."""
    inside = acrylic[1:-1, 1:-1]
    edges = []
    for neighbour, start, end in (
        (acrylic[:-2, 1:-1], (0, 0), (1, 0)),  # below: eastward
        (acrylic[1:-1, 2:], (1, 0), (1, 1)),  # right: northward
        (acrylic[2:, 1:-1], (1, 1), (0, 1)),  # above: westward
        (acrylic[1:-1, :-2], (0, 1), (0, 0)),  # left: southward
    ):
        rows, columns = np.nonzero(inside & ~neighbour)
        cells = np.stack([columns, rows], axis=1)
        edges += list(zip(map(tuple, (cells + start).tolist()), map(tuple, (cells + end).tolist()), strict=True))
    following = dict(edges)
    if len(following) != len(edges):
        raise InputError('acrylic or holes that touch at a point only: not cuttable without bridges')
    return following


def _without_collinear(loop: FloatArray) -> FloatArray:
    before, after = loop - np.roll(loop, 1, axis=0), np.roll(loop, -1, axis=0) - loop
    turning = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
    return np.asarray(loop[turning != 0])


def contour(corners: FloatArray, kerf: float, radius: float) -> Contour:
    """Path of the laser that leaves acrylic with ``corners``.

    Parameters
    ----------
    corners : (N, 2) [mm] of a rectilinear contour with acrylic to its left
    kerf : width of the cut [mm]: half of it lies outside the acrylic
    radius : of the re-entrant corners [mm], where cracks start; convex corners stay sharp, since the camera measures
        the edges that end there. The radius is reduced where edges are short.

    Raises
    ------
    InputError
        A hole or gap that the kerf fills, or that a rounded corner reaches across.
    """
    before, after = corners - np.roll(corners, 1, axis=0), np.roll(corners, -1, axis=0) - corners
    length = np.linalg.norm(after, axis=1, keepdims=True)
    forward = after / length
    outward = np.stack([forward[:, 1], -forward[:, 0]], axis=1)
    moved = corners + 0.5 * kerf * (outward + np.roll(outward, 1, axis=0))
    moved_length = np.sum((np.roll(moved, -1, axis=0) - moved) * forward, axis=1)
    if np.any(moved_length <= 0.0):
        raise InputError(f'a gap of {float(length.min()):.3g} mm is closed by a kerf of {kerf:g} mm')
    reentrant = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0] < 0
    rounded = _rounded(moved, forward, moved_length, np.where(reentrant, radius, 0.0))
    if not LinearRing(rounded.flattened()).is_simple:
        raise InputError(f'corners of radius {radius:g} mm reach across a gap: a smaller --corner-radius is needed')
    return rounded


def _rounded(corners: FloatArray, forward: FloatArray, length: FloatArray, radii: FloatArray) -> Contour:
    """Replace corners by quarter arcs that turn right."""
    # Each of two arcs takes at most half of the edge between them, so that no vertex occurs twice.
    radii = np.minimum(radii, 0.499 * np.minimum(length, np.roll(length, 1)))
    points, bulges = [], []
    for corner, came, goes, radius in zip(corners, np.roll(forward, 1, axis=0), forward, radii, strict=True):
        if radius > 0.0:
            points += [corner - radius * came, corner + radius * goes]
            bulges += [-np.tan(np.pi / 8.0), 0.0]
        else:
            points.append(corner)
            bulges.append(0.0)
    return Contour(np.array(points), np.array(bulges))
