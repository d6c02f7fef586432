"""Rotations of steps, and their integrals."""

from math import factorial

import numpy as np
import numpy.typing as npt

from thermal_fiducial.core.geometry.se3 import skew
from thermal_fiducial.core.types import FloatArray

_IDENTITY = np.eye(3)
#: Gamma_m = c[m, 0] 1 + c[m, 1] skew + c[m, 2] skew^2; series (terms, 9) of c in the negative square of the angle.
_TERMS = np.arange(14)
_SERIES = np.array(
    [[share / factorial(2 * k + m + j) for m in range(3) for j, share in enumerate((k == 0, 1, 1))] for k in _TERMS]
)
#: Beyond this square of the angle [rad^2] the terms that are left out count: no sound step turns so far.
_LARGEST = 10.0


def rotation_integrals(angles: npt.ArrayLike) -> FloatArray:
    """Rotations of steps and their first and second integrals.

    ``Gamma_m(phi) = sum_n skew(phi)^n / (n + m)!`` for m = 0, 1, 2 (Bloesch et al., "State Estimation for Legged
    Robots", 2013): Gamma_0 is the rotation, Gamma_1 the left Jacobian.

    Parameters
    ----------
    angles : (..., 3) rotation vectors [rad]

    Returns
    -------
    (..., 3, 3, 3) Gamma_0, Gamma_1, Gamma_2
    """
    phi = np.asarray(angles, float)
    squares = (phi * phi).sum(axis=-1)
    basis = np.empty((*phi.shape, 3, 3))
    basis[..., 0, :, :] = _IDENTITY
    basis[..., 1, :, :] = matrix = skew(phi)
    basis[..., 2, :, :] = matrix @ matrix
    return np.asarray(_coefficients(squares) @ basis.reshape(*phi.shape, 9)).reshape(basis.shape)


def _coefficients(squares: FloatArray) -> FloatArray:
    """(..., 3, 3) what Gamma_m has of 1, skew and skew^2, for squares (...) of the angles."""
    coefficients = (-squares[..., None]) ** _TERMS @ _SERIES
    if squares.max() > _LARGEST:
        far = np.maximum(squares, _LARGEST)
        angle = np.sqrt(far)
        a, b = np.sin(angle) / angle, (1.0 - np.cos(angle)) / far
        c, d = (1.0 - a) / far, (0.5 - b) / far
        one = np.ones_like(a)
        closed = np.stack((one, a, b, one, b, c, 0.5 * one, c, d), axis=-1)
        coefficients = np.where(squares[..., None] > _LARGEST, closed, coefficients)
    return np.asarray(coefficients).reshape(*squares.shape, 3, 3)
