"""Regular grids among keypoints, grown point by point.

Each point is predicted from its nearest grid points only, and compared with its neighbours only, so lens distortion,
perspective, and contrast that fades or reverses over a board do not matter.
"""

from collections import Counter
from collections.abc import Iterator
from itertools import product

import numpy as np
from scipy.spatial import cKDTree

from thermal_fiducial.calibration.keypoints import Keypoints, SCALE_RATIO
from thermal_fiducial.calibration.surface import local_surfaces, REACH
from thermal_fiducial.core.types import FloatArray, IntArray

# Steps from a place to those that show where its point should be.
_STEPS = tuple(product(range(-REACH, REACH + 1), repeat=2))
#: Place in a grid, (along its first axis, along its second).
LatticeNode = tuple[int, int]
#: A keypoint, its two neighbours along one axis and the two along another.
Seed = tuple[int, int, int, int, int]

_NEIGHBOURS, _MOST_SEEDS = 12, 20
# Least likeness (cosine) of the Hessians of neighbours, but for their sign.
_LIKE = 0.5
# Largest ratio of the responses of neighbours, which is that of their contrasts squared.
_STRONGER = 16.0
# Deviation from where the grid predicts a point, in steps of the grid. Points of a board deviate by a tenth or less on
# average, whatever the lens; those of noise by as much as is allowed.
_TOLERANCE, _SEED_TOLERANCE, _ORDERLY, _ENOUGH = 0.3, 0.25, 0.15, 6
# Largest difference of a point's search scale from that of its grid there: the next finer or coarser one is as good.
_SCALES_OFF = 1.5
# Directions of a grid's axes differ by this much (sine).
_LEAST_SINE = 0.35


class Grower:
    """Grows grids of keypoints.

    Parameters
    ----------
    keypoints : (N) of any scales

    Attributes
    ----------
    pixels : (N, 2)
    contrast, signal : (N,)
    seeds : those within a grid first, of these the strongest
    """

    def __init__(self, keypoints: Keypoints) -> None:
        self.pixels, self._hessians = keypoints.pixels, keypoints.hessians
        # Responses are contrasts squared.
        self.contrast, self.signal = np.sqrt(keypoints.response), keypoints.signal
        self._alternate = keypoints.alternate
        self._scale, self._strength = keypoints.scale, np.log(keypoints.response)
        self._similar = {scale: _similar_scales(keypoints, scale) for scale in np.unique(keypoints.scale).tolist()}
        self._trees = {scale: cKDTree(self.pixels[similar]) for scale, similar in self._similar.items()}
        self._tree = cKDTree(self.pixels)
        seeds = np.concatenate([self._seeds_of(scale) for scale in self._similar] or [np.zeros((0, 5), np.int64)])
        closed = self._closed_corners(seeds)
        self.seeds: list[Seed] = [tuple(seeds[row].tolist()) for row in np.lexsort((seeds[:, 0], -closed))]

    def _seeds_of(self, scale: int) -> IntArray:
        """Seeds (S, 5) of a search scale, as :data:`Seed`: nearest like neighbours of similar scales on four sides."""
        similar, own = self._similar[scale], np.flatnonzero(self._scale == scale)
        if len(similar) < 5:
            return np.zeros((0, 5), np.int64)
        pixels, hessians, strength = self.pixels, self._hessians, self._strength
        _, near = self._trees[scale].query(pixels[own], min(_NEIGHBOURS + 1, len(similar)))
        near = similar[near[:, 1:]]
        offset = pixels[near] - pixels[own][:, None]
        length = np.linalg.norm(offset, axis=-1)
        sign = -1.0 if self._alternate else 1.0
        like = sign * np.einsum('nki,ni->nk', hessians[near], hessians[own]) > _LIKE
        like &= np.abs(strength[near] - strength[own][:, None]) < np.log(_STRONGER)
        closing = np.linalg.norm(offset[:, :, None] + offset[:, None], axis=-1)
        opposite = closing < _SEED_TOLERANCE * np.minimum(length[:, :, None], length[:, None])
        opposite &= like[:, :, None] & like[:, None]
        # Pairs of opposite neighbours, the nearest first; the second pair is the next that runs in another direction.
        row, one, other = np.nonzero(np.triu(opposite))
        unit = offset[row, one] / length[row, one][:, None]
        begins = np.asarray(np.searchsorted(row, row))
        across = np.abs(unit[begins, 0] * unit[:, 1] - unit[begins, 1] * unit[:, 0]) > _LEAST_SINE
        second = np.flatnonzero(across)
        second = second[np.unique(row[second], return_index=True)[1]]
        first = begins[second]
        return np.column_stack(
            [own[row[second]], *(near[row[pair], end[pair]] for pair in (first, second) for end in (one, other))]
        )

    def _closed_corners(self, seeds: IntArray) -> IntArray:
        """Number (S,) of corners of the square around each seed's centre that have a keypoint: 4 within a board.

        Beside the last row of a board, the second pair of a seed is another row's point and a point of clutter.
        """
        closed = np.zeros(len(seeds), dtype=np.int64)
        centre = self.pixels[seeds[:, 0]]
        for one, other in product((1, 2), (3, 4)):
            steps = self.pixels[seeds[:, [one, other]]] - centre[:, None]
            away, found = self._tree.query(centre + steps.sum(axis=1))
            like = np.einsum('ni,ni->n', self._hessians[found], self._hessians[seeds[:, 0]]) > _LIKE
            closed += like & (away < _TOLERANCE * np.linalg.norm(steps, axis=2).min(axis=1))
        return closed

    def total_contrast(self) -> float:
        """Of the seeds."""
        return float(self.contrast[[seed[0] for seed in self.seeds]].sum())

    def grids(self) -> Iterator[dict[LatticeNode, int]]:
        """Keypoints (their index) by their place in a grid, by the order of seeds; those of a grid seed no other."""
        taken: set[int] = set()
        tried = 0
        for seed in self.seeds:
            if tried == _MOST_SEEDS:
                return
            if seed[0] not in taken:
                tried += 1
                grid, orderly = self._grow(seed)
                taken.update(grid.values())
                if orderly:
                    yield grid

    def _grow(self, seed: Seed) -> tuple[dict[LatticeNode, int], bool]:
        """Grid from a seed: first what is next to it, then over gaps of one point; and whether it is orderly.

        Points of noise lie anywhere within the tolerance: their grid is given up.
        """
        grid: dict[LatticeNode, int] = dict(zip(((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)), seed, strict=True))
        support: Counter[LatticeNode] = Counter()
        for node in grid:
            support.update(_supported(node))
        asked: dict[LatticeNode, int] = {}
        off: list[float] = []
        growing = orderly = True
        while growing and orderly:
            growing = any(self._add(grid, reach, support, asked, off) for reach in (1, 2))
            orderly = len(off) < _ENOUGH or bool(np.mean(off) < _ORDERLY)
        return grid, orderly

    def _add(
        self,
        grid: dict[LatticeNode, int],
        reach: int,
        support: Counter[LatticeNode],
        asked: dict[LatticeNode, int],
        off: list[float],
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
        nodes, pixels = np.array(list(grid), dtype=np.float64), self.pixels[list(grid.values())]
        surfaces = local_surfaces(nodes, pixels, np.array(places, dtype=np.float64))
        steps, used, before = surfaces.steps, set(grid.values()), len(grid)
        rows = np.flatnonzero(surfaces.determined)
        radii = _TOLERANCE * np.linalg.norm(steps[rows], axis=1).max(axis=1, initial=0.0)
        nearby = self._tree.query_ball_point(surfaces.centres[rows], radii)
        scales = self._scales_at(grid, steps[rows])
        for row, near, scale in zip(rows.tolist(), nearby, scales.tolist(), strict=True):
            free = [index for index in near if index not in used and abs(self._scale[index] - scale) <= _SCALES_OFF]
            found = self._next(grid, places[row], free, surfaces.centres[row], steps[row]) if free else None
            if found is not None:
                grid[places[row]] = found[0]
                used.add(found[0])
                support.update(_supported(places[row]))
                off.append(found[1])
        return len(grid) > before

    def _scales_at(self, grid: dict[LatticeNode, int], steps: FloatArray) -> FloatArray:
        """Search scales (P,) of a grid's points where its ``steps`` (P, 2, 2) are, which grow with them."""
        ends = self.pixels[[grid[node] for node in ((1, 0), (-1, 0), (0, 1), (0, -1))]]
        seed_area = 0.25 * abs(np.linalg.det([ends[0] - ends[1], ends[2] - ends[3]]))
        wider = 0.5 * np.log(np.abs(np.linalg.det(steps)) / max(seed_area, 1.0))
        return np.asarray(self._scale[grid[0, 0]] - wider / np.log(SCALE_RATIO))

    def _next(
        self, grid: dict[LatticeNode, int], node: LatticeNode, nearby: list[int], centre: FloatArray, steps: FloatArray
    ) -> tuple[int, float] | None:
        """Keypoint of those ``nearby`` that is at ``node``, expected at ``centre``, and how far it is off [steps].

        Parameters
        ----------
        steps : (2, 2) to the next places, by columns [px]
        """
        off = np.linalg.norm(np.linalg.solve(steps, (self.pixels[nearby] - centre).T), axis=0)
        for away, index in sorted(zip(off.tolist(), nearby, strict=True)):
            if away <= _TOLERANCE and self._fits(grid, node, index):
                return index, away
        return None

    def _fits(self, grid: dict[LatticeNode, int], node: LatticeNode, index: int) -> bool:
        """Whether Hessian and contrast are like those of a neighbour; of any sign, for contrast may reverse."""
        neighbours = next(known for reach in (1, 2) if (known := [grid[n] for n in _around(node, reach) if n in grid]))
        alike = np.abs(self._hessians[neighbours] @ self._hessians[index]) > _LIKE
        alike &= np.abs(self._strength[neighbours] - self._strength[index]) < np.log(_STRONGER)
        return bool(alike.any())


def _similar_scales(keypoints: Keypoints, scale: int) -> IntArray:
    """Keypoints of a search scale, the next finer and the next coarser one: perspective spreads a board over them."""
    return np.flatnonzero(np.abs(keypoints.scale - scale) <= 1)


def _around(node: LatticeNode, reach: int) -> list[LatticeNode]:
    a, b = node
    return [(a + reach, b), (a - reach, b), (a, b + reach), (a, b - reach)]


def _beside(grid: dict[LatticeNode, int], reach: int) -> list[LatticeNode]:
    """Places ``reach`` steps from a point of the grid that have none, each once."""
    return list({node: None for known in grid for node in _around(known, reach) if node not in grid})


def _supported(node: LatticeNode) -> list[LatticeNode]:
    """Places that the point at a ``node`` leads to."""
    a, b = node
    return [(a + i, b + j) for i, j in _STEPS]
