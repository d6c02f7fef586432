"""Strength of a plate: the width of its narrowest web of acrylic, and the bending stress of its necks.

The narrowest web is found by shrinking the shape: at half the width of the web, a part comes off, a ring around a hole
opens, or a part is not restored when the shape is grown again.
"""

from dataclasses import dataclass

import numpy as np
import shapely
from shapely.geometry import MultiPolygon, Point, Polygon

from thermal_fiducial.core.types import FloatArray
from thermal_fiducial.fabrication.drawing import Drawing
from thermal_fiducial.fabrication.plate import ear_length, neck_arm, pattern_origin, PlateOptions
from thermal_fiducial.fabrication.verification import sheet_of

#: Resolution of widths [mm].
RESOLUTION_MM = 0.02
#: Allowed bending stress of a neck [MPa]: a third of the strength of cast acrylic.
STRESS_LIMIT_MPA = 23.0
#: Largest size of an ear, as a share of a side, with which detectors still find a square outline. Rendered with 24 and
#: 60 px a side: with 12 % all of 16 views are found, with 14 % 12, with 21 % none.
LARGEST_EAR = 0.12

_DENSITY, _GRAVITY = 1.19e-6, 9.81  # kg/mm^3, m/s^2
# Acceleration of a plate that is carried by two ears, in multiples of gravity.
_HANDLING = 3.0


@dataclass(frozen=True)
class Web:
    """The narrowest acrylic of a plate: its width, and where it is [mm]."""

    width: float
    place: FloatArray


@dataclass(frozen=True)
class Strength:
    """Width [mm] and kind of the narrowest web of a plate, and warnings in words."""

    web_mm: float
    kind: str
    complaints: list[str]


def strength_of(drawing: Drawing, options: PlateOptions, cells: int, least: float) -> Strength:
    """Strength of a marker's plate.

    Parameters
    ----------
    cells : of the marker along a side, its border included
    least : width of the narrowest web that is good enough [mm]
    """
    shape = acrylic_of(drawing, options.kerf)
    web = narrowest_web(shape)
    wrong = _complaints(web, neck_stress(shape, options, cells), options, least)
    return Strength(web.width, _web_kind(web, drawing, options, cells), wrong)


def acrylic_of(drawing: Drawing, kerf: float) -> Polygon | MultiPolygon:
    """Shape of the acrylic after the laser has removed half its ``kerf`` [mm] on both sides of the paths."""
    shape = shapely.buffer(sheet_of(drawing), -0.5 * kerf, join_style='mitre')
    circles = (*drawing.holes, *drawing.dots)
    return shapely.difference(
        shape, shapely.union_all([Point(c.x, c.y).buffer(c.radius + 0.5 * kerf) for c in circles])
    )


def narrowest_web(shape: Polygon | MultiPolygon) -> Web:
    """Narrowest web of a shape of acrylic."""
    low, high = 0.0, float(np.sqrt(shape.area))
    while high - low > RESOLUTION_MM:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if _holds(shape, middle) else (low, middle)
    return Web(0.5 * (low + high), _place(shape, high))


def _place(shape: Polygon | MultiPolygon, width: float) -> FloatArray:
    """Middle (2,) of a part that is hardly wider than ``width``."""
    pieces = sorted(shapely.get_parts(_shrunk(shape, 1.02 * width)), key=lambda piece: piece.area)
    if len(pieces) > len(shapely.get_parts(shape)):
        gap = shapely.shortest_line(pieces[0], shapely.union_all(pieces[1:]))
        return np.array(gap.centroid.coords[0])
    for wider in width * np.array([1.05, 1.1, 1.15, 1.2, 1.3]):
        lost = shapely.get_parts(shapely.difference(shape, shapely.buffer(_shrunk(shape, wider), 0.5 * wider)))
        # Convex corners are lost as well, but touch the shape's boundary in one stretch; a web does in two.
        edge = shapely.buffer(shape.boundary, 1e-3 * wider)
        stretches = shapely.get_num_geometries(shapely.intersection(lost, edge))
        best = np.lexsort([shapely.area(lost), stretches])[-1]
        if stretches[best] > 1:
            break
    return np.array(lost[best].centroid.coords[0])


def _shrunk(shape: Polygon | MultiPolygon, width: float) -> Polygon | MultiPolygon:
    return shapely.buffer(shape, -0.5 * width)


def _opened(shape: Polygon | MultiPolygon, width: float) -> Polygon | MultiPolygon:
    # With mitred joins convex corners are restored.
    return shapely.buffer(_shrunk(shape, width), 0.5 * width, join_style='mitre')


def _holds(shape: Polygon | MultiPolygon, width: float) -> bool:
    """Whether all of a shape is wider than ``width``."""
    if _pieces_and_holes(_shrunk(shape, width)) != _pieces_and_holes(shape):
        return False
    # Corners between rounded ones are not restored either, but are small: a lost arm is at least as long as wide.
    return bool(shapely.difference(shape, _opened(shape, width)).area < 0.5 * width**2)


def _pieces_and_holes(shape: Polygon | MultiPolygon) -> tuple[int, int]:
    parts = shapely.get_parts(shape)
    return int(np.sum(shapely.area(parts) > 0.0)), int(np.sum(shapely.get_num_interior_rings(parts)))


def _web_kind(web: Web, drawing: Drawing, options: PlateOptions, cells: int) -> str:
    """The kind of a plate's narrowest web, in words."""
    reach = 0.5 * options.hole_diameter + web.width + 1.0
    if any(np.hypot(hole.x - web.place[0], hole.y - web.place[1]) < reach for hole in drawing.holes):
        return 'hole wall'
    inside = web.place - pattern_origin(options, cells)
    if np.all(inside >= 0.0) and np.all(inside <= options.size):
        return 'pattern'
    return 'neck' if options.mount == 'ears' else 'tie or frame'


def neck_stress(shape: Polygon | MultiPolygon, options: PlateOptions, cells: int) -> float:
    """Bending stress [MPa] of the necks when the plate is carried flat, by two opposite ears or by all ties.

    Parameters
    ----------
    shape : of the acrylic
    cells : of the marker along a side, its border included
    """
    if options.mount == 'none':
        return 0.0
    low = pattern_origin(options, cells)
    square = shapely.box(*low, *(low + options.size))
    force = _HANDLING * _GRAVITY * _DENSITY * options.thickness * shapely.intersection(shape, square).area
    carried = force / (2.0 if options.mount == 'ears' else 4.0)
    return float(carried * neck_arm(options, cells) * 6.0 / (options.tie_width * options.thickness**2))


def _complaints(web: Web, stress: float, options: PlateOptions, least: float) -> list[str]:
    """Warning about a plate, in words; empty for a sound one."""
    found = []
    if web.width < least - 2.0 * RESOLUTION_MM:
        found.append(f'its narrowest web is {web.width:.1f} mm wide')
    if stress > STRESS_LIMIT_MPA:
        width = options.tie_width * stress / STRESS_LIMIT_MPA
        bears = f'--tie-width {np.ceil(width):g} is enough'
        found.append(f'too heavy for its necks: {stress:.0f} MPa when it is carried flat; {bears}')
    ear = ear_length(options) if options.mount == 'ears' else 0.0
    if ear > LARGEST_EAR * options.size:
        found.append(f'too small for its ears, of {100.0 * ear / options.size:.0f} % of a side: --mount frame or none')
    return found
