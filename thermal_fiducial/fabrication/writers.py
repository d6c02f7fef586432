"""Drawings as files: SVG and DXF for the cutter, PDF for checking on paper at true size, PNG to look at.

ezdxf and matplotlib (extra ``tools``) are imported when they are needed.
"""

from collections.abc import Iterable
from html import escape
import os
from pathlib import Path
from typing import Any

import numpy as np

from thermal_fiducial.errors import InputError
from thermal_fiducial.fabrication.drawing import Contour, Drawing

#: Layer to its colour: AutoCAD index and SVG.
LAYERS = {'CUT': (1, '#ff0000'), 'HOLES': (3, '#00a000'), 'ENGRAVE': (5, '#0000ff')}

FORMATS = ('svg', 'dxf', 'pdf', 'png')

_MM_PER_INCH = 25.4
_ACRYLIC, _WARM = '#26465a', '#ffb347'


def write(drawing: Drawing, path: str | os.PathLike[str]) -> None:
    """Write ``drawing`` in the format that the name of ``path`` ends in.

    Raises
    ------
    InputError
        Another ending than those of :data:`FORMATS`, or a folder that can't be written to.
    """
    writers = {'svg': write_svg, 'dxf': write_dxf, 'pdf': write_pdf, 'png': write_png}
    path = Path(path)
    kind = path.suffix.lower().lstrip('.')
    if kind not in writers:
        raise InputError(f'{path}: drawings are written as {", ".join(FORMATS)}')
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        writers[kind](drawing, path)
    except OSError as error:
        raise InputError(f'{path}: {error.strerror or error}') from None


def write_svg(drawing: Drawing, path: Path) -> None:
    """SVG in millimetres, a group a layer, hair lines."""
    height = drawing.height
    groups = {
        'CUT': [_svg_path(contour, height) for contour in drawing.cuts],
        'HOLES': [f'<circle cx="{_n(c.x)}" cy="{_n(height - c.y)}" r="{_n(c.radius)}"/>' for c in drawing.holes],
        'ENGRAVE': [_svg_path(contour, height) for contour in drawing.engraving],
    }
    size = f'width="{_n(drawing.width)}mm" height="{_n(height)}mm" viewBox="0 0 {_n(drawing.width)} {_n(height)}"'
    lines = ['<?xml version="1.0" encoding="UTF-8"?>', f'<svg xmlns="http://www.w3.org/2000/svg" {size}>']
    lines += [f'<title>{escape(drawing.name)}</title>', f'<desc>{escape("; ".join(drawing.notes))}</desc>']
    for layer, elements in groups.items():
        lines.append(f'<g id="{layer}" fill="none" stroke="{LAYERS[layer][1]}" stroke-width="0.01">')
        lines += [*elements, '</g>']
    path.write_text('\n'.join([*lines, '</svg>', '']), encoding='utf-8')


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
    return f'<path d="{" ".join(steps)} Z"/>'


def write_dxf(drawing: Drawing, path: Path) -> None:
    """DXF R2010 in millimetres: closed polylines and circles on the layers CUT, HOLES and ENGRAVE."""
    from ezdxf import units
    from ezdxf.filemanagement import new

    document = new('R2010', units=units.MM)
    for name, (color, _) in LAYERS.items():
        document.layers.add(name, color=color)
    space = document.modelspace()
    for layer, contours in (('CUT', drawing.cuts), ('ENGRAVE', drawing.engraving)):
        for contour in contours:
            rows = np.column_stack([contour.points, contour.bulges]).tolist()
            space.add_lwpolyline(rows, format='xyb', close=True, dxfattribs={'layer': layer})
    for circle in drawing.holes:
        space.add_circle((circle.x, circle.y), circle.radius, dxfattribs={'layer': 'HOLES'})
    document.saveas(path)


def write_pdf(drawing: Drawing, path: Path) -> None:
    """PDF whose page is the drawing: printed at 100 % a millimetre is a millimetre."""
    figure, axes = _page(drawing)
    _stroke(axes, drawing.cuts, LAYERS['CUT'][1])
    _stroke(axes, drawing.engraving, LAYERS['ENGRAVE'][1])
    _stroke(axes, _hole_contours(drawing), LAYERS['HOLES'][1])
    figure.savefig(path, metadata={'Title': drawing.name, 'CreationDate': None})


def write_png(drawing: Drawing, path: Path, width_px: int = 800) -> None:
    """Preview: dark acrylic in front of a warm background, as the camera sees it."""
    from matplotlib.patches import PathPatch

    figure, axes = _page(drawing)
    axes.set_facecolor(_WARM)
    axes.add_patch(PathPatch(_path([*drawing.cuts, *_hole_contours(drawing)]), facecolor=_ACRYLIC, linewidth=0.0))
    if drawing.engraving:
        axes.add_patch(PathPatch(_path(drawing.engraving), facecolor='white', linewidth=0.0))
    figure.savefig(path, dpi=width_px * _MM_PER_INCH / drawing.width)


def _page(drawing: Drawing) -> tuple[Any, Any]:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(drawing.width / _MM_PER_INCH, drawing.height / _MM_PER_INCH))
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(0.0, drawing.width), ylim=(0.0, drawing.height), xticks=[], yticks=[])
    for spine in axes.spines.values():
        spine.set_visible(False)
    return figure, axes


def _stroke(axes: Any, contours: Iterable[Contour], color: str) -> None:
    for contour in contours:
        points = contour.flattened()
        axes.plot(*np.concatenate([points, points[:1]]).T, color=color, linewidth=0.3)


def _hole_contours(drawing: Drawing) -> list[Contour]:
    """Circles as pairs of half arcs, clockwise."""
    return [
        Contour(np.array([[c.x - c.radius, c.y], [c.x + c.radius, c.y]]), np.array([-1.0, -1.0])) for c in drawing.holes
    ]


def _path(contours: Iterable[Contour]) -> Any:
    """Compound path; contours round acrylic and round holes turn opposite ways, so that holes stay open."""
    from matplotlib.path import Path as Outline

    outlines = []
    for contour in contours:
        points = contour.flattened()
        outlines.append(Outline(np.concatenate([points, points[:1]]), closed=True))
    return Outline.make_compound_path(*outlines)
