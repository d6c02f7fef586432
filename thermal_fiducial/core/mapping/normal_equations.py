"""Normal equations of a bundle adjustment over keyframes and markers: Schur complement, solution, covariances."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from thermal_fiducial.core.geometry.rigid_fit import SINGULAR
from thermal_fiducial.core.types import BoolArray, FloatArray, IntArray

# Columns of the inverse that are computed at a time.
_CHUNK = 96
# Unknowns up to which a dense factorisation is faster than a sparse one.
_DENSE = 1500
# Share of the markers that a keyframe sees from which a dense product is faster than a sparse one.
_FULL = 0.15


@dataclass(frozen=True)
class Blocks:
    """Gauss-Newton terms of n views of M markers in F keyframes."""

    #: (F, 6, 6) and (M, 6, 6) J' J of each keyframe and marker, over its views and its prior
    frame: FloatArray
    marker: FloatArray
    #: (n, 6, 6) J' J of each view's keyframe with its marker
    cross: FloatArray


class NormalEquations:
    """The structure of the system: which view connects which keyframe with which marker.

    Parameters
    ----------
    frame, marker : (n,) of each view; views are ordered by keyframe
    held : (M,) markers that are held fixed
    """

    def __init__(self, frame: IntArray, marker: IntArray, held: BoolArray) -> None:
        self._frame, self._marker, self._held = frame, marker, held
        self._frames = int(frame[-1]) + 1
        self._starts = np.searchsorted(frame, np.arange(self._frames + 1))

    def reduced(self, blocks: Blocks, damping: float = 0.0) -> 'ReducedSystem | None':
        """The system of the markers alone, factorised; None where it is singular."""
        from scipy.sparse import bsr_array

        markers = len(self._held)
        try:
            root = np.linalg.inv(np.linalg.cholesky(_damped(blocks.frame, damping)))
        except np.linalg.LinAlgError:
            return None
        shape = (6 * self._frames, 6 * markers)
        coupling: Any = bsr_array((root[self._frame] @ blocks.cross, self._marker, self._starts), shape=shape)
        if len(self._frame) > _FULL * self._frames * markers:
            coupling = coupling.toarray()
        each = np.arange(markers + 1)
        own = bsr_array((_damped(blocks.marker, damping), each[:-1], each))
        matrix = own.tocsr() - coupling.T @ coupling
        free = np.flatnonzero(np.repeat(~self._held, 6))
        factor = _factorise(matrix[free][:, free])
        return None if factor is None else ReducedSystem(root, coupling, matrix, factor, self._held)


@dataclass(frozen=True)
class ReducedSystem:
    """Schur complement: the system of the markers after the keyframes are eliminated."""

    #: (F, 6, 6) inverse Cholesky factors of the keyframes' blocks
    root: FloatArray
    #: (6 F, 6 M) these factors times the cross blocks of keyframes and markers
    coupling: Any
    #: (6 M, 6 M) Schur complement, and the factorisation of its part of free markers
    matrix: Any
    factor: Any
    #: (M,)
    held: BoolArray

    def solve(self, of_frames: FloatArray, of_markers: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Solutions (F, 6, K) and (M, 6, K) for right sides of the same shapes."""
        count = of_frames.shape[-1]
        sides = (self.root @ of_frames).reshape(-1, count)
        remaining = (of_markers.reshape(-1, count) - self.coupling.T @ sides).reshape(of_markers.shape)
        markers = np.zeros_like(of_markers)
        markers[~self.held] = self.factor.solve(remaining[~self.held].reshape(-1, count)).reshape(-1, 6, count)
        left = sides - self.coupling @ markers.reshape(-1, count)
        return np.swapaxes(self.root, -1, -2) @ left.reshape(of_frames.shape), markers

    def covariances(self, factor: float, held_covariances: FloatArray) -> FloatArray:
        """Covariances (M, 6, 6) of the markers: noise times ``factor``, plus those by held markers (M, 6, 6)."""
        free = np.flatnonzero(~self.held)
        unknowns = (6 * free[:, None] + np.arange(6)).ravel()
        result = held_covariances.copy()
        result[free] = factor * _diagonal_blocks(self.factor, len(free))
        for held in np.flatnonzero(self.held):
            if np.any(held_covariances[held]):
                columns = self.matrix[unknowns][:, 6 * held : 6 * held + 6]
                gains = -self.factor.solve(_dense(columns)).reshape(-1, 6, 6)
                result[free] += gains @ held_covariances[held] @ np.swapaxes(gains, -1, -2)
        return np.asarray(0.5 * (result + np.swapaxes(result, -1, -2)))


def _damped(H: FloatArray, damping: float) -> FloatArray:
    """Marquardt damping of (..., 6, 6); a little of it always, so that no block is singular."""
    diagonal = np.einsum('...ii->...i', H)
    floor = SINGULAR * (np.max(diagonal, axis=-1, keepdims=True) + SINGULAR)
    return np.asarray(H + (damping * diagonal + floor)[..., None] * np.eye(6))


@dataclass(frozen=True)
class _Cholesky:
    """A dense factor with the interface of scipy's sparse one."""

    factor: tuple[FloatArray, bool]

    def solve(self, right: FloatArray) -> FloatArray:
        from scipy.linalg import cho_solve

        return np.asarray(cho_solve(self.factor, right, check_finite=False))


def _dense(matrix: Any) -> FloatArray:
    return np.asarray(matrix if isinstance(matrix, np.ndarray) else matrix.toarray())


def _factorise(S: Any) -> Any:
    """Factors of a matrix; None when it is singular."""
    from scipy.linalg import cho_factor
    from scipy.sparse import csc_array
    from scipy.sparse.linalg import splu

    try:
        if S.shape[0] <= _DENSE:
            return _Cholesky(cho_factor(_dense(S), lower=True, overwrite_a=True))
        return splu(csc_array(S), permc_spec='MMD_AT_PLUS_A', options={'SymmetricMode': True}, diag_pivot_thresh=0.0)
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
