"""Calibration boards: a stencil of round holes in one piece, and a base plate that carries single markers."""

from collections.abc import Sequence

import numpy as np

from thermal_fiducial.core.types import FloatArray
from thermal_fiducial.errors import InputError
from thermal_fiducial.fabrication.drawing import Circle, Contour, Drawing
from thermal_fiducial.fabrication.plate import arrow, mounting_points, PlateOptions, text, WALL_MM
from thermal_fiducial.fabrication.shape import contour, Rectangle, trace

#: Fewest markers of a board, and of it in a view: four corners alone fit any view.
LEAST_MARKERS = 2
# Most circles of a board: more would be too small for any camera, and fill the memory.
_MOST_CIRCLES = 10_000


def asymmetric_circles(columns: int, rows: int, spacing: float) -> FloatArray:
    """Centres (rows * columns, 2) of OpenCV's asymmetric grid, row by row, x along a row and y down the rows.

    Parameters
    ----------
    columns, rows : as ``cv2.findCirclesGrid`` counts them, e.g. 4 and 11
    spacing : between two rows, half the distance of two circles in a row; any unit
    """
    row, column = np.divmod(np.arange(rows * columns), columns)
    return np.stack([(2 * column + row % 2) * spacing, row * spacing], axis=1).astype(np.float64)


def circle_board(columns: int, rows: int, spacing: float, diameter: float, options: PlateOptions) -> Drawing:
    """Asymmetric circle grid cut from one sheet [mm].

    Raises
    ------
    InputError
        Circles that touch, or a grid of too few or too many circles.
    """
    if columns < 2 or rows < 3 or not 0.0 < diameter < spacing * np.sqrt(2.0) - 1.0:
        raise InputError('a circle grid needs 2 x 3 circles or more, and a millimetre of acrylic between them')
    if columns * rows > _MOST_CIRCLES:
        raise InputError(f'a circle grid of {columns} x {rows}: {_MOST_CIRCLES} circles at most')
    # Small circles must not run into the mounting holes in the corners.
    apart = 0.5 * (diameter + options.hole_diameter) + WALL_MM
    margin = max(2.0 * spacing, _hole_inset(options) + apart / np.sqrt(2.0))
    centres = asymmetric_circles(columns, rows, spacing)
    width, height = centres.max(axis=0) + 2.0 * margin
    circles = [Circle(margin + x, height - margin - y, 0.5 * (diameter - options.kerf)) for x, y in centres.tolist()]
    label = f'circles {columns}x{rows} {spacing:g} mm'
    return Drawing(
        name=label.replace(' ', '-'),
        width=float(width),
        height=float(height),
        cuts=_outline(float(width), float(height), options),
        holes=tuple(_corner_holes(float(width), float(height), options)),
        dots=tuple(circles),
        engraving=(
            *text(label, 0.5 * width, height - 0.5 * spacing, 0.4 * width, 0.5 * spacing),
            *arrow(0.8 * width, height - 0.5 * spacing, 0.5 * spacing, 0.5 * spacing),
        ),
        notes=(f'asymmetric circle grid {columns} x {rows}, spacing {spacing:g} mm, diameter {diameter:g} mm',),
    )


def marker_grid(columns: int, rows: int, size: float, gap: float) -> FloatArray:
    """Centres (rows * columns, 2) of markers of a board, row by row from the top left, y up; their mean is 0."""
    row, column = np.divmod(np.arange(rows * columns), columns)
    pitch = size + gap
    return np.stack([(column - 0.5 * (columns - 1)) * pitch, (0.5 * (rows - 1) - row) * pitch], axis=1)


def base_plate(centres: FloatArray, labels: Sequence[str], cells: int, options: PlateOptions) -> Drawing:
    """Drilling template of the warm plate that carries markers at ``centres`` (N, 2) [mm], each with its label.

    Parameters
    ----------
    cells : of a marker along a side, its border included
    """
    points, size = mounting_points(options, cells)
    margin = 0.5 * size + options.quiet_cells * options.size / cells
    low = centres.min(axis=0) - margin
    width, height = (centres.max(axis=0) + margin - low).tolist()
    holes, engraving = [], []
    for (x, y), label in zip(centres - low, labels, strict=True):
        holes += [Circle(x + dx, y + dy, 0.5 * (options.hole_diameter - options.kerf)) for dx, dy in points.tolist()]
        engraving += text(label, x, y, 0.3 * options.size, 0.15 * options.size)
    return Drawing(
        name='base-plate',
        width=width,
        height=height,
        cuts=_outline(width, height, options),
        holes=tuple(holes),
        engraving=tuple(engraving),
        notes=('drilling template of the warm plate behind the markers',),
    )


def _outline(width: float, height: float, options: PlateOptions) -> tuple[Contour, ...]:
    corners = trace([Rectangle(0.0, 0.0, width, height)])[0]
    return (contour(corners, options.kerf, 0.0),)


def _hole_inset(options: PlateOptions) -> float:
    """Distance of the centres of mounting holes from both edges."""
    return 1.5 * options.hole_diameter


def _corner_holes(width: float, height: float, options: PlateOptions) -> list[Circle]:
    inset = _hole_inset(options)
    radius = 0.5 * (options.hole_diameter - options.kerf)
    return [Circle(x, y, radius) for x in (inset, width - inset) for y in (inset, height - inset)]
