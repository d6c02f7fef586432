"""Webs of acrylic that hold the loose parts of a marker from a standard dictionary.

Detectors read the bit in the middle of each cell (OpenCV ignores 13 % on each side), so webs run along the lines
between cells: a square patch where two acrylic cells meet at a point, and along the lines between white cells from
an island to the nearest acrylic.
"""

from collections import deque
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from thermal_fiducial.core.types import BoolArray, FloatArray, Gray, IntArray
from thermal_fiducial.fabrication.cuttability import acrylic_cells, pieces, point_contacts
from thermal_fiducial.fabrication.shape import paint, Rectangle

#: Point where cells meet, as (row, column) of a corner of the cells' lattice, rows from the top.
Vertex = tuple[int, int]

# Margin on each side of a cell that OpenCV ignores when it reads the bit, in cells.
_READING_MARGIN = 0.13


@dataclass(frozen=True)
class Bridges:
    """Webs of one marker, on the lattice of its cells."""

    #: corners where two acrylic cells meet at a point
    patches: tuple[Vertex, ...]
    #: paths along the lattice, each from an island to other acrylic
    webs: tuple[tuple[Vertex, ...], ...]

    def rectangles(self, cells: int, cell: float, width: float) -> list[Rectangle]:
        """Acrylic to add to a marker of ``cells`` x ``cells`` cells of side ``cell``, webs ``width`` wide [mm].

        Origin at the lower left of the black square, y up.
        """
        half = 0.5 * width
        boxes = [_box(vertex, vertex, half, half) for vertex in _scaled(self.patches, cells, cell)]
        for web in self.webs:
            points = _scaled(web, cells, cell)
            last = len(points) - 2
            for index, (start, end) in enumerate(pairwise(points)):
                # At its ends a web extends its own width along the acrylic, else its joints would be thinner.
                before = width if index == 0 else half
                after = width if index == last else half
                along = (end - start) / np.linalg.norm(end - start)
                boxes.append(_box(start - (before - half) * along, end + (after - half) * along, half, half))
        return boxes


def _scaled(vertices: tuple[Vertex, ...], cells: int, cell: float) -> FloatArray:
    lattice = np.array(vertices, dtype=np.float64).reshape(-1, 2)
    return np.stack([lattice[:, 1] * cell, (cells - lattice[:, 0]) * cell], axis=1)


def _box(start: FloatArray, end: FloatArray, dx: float, dy: float) -> Rectangle:
    (x0, y0), (x1, y1) = np.minimum(start, end), np.maximum(start, end)
    return Rectangle(x0 - dx, y0 - dy, x1 + dx, y1 + dy)


def find_bridges(bits: Gray) -> Bridges:
    """Bridges that join the acrylic of a marker with ``bits`` (n, n), 1 for white; none if it is one piece."""
    acrylic = acrylic_cells(bits)
    contacts = [(int(row) + 1, int(column) + 1) for row, column in np.argwhere(point_contacts(acrylic))]
    _, piece = pieces(acrylic)
    for vertex in contacts:
        _merge(piece, _touched(piece, vertex))
    webs = []
    border = piece[0, 0]
    while np.any(acrylic & (piece != border)):
        islands = np.unique(piece[acrylic & (piece != border)])
        web = min((_way_out(acrylic, piece, int(island)) for island in islands), key=len)
        webs.append(web)
        _merge(piece, np.concatenate([_touched(piece, web[0]), _touched(piece, web[-1])]))
        border = piece[0, 0]
    return Bridges(tuple(contacts), tuple(webs))


def _merge(piece: IntArray, joined: IntArray) -> None:
    labels = np.unique(joined[joined > 0])
    piece[np.isin(piece, labels)] = labels.min()


def _touched(piece: IntArray, vertex: Vertex) -> IntArray:
    row, column = vertex
    return np.asarray(piece[row - 1 : row + 1, column - 1 : column + 1]).reshape(-1)


def _way_out(acrylic: BoolArray, piece: IntArray, island: int) -> tuple[Vertex, ...]:
    """Shortest way along lattice lines between white cells from ``island`` to other acrylic (breadth first)."""
    size = len(acrylic)
    inner = [(row, column) for row in range(1, size) for column in range(1, size)]
    came_from: dict[Vertex, Vertex | None] = {v: None for v in inner if island in _touched(piece, v)}
    queue = deque(came_from)
    while queue:
        row, column = queue.popleft()
        for step_row, step_column in ((-1, 0), (1, 0), (0, -1), (0, 1)):
            vertex = (row + step_row, column + step_column)
            beside = _beside(acrylic, (row, column), vertex)
            if vertex in came_from or beside.any():
                continue
            came_from[vertex] = (row, column)
            if np.any((_touched(piece, vertex) > 0) & (_touched(piece, vertex) != island)):
                return _walked(came_from, vertex)
            queue.append(vertex)
    raise AssertionError('white cells around an island reach other acrylic: the border surrounds them')


def _walked(came_from: dict[Vertex, Vertex | None], end: Vertex) -> tuple[Vertex, ...]:
    way = [end]
    while (previous := came_from[way[-1]]) is not None:
        way.append(previous)
    return tuple(reversed(way))


def _beside(acrylic: BoolArray, start: Vertex, end: Vertex) -> BoolArray:
    """The two cells on either side of the line from ``start`` to ``end``."""
    row, column = min(start[0], end[0]), min(start[1], end[1])
    if start[0] == end[0]:
        return acrylic[row - 1 : row + 1, column]
    return acrylic[row, column - 1 : column + 1]


def darkest_white(bits: Gray, bridges: Bridges, cell: float, width: float) -> float:
    """Largest covered share of the part of a white cell that is read, with webs of ``width``; below 0.5: white."""
    cells = len(bits) + 2
    covered = np.zeros((cells, cells))
    margin = _READING_MARGIN * cell
    for row, column in np.argwhere(np.pad(bits, 1) > 0):
        x0, y0 = column * cell + margin, (cells - 1 - row) * cell + margin
        x1, y1 = x0 + cell - 2 * margin, y0 + cell - 2 * margin
        window = [Rectangle(x0, y0, x1, y1, acrylic=False)]
        for box in bridges.rectangles(cells, cell, width):
            clipped = Rectangle(max(box.x0, x0), max(box.y0, y0), min(box.x1, x1), min(box.y1, y1))
            if clipped.x1 > clipped.x0 and clipped.y1 > clipped.y0:
                window.append(clipped)
        xs, ys, acrylic = paint(window)
        covered[row, column] = np.sum(acrylic * np.diff(ys)[:, None] * np.diff(xs)) / ((x1 - x0) * (y1 - y0))
    return float(covered.max())
