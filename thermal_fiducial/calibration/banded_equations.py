"""Normal equations of a chain of states (block tridiagonal) with unknowns shared by all of them."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from scipy.linalg import solveh_banded

from thermal_fiducial.core.types import FloatArray


@dataclass(frozen=True)
class BandedEquations:
    """Accumulated normal equations of a Gauss-Newton step.

    Parameters
    ----------
    H : (N, 2, S, S) blocks of each state with itself and with the next one
    B : (N, S, K) blocks of the states with the K shared unknowns
    C : (K, K) block of the shared unknowns
    g, c : (N, S) and (K,) gradients by the states and by the shared unknowns
    """

    H: FloatArray
    B: FloatArray
    C: FloatArray
    g: FloatArray
    c: FloatArray

    @classmethod
    def empty(cls, states: int, size: int, shared: int) -> Self:
        """Zero equations for ``states`` states of ``size`` unknowns each."""
        H, B = np.zeros((states, 2, size, size)), np.zeros((states, size, shared))
        return cls(H, B, np.zeros((shared, shared)), np.zeros((states, size)), np.zeros(shared))

    def copy(self) -> Self:
        """An independent copy."""
        return type(self)(*(values.copy() for values in vars(self).values()))

    def add_states(self, index: slice, J: FloatArray, by_shared: FloatArray, error: FloatArray) -> None:
        """Add whitened errors (M, E) with their derivatives (M, E, S) by the states ``index``, and (M, E, K)."""
        transposed = np.swapaxes(J, 1, 2)
        self.H[index, 0] += transposed @ J
        self.B[index] += transposed @ by_shared
        self.g[index] += (transposed @ error[:, :, None])[:, :, 0]

    def add_shared(self, by_shared: FloatArray, error: FloatArray) -> None:
        """Add the blocks of the shared unknowns for the same errors."""
        flat = by_shared.reshape(-1, len(self.c))
        self.C[...] += flat.T @ flat
        self.c[...] += flat.T @ error.ravel()

    def solved(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Steps of the states (N, S) and of the shared unknowns (K,), and the covariance (K, K) of the latter."""
        steps, by_shared, covariance = self._eliminated(self.g.reshape(-1, 1))
        shared = -covariance @ (self.c - self.B.reshape(by_shared.shape).T @ steps[:, 0])
        own = (-steps[:, 0] - by_shared @ shared).reshape(self.g.shape)
        return own, shared, covariance

    def steps_of_shared(self, g: FloatArray, c: FloatArray) -> FloatArray:
        """Steps (K, k) of the shared unknowns by each of k gradients (N, S, k) and (K, k)."""
        steps, by_shared, covariance = self._eliminated(g.reshape(self.g.size, c.shape[-1]))
        return np.asarray(-covariance @ (c - self.B.reshape(by_shared.shape).T @ steps))

    def _eliminated(self, sides: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """States by k right sides (N S, k), by the shared unknowns (N S, K), and the covariance (K, K) of those."""
        flat = self.B.reshape(-1, len(self.c))
        solved = solveh_banded(_band(self.H), np.column_stack([sides, flat]), lower=True)
        by_shared = solved[:, sides.shape[1] :]
        return solved[:, : sides.shape[1]], by_shared, np.linalg.inv(self.C - flat.T @ by_shared)


def _band(H: FloatArray) -> FloatArray:
    """Lower band (2 S, S N) of the block tridiagonal matrix, as LAPACK stores it."""
    count, size = len(H), H.shape[-1]
    band = np.zeros((2 * size, count, size))
    column = np.arange(size)
    for row in range(size):
        inside = column <= row
        band[row - column[inside], :, column[inside]] = H[:, 0, row, inside].T
        band[size + row - column, :, column] = H[:, 1, row, :].T
    return band.reshape(2 * size, -1)
