"""Normal equations of a bundle adjustment over keyframes and nodes: Schur complement, solution, covariances."""

from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from thermal_fiducial.core.geometry.rigid_fit import SINGULAR
from thermal_fiducial.core.types import BoolArray, FloatArray, IntArray

# Unknowns up to which a dense factorisation is faster than a sparse one.
_DENSE = 1500
# Entries of the inverse of a sparse matrix that are computed at a time.
_ENTRIES = 1500**2
# Successive keyframes, which see nearly the same markers, whose products are computed at a time.
_TOGETHER = 48
# Size up to which numpy inverts triangular matrices as fast as it can.
_SMALL = 64


class Vectors(NamedTuple):
    """K vectors of all unknowns: (F, 6, K) of keyframes, (M, 6, K) of nodes, (L, K) of what views have in common."""

    frames: FloatArray
    nodes: FloatArray
    common: FloatArray

    def dot(self, other: 'Vectors') -> FloatArray:
        """Products (L, K) with L ``other`` ones, over keyframes and nodes."""
        over = ([0, 1], [0, 1])
        return np.asarray(np.tensordot(other.frames, self.frames, over) + np.tensordot(other.nodes, self.nodes, over))


@dataclass(frozen=True)
class Blocks:
    """Gauss-Newton terms of n connections of M nodes with F keyframes: of markers by their views, and of odometry."""

    #: (F, 6, 6) and (M, 6, 6) J' J of each keyframe and node, over its connections and its prior
    frame: FloatArray
    node: FloatArray
    #: (n, 6, 6) J' J of each connection's keyframe with its node
    cross: FloatArray
    #: of L unknowns that all views have in common: with keyframes, with nodes, and (L, L) with each other and the prior
    common: Vectors


class NormalEquations:
    """The structure of the system: which keyframe is connected with which node.

    Parameters
    ----------
    frame, node : (n,) of each connection
    held : (M,) nodes that are held fixed
    """

    def __init__(self, frame: IntArray, node: IntArray, held: BoolArray) -> None:
        self._order = np.argsort(frame, kind='stable')
        self._frame, self._node, self._held = frame[self._order], node[self._order], held
        self._frames = int(self._frame[-1]) + 1
        self._starts = np.searchsorted(self._frame, np.arange(self._frames + 1))

    def reduced(self, blocks: Blocks, damping: float = 0.0) -> 'ReducedSystem | None':
        """The system of the nodes alone, factorised; None where it is singular."""
        try:
            root = np.linalg.inv(np.linalg.cholesky(_damped(blocks.frame, damping)))
            cross = root[self._frame] @ blocks.cross[self._order]
            coupling, node = self._coupling(cross), _damped(blocks.node, damping)
            dense = 6 * len(node) <= _DENSE
            matrix = coupling.schur(node) if dense else self._sparse_schur(cross, node)
            free = np.flatnonzero(np.repeat(~self._held, 6))
            own = matrix[free][:, free]
            factor = _DenseFactor.of(own) if dense else _SparseFactor.of(own)
            return ReducedSystem(root, coupling, matrix, factor, self._held, blocks.common)
        except (RuntimeError, ValueError, np.linalg.LinAlgError):
            return None

    def _coupling(self, cross: FloatArray) -> 'Coupling':
        """Keyframes and nodes by the blocks (n, 6, 6) of their connections, ordered by keyframe."""
        parts = []
        for first, end in pairwise([*range(0, self._frames, _TOGETHER), self._frames]):
            some = slice(self._starts[first], self._starts[end])
            nodes, place = np.unique(self._node[some], return_inverse=True)
            cells = np.zeros((end - first, 6, len(nodes), 6))
            cells[self._frame[some] - first, :, place] = cross[some]
            columns = (6 * nodes[:, None] + np.arange(6)).ravel()
            parts.append((slice(6 * first, 6 * end), columns, cells.reshape(-1, len(columns))))
        return Coupling(parts)

    def _sparse_schur(self, cross: FloatArray, own: FloatArray) -> Any:
        """As :meth:`Coupling.schur`, for a large map."""
        # Only here, as its import takes 30 MB.
        from scipy.sparse import bsr_array

        each, shape = np.arange(len(own) + 1), (6 * self._frames, 6 * len(own))
        sparse: Any = bsr_array((cross, self._node, self._starts), shape=shape)
        return bsr_array((own, each[:-1], each)).tocsr() - sparse.T @ sparse


@dataclass(frozen=True)
class Coupling:
    """A matrix (6 F, 6 M) of keyframes and nodes."""

    #: of some successive keyframes: rows, columns of the nodes that any of them is connected with, and what is there
    parts: list[tuple[slice, IntArray, FloatArray]]

    def times(self, nodes: FloatArray) -> FloatArray:
        """Product (6 F, K) with vectors (6 M, K)."""
        return np.concatenate([cells @ nodes[columns] for _, columns, cells in self.parts])

    def taken_off(self, nodes: FloatArray, frames: FloatArray) -> FloatArray:
        """Vectors ``nodes`` (6 M, K) less the product of the transpose with ``frames`` (6 F, K)."""
        left = nodes.copy()
        for rows, columns, cells in self.parts:
            left[columns] -= cells.T @ frames[rows]
        return left

    def schur(self, own: FloatArray) -> FloatArray:
        """Schur complement (6 M, 6 M): blocks (M, 6, 6) of the nodes less the product of the transpose with this."""
        blocks, each = np.zeros((len(own), 6, len(own), 6)), np.arange(len(own))
        blocks[each, :, each] = own
        matrix = blocks.reshape(6 * len(own), -1)
        for _, columns, cells in self.parts:
            matrix[np.ix_(columns, columns)] -= cells.T @ cells
        return matrix


@dataclass(frozen=True)
class _DenseFactor:
    """A factorised positive definite matrix (m, m) of nodes, by the inverse of its Cholesky factor."""

    root: FloatArray

    @classmethod
    def of(cls, S: FloatArray) -> '_DenseFactor':
        """LinAlgError if it is not positive definite."""
        return cls(inverse_of_triangular(np.asarray(np.linalg.cholesky(S))))

    def solve(self, sides: FloatArray) -> FloatArray:
        """Solutions (m, K)."""
        return np.asarray(self.root.T @ (self.root @ sides))

    def drawn(self, normal: FloatArray) -> FloatArray:
        """Draws (m, K) of errors whose covariance is the inverse, by ``normal`` (m, K) of independent variables."""
        return np.asarray(self.root.T @ normal)

    def covariances(self) -> FloatArray:
        """Blocks (m / 6, 6, 6) on the diagonal of the inverse."""
        roots = self.root.T.reshape(-1, 6, len(self.root))
        return np.asarray(roots @ np.swapaxes(roots, -1, -2))


@dataclass(frozen=True)
class _SparseFactor:
    """The same by sparse triangular factors."""

    factors: Any

    @classmethod
    def of(cls, S: Any) -> '_SparseFactor':
        """RuntimeError if it is singular."""
        from scipy.sparse import csc_array
        from scipy.sparse.linalg import splu

        return cls(
            splu(csc_array(S), permc_spec='MMD_AT_PLUS_A', options={'SymmetricMode': True}, diag_pivot_thresh=0.0)
        )

    def solve(self, sides: FloatArray) -> FloatArray:
        return np.asarray(self.factors.solve(sides))

    def drawn(self, normal: FloatArray) -> FloatArray:
        # The matrix in another order is L D L', and D what is on the diagonal of the upper factor.
        permuted = self.factors.L @ (np.sqrt(np.abs(self.factors.U.diagonal()))[:, None] * normal)
        return self.solve(permuted[self.factors.perm_r])

    def covariances(self) -> FloatArray:
        size = self.factors.shape[0]
        result = np.zeros((size // 6, 6, 6))
        number = max(_ENTRIES // (6 * size), 1)
        for first in range(0, len(result), number):
            each = np.arange(min(number, len(result) - first))
            unit = np.zeros((len(result), 6, len(each), 6))
            unit[first + each, :, each] = np.eye(6)
            inverse = self.solve(unit.reshape(size, -1)).reshape(unit.shape)
            result[first + each] = inverse[first + each, :, each]
        return np.asarray(0.5 * (result + np.swapaxes(result, -1, -2)))


class ReducedSystem:
    """Schur complement: the system of the nodes after the keyframes are eliminated.

    Unknowns that all views have in common are eliminated last.

    Parameters
    ----------
    root : (F, 6, 6) inverse Cholesky factors of the keyframes' blocks
    coupling : these factors times the cross blocks of keyframes and nodes
    matrix, factor : (6 M, 6 M) Schur complement, sparse in large maps, and its part of the free nodes, factorised
    held : (M,)
    common : terms of the common unknowns with keyframes, nodes and each other

    Raises
    ------
    LinAlgError
        The whole is not positive definite.
    """

    def __init__(
        self,
        root: FloatArray,
        coupling: Coupling,
        matrix: Any,
        factor: _DenseFactor | _SparseFactor,
        held: BoolArray,
        common: Vectors,
    ) -> None:
        self._root, self._coupling, self._matrix, self._factor, self._held = root, coupling, matrix, factor, held
        self._common = common
        #: what a unit of each common unknown moves the others by
        self.moved = Vectors(*self._apart(common.frames, common.nodes), common.common)
        schur = common.common - self.moved.dot(common)
        inverse_root = np.linalg.inv(np.linalg.cholesky(0.5 * (schur + schur.T)))
        #: (L, L) inverse of the Schur complement of the common unknowns
        self.covariance = inverse_root.T @ inverse_root

    def solve(self, sides: Vectors) -> Vectors:
        """Solutions for right sides of the same shapes."""
        return self._with_common(*self._apart(sides.frames, sides.nodes), sides.common)

    def covariances(self, of_common: FloatArray) -> FloatArray:
        """Covariances (M, 6, 6) of the nodes by noise, with that (L, L) of what is common."""
        result = np.zeros((len(self._held), 6, 6))
        result[~self._held] = self._factor.covariances()
        return np.asarray(result + self.moved.nodes @ of_common @ np.swapaxes(self.moved.nodes, -1, -2))

    def drawn(self, common: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Draws (M, 6, K) of the nodes' errors by noise, with those (L, K) of what is ``common``."""
        normal = rng.standard_normal((6 * np.count_nonzero(~self._held), common.shape[-1]))
        return self._of_free(self._factor.drawn(normal)) - self.moved.nodes @ common

    def by_held(self, drawn: FloatArray) -> Vectors:
        """Errors of all by those of the held nodes, of ``drawn`` (M, 6, K)."""
        free, nodes, count = ~self._held, np.where(self._held[:, None, None], drawn, 0.0), drawn.shape[-1]
        if nodes.any():
            moved = (self._matrix @ nodes.reshape(-1, count)).reshape(nodes.shape)
            nodes[free] = -self._factor.solve(moved[free].reshape(-1, count)).reshape(nodes[free].shape)
        frames = -self._coupling.times(nodes.reshape(-1, count)).reshape(-1, 6, count)
        return self._with_common(np.swapaxes(self._root, -1, -2) @ frames, nodes, np.zeros((1, 1)))

    def _apart(self, of_frames: FloatArray, of_nodes: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Solutions (F, 6, K) and (M, 6, K) for right sides of the same shapes, if nothing were common."""
        count = of_frames.shape[-1]
        sides = (self._root @ of_frames).reshape(-1, count)
        remaining = self._coupling.taken_off(of_nodes.reshape(-1, count), sides).reshape(of_nodes.shape)
        nodes = self._of_free(self._factor.solve(remaining[~self._held].reshape(-1, count)))
        left = sides - self._coupling.times(nodes.reshape(-1, count))
        return np.swapaxes(self._root, -1, -2) @ left.reshape(of_frames.shape), nodes

    def _with_common(self, frames: FloatArray, nodes: FloatArray, side: FloatArray) -> Vectors:
        """Solutions by those (F, 6, K) and (M, 6, K) without common unknowns, and the right sides (L, K) of these."""
        common = self.covariance @ (side - Vectors(frames, nodes, side).dot(self._common))
        return Vectors(frames - self.moved.frames @ common, nodes - self.moved.nodes @ common, common)

    def _of_free(self, values: FloatArray) -> FloatArray:
        """Of all nodes (M, 6, K) by those (m, K) of the free ones."""
        nodes = np.zeros((len(self._held), 6, values.shape[-1]))
        nodes[~self._held] = values.reshape(-1, 6, values.shape[-1])
        return nodes


def _damped(H: FloatArray, damping: float) -> FloatArray:
    """Marquardt damping of (..., 6, 6); a little of it always, so that no block is singular."""
    diagonal = np.einsum('...ii->...i', H)
    floor = SINGULAR * (np.max(diagonal, axis=-1, keepdims=True) + SINGULAR)
    return np.asarray(H + (damping * diagonal + floor)[..., None] * np.eye(6))


def inverse_of_triangular(L: FloatArray) -> FloatArray:
    """Inverse of a lower triangular matrix (m, m), by halves: numpy's for any matrix takes several times as long."""
    half = len(L) // 2
    if half < _SMALL:
        return np.asarray(np.linalg.inv(L))
    inverse, first, second = np.zeros_like(L), slice(half), slice(half, None)
    inverse[first, first] = inverse_of_triangular(L[first, first])
    inverse[second, second] = inverse_of_triangular(L[second, second])
    inverse[second, first] = -inverse[second, second] @ (L[second, first] @ inverse[first, first])
    return inverse
