"""Checks of drawings, read back from their files."""

from itertools import combinations
import os

import numpy as np
import shapely
from shapely.geometry import LinearRing, Point, Polygon

from thermal_fiducial.core.types import FloatArray
from thermal_fiducial.errors import InputError
from thermal_fiducial.fabrication.drawing import Circle, Contour, Drawing

#: Largest difference between a drawing and its file, read back [mm].
TOLERANCE_MM = 1e-6


def read_dxf(path: str | os.PathLike[str]) -> Drawing:
    """Drawing from the layers of a DXF file in millimetres.

    Raises
    ------
    InputError
        Not a DXF file, not in millimetres, an open polyline, or an entity that cannot be cut.
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
    contours: dict[str, list[Contour]] = {'ENGRAVE': [], 'PATTERN': [], 'OUTLINE': []}
    circles: dict[str, list[Circle]] = {'HOLES': [], 'PATTERN': []}
    for entity in document.modelspace():
        layer = entity.dxf.layer
        if isinstance(entity, LWPolyline) and layer in contours:
            if not entity.closed:
                raise InputError(f'{path}: open polyline on layer {layer}')
            rows = np.array(entity.get_points('xyb'), dtype=np.float64)
            contours[layer].append(Contour(rows[:, :2], rows[:, 2]))
        elif isinstance(entity, DxfCircle) and layer in circles:
            circles[layer].append(Circle(entity.dxf.center.x, entity.dxf.center.y, entity.dxf.radius))
        else:
            raise InputError(f'{path}: {entity.dxftype()} on layer {layer}')
    cuts = (*contours['PATTERN'], *contours['OUTLINE'])
    extent = np.concatenate([c.points for c in cuts] or [np.zeros((1, 2))]).max(axis=0)
    return Drawing(
        str(path),
        float(extent[0]),
        float(extent[1]),
        cuts,
        tuple(circles['HOLES']),
        tuple(contours['ENGRAVE']),
        tuple(circles['PATTERN']),
    )


def problems(drawing: Drawing, parts: int) -> list[str]:
    """Faults of a drawing that should give ``parts`` pieces of acrylic; empty for a sound one."""
    found = []
    polygons = [contour.flattened() for contour in drawing.cuts]
    rings = [LinearRing(polygon) for polygon in polygons]
    crossings = sum(not ring.is_simple for ring in rings) + sum(a.intersects(b) for a, b in combinations(rings, 2))
    if crossings:
        found.append(f'{crossings} crossings of cut lines')
    outer = [Polygon(ring) for ring, contour in zip(rings, drawing.cuts, strict=True) if contour.area > 0]
    if len(outer) != parts:
        found.append(f'{len(outer)} pieces, not {parts}')
    for contour, polygon in zip(drawing.cuts, polygons, strict=True):
        owners = sum(other.contains(Point(polygon[0])) for other in outer)
        if owners != int(contour.area < 0):
            found.append(f'a contour at {np.round(polygon[0], 2).tolist()} mm is nested the wrong way')
    sheet = sheet_of(drawing)
    for circle in (*drawing.holes, *drawing.dots):
        if not sheet.contains(Point(circle.x, circle.y).buffer(circle.radius)):
            found.append(f'the hole at ({circle.x:.2f}, {circle.y:.2f}) mm leaves the acrylic')
    return found


def agree(drawing: Drawing, other: Drawing) -> bool:
    """Whether two drawings agree within :data:`TOLERANCE_MM`, layer by layer."""
    return all(
        len(shapes) == len(theirs) and all(_same(a, b) for a, b in zip(shapes, theirs, strict=True))
        for shapes, theirs in zip(drawing.layers.values(), other.layers.values(), strict=True)
    )


def _same(a: Contour | Circle, b: Contour | Circle) -> bool:
    mine, its = _numbers(a), _numbers(b)
    return type(a) is type(b) and mine.shape == its.shape and bool(np.all(np.abs(mine - its) <= TOLERANCE_MM))


def _numbers(shape: Contour | Circle) -> FloatArray:
    if isinstance(shape, Circle):
        return np.array([shape.x, shape.y, shape.radius])
    return np.column_stack([shape.points, shape.bulges])


def sheet_of(drawing: Drawing) -> Polygon:
    """Area between the contours, without regard to round holes; arcs are replaced by chords."""
    outlines = [Polygon(cut.flattened()) for cut in drawing.cuts if cut.area > 0]
    openings = [Polygon(cut.flattened()) for cut in drawing.cuts if cut.area < 0]
    return shapely.difference(shapely.union_all(outlines), shapely.union_all(openings))
