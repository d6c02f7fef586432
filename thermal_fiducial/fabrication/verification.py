"""Checks of drawings as they stand in the file: read back, not trusted."""

from itertools import pairwise
import os

import numpy as np

from thermal_fiducial.core.types import BoolArray, FloatArray
from thermal_fiducial.errors import InputError
from thermal_fiducial.fabrication.drawing import Circle, Contour, Drawing

#: A drawing read back must agree with the one written to this [mm].
TOLERANCE_MM = 1e-6


def read_dxf(path: str | os.PathLike[str]) -> Drawing:
    """Drawing from the layers CUT, HOLES and ENGRAVE of a DXF file in millimetres.

    Raises
    ------
    InputError
        Not a DXF file, not in millimetres, an open polyline, or an entity that nobody cuts.
    """
    from ezdxf import units
    from ezdxf.entities.circle import Circle as DxfCircle
    from ezdxf.entities.lwpolyline import LWPolyline
    from ezdxf.filemanagement import readfile
    from ezdxf.lldxf.const import DXFError

    try:
        document = readfile(path)
    except (OSError, DXFError) as error:
        raise InputError(f'{path}: not a readable DXF file: {error}') from None
    if document.units != units.MM:
        raise InputError(f'{path}: not in millimetres')
    contours: dict[str, list[Contour]] = {'CUT': [], 'ENGRAVE': []}
    holes = []
    for entity in document.modelspace():
        layer = entity.dxf.layer
        if isinstance(entity, LWPolyline) and layer in contours:
            if not entity.closed:
                raise InputError(f'{path}: open polyline on layer {layer}')
            rows = np.array(entity.get_points('xyb'), dtype=np.float64)
            contours[layer].append(Contour(rows[:, :2], rows[:, 2]))
        elif isinstance(entity, DxfCircle) and layer == 'HOLES':
            holes.append(Circle(entity.dxf.center.x, entity.dxf.center.y, entity.dxf.radius))
        else:
            raise InputError(f'{path}: {entity.dxftype()} on layer {layer}')
    extent = np.concatenate([c.points for c in contours['CUT']] or [np.zeros((1, 2))]).max(axis=0)
    return Drawing(
        str(path), float(extent[0]), float(extent[1]), tuple(contours['CUT']), tuple(holes), tuple(contours['ENGRAVE'])
    )


def problems(drawing: Drawing, parts: int) -> list[str]:
    """What is wrong with a drawing from which ``parts`` pieces of acrylic shall come out; empty when nothing is."""
    found = []
    polygons = [contour.flattened() for contour in drawing.cuts]
    crossings = _crossings(polygons)
    if crossings:
        found.append(f'{crossings} crossings of cut lines')
    outer = [p for p, contour in zip(polygons, drawing.cuts, strict=True) if contour.area > 0]
    if len(outer) != parts:
        found.append(f'{len(outer)} pieces, not {parts}')
    for contour, polygon in zip(drawing.cuts, polygons, strict=True):
        owners = sum(bool(inside(other, polygon[:1])[0]) for other in outer if other is not polygon)
        if owners != int(contour.area < 0):
            found.append(f'a contour at {np.round(polygon[0], 2).tolist()} mm is nested the wrong way')
    for circle in drawing.holes:
        rim = np.array([[circle.x + circle.radius * x, circle.y + circle.radius * y] for x, y in _OCTAGON])
        if not np.all(acrylic_at(drawing, rim)):
            found.append(f'the hole at ({circle.x:.2f}, {circle.y:.2f}) mm leaves the acrylic')
    return found


_OCTAGON = [(np.cos(angle), np.sin(angle)) for angle in np.arange(8) * np.pi / 4]


def agree(drawing: Drawing, other: Drawing) -> bool:
    """Whether two drawings are the same to :data:`TOLERANCE_MM`."""
    pairs = [*zip(drawing.cuts, other.cuts, strict=False), *zip(drawing.engraving, other.engraving, strict=False)]
    return (
        len(drawing.cuts) == len(other.cuts)
        and len(drawing.engraving) == len(other.engraving)
        and len(drawing.holes) == len(other.holes)
        and all(_same(a.points, b.points) and _same(a.bulges, b.bulges) for a, b in pairs)
        and all(
            _same(np.array([a.x, a.y, a.radius]), np.array([b.x, b.y, b.radius]))
            for a, b in zip(drawing.holes, other.holes, strict=True)
        )
    )


def _same(a: FloatArray, b: FloatArray) -> bool:
    return a.shape == b.shape and bool(np.all(np.abs(a - b) <= TOLERANCE_MM))


def acrylic_at(drawing: Drawing, points: FloatArray) -> BoolArray:
    """Whether points (N, 2) [mm] lie on acrylic (even-odd rule over all contours; drilled holes left out)."""
    crossed = np.zeros(len(points), dtype=np.int64)
    for contour in drawing.cuts:
        crossed += inside(contour.flattened(), points)
    return np.asarray(crossed % 2 == 1)


def inside(polygon: FloatArray, points: FloatArray) -> BoolArray:
    """Whether points (N, 2) lie in a polygon (M, 2): parity of the crossings of a ray to the right."""
    ends = np.roll(polygon, -1, axis=0)
    x, y = points[:, :1], points[:, 1:]
    straddles = (polygon[:, 1] > y) != (ends[:, 1] > y)
    height = np.where(ends[:, 1] == polygon[:, 1], 1.0, ends[:, 1] - polygon[:, 1])
    reach = polygon[:, 0] + (y - polygon[:, 1]) / height * (ends[:, 0] - polygon[:, 0])
    return np.asarray(np.sum(straddles & (x < reach), axis=1) % 2 == 1)


def _crossings(polygons: list[FloatArray]) -> int:
    """Pairs of segments of the polygons that cross or touch, neighbours along a polygon left out."""
    starts = np.concatenate(polygons)
    ends = np.concatenate([np.roll(p, -1, axis=0) for p in polygons])
    index = np.arange(len(starts))
    following = np.concatenate(
        [np.roll(index[a:b], -1) for a, b in pairwise(np.cumsum([0, *(len(p) for p in polygons)]))]
    )
    count = 0
    for i, (start, end) in enumerate(zip(starts, ends, strict=True)):
        later = slice(i + 1, None)
        a, b = starts[later], ends[later]
        near = np.all(
            (np.minimum(a, b) <= np.maximum(start, end)) & (np.maximum(a, b) >= np.minimum(start, end)), axis=1
        )
        near &= (index[later] != following[i]) & (following[later] != i)
        sides = _side(start, end, a) * _side(start, end, b) <= 0.0
        count += int(np.sum(near & sides & (_side(a, b, start) * _side(a, b, end) <= 0.0)))
    return count


def _side(start: FloatArray, end: FloatArray, point: FloatArray) -> FloatArray:
    """Twice the signed area of the triangle start, end, point."""
    along, to = end - start, point - start
    return np.asarray(along[..., 0] * to[..., 1] - along[..., 1] * to[..., 0])
