"""Drawings as files: SVG and DXF for the cutter, PDF for checking on paper at true size, PNG as a preview.

svgwrite, ezdxf, reportlab and matplotlib (extra ``tools``) are imported when they are needed.
"""

from collections.abc import Iterable
import os
from pathlib import Path
from typing import Any

import numpy as np

from thermal_fiducial.errors import InputError
from thermal_fiducial.fabrication.drawing import Circle, Contour, Drawing
from thermal_fiducial.fabrication.paper import write_pdf
from thermal_fiducial.files.writing import new_file

#: Layer to its colour: AutoCAD index and SVG.
LAYERS = {
    'ENGRAVE': (5, '#0000ff'),
    'HOLES': (3, '#00a000'),
    'PATTERN': (6, '#d000d0'),
    'OUTLINE': (1, '#ff0000'),
}

#: Formats, and the library that writes each.
FORMATS = {'svg': 'svgwrite', 'dxf': 'ezdxf', 'pdf': 'reportlab', 'png': 'matplotlib'}

_MM_PER_INCH = 25.4
_ACRYLIC, _WARM = '#26465a', '#ffb347'
# Width of the lines [mm]: visible on a screen, where a millimetre is about four pixels.
_LINE_MM = 0.2


def write(drawing: Drawing, path: str | os.PathLike[str], paper: str | None = None) -> None:
    """Write ``drawing`` in the format that the name of ``path`` ends in; a PDF on sheets of ``paper``, where given.

    Raises
    ------
    InputError
        An unknown format, or a folder that cannot be written to.
    """
    path = Path(path)
    kind = path.suffix.lower().lstrip('.')
    if kind not in FORMATS:
        raise InputError(f'{path}: drawings are written as {", ".join(FORMATS)}')
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise InputError(f'{path.parent}: is a file, not a folder') from None
    except OSError as error:
        raise InputError(f'{path}: {error.strerror or error}') from None
    with new_file(path) as new:
        if kind == 'pdf':
            write_pdf(drawing, new, {layer: colour for layer, (_, colour) in LAYERS.items()}, paper)
        else:
            {'svg': write_svg, 'dxf': write_dxf, 'png': write_png}[kind](drawing, new)


def write_svg(drawing: Drawing, path: Path) -> None:
    """SVG in millimetres, each layer one of Inkscape's, on a page as large as the paths."""
    import svgwrite
    from svgwrite.extensions import Inkscape

    low, high = drawing.page
    width, height = map(_n, high - low)
    file = svgwrite.Drawing(size=(f'{width}mm', f'{height}mm'), viewBox=f'0 0 {width} {height}', debug=False)
    file.set_desc(title=drawing.name, desc='; '.join(drawing.notes))
    inkscape = Inkscape(file)
    for layer, shapes in drawing.layers.items():
        style = {'fill': 'none', 'stroke': LAYERS[layer][1], 'stroke_width': _n(_LINE_MM)}
        group = inkscape.layer(label=layer, locked=False, id=layer, **style)
        for shape in shapes:
            moved = shape.moved(-low[0], -low[1])
            if isinstance(moved, Circle):
                centre = _n(moved.x), _n(high[1] - low[1] - moved.y)
                group.add(file.circle(center=centre, r=_n(moved.radius)))
            else:
                group.add(file.path(d=_svg_path(moved, high[1] - low[1])))
        file.add(group)
    file.saveas(path, pretty=True)


def _n(value: float) -> str:
    return f'{value:.9f}'.rstrip('0').rstrip('.')


def _svg_path(contour: Contour, height: float) -> str:
    """Path of a closed contour; SVG's y points down, so arcs turn the other way round."""
    points = contour.points * (1.0, -1.0) + (0.0, height)
    steps = [f'M{_n(points[0, 0])} {_n(points[0, 1])}']
    following = np.roll(points, -1, axis=0)
    for start, end, bulge in zip(points, following, contour.bulges, strict=True):
        target = f'{_n(end[0])} {_n(end[1])}'
        if bulge == 0.0:
            steps.append(f'L{target}')
        else:
            radius = _n(float(np.linalg.norm(end - start)) * (1.0 + bulge**2) / (4.0 * abs(bulge)))
            steps.append(f'A{radius} {radius} 0 0 {int(bulge < 0.0)} {target}')
    return f'{" ".join(steps)} Z'


def write_dxf(drawing: Drawing, path: Path) -> None:
    """DXF R2010 in millimetres: closed polylines and circles, layer after layer."""
    from ezdxf import units
    from ezdxf.filemanagement import new

    document = new('R2010', units=units.MM)
    space = document.modelspace()
    for layer, shapes in drawing.layers.items():
        document.layers.add(layer, color=LAYERS[layer][0])
        for shape in shapes:
            if isinstance(shape, Circle):
                space.add_circle((shape.x, shape.y), shape.radius, dxfattribs={'layer': layer})
            else:
                rows = np.column_stack([shape.points, shape.bulges]).tolist()
                space.add_lwpolyline(rows, format='xyb', close=True, dxfattribs={'layer': layer})
    document.saveas(path)


def write_png(drawing: Drawing, path: Path, width_px: int = 800) -> None:
    """Preview: dark acrylic in front of a warm background, as the camera sees it."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.patches import PathPatch

    low, high = drawing.page
    width, height = ((high - low) / _MM_PER_INCH).tolist()
    figure = Figure(figsize=(width, height))
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0), xlim=(low[0], high[0]), ylim=(low[1], high[1]), facecolor=_WARM)
    axes.set(xticks=[], yticks=[])
    for spine in axes.spines.values():
        spine.set_visible(False)
    openings = [*drawing.cuts, *map(_half_arcs, (*drawing.holes, *drawing.dots))]
    axes.add_patch(PathPatch(_path(openings), facecolor=_ACRYLIC, linewidth=0.0))
    if drawing.engraving:
        axes.add_patch(PathPatch(_path(drawing.engraving), facecolor='white', linewidth=0.0))
    figure.savefig(path, dpi=width_px / width)


def _half_arcs(circle: Circle) -> Contour:
    """A circle as a pair of half arcs, clockwise."""
    ends = np.array([[circle.x - circle.radius, circle.y], [circle.x + circle.radius, circle.y]])
    return Contour(ends, np.array([-1.0, -1.0]))


def _path(contours: Iterable[Contour]) -> Any:
    """Compound path; contours around acrylic and around holes run in opposite directions, so that holes stay open."""
    from matplotlib.path import Path as Outline

    outlines = []
    for contour in contours:
        points = contour.flattened()
        outlines.append(Outline(np.concatenate([points, points[:1]]), closed=True))
    return Outline.make_compound_path(*outlines)
