"""Drawings of one marker plate: the pattern and its mount.

There are three mounts. ``ears``: the black square has a tab on a narrow neck at the middle of each side, so that the
edges which the camera measures are free; the warm surface must extend a cell beyond the square. ``frame``: a ring of
warm background, one cell wide, and a frame of acrylic surround the square; ties join the two, and interrupt the outline
of the black square if the camera resolves them. ``none``: the black square alone.
"""

from dataclasses import dataclass

import numpy as np

from thermal_fiducial.core.types import FloatArray, Gray
from thermal_fiducial.errors import InputError
from thermal_fiducial.fabrication.bridges import find_bridges
from thermal_fiducial.fabrication.cuttability import acrylic_cells
from thermal_fiducial.fabrication.drawing import Circle, Contour, Drawing
from thermal_fiducial.fabrication.shape import contour, Rectangle, trace

MOUNTS = ('ears', 'frame', 'none')

#: Width of acrylic around a mounting hole [mm]: the thickness of usual sheets, the least that a bolt may clamp.
WALL_MM = 3.0
# Sides and thicknesses that the nodes take, without foil [mm]: other numbers are probably of another unit.
_SIZES_MM, _THICKNESSES_MM = (5.0, 10_000.0), (0.1, 50.0)
_POSITIVE = ('hole_diameter', 'bridge_width', 'quiet_cells', 'frame_width', 'tie_width')
_MAY_BE_ZERO = ('kerf', 'corner_radius', 'stand_off')
# Lengths that leave nothing of a marker if they are longer than its side.
_PARTS_OF_SIDE = ('hole_diameter', 'bridge_width', 'tie_width')
# Width of a tab and length of its neck, in sides of the marker: the tab has room for the engraving, and the camera
# resolves the warm background between tab and edge. Together they are below 12 % of a side, which OpenCV smooths away
# in its search for squares.
_TAB_WIDTH, _NECK = 0.15, 0.04


@dataclass(frozen=True)
class PlateOptions:
    """Dimensions of a marker plate [mm] and its mount."""

    #: side of the black square
    size: float = 300.0
    mount: str = 'ears'
    #: of the acrylic
    thickness: float = 3.0
    #: diameter of the mounting holes (4.3: M4)
    hole_diameter: float = 4.3
    #: length of the spacers between warm surface and plate
    stand_off: float = 10.0
    #: width of the cut
    kerf: float = 0.15
    #: radius of re-entrant corners
    corner_radius: float = 1.0
    #: width of the webs that hold islands
    bridge_width: float = 4.0
    #: width of the warm ring between pattern and frame, in cells
    quiet_cells: float = 1.0
    #: width of the frame
    frame_width: float = 15.0
    #: width of the necks of the ears, and of the ties between pattern and frame
    tie_width: float = 4.0

    def __post_init__(self) -> None:
        if self.mount not in MOUNTS:
            raise InputError(f'mount {self.mount!r} is not one of {", ".join(MOUNTS)}')
        if not _SIZES_MM[0] <= self.size <= _SIZES_MM[1]:
            allowed = '{:g} to {:g}'.format(*_SIZES_MM)
            raise InputError(f'a marker of {self.size:g} mm: sizes are in millimetres, {allowed}')
        if not _THICKNESSES_MM[0] <= self.thickness <= _THICKNESSES_MM[1]:
            allowed = '{:g} to {:g}'.format(*_THICKNESSES_MM)
            raise InputError(f'a plate of {self.thickness:g} mm: thicknesses are in millimetres, {allowed}')
        self._require_lengths()
        if self.mount == 'frame' and self.frame_width < self.hole_diameter + WALL_MM:
            raise InputError(f'a frame of {self.frame_width:g} mm has no room for holes of {self.hole_diameter:g} mm')

    def _require_lengths(self) -> None:
        """Require lengths that a plate may have, which excludes NaN and infinity."""
        for name in (*_POSITIVE, *_MAY_BE_ZERO):
            value, words = getattr(self, name), name.replace('_', ' ')
            if not 0.0 <= value <= _SIZES_MM[1] or (name in _POSITIVE and value == 0.0):
                least = 'more than 0' if name in _POSITIVE else '0 or more'
                raise InputError(f'{words} of a plate: {value:g} is not {least}, {_SIZES_MM[1]:g} at most')
            if name in _PARTS_OF_SIDE and value > self.size:
                raise InputError(f'{words} of a plate: {value:g} mm is more than its side, {self.size:g} mm')


def marker_rectangles(bits: Gray, options: PlateOptions) -> list[Rectangle]:
    """Black square, holes and bridges of a marker, origin at the lower left of the black square.

    Raises
    ------
    InputError
        Bridges as wide as half a cell.
    """
    acrylic = acrylic_cells(bits)
    count = len(acrylic)
    cell = options.size / count
    bridges = find_bridges(bits)
    if (bridges.patches or bridges.webs) and options.bridge_width >= 0.5 * cell:
        raise InputError(f'bridges of {options.bridge_width:g} mm are too wide for cells of {cell:.3g} mm')
    rectangles = [Rectangle(0.0, 0.0, options.size, options.size)]
    for row, column in np.argwhere(~acrylic):
        x, y = column * cell, (count - 1 - row) * cell
        rectangles.append(Rectangle(x, y, x + cell, y + cell, acrylic=False))
    return rectangles + bridges.rectangles(count, cell, options.bridge_width)


def marker_drawing(bits: Gray, label: str, options: PlateOptions) -> Drawing:
    """Drawing of the marker with ``bits`` (n, n), 1 for white, engraved with ``label`` outside the pattern.

    Raises
    ------
    InputError
        Impossible dimensions, e.g. a kerf that closes a gap.
    """
    mounted = {'ears': _ears, 'frame': _frame, 'none': _bare}[options.mount]
    cells = len(bits) + 2
    origin = pattern_origin(options, cells)
    outline, engraving = mounted(label, options, float(origin[0]))
    pattern = [_moved(r, origin) for r in marker_rectangles(bits, options)]
    contours = trace([*outline, *pattern])
    points, side = mounting_points(options, cells)
    spacers = f'; {len(points)} spacers of {options.stand_off:g} mm, holes of {options.hole_diameter:g} mm'
    holes = (Circle(x, y, 0.5 * (options.hole_diameter - options.kerf)) for x, y in (points + 0.5 * side).tolist())
    return Drawing(
        name=label,
        width=side,
        height=side,
        cuts=tuple(contour(corners, options.kerf, options.corner_radius) for corners in contours),
        holes=tuple(holes),
        engraving=tuple(engraving),
        notes=(f'{label}: black square {options.size:g} mm, kerf {options.kerf:g} mm{spacers if len(points) else ""}',),
    )


def mounting_points(options: PlateOptions, cells: int) -> tuple[FloatArray, float]:
    """Centres (N, 2) of the mounting holes from the plate's middle, and the plate's side [mm]."""
    origin = float(pattern_origin(options, cells)[0])
    side = 2.0 * origin + options.size
    if options.mount == 'none':
        return np.zeros((0, 2)), side
    if options.mount == 'ears':
        reach = 0.5 * (side - _tab_length(options))
        return reach * np.array([(0.0, -1.0), (0.0, 1.0), (-1.0, 0.0), (1.0, 0.0)]), side
    reach = 0.5 * (side - options.frame_width)
    return reach * np.array([(-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0), (1.0, 1.0)]), side


def pattern_origin(options: PlateOptions, cells: int) -> FloatArray:
    """Lower left corner (2,) of the black square in a drawing [mm]."""
    if options.mount == 'frame':
        return np.full(2, options.frame_width + options.quiet_cells * options.size / cells)
    return np.full(2, ear_length(options) if options.mount == 'ears' else 0.0)


def _moved(r: Rectangle, offset: FloatArray) -> Rectangle:
    return Rectangle(r.x0 + offset[0], r.y0 + offset[1], r.x1 + offset[0], r.y1 + offset[1], r.acrylic)


Mounted = tuple[list[Rectangle], list[Contour]]


def neck_arm(options: PlateOptions, cells: int) -> float:
    """Length over which a neck or tie is bent [mm]: from the black square to the mounting hole, or across the ring."""
    if options.mount == 'frame':
        return options.quiet_cells * options.size / cells
    return _NECK * options.size + 0.5 * _tab_length(options)


def _tab_length(options: PlateOptions) -> float:
    return options.hole_diameter + 2.0 * WALL_MM


def ear_length(options: PlateOptions) -> float:
    """Length of neck and tab of an ear [mm]."""
    return _NECK * options.size + _tab_length(options)


def _ears(label: str, options: PlateOptions, length: float) -> Mounted:
    """Four tabs on necks; the upper one carries the label to the left of its hole and the arrow to the right."""
    tab, total = _tab_length(options), 2.0 * length + options.size
    half, neck = 0.5 * max(tab, _TAB_WIDTH * options.size), 0.5 * options.tie_width
    middle, far = 0.5 * total, total - tab
    ears = [
        Rectangle(middle - neck, 0.0, middle + neck, total),
        Rectangle(0.0, middle - neck, total, middle + neck),
        Rectangle(middle - half, 0.0, middle + half, tab),
        Rectangle(middle - half, far, middle + half, total),
        Rectangle(0.0, middle - half, tab, middle + half),
        Rectangle(far, middle - half, total, middle + half),
    ]
    room = half - 0.5 * options.hole_diameter - 2.0
    beside = 0.5 * options.hole_diameter + 1.0 + 0.5 * room
    height = total - 0.5 * tab
    engraving = [
        *text(label, middle - beside, height, room, 0.6 * tab),
        *arrow(middle + beside, height, room, 0.6 * tab),
    ]
    return ears, engraving


def _frame(label: str, options: PlateOptions, origin: float) -> Mounted:
    """A ring of warm background, a tie across it at the middle of each side, and the frame."""
    width, total = options.frame_width, 2.0 * origin + options.size
    middle, half = 0.5 * total, 0.5 * options.tie_width
    outline = [
        Rectangle(0.0, 0.0, total, total),
        Rectangle(width, width, total - width, total - width, acrylic=False),
        Rectangle(middle - half, width, middle + half, total - width),
        Rectangle(width, middle - half, total - width, middle + half),
    ]
    height = total - 0.5 * width
    engraving = [
        *text(label, middle - 2.0 * width, height, 3.0 * width, 0.5 * width),
        *arrow(middle + 0.5 * width, height, 0.5 * width, 0.5 * width),
    ]
    return outline, engraving


def _bare(label: str, options: PlateOptions, origin: float) -> Mounted:
    return [], []


def text(label: str, x: float, y: float, width: float, height: float) -> list[Contour]:
    """Outlines of ``label`` centred at (x, y) in a box of ``width`` times ``height`` [mm]."""
    from matplotlib.textpath import TextPath

    outlines = map(np.asarray, TextPath((0.0, 0.0), label, size=10.0).to_polygons())
    polygons = [outline[:-1] for outline in outlines if len(outline) > 3]
    if not polygons:
        return []
    every = np.concatenate(polygons)
    low, high = every.min(axis=0), every.max(axis=0)
    scale = min(width / (high[0] - low[0]), height / (high[1] - low[1]))
    placed = [(polygon - 0.5 * (low + high)) * scale + np.array([x, y]) for polygon in polygons]
    return [Contour(polygon, np.zeros(len(polygon))) for polygon in placed]


def arrow(x: float, y: float, width: float, height: float) -> list[Contour]:
    """An arrow that points up, centred at (x, y)."""
    w, h = 0.5 * min(width, height), 0.5 * height
    tip = [(0.0, h), (-w, 0.0), (-0.35 * w, 0.0), (-0.35 * w, -h), (0.35 * w, -h), (0.35 * w, 0.0), (w, 0.0)]
    points = np.array(tip) + np.array([x, y])
    return [Contour(points, np.zeros(len(points)))]
