"""Normal equations of a bundle adjustment over keyframes and markers: Schur complement, solution, covariances."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from thermal_fiducial.core.types import BoolArray, FloatArray, IntArray

# Columns of the inverse that are computed at a time.
_CHUNK = 96
# Unknowns up to which a dense factorisation is faster than a sparse one.
_DENSE = 1500


@dataclass(frozen=True)
class Blocks:
    """Gauss-Newton terms of n views, and of links between keyframes and priors of markers."""

    #: (n, 6, 6) J' J of keyframe, of marker, and of keyframe with marker
    rig: FloatArray
    marker: FloatArray
    cross: FloatArray
    #: (n, 6) J' r
    rig_gradient: FloatArray
    marker_gradient: FloatArray
    #: keyframes a and b, whitened residual (6,), derivatives (6, 6) with respect to each
    links: list[tuple[int, int, FloatArray, FloatArray, FloatArray]]
    #: marker, whitened residual (6,), derivative (6, 6)
    priors: list[tuple[int, FloatArray, FloatArray]]
    #: (F, 6, 6) and (F, 6), J' J and J' r of what is known of the keyframes' poses beside the views
    known: FloatArray
    known_gradient: FloatArray


@dataclass(frozen=True)
class ReducedSystem:
    """Schur complement over markers and tied keyframes (``nodes``)."""

    #: sparse (6 nodes, 6 nodes), and the factors of its free part
    matrix: Any
    factor: Any
    #: (n, 6, 6) what each view of a loose keyframe takes of that one's right side
    eliminated: FloatArray


class NormalEquations:
    """The structure of the system: which view connects which keyframe with which marker.

    Unknown poses ("nodes") of the reduced system are the markers, 0 to M - 1, and behind them the tied keyframes.

    Parameters
    ----------
    frame, marker : (n,) of each view; views are ordered by keyframe
    tied : (F,) keyframes that stay in the reduced system because links join them
    held : (M,) markers that are no unknowns
    """

    def __init__(self, frame: IntArray, marker: IntArray, tied: BoolArray, held: BoolArray) -> None:
        self.frame, self.marker, self.tied, self.held = frame, marker, tied, held
        self._frames, self._markers = len(tied), len(held)
        self._tied_node = np.full(self._frames, -1)
        self._tied_node[tied] = self._markers + np.arange(np.count_nonzero(tied))
        self._nodes = self._markers + int(np.count_nonzero(tied))
        free = np.concatenate([~held, np.ones(self._nodes - self._markers, dtype=bool)])
        self._free = np.flatnonzero(free)
        self._held_nodes = np.flatnonzero(~free)

    def solve(self, blocks: Blocks, damping: float) -> tuple[FloatArray, FloatArray] | None:
        """Steps (F, 6) of the keyframes and (M, 6) of the markers; None where the system is singular."""
        H_ff, g_f = self._frame_terms(blocks, damping)
        H_inverse = _inverse(H_ff)
        S, g = self._reduced(blocks, H_inverse, g_f, damping)
        factor = _factorise(self._select(S, self._free, self._free))
        if factor is None:
            return None
        nodes = np.zeros((self._nodes, 6))
        nodes[self._free] = factor.solve(g[self._free].ravel()).reshape(-1, 6)
        rest = g_f.copy()
        np.subtract.at(rest, self.frame, (blocks.cross @ nodes[self.marker][..., None])[..., 0])
        frames = (H_inverse @ rest[..., None])[..., 0]
        frames[self.tied] = nodes[self._tied_node[self.tied]]
        if not np.all(np.isfinite(frames)) or not np.all(np.isfinite(nodes)):
            return None
        return frames, nodes[: self._markers]

    def reduced(self, blocks: Blocks) -> 'ReducedSystem | None':
        """The undamped system without its loose keyframes, factorised; None where it is singular."""
        H_ff, g_f = self._frame_terms(blocks, 0.0)
        H_inverse = _inverse(H_ff)
        S, _ = self._reduced(blocks, H_inverse, g_f, 0.0)
        factor = _factorise(self._select(S, self._free, self._free))
        return None if factor is None else ReducedSystem(S, factor, self._eliminated(blocks, H_inverse))

    def responses(self, system: 'ReducedSystem', rig: FloatArray, marker: FloatArray) -> FloatArray:
        """How far the markers go (M, 6, K) for each of K other right sides.

        Parameters
        ----------
        rig, marker : J' r of each view's keyframe and marker, both (n, 6, K), in place of those of the blocks
        """
        of_frames = np.add.reduceat(rig, np.flatnonzero(np.diff(self.frame, prepend=-1)), axis=0)
        g = np.zeros((self._nodes, *rig.shape[1:]))
        np.add.at(g, self.marker, marker - system.eliminated @ of_frames[self.frame])
        g[self._tied_node[self.tied]] = of_frames[self.tied]
        nodes = np.zeros_like(g)
        nodes[self._free] = system.factor.solve(g[self._free].reshape(-1, g.shape[-1])).reshape(-1, *g.shape[1:])
        return np.asarray(nodes[: self._markers])

    def covariances(self, system: 'ReducedSystem', factor: float, held_covariances: FloatArray) -> FloatArray:
        """Covariances (M, 6, 6) of the markers: noise times ``factor``, and what the held markers (M, 6, 6) pass on."""
        result = held_covariances.copy()
        unknown = self._free[self._free < self._markers]
        result[unknown] = factor * _diagonal_blocks(system.factor, len(self._free))[: len(unknown)]
        for node in self._held_nodes:
            if np.any(held_covariances[node]):
                S_held = self._select(system.matrix, self._free, np.array([node])).toarray()
                gains = -system.factor.solve(S_held).reshape(-1, 6, 6)[: len(unknown)]
                result[unknown] += gains @ held_covariances[node] @ np.swapaxes(gains, -1, -2)
        return np.asarray(0.5 * (result + np.swapaxes(result, -1, -2)))

    def _frame_terms(self, blocks: Blocks, damping: float) -> tuple[FloatArray, FloatArray]:
        starts = np.flatnonzero(np.diff(self.frame, prepend=-1))
        H = np.add.reduceat(blocks.rig, starts, axis=0) + blocks.known
        return _damped(H, damping), np.add.reduceat(blocks.rig_gradient, starts, axis=0) + blocks.known_gradient

    def _reduced(
        self, blocks: Blocks, H_inverse: FloatArray, g_f: FloatArray, damping: float
    ) -> tuple[Any, FloatArray]:
        """Schur complement, sparse, over all nodes, and its right side (nodes, 6)."""
        loose = ~self.tied[self.frame]
        eliminated = self._eliminated(blocks, H_inverse)
        g = np.zeros((self._nodes, 6))
        np.add.at(g, self.marker, blocks.marker_gradient - (eliminated @ g_f[self.frame][..., None])[..., 0])
        H_mm = np.zeros((self._nodes, 6, 6))
        np.add.at(H_mm, self.marker, blocks.marker)
        for m, e, J in blocks.priors:
            H_mm[m] += J.T @ J
            g[m] += J.T @ e
        nodes = self._tied_node[self.tied]
        H_mm[nodes] = np.linalg.inv(H_inverse[self.tied])
        g[nodes] = g_f[self.tied]
        everyone = np.arange(self._nodes)
        terms = [(everyone, everyone, _damped(H_mm, damping)), *self._tied_terms(blocks, loose)]
        for a, b, e, J_a, J_b in blocks.links:
            node_a, node_b = self._tied_node[a], self._tied_node[b]
            g[node_a] += J_a.T @ e
            g[node_b] += J_b.T @ e
            ends = ((node_a, J_a), (node_b, J_b))
            terms += [(np.array([i]), np.array([j]), (J_i.T @ J_j)[None]) for i, J_i in ends for j, J_j in ends]
        S = self._eliminated_pairs(blocks, H_inverse)
        return S + self._assemble(terms), g

    def _eliminated(self, blocks: Blocks, H_inverse: FloatArray) -> FloatArray:
        """What each view of a loose keyframe takes (n, 6, 6) of that one's right side."""
        loose = ~self.tied[self.frame][:, None, None]
        return np.where(loose, np.swapaxes(blocks.cross, -1, -2) @ H_inverse[self.frame], 0.0)

    def _tied_terms(self, blocks: Blocks, loose: BoolArray) -> list[tuple[IntArray, IntArray, FloatArray]]:
        if np.all(loose):
            return []
        rows, columns, cross = self._tied_node[self.frame[~loose]], self.marker[~loose], blocks.cross[~loose]
        return [(rows, columns, cross), (columns, rows, np.swapaxes(cross, -1, -2))]

    def _eliminated_pairs(self, blocks: Blocks, H_inverse: FloatArray) -> Any:
        """What the elimination of keyframes takes from each pair of markers that one of them sees.

        A keyframe of k views takes one product of (6 k, 6) matrices, not k^2 of (6, 6).
        """
        from scipy.sparse import bsr_array

        rows, columns, target, twice = self._pairs
        data = np.zeros((len(rows), 6, 6))
        bounds = np.flatnonzero(np.diff(self.frame, prepend=-1, append=self._frames))
        begin = 0
        for frame in np.flatnonzero(~self.tied):
            low, high = bounds[frame], bounds[frame + 1]
            k = high - low
            cross = np.swapaxes(blocks.cross[low:high], 0, 1).reshape(6, 6 * k)
            product = (cross.T @ (H_inverse[frame] @ cross)).reshape(k, 6, k, 6).swapaxes(1, 2).reshape(k * k, 6, 6)
            at = target[begin : begin + k * k]
            begin += k * k
            if twice:
                np.subtract.at(data, at, product)
            else:
                data[at] -= product
        starts = np.searchsorted(rows, np.arange(self._nodes + 1))
        return bsr_array((data, columns, starts), shape=(6 * self._nodes, 6 * self._nodes)).tocsr()

    @cached_property
    def _pairs(self) -> tuple[IntArray, IntArray, IntArray, bool]:
        """Markers of each pair that a loose keyframe sees, rising, and which of them each of its pairs of views is.

        The last says whether any keyframe sees a marker twice, with two cameras.
        """
        counts = np.bincount(self.frame, minlength=self._frames)
        counts_of_view = np.where(self.tied[self.frame], 0, counts[self.frame])
        first = np.repeat(np.arange(len(self.frame)), counts_of_view)
        begin = np.concatenate([[0], np.cumsum(counts)[:-1]])[self.frame]
        within = np.arange(len(first)) - np.repeat(np.cumsum(counts_of_view) - counts_of_view, counts_of_view)
        second = np.repeat(begin, counts_of_view) + within
        keys, target = np.unique(self.marker[first] * self._markers + self.marker[second], return_inverse=True)
        seen = np.unique(self.frame * self._markers + self.marker)
        return keys // self._markers, keys % self._markers, target, len(seen) < len(self.frame)

    def _assemble(self, terms: list[tuple[IntArray, IntArray, FloatArray]]) -> Any:
        """Sparse matrix of 6 x 6 blocks at (row, column); blocks at one place add up."""
        from scipy.sparse import coo_array

        rows = np.concatenate([term[0] for term in terms])
        columns = np.concatenate([term[1] for term in terms])
        blocks = np.concatenate([term[2] for term in terms])
        i = (6 * rows[:, None, None] + np.arange(6)[:, None]) + np.zeros((6, 6), dtype=int)
        j = (6 * columns[:, None, None] + np.arange(6)) + np.zeros((6, 6), dtype=int)
        shape = (6 * self._nodes, 6 * self._nodes)
        return coo_array((blocks.ravel(), (i.ravel(), j.ravel())), shape=shape).tocsr()

    @staticmethod
    def _select(S: Any, rows: IntArray, columns: IntArray) -> Any:
        scalar_rows = (6 * rows[:, None] + np.arange(6)).ravel()
        scalar_columns = (6 * columns[:, None] + np.arange(6)).ravel()
        return S[scalar_rows][:, scalar_columns]


def _damped(H: FloatArray, damping: float) -> FloatArray:
    """Marquardt's damping of (..., 6, 6); a trace of it always, lest an unseen direction makes the block singular."""
    diagonal = np.einsum('...ii->...i', H)
    floor = 1e-12 * (np.max(diagonal, axis=-1, keepdims=True) + 1e-12)
    return np.asarray(H + (damping * diagonal + floor)[..., None] * np.eye(6))


def _inverse(H: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.inv(H), dtype=np.float64)


@dataclass(frozen=True)
class _Cholesky:
    """A dense factor with the interface of scipy's sparse one."""

    factor: tuple[FloatArray, bool]

    def solve(self, right: FloatArray) -> FloatArray:
        from scipy.linalg import cho_solve

        return np.asarray(cho_solve(self.factor, right, check_finite=False))


def _factorise(S: Any) -> Any:
    """Factors of a sparse matrix; None when it is singular."""
    from scipy.linalg import cho_factor
    from scipy.sparse.linalg import splu

    try:
        if S.shape[0] <= _DENSE:
            return _Cholesky(cho_factor(S.toarray(), lower=True, overwrite_a=True))
        return splu(S.tocsc(), permc_spec='MMD_AT_PLUS_A', options={'SymmetricMode': True}, diag_pivot_thresh=0.0)
    except (RuntimeError, ValueError, np.linalg.LinAlgError):
        return None


def _diagonal_blocks(lu: Any, count: int) -> FloatArray:
    """The 6 x 6 blocks (count, 6, 6) on the diagonal of the inverse."""
    blocks = np.empty((count, 6, 6))
    for low in range(0, 6 * count, _CHUNK):
        width = min(_CHUNK, 6 * count - low)
        unit = np.zeros((6 * count, width))
        unit[low + np.arange(width), np.arange(width)] = 1.0
        columns = lu.solve(unit)[low : low + width].reshape(width // 6, 6, width // 6, 6)
        k = np.arange(width // 6)
        blocks[low // 6 : low // 6 + width // 6] = columns[k, :, k]
    return blocks
