"""Normal equations of a bundle adjustment over keyframes and nodes: Schur complement, solution, covariances."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from thermal_fiducial.core.geometry.rigid_fit import SINGULAR
from thermal_fiducial.core.types import BoolArray, FloatArray, IntArray

# Unknowns up to which a dense factorisation is faster than a sparse one.
_DENSE = 1500
# Entries of the inverse that are computed at a time: all of a dense one.
_ENTRIES = _DENSE**2
# Share of the markers that a keyframe sees from which a dense product is faster than a sparse one.
_FULL = 0.15


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

    def reduced(self, blocks: Blocks, damping: float = 0.0) -> 'BorderedSystem | None':
        """The system of the nodes alone, factorised; None where it is singular."""
        try:
            root = np.linalg.inv(np.linalg.cholesky(_damped(blocks.frame, damping)))
            coupling, matrix = self._schur(root[self._frame] @ blocks.cross[self._order], _damped(blocks.node, damping))
            free = np.flatnonzero(np.repeat(~self._held, 6))
            apart = ReducedSystem(root, coupling, matrix, _solver(matrix[free][:, free]), self._held)
            return BorderedSystem.of(apart, blocks.common)
        except (RuntimeError, ValueError, np.linalg.LinAlgError):
            return None

    def _schur(self, cross: FloatArray, own: FloatArray) -> tuple[Any, Any]:
        """Coupling (6 F, 6 M) of keyframes and nodes, and Schur complement (6 M, 6 M); sparse in large maps.

        Parameters
        ----------
        cross, own : (n, 6, 6), (M, 6, 6) blocks of the connections, ordered by keyframe, and of the nodes
        """
        frames, each = self._frames, np.arange(len(own))
        if len(cross) > _FULL * frames * len(own):
            cells, blocks = np.zeros((frames, 6, len(own), 6)), np.zeros((len(own), 6, len(own), 6))
            cells[self._frame, :, self._node] = cross
            blocks[each, :, each] = own
            coupling = cells.reshape(6 * frames, -1)
            return coupling, blocks.reshape(6 * len(own), -1) - coupling.T @ coupling
        # Only here, as its import takes 30 MB.
        from scipy.sparse import bsr_array

        sparse: Any = bsr_array((cross, self._node, self._starts), shape=(6 * frames, 6 * len(own)))
        reduced = bsr_array((own, each, np.arange(len(own) + 1))).tocsr() - sparse.T @ sparse
        return sparse, reduced.toarray() if reduced.shape[0] <= _DENSE else reduced


@dataclass(frozen=True)
class ReducedSystem:
    """Schur complement: the system of the nodes after the keyframes are eliminated."""

    #: (F, 6, 6) inverse Cholesky factors of the keyframes' blocks
    root: FloatArray
    #: (6 F, 6 M) these factors times the cross blocks of keyframes and nodes
    coupling: Any
    #: (6 M, 6 M) Schur complement, and what solves its part of the m free nodes for right sides (6 m, K)
    matrix: Any
    solve_free: Callable[[FloatArray], FloatArray]
    #: (M,)
    held: BoolArray

    def solve(self, of_frames: FloatArray, of_nodes: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Solutions (F, 6, K) and (M, 6, K) for right sides of the same shapes."""
        count = of_frames.shape[-1]
        sides = (self.root @ of_frames).reshape(-1, count)
        remaining = (of_nodes.reshape(-1, count) - self.coupling.T @ sides).reshape(of_nodes.shape)
        nodes = np.zeros_like(of_nodes)
        nodes[~self.held] = self.solve_free(remaining[~self.held].reshape(-1, count)).reshape(-1, 6, count)
        left = sides - self.coupling @ nodes.reshape(-1, count)
        return np.swapaxes(self.root, -1, -2) @ left.reshape(of_frames.shape), nodes

    def covariances(self) -> FloatArray:
        """Covariances (M, 6, 6) of the nodes by noise."""
        free, result = np.flatnonzero(~self.held), np.zeros((len(self.held), 6, 6))
        number = max(_ENTRIES // (36 * len(free)), 1)
        for first in range(0, len(free), number):
            some = free[first : first + number]
            unit = np.zeros((len(free), 6, len(some), 6))
            each = np.arange(len(some))
            unit[first + each, :, each] = np.eye(6)
            inverse = self.solve_free(unit.reshape(6 * len(free), -1)).reshape(unit.shape)
            result[some] = inverse[first + each, :, each]
        return 0.5 * (result + np.swapaxes(result, -1, -2))

    def by_held(self, drawn: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Errors (F, 6, K) and (M, 6, K) of all by those of the held nodes, of ``drawn`` (M, 6, K)."""
        free, result, count = ~self.held, np.where(self.held[:, None, None], drawn, 0.0), drawn.shape[-1]
        if result.any():
            moved = (self.matrix @ result.reshape(-1, count)).reshape(result.shape)
            result[free] = -self.solve_free(moved[free].reshape(-1, count)).reshape(result[free].shape)
        frames = -(self.coupling @ result.reshape(-1, count)).reshape(-1, 6, count)
        return np.swapaxes(self.root, -1, -2) @ frames, np.asarray(result)


@dataclass(frozen=True)
class BorderedSystem:
    """A reduced system with unknowns that all views have in common, which are eliminated last."""

    apart: ReducedSystem
    #: their terms with keyframes, nodes and each other, and what a unit of each moves the others by
    border: Vectors
    moved: Vectors
    #: (L, L) inverse of their Schur complement
    covariance: FloatArray

    @classmethod
    def of(cls, apart: ReducedSystem, border: Vectors) -> 'BorderedSystem':
        """LinAlgError if the whole is not positive definite."""
        moved = Vectors(*apart.solve(border.frames, border.nodes), border.common)
        schur = border.common - moved.dot(border)
        root = np.linalg.inv(np.linalg.cholesky(0.5 * (schur + schur.T)))
        return cls(apart, border, moved, root.T @ root)

    def solve(self, sides: Vectors) -> Vectors:
        """Solutions for right sides of the same shapes."""
        return self._with_common(*self.apart.solve(sides.frames, sides.nodes), sides.common)

    def common(self, sides: Vectors) -> FloatArray:
        """The part (L, K) of :meth:`solve` that is of what is common: the equations are symmetric."""
        return np.asarray(self.covariance @ (sides.common - sides.dot(self.moved)))

    def covariances(self, of_common: FloatArray) -> FloatArray:
        """Covariances (M, 6, 6) of the nodes, with that (L, L) of what is common."""
        return self.apart.covariances() + self.moved.nodes @ of_common @ np.swapaxes(self.moved.nodes, -1, -2)

    def by_held(self, drawn: FloatArray) -> Vectors:
        """Errors of all by those of the held nodes, of ``drawn`` (M, 6, K)."""
        return self._with_common(*self.apart.by_held(drawn), np.zeros((1, 1)))

    def _with_common(self, frames: FloatArray, nodes: FloatArray, side: FloatArray) -> Vectors:
        """Solutions by those (F, 6, K) and (M, 6, K) without common unknowns, and the right sides (L, K) of these."""
        apart = Vectors(frames, nodes, side)
        common = self.covariance @ (side - apart.dot(self.border))
        return Vectors(frames - self.moved.frames @ common, nodes - self.moved.nodes @ common, common)


def _damped(H: FloatArray, damping: float) -> FloatArray:
    """Marquardt damping of (..., 6, 6); a little of it always, so that no block is singular."""
    diagonal = np.einsum('...ii->...i', H)
    floor = SINGULAR * (np.max(diagonal, axis=-1, keepdims=True) + SINGULAR)
    return np.asarray(H + (damping * diagonal + floor)[..., None] * np.eye(6))


def _solver(S: Any) -> Callable[[FloatArray], FloatArray]:
    """What solves with a positive definite matrix; LinAlgError if a small one is not, RuntimeError if singular."""
    if isinstance(S, np.ndarray):
        np.linalg.cholesky(S)
        return partial(np.linalg.solve, S)
    from scipy.sparse import csc_array
    from scipy.sparse.linalg import splu

    options = {'SymmetricMode': True}
    solve: Callable[[FloatArray], FloatArray] = splu(
        csc_array(S), permc_spec='MMD_AT_PLUS_A', options=options, diag_pivot_thresh=0.0
    ).solve
    return solve
