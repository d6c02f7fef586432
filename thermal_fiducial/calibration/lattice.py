"""Regular grids among keypoints, grown point by point, and the board within a grid.

Each point is predicted from its nearest grid points only, so lens distortion, perspective, and contrast that fades or
reverses over a board do not matter.
"""

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.spatial import cKDTree

from thermal_fiducial.calibration.keypoints import Keypoints
from thermal_fiducial.calibration.placement import BoardNodes, GridRefusal
from thermal_fiducial.calibration.surface import local_surfaces, REACH
from thermal_fiducial.core.types import FloatArray, IntArray

# Steps from a place to those that show where its point should be.
_STEPS = tuple(product(range(-REACH, REACH + 1), repeat=2))
#: Place in a grid, (along its first axis, along its second).
Node = tuple[int, int]
#: A keypoint, its two neighbours along one axis and the two along another.
Seed = tuple[int, int, int, int, int]

_NEIGHBOURS, _MOST_SEEDS = 12, 40
# Least likeness (cosine) of the Hessians of neighbours, but for their sign.
_LIKE = 0.5
# Deviation from where the grid predicts a point, in steps of the grid. Points of a board deviate by a tenth or less on
# average, whatever the lens; those of noise by as much as is allowed.
_TOLERANCE, _SEED_TOLERANCE, _ORDERLY, _ENOUGH = 0.3, 0.25, 0.15, 6
# Directions of a grid's axes differ by this much (sine).
_LEAST_SINE = 0.35


@dataclass(frozen=True)
class BoardPoints:
    """Points of a board in an image.

    Parameters
    ----------
    points : (N,) their index on the board
    pixels : (N, 2) where they are, to a pixel or a tenth of their spacing
    beyond_nodes, beyond_pixels : (B, 2) grid points outside the board
    look : search index of the keypoints, see :class:`Keypoints`
    """

    points: IntArray
    pixels: FloatArray
    beyond_nodes: IntArray
    beyond_pixels: FloatArray
    look: int = 0


@dataclass(frozen=True)
class LargerGrid:
    """A grid that covers a board and extends beyond it: another board, or this one with clutter beside it.

    Parameters
    ----------
    nodes, pixels : (L, 2)
    covered : number of board points in it
    look : see :class:`BoardPoints`
    """

    nodes: IntArray
    pixels: FloatArray
    covered: int
    look: int


def find_board(views: Iterable[Keypoints], board: BoardNodes) -> tuple[BoardPoints | GridRefusal, LargerGrid | None]:
    """Most complete sighting of a board among several sets of keypoints, or why there is none.

    Also the larger grid that covers most of the board, if it covers more than the sighting.
    """
    best: BoardPoints | None = None
    refusal, weightiest = GridRefusal('no regular grid of points'), 0.0
    larger: LargerGrid | None = None
    for keypoints, grid in ((points, grid) for points in views for grid in Grower(points).grids()):
        pixels = keypoints.pixels[list(grid.values())]
        nodes = _facing(np.array(list(grid), dtype=np.int64), pixels)
        placed = board.place(nodes)
        if isinstance(placed, GridRefusal):
            # Among many points that belong to no board a large grid may be chance: its share of them counts too.
            weight = len(grid) ** 2 / len(keypoints.pixels)
            if weight > weightiest:
                refusal, weightiest = placed, weight
            if placed.covered > (0 if larger is None else larger.covered):
                larger = LargerGrid(nodes, pixels, placed.covered, keypoints.look)
        elif best is None or len(placed.points) > len(best.points):
            beyond = placed.beyond_nodes, pixels[placed.beyond]
            best = BoardPoints(placed.points, pixels[placed.rows], *beyond, look=keypoints.look)
            if len(best.points) == len(board.nodes):
                break
    if best is not None and larger is not None and larger.covered <= len(best.points):
        larger = None
    return best or refusal, larger


def _facing(nodes: IntArray, pixels: FloatArray) -> IntArray:
    """Nodes of a grid with axes that turn like those of the image."""
    design = np.column_stack([np.ones(len(nodes)), nodes])
    steps = np.linalg.lstsq(design, pixels, rcond=None)[0][1:]
    return nodes if np.linalg.det(steps) > 0.0 else np.ascontiguousarray(nodes[:, ::-1])


class Grower:
    """Grows grids of keypoints."""

    def __init__(self, keypoints: Keypoints) -> None:
        self._pixels, self._hessians = keypoints.pixels, keypoints.hessians
        self._sign = -1.0 if keypoints.alternate else 1.0
        self._tree = cKDTree(self._pixels)

    def grids(self) -> Iterator[dict[Node, int]]:
        """Keypoints (their index) by their place in a grid, strongest seeds first; those of a grid seed no other."""
        taken: set[int] = set()
        tried = 0
        for seed in self._seeds():
            if tried == _MOST_SEEDS:
                return
            if seed[0] not in taken:
                tried += 1
                grid = self._grow(seed)
                taken.update(grid.values())
                yield grid

    def _seeds(self) -> Iterator[Seed]:
        """Points with like neighbours on four sides, the nearest such."""
        if len(self._pixels) < 5:
            return
        _, near = self._tree.query(self._pixels, min(_NEIGHBOURS + 1, len(self._pixels)))
        near = near[:, 1:]
        offset = self._pixels[near] - self._pixels[:, None]
        length = np.linalg.norm(offset, axis=-1)
        like = self._sign * np.einsum('nki,ni->nk', self._hessians[near], self._hessians) > _LIKE
        closing = np.linalg.norm(offset[:, :, None] + offset[:, None], axis=-1)
        opposite = closing < _SEED_TOLERANCE * np.minimum(length[:, :, None], length[:, None])
        opposite &= like[:, :, None] & like[:, None]
        for index in np.flatnonzero(opposite.any(axis=(1, 2))).tolist():
            pairs = [(j, k) for j, k in np.argwhere(opposite[index]).tolist() if j < k]
            unit = offset[index] / length[index][:, None]
            along = unit[pairs[0][0]]
            for pair in pairs[1:]:
                if abs(along[0] * unit[pair[0], 1] - along[1] * unit[pair[0], 0]) > _LEAST_SINE:
                    first, second, third, fourth = near[index, [*pairs[0], *pair]].tolist()
                    yield index, first, second, third, fourth
                    break

    def _grow(self, seed: Seed) -> dict[Node, int]:
        """Grid from a seed: first what is next to it, then over gaps of one point; given up where it is no grid."""
        grid: dict[Node, int] = dict(zip(((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)), seed, strict=True))
        support: Counter[Node] = Counter()
        for node in grid:
            support.update(_supported(node))
        asked: dict[Node, int] = {}
        off: list[float] = []
        growing = True
        while growing and (len(off) < _ENOUGH or np.mean(off) < _ORDERLY):
            growing = any(self._add(grid, reach, support, asked, off) for reach in (1, 2))
        return grid

    def _add(
        self, grid: dict[Node, int], reach: int, support: Counter[Node], asked: dict[Node, int], off: list[float]
    ) -> bool:
        """Add points ``reach`` steps from the grid, all predicted from the present grid; returns whether any was added.

        Parameters
        ----------
        support : number of grid points that predict each place
        asked : support of each place at its last test, which is repeated only with another support
        off : deviations of the added points from their predictions [steps]
        """
        places = [node for node in _beside(grid, reach) if asked.get(node) != support[node]]
        if not places:
            return False
        asked.update((node, support[node]) for node in places)
        nodes, pixels = np.array(list(grid), dtype=np.float64), self._pixels[list(grid.values())]
        surfaces = local_surfaces(nodes, pixels, np.array(places, dtype=np.float64))
        steps, used, before = surfaces.steps, set(grid.values()), len(grid)
        rows = np.flatnonzero(surfaces.determined)
        radii = _TOLERANCE * np.linalg.norm(steps[rows], axis=1).max(axis=1, initial=0.0)
        for row, nearby in zip(rows.tolist(), self._tree.query_ball_point(surfaces.centres[rows], radii), strict=True):
            free = [index for index in nearby if index not in used]
            found = self._next(grid, places[row], free, surfaces.centres[row], steps[row]) if free else None
            if found is not None:
                grid[places[row]] = found[0]
                used.add(found[0])
                support.update(_supported(places[row]))
                off.append(found[1])
        return len(grid) > before

    def _next(
        self, grid: dict[Node, int], node: Node, nearby: list[int], centre: FloatArray, steps: FloatArray
    ) -> tuple[int, float] | None:
        """Keypoint of those ``nearby`` that is at ``node``, expected at ``centre``, and how far it is off [steps].

        Parameters
        ----------
        steps : (2, 2) to the next places, by columns [px]
        """
        off = np.linalg.norm(np.linalg.solve(steps, (self._pixels[nearby] - centre).T), axis=0)
        for away, index in sorted(zip(off.tolist(), nearby, strict=True)):
            if away <= _TOLERANCE and self._fits(grid, node, index):
                return index, away
        return None

    def _fits(self, grid: dict[Node, int], node: Node, index: int) -> bool:
        """Whether the Hessian is like those of the neighbours; of any sign, for contrast may reverse."""
        neighbours = [grid[n] for n in _around(node, 1) if n in grid]
        likeness = np.abs(self._hessians[neighbours] @ self._hessians[index])
        return len(neighbours) == 0 or float(likeness.max()) > _LIKE


def _around(node: Node, reach: int) -> list[Node]:
    a, b = node
    return [(a + reach, b), (a - reach, b), (a, b + reach), (a, b - reach)]


def _beside(grid: dict[Node, int], reach: int) -> list[Node]:
    """Places ``reach`` steps from a point of the grid that have none, each once."""
    return list({node: None for known in grid for node in _around(known, reach) if node not in grid})


def _supported(node: Node) -> list[Node]:
    """Places that the point at a ``node`` leads to."""
    a, b = node
    return [(a + i, b + j) for i, j in _STEPS]
