"""Where a board lies in a grid of points; refused where it could as well lie elsewhere."""

import numpy as np
from scipy.signal import correlate2d

from thermal_fiducial.core.types import BoolArray, FloatArray, IntArray

# A board is where it is when at least this share of it is seen, and when every other place would lose at least this
# share of the points that it would lose of a whole board: a board that a row is missing of may be shifted by a row.
_LEAST_SHARE, _CLEAR = 0.5, 0.5
# Points beyond the board, as a share of it: more, and it is another board.
_BEYOND = 0.1
_OFF_DIAGONAL = np.array([[0, 1], [0, 0]]), np.array([[0, 0], [1, 0]])
# Seen steeply, the nearest points in a grid need not be its neighbours on the board: the grid's axes are sheared.
_SHEARS = tuple(np.array([[1, 0], [0, 1]]) + shear * axis for axis in _OFF_DIAGONAL for shear in (0, 1, -1, 2, -2))
_QUARTER = np.array([[0, -1], [1, 0]])


class BoardNodes:
    """Nodes of a board's points, and the ways in which they may appear in a grid.

    Parameters
    ----------
    nodes : (N, 2) integers
    """

    def __init__(self, nodes: IntArray) -> None:
        self.nodes = nodes
        self._views = _views(nodes)
        self._margin = len(nodes) - _largest_two(self._overlaps(nodes))[1]

    def place(self, grid: IntArray) -> tuple[IntArray, IntArray] | None:
        """Points of the board (K,) and the rows (K,) of ``grid`` that show them; None where that is not certain.

        Parameters
        ----------
        grid : (M, 2) nodes of a grid whose axes turn like those of the board: it is seen from the front
        """
        if len(grid) < _LEAST_SHARE * len(self.nodes):
            return None
        overlaps = self._overlaps(grid)
        most, second = _largest_two(overlaps)
        enough = most >= _LEAST_SHARE * len(self.nodes) and len(grid) - most <= _BEYOND * len(self.nodes) + 1.0
        if not enough or most - second < _CLEAR * self._margin:
            return None
        best = int(np.argmax([overlap.max() for overlap in overlaps]))
        view, overlap = self._views[best], overlaps[best]
        shift = np.array(np.unravel_index(int(np.argmax(overlap)), overlap.shape)) - view.max(axis=0)
        rows = {tuple(node): row for row, node in enumerate((grid - grid.min(axis=0)).tolist())}
        pairs = [(point, rows[node]) for point, node in enumerate(map(tuple, (view + shift).tolist())) if node in rows]
        points, shown = np.array(pairs, dtype=np.int64).T
        return points, shown

    def _overlaps(self, grid: IntArray) -> list[FloatArray]:
        """Points that each view of the board has in common with a grid, for each shift."""
        seen = _occupancy(grid)
        return [correlate2d(seen, _occupancy(view)) for view in self._views]


def _views(nodes: IntArray) -> list[IntArray]:
    """Different patterns of the board by quarter turns and shears, each from zero."""
    views, patterns = [], set()
    for shear in _SHEARS:
        turned = nodes @ shear
        for _ in range(4):
            view = turned - turned.min(axis=0)
            pattern = frozenset(map(tuple, view.tolist()))
            if pattern not in patterns:
                patterns.add(pattern)
                views.append(view)
            turned = turned @ _QUARTER
    return views


def _occupancy(nodes: IntArray) -> FloatArray:
    nodes = nodes - nodes.min(axis=0)
    seen: BoolArray = np.zeros(nodes.max(axis=0) + 1, dtype=np.bool_)
    seen[nodes[:, 0], nodes[:, 1]] = True
    return seen.astype(np.float64)


def _largest_two(overlaps: list[FloatArray]) -> tuple[float, float]:
    values = np.concatenate([overlap.reshape(-1) for overlap in overlaps])
    second, most = np.partition(values, -2)[-2:].tolist()
    return most, second
