"""Placement of a board in a grid of points; refused if it is ambiguous, or if the grid extends beyond the board."""

from dataclasses import dataclass

import cv2
import numpy as np

from thermal_fiducial.core.types import FloatArray, IntArray
from thermal_fiducial.core.wording import number_of

# A placement is accepted if at least this share of the board is seen, and if every other placement loses at least this
# share of the points that it would lose of a complete board: a board with a missing row may be shifted by a row.
_LEAST_SHARE, _CLEAR = 0.5, 0.5
# Largest number of points beyond the board, relative to its own; with more it is another board.
_BEYOND = 0.1
_OFF_DIAGONAL = np.array([[0, 1], [0, 0]]), np.array([[0, 0], [1, 0]])
# At oblique views the nearest points are not always neighbours on the board: the grid's axes may be sheared.
_SHEARS = tuple(np.array([[1, 0], [0, 1]]) + shear * axis for axis in _OFF_DIAGONAL for shear in (0, 1, -1, 2, -2))
_QUARTER = np.array([[0, -1], [1, 0]])


@dataclass(frozen=True)
class GridPlacement:
    """Placement of a board in a grid.

    Parameters
    ----------
    points, rows : (K,) points of the board, and their rows of the grid
    beyond, beyond_nodes : (B,) rows of the grid outside the board, and (B, 2) their nodes on the board
    """

    points: IntArray
    rows: IntArray
    beyond: IntArray
    beyond_nodes: IntArray


@dataclass(frozen=True)
class GridRefusal:
    """Why a grid is not the board.

    Parameters
    ----------
    reason : in words
    covered : number of board points that may be in the grid; 0 where most of the board is not
    placed : where the board may be nevertheless, if the grid's points beyond it are clutter
    another : whether it is another board if those points are none
    """

    reason: str
    covered: int = 0
    placed: GridPlacement | None = None
    another: bool = False


class BoardNodes:
    """Nodes of a board's points, and their patterns in a grid.

    Parameters
    ----------
    nodes : (N, 2) integers
    missing : (M, 2) nodes within the board where it has no point
    """

    def __init__(self, nodes: IntArray, missing: IntArray | None = None) -> None:
        self.nodes = nodes
        missing = np.zeros((0, 2), np.int64) if missing is None else missing
        # A board with a hole is symmetric except for the hole, so its outline is placed.
        self._outline = np.concatenate([nodes, missing])
        self._views = _views(self._outline)
        self._margin = len(self._outline) - _largest_two(self._overlaps(self._outline))[1]

    def place(self, grid: IntArray, contrast: FloatArray | None = None) -> GridPlacement | GridRefusal:
        """Where the board lies in ``grid``.

        Parameters
        ----------
        grid : (M, 2) nodes of a grid whose axes have the orientation of the board's, as seen from the front
        contrast : (M,) of its points; of places with as many points the one with most contrast counts. None: any
        """
        count = len(self._outline)
        if len(grid) < _LEAST_SHARE * count:
            return GridRefusal(f'only {len(grid)} points in a regular grid, the board has {len(self.nodes)}')
        overlaps = self._overlaps(grid)
        most, second = _largest_two(overlaps)
        beyond = len(grid) - int(most)
        if most < _LEAST_SHARE * count:
            return GridRefusal(f'a grid of {len(grid)} points that is not like the board')
        unclear = most - second < _CLEAR * self._margin
        placement = self._best(grid, overlaps if contrast is None else self._weighed(grid, overlaps, contrast))
        # A few extra points belong to another board if all of this one is seen, and are clutter if its border is not.
        if beyond > _BEYOND * count + 1.0 or (unclear and beyond > 0 and most >= (1.0 - _BEYOND) * count):
            return GridRefusal(goes_on(beyond), int(most), placement, another=True)
        if unclear:
            # Clutter makes a place unclear only if it is clear without.
            reason = f'{most:.0f} of {count} points found, which may lie in more than one place of the board'
            clear = beyond > 0 and isinstance(self.place(grid[placement.rows]), GridPlacement)
            return GridRefusal(reason, int(most), placement if clear else None)
        return placement

    def _best(self, grid: IntArray, overlaps: list[FloatArray]) -> GridPlacement:
        """Placement with the largest overlap."""
        best = int(np.argmax([overlap.max() for overlap in overlaps]))
        view, overlap = self._views[best], overlaps[best]
        pattern = view.nodes(self._outline)
        shift = np.array(np.unravel_index(int(np.argmax(overlap)), overlap.shape)) - pattern.max(axis=0)
        placements = [self._placement(matrix, view.origin(matrix, self._outline), shift, grid) for matrix in view.ways]
        return max(placements, key=lambda placement: len(placement.points))

    def _placement(self, matrix: IntArray, origin: IntArray, shift: IntArray, grid: IntArray) -> GridPlacement:
        inverse = np.rint(np.linalg.inv(matrix)).astype(np.int64)
        on_board = (grid - grid.min(axis=0) - shift + origin) @ inverse
        index = {node: point for point, node in enumerate(map(tuple, self._outline.tolist()))}
        point = np.array([index.get(node, -1) for node in map(tuple, on_board.tolist())], dtype=np.int64)
        shown = np.flatnonzero((point >= 0) & (point < len(self.nodes)))
        shown = shown[np.argsort(point[shown])]
        outside = np.flatnonzero(point < 0)
        return GridPlacement(point[shown], shown, outside, on_board[outside])

    def _overlaps(self, grid: IntArray) -> list[FloatArray]:
        """Number of points that each view of the board shares with a grid, for each shift."""
        return [np.rint(shared) for shared in self._shared(_occupancy(grid))]

    def _weighed(self, grid: IntArray, overlaps: list[FloatArray], contrast: FloatArray) -> list[FloatArray]:
        """Overlaps, and less than a point for their share of the contrast: a board's frame is fainter than its rows."""
        shares = self._shared(_occupancy(grid, 0.9 * contrast / contrast.sum()))
        return [overlap + share for overlap, share in zip(overlaps, shares, strict=True)]

    def _shared(self, grid: FloatArray) -> list[FloatArray]:
        """Sum of the values of a ``grid`` at the points of each view of the board, for each shift."""
        return [_correlation(grid, _occupancy(view.nodes(self._outline))) for view in self._views]


def goes_on(beyond: int) -> str:
    """Reason to refuse a grid with points ``beyond`` the board."""
    return f'the grid goes on beyond the one described: {number_of(beyond, "more point")}'


@dataclass(frozen=True)
class _PlacedView:
    """A pattern of the board in a grid, and the quarter turns and shears (2, 2) that lead to it."""

    ways: list[IntArray]

    def nodes(self, outline: IntArray) -> IntArray:
        """Nodes (N, 2) from zero."""
        return outline @ self.ways[0] - self.origin(self.ways[0], outline)

    @staticmethod
    def origin(matrix: IntArray, outline: IntArray) -> IntArray:
        """Least node (2,) after the turn."""
        return np.asarray((outline @ matrix).min(axis=0))


def _views(outline: IntArray) -> list[_PlacedView]:
    """Different patterns of the board by quarter turns and shears."""
    views: dict[frozenset[tuple[int, ...]], _PlacedView] = {}
    for shear in _SHEARS:
        matrix = shear
        for _ in range(4):
            turned = outline @ matrix
            pattern = frozenset(map(tuple, (turned - turned.min(axis=0)).tolist()))
            views.setdefault(pattern, _PlacedView([])).ways.append(matrix)
            matrix = matrix @ _QUARTER
    return list(views.values())


def _occupancy(nodes: IntArray, values: FloatArray | float = 1.0) -> FloatArray:
    """Values of the nodes (N, 2), 0 where there is none."""
    nodes = nodes - nodes.min(axis=0)
    occupied = np.zeros(nodes.max(axis=0) + 1)
    occupied[nodes[:, 0], nodes[:, 1]] = values
    return occupied


def _correlation(a: FloatArray, b: FloatArray) -> FloatArray:
    """Sum of the values ``a`` at the points of ``b`` for each shift of ``b`` with any overlap, in single precision."""
    around = np.pad(a, [(n - 1, n - 1) for n in b.shape]).astype(np.float32)
    return cv2.matchTemplate(around, b.astype(np.float32), cv2.TM_CCORR).astype(np.float64)


def _largest_two(overlaps: list[FloatArray]) -> tuple[float, float]:
    values = np.concatenate([overlap.reshape(-1) for overlap in overlaps])
    second, most = np.partition(values, -2)[-2:].tolist()
    return most, second
