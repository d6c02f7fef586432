"""The board among the grids of an image."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from thermal_fiducial.calibration.keypoints import Keypoints
from thermal_fiducial.calibration.lattice import Grower, LatticeNode
from thermal_fiducial.calibration.placement import BoardNodes, GridPlacement, GridRefusal
from thermal_fiducial.core.types import FloatArray, IntArray


@dataclass(frozen=True)
class BoardPoints:
    """Points of a board in an image.

    Parameters
    ----------
    points : (N,) their index on the board
    pixels : (N, 2) where they are, to a pixel or a tenth of their spacing
    beyond_nodes, beyond_pixels : (B, 2) grid points outside the board
    """

    points: IntArray
    pixels: FloatArray
    beyond_nodes: IntArray
    beyond_pixels: FloatArray


@dataclass(frozen=True)
class RefusedGrid:
    """A grid that is not the board, or not clearly.

    Parameters
    ----------
    nodes, pixels : (L, 2)
    signal : of its points, see :class:`Keypoints`, the median
    refusal : why
    """

    nodes: IntArray
    pixels: FloatArray
    signal: float
    refusal: GridRefusal


@dataclass
class GridSearch:
    """What the grids of an image are; each is weighed by the contrast of its points, summed.

    Gaps between the points of a board, edges and noise make grids too, some of more points, none of more contrast.

    Parameters
    ----------
    placed : the board, in the heaviest grid in which it is
    refused : the heaviest grid that is not the board, unless the board's is heavier
    """

    placed: BoardPoints | None = None
    refused: RefusedGrid | None = None
    _weight: float = 0.0
    _alike: float = 0.0
    _placed: float = 0.0

    def add(self, grower: Grower, grid: dict[LatticeNode, int], board: BoardNodes) -> bool:
        """Weigh a grid; returns whether it is like the board."""
        index = list(grid.values())
        pixels, weight = grower.pixels[index], float(grower.contrast[index].sum())
        nodes = _facing(np.array(list(grid), dtype=np.int64), pixels)
        found = board.place(nodes, grower.contrast[index])
        alike = isinstance(found, GridPlacement) or found.covered > 0
        if isinstance(found, GridPlacement) and weight > self._placed:
            self.placed, self._placed = _points_of(found, pixels), weight
        if alike:
            self._alike = max(self._alike, weight)
        if weight > self._weight:
            self._weight = weight
            signal = float(np.median(grower.signal[index]))
            self.refused = RefusedGrid(nodes, pixels, signal, found) if isinstance(found, GridRefusal) else None
        return alike

    def among(self, grower: Grower, board: BoardNodes) -> bool:
        """Weigh the grids of some keypoints, while a heavier one may be left; returns whether the board is whole."""
        used: set[int] = set()
        grids = grower.grids()
        while grower.contrast.sum() - grower.contrast[list(used)].sum() > self._alike:
            grid = next(grids, None)
            if grid is None:
                return False
            if self.add(grower, grid, board):
                used.update(grid.values())
            if self.placed is not None and len(self.placed.points) == len(board.nodes):
                return True
        return False


def find_board(views: Iterable[Keypoints], board: BoardNodes) -> GridSearch:
    """A board among several sets of keypoints."""
    search = GridSearch()
    for grower in sorted(map(Grower, views), key=Grower.total_contrast, reverse=True):
        if search.among(grower, board):
            break
    return search


def _points_of(placed: GridPlacement, pixels: FloatArray) -> BoardPoints:
    return BoardPoints(placed.points, pixels[placed.rows], placed.beyond_nodes, pixels[placed.beyond])


def _facing(nodes: IntArray, pixels: FloatArray) -> IntArray:
    """Nodes of a grid with axes that turn like those of the image."""
    design = np.column_stack([np.ones(len(nodes)), nodes])
    steps = np.linalg.lstsq(design, pixels, rcond=None)[0][1:]
    return nodes if np.linalg.det(steps) > 0.0 else np.ascontiguousarray(nodes[:, ::-1])
