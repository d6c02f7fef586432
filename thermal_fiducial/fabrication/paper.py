"""Drawings on paper at true size: on one large page, or in tiles on sheets of a printer, to be glued together.

reportlab (extra ``tools``) is imported when it is needed.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from thermal_fiducial.core.types import FloatArray
from thermal_fiducial.errors import InputError
from thermal_fiducial.fabrication.drawing import Circle, Drawing

#: Papers by name, as reportlab knows them.
PAPERS = ('A4', 'A3', 'A2', 'A1', 'A0', 'Letter', 'Legal', 'Tabloid')

_POINTS_PER_MM = 72.0 / 25.4
_LINE_MM = 0.1
# Unprintable margin of the paper, and overlap of neighbouring tiles, with the marks in its middle [mm].
_MARGIN_MM, _OVERLAP_MM = 12.0, 10.0
# Half the length of a mark, and the length of the ruler that shows whether the page has its true size [mm].
_MARK_MM, _RULER_MM = 4.0, 100.0
_POINTS_PER_ARC = 32


@dataclass(frozen=True)
class Tiling:
    """Division of a drawing over sheets of paper.

    Parameters
    ----------
    sheet : width and height (2,) of the paper, upright or turned [mm]
    origin : lower left corner (2,) of the first tile, in the drawing [mm]
    columns, rows : number of tiles
    """

    sheet: FloatArray
    origin: FloatArray
    columns: int
    rows: int

    @property
    def tile(self) -> FloatArray:
        """Width and height (2,) of a tile [mm]."""
        return self.sheet - 2.0 * _MARGIN_MM

    def corner(self, column: int, row: int) -> FloatArray:
        """Lower left corner (2,) of a tile in the drawing [mm]; rows are counted from the top."""
        return self.origin + (self.tile - _OVERLAP_MM) * (column, self.rows - 1 - row)


def tiling(drawing: Drawing, paper: str) -> Tiling:
    """Tiles with ``drawing`` in their middle, on upright or turned paper, whichever takes fewer sheets.

    Raises
    ------
    InputError
        A paper that is not among :data:`PAPERS`.
    """
    low, high = drawing.page
    choices = []
    for sheet in (_paper(paper), _paper(paper)[::-1]):
        step = sheet - 2.0 * _MARGIN_MM - _OVERLAP_MM
        count = np.maximum(np.ceil((high - low - _OVERLAP_MM) / step), 1.0)
        origin = 0.5 * (low + high) - 0.5 * (count * step + _OVERLAP_MM)
        choices.append(Tiling(sheet, origin, int(count[0]), int(count[1])))
    return min(choices, key=lambda choice: choice.columns * choice.rows)


def check_paper(name: str) -> None:
    """Raise InputError for a paper that is not among :data:`PAPERS`."""
    if name.upper() not in {known.upper() for known in PAPERS}:
        raise InputError(f'--paper {name}: choose one of {", ".join(PAPERS)}')


def _paper(name: str) -> FloatArray:
    from reportlab.lib import pagesizes

    check_paper(name)
    return np.array(getattr(pagesizes, name.upper())) / _POINTS_PER_MM


def write_pdf(drawing: Drawing, path: Path, colours: Mapping[str, str], paper: str | None) -> None:
    """PDF to be printed at 100 %: one page as large as the paths, or tiles on sheets of ``paper``.

    Parameters
    ----------
    colours : of the layers, as of HTML
    """
    from reportlab.pdfgen.canvas import Canvas

    low, high = drawing.page
    # Without date and random number, so that the same drawing gives the same bytes.
    canvas = Canvas(str(path), pagesize=tuple((high - low) * _POINTS_PER_MM), invariant=1)
    title = f'marker {drawing.name}' if drawing.name.isdigit() else drawing.name
    canvas.setTitle(title)
    canvas.beginForm('drawing', *(low - 1.0), *(high + 1.0))
    _draw(canvas, drawing, colours)
    canvas.endForm()
    if paper is None:
        canvas.scale(_POINTS_PER_MM, _POINTS_PER_MM)
        canvas.translate(*-low)
        canvas.doForm('drawing')
        canvas.showPage()
    else:
        _write_tiles(canvas, title, tiling(drawing, paper))
    canvas.save()


def _draw(canvas: Any, drawing: Drawing, colours: Mapping[str, str]) -> None:
    canvas.setLineWidth(_LINE_MM)
    for layer, shapes in drawing.layers.items():
        canvas.setStrokeColor(colours[layer])
        for shape in shapes:
            if isinstance(shape, Circle):
                canvas.circle(shape.x, shape.y, shape.radius)
                continue
            line = canvas.beginPath()
            first, *others = shape.flattened(_POINTS_PER_ARC).tolist()
            line.moveTo(*first)
            for point in others:
                line.lineTo(*point)
            line.close()
            canvas.drawPath(line)


def _write_tiles(canvas: Any, name: str, tiles: Tiling) -> None:
    for row in range(tiles.rows):
        for column in range(tiles.columns):
            corner = tiles.corner(column, row)
            canvas.setPageSize(tuple(tiles.sheet * _POINTS_PER_MM))
            canvas.scale(_POINTS_PER_MM, _POINTS_PER_MM)
            canvas.saveState()
            clip = canvas.beginPath()
            clip.rect(_MARGIN_MM, _MARGIN_MM, *tiles.tile)
            canvas.clipPath(clip, stroke=0, fill=0)
            canvas.translate(*(_MARGIN_MM - corner))
            canvas.doForm('drawing')
            canvas.restoreState()
            _mark(canvas, tiles)
            where = f'row {row + 1} of {tiles.rows}, column {column + 1} of {tiles.columns}'
            canvas.setFont('Helvetica', 3.0)
            note = f'{name}: {where}. Print at 100 %: the ruler has {_RULER_MM:g} mm. Lay marks on marks.'
            canvas.drawString(_MARGIN_MM, 0.55 * _MARGIN_MM, note)
            canvas.showPage()


def _mark(canvas: Any, tiles: Tiling) -> None:
    """Draw crosses in the corners, which lie on those of the neighbouring tiles, and a ruler above the tile."""
    canvas.setStrokeColor('black')
    canvas.setLineWidth(_LINE_MM)
    for x in _MARGIN_MM + np.array([0.5 * _OVERLAP_MM, tiles.tile[0] - 0.5 * _OVERLAP_MM]):
        for y in _MARGIN_MM + np.array([0.5 * _OVERLAP_MM, tiles.tile[1] - 0.5 * _OVERLAP_MM]):
            canvas.line(x - _MARK_MM, y, x + _MARK_MM, y)
            canvas.line(x, y - _MARK_MM, x, y + _MARK_MM)
            canvas.circle(x, y, 0.5 * _MARK_MM)
    y = tiles.sheet[1] - 0.5 * _MARGIN_MM
    canvas.line(_MARGIN_MM, y, _MARGIN_MM + _RULER_MM, y)
    for x in _MARGIN_MM + np.arange(0.0, _RULER_MM + 1.0, 10.0):
        canvas.line(x, y - 1.0, x, y + 1.0)
