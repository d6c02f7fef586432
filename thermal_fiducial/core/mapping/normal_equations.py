"""Normal equations of a bundle adjustment over keyframes and markers: Schur complement, solution, covariances."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from thermal_fiducial.core.types import BoolArray, FloatArray, IntArray

# Columns of the inverse that are computed at a time.
_CHUNK = 96
# Pairs of views of one keyframe that are multiplied at a time: bounds the memory.
_PAIRS = 50_000


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

    def responses(self, blocks: Blocks, sides: Iterable[tuple[FloatArray, FloatArray]]) -> FloatArray | None:
        """How far the markers go (M, 6, K) for each of K other right sides; None where the system is singular.

        Parameters
        ----------
        sides : J' r of each view's keyframe and marker, both (n, 6), in place of those of ``blocks``
        """
        H_ff, g_f = self._frame_terms(blocks, 0.0)
        H_inverse = _inverse(H_ff)
        S, _ = self._reduced(blocks, H_inverse, g_f, 0.0)
        lu = _factorise(self._select(S, self._free, self._free))
        if lu is None:
            return None
        eliminated = self._eliminated(blocks, H_inverse)
        g = np.stack([self._right_side(eliminated, *side) for side in sides], axis=-1)
        nodes = np.zeros_like(g)
        nodes[self._free] = lu.solve(g[self._free].reshape(-1, g.shape[-1])).reshape(-1, *g.shape[1:])
        return np.asarray(nodes[: self._markers])

    def _right_side(self, eliminated: FloatArray, rig: FloatArray, marker: FloatArray) -> FloatArray:
        """Right side (nodes, 6) of the reduced system from those of the views."""
        of_frames = np.add.reduceat(rig, np.flatnonzero(np.diff(self.frame, prepend=-1)), axis=0)
        g = np.zeros((self._nodes, 6))
        np.add.at(g, self.marker, marker - (eliminated @ of_frames[self.frame][..., None])[..., 0])
        g[self._tied_node[self.tied]] = of_frames[self.tied]
        return g

    def covariances(self, blocks: Blocks, factor: float, held_covariances: FloatArray) -> FloatArray | None:
        """Covariances (M, 6, 6) of the markers: noise times ``factor``, and what the held markers (M, 6, 6) pass on."""
        H_ff, g_f = self._frame_terms(blocks, 0.0)
        S, _ = self._reduced(blocks, _inverse(H_ff), g_f, 0.0)
        lu = _factorise(self._select(S, self._free, self._free))
        if lu is None:
            return None
        result = held_covariances.copy()
        unknown = self._free[self._free < self._markers]
        result[unknown] = factor * _diagonal_blocks(lu, len(self._free))[: len(unknown)]
        for node in self._held_nodes:
            if np.any(held_covariances[node]):
                S_held = self._select(S, self._free, np.array([node])).toarray()
                gains = -lu.solve(S_held).reshape(-1, 6, 6)[: len(unknown)]
                result[unknown] += gains @ held_covariances[node] @ np.swapaxes(gains, -1, -2)
        symmetric = 0.5 * (result + np.swapaxes(result, -1, -2))
        return symmetric if np.all(np.isfinite(symmetric)) else None

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
        S = self._eliminated_pairs(blocks, eliminated)
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

    def _eliminated_pairs(self, blocks: Blocks, eliminated: FloatArray) -> Any:
        """What the elimination of keyframes takes from each pair of markers that one of them sees."""
        first, second, order, starts = self._pairs
        merged = np.zeros((len(starts), 6, 6))
        group = np.cumsum(np.bincount(starts, minlength=len(order))) - 1 if len(order) else np.zeros(0, dtype=int)
        for low in range(0, len(order), _PAIRS):
            chosen = order[low : low + _PAIRS]
            products = eliminated[first[chosen]] @ blocks.cross[second[chosen]]
            inside = group[low : low + _PAIRS]
            begin = np.flatnonzero(np.diff(inside, prepend=-1))
            merged[inside[begin]] -= np.add.reduceat(products, begin, axis=0)
        heads = order[starts]
        return self._assemble([(self.marker[first[heads]], self.marker[second[heads]], merged)])

    @cached_property
    def _pairs(self) -> tuple[IntArray, IntArray, IntArray, IntArray]:
        """Pairs of views of one loose keyframe, their order by the two markers, and where each group of it starts."""
        counts = np.bincount(self.frame, minlength=self._frames)
        counts_of_view = np.where(self.tied[self.frame], 0, counts[self.frame])
        first = np.repeat(np.arange(len(self.frame)), counts_of_view)
        begin = np.concatenate([[0], np.cumsum(counts)[:-1]])[self.frame]
        within = np.arange(len(first)) - np.repeat(np.cumsum(counts_of_view) - counts_of_view, counts_of_view)
        second = np.repeat(begin, counts_of_view) + within
        key = self.marker[first] * self._markers + self.marker[second]
        order = np.argsort(key, kind='stable')
        return first, second, order, np.flatnonzero(np.diff(key[order], prepend=-1))

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


def _factorise(S: Any) -> Any:
    """LU factors of a sparse matrix; None when it is singular."""
    from scipy.sparse.linalg import splu

    try:
        return splu(S.tocsc(), permc_spec='MMD_AT_PLUS_A', options={'SymmetricMode': True}, diag_pivot_thresh=0.0)
    except RuntimeError:
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
