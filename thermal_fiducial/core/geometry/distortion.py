"""Lenses: distortion in normalised image coordinates (..., 2), its derivative and its inverse, by each model."""

from typing import Protocol

import numpy as np

from thermal_fiducial.core.types import FloatArray

# Newton's iteration doubles the digits: after a step this small nothing is left, and ten are enough at any lens's
# border.
_STEPS, _SHORT = 10, 1e-6
# Slopes and determinants nearer to zero than this are taken for it.
_FLAT = 1e-9
_EYE = np.eye(2)
# Widest angle from the axis for which x/z is of use [rad].
_WIDEST = 1.5


class LensModel(Protocol):
    """What each model knows."""

    def distort(self, x: FloatArray) -> FloatArray:
        """Distorted coordinates."""

    def linearise(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """:meth:`distort`, and its derivative (..., 2, 2)."""

    def undistort(self, target: FloatArray) -> FloatArray:
        """What :meth:`distort` makes ``target`` of."""

    def radius(self, r: FloatArray) -> FloatArray:
        """Distorted distances from the axis (...), the tangential part left out."""


class PolynomialLens:
    """plumb_bob, and rational_polynomial where there is a denominator.

    Parameters
    ----------
    D : k1 k2 p1 p2 k3, or these and k4 k5 k6
    """

    def __init__(self, D: FloatArray) -> None:
        k1, k2, self._p1, self._p2, k3, *rational = D.tolist()
        self._top, self._bottom = (k1, k2, k3), tuple(rational) if any(rational) else ()

    def distort(self, x: FloatArray) -> FloatArray:
        """See :class:`LensModel`."""
        r2 = np.einsum('...k,...k->...', x, x)
        return self._moved(x, r2, self._factor(r2))

    def linearise(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """See :class:`LensModel`."""
        p1, p2, r2 = self._p1, self._p2, np.einsum('...k,...k->...', x, x)
        factor, (k1, k2, k3) = self._factor(r2), self._top
        slope = k1 + r2 * (2.0 * k2 + 3.0 * k3 * r2)
        if self._bottom:
            k4, k5, k6 = self._bottom
            falling = k4 + r2 * (2.0 * k5 + 3.0 * k6 * r2)
            slope = (slope - factor * falling) / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6)))
        a, b, slope = x[..., 0], x[..., 1], 2.0 * slope
        J = np.empty((*x.shape[:-1], 2, 2))
        J[..., 0, 0] = factor + a * (a * slope + 6.0 * p2) + 2.0 * p1 * b
        J[..., 0, 1] = J[..., 1, 0] = a * (b * slope + 2.0 * p1) + 2.0 * p2 * b
        J[..., 1, 1] = factor + b * (b * slope + 6.0 * p1) + 2.0 * p2 * a
        return self._moved(x, r2, factor), J

    def undistort(self, target: FloatArray) -> FloatArray:
        """See :class:`LensModel`."""
        x = target.copy()
        for _ in range(_STEPS):
            distorted, J = self.linearise(x)
            a, b, c, d = J[..., 0, 0], J[..., 0, 1], J[..., 1, 0], J[..., 1, 1]
            determinant = a * d - b * c
            determinant = np.where(np.abs(determinant) < _FLAT, _FLAT, determinant)
            error = target - distorted
            step = np.empty_like(x)
            step[..., 0] = d * error[..., 0] - b * error[..., 1]
            step[..., 1] = a * error[..., 1] - c * error[..., 0]
            step /= determinant[..., None]
            x = x + step
            if np.abs(step).max(initial=0.0) < _SHORT:
                break
        return x

    def radius(self, r: FloatArray) -> FloatArray:
        """See :class:`LensModel`."""
        return np.asarray(r * self._factor(r * r))

    def _factor(self, r2: FloatArray) -> FloatArray:
        """By which points at a squared distance (...) from the axis are moved outwards."""
        k1, k2, k3 = self._top
        top = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        if not self._bottom:
            return np.asarray(top)
        k4, k5, k6 = self._bottom
        return np.asarray(top / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6))))

    def _moved(self, x: FloatArray, r2: FloatArray, factor: FloatArray) -> FloatArray:
        if not (self._p1 or self._p2):
            return np.asarray(x * factor[..., None])
        # The tangential part is p r^2 + 2 (p . x) x with p = (p2, p1).
        p1, p2 = self._p1, self._p2
        distorted = np.empty_like(x)
        a, b = x[..., 0], x[..., 1]
        factor = factor + (2.0 * p2) * a + (2.0 * p1) * b
        distorted[..., 0], distorted[..., 1] = a * factor + p2 * r2, b * factor + p1 * r2
        return distorted


class EquidistantLens:
    """The equidistant model: the distorted radius is a polynomial of the angle from the axis.

    Parameters
    ----------
    k : (4,)
    """

    def __init__(self, k: FloatArray) -> None:
        self._k = k

    def distort(self, x: FloatArray) -> FloatArray:
        """See :class:`LensModel`."""
        # Radius and angle are the same to the last digit where they are as small.
        r = np.maximum(np.sqrt(np.einsum('...k,...k->...', x, x)), 1e-12)
        return np.asarray(x * (self.radius(r) / r)[..., None])

    def linearise(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """See :class:`LensModel`."""
        r2 = (x * x).sum(axis=-1)
        r = np.sqrt(r2)
        theta = np.arctan(r)
        near = r < 1e-6
        safe = np.where(near, 1.0, r)
        scale = np.where(near, 1.0, self._of_angle(theta) / safe)
        # d(scale)/d(r^2): theta_d / r to second order at the axis is 1 + (k1 - 1/3) r^2.
        d_scale = (self._slope(theta) / (1.0 + r2) - scale) / (2.0 * safe * safe)
        d_scale = np.where(near, self._k[0] - 1 / 3, d_scale)
        J = scale[..., None, None] * _EYE + 2.0 * d_scale[..., None, None] * x[..., :, None] * x[..., None, :]
        return x * scale[..., None], J

    def undistort(self, target: FloatArray) -> FloatArray:
        """See :class:`LensModel`."""
        radius = np.linalg.norm(target, axis=-1)
        theta = np.minimum(radius, _WIDEST)
        for _ in range(_STEPS):
            slope = self._slope(theta)
            step = (radius - self._of_angle(theta)) / np.where(np.abs(slope) < _FLAT, _FLAT, slope)
            theta = np.clip(theta + step, 0.0, _WIDEST)
            if np.all(np.abs(step) < _SHORT):
                break
        near = radius < _FLAT
        return np.asarray(target * np.where(near, 1.0, np.tan(theta) / np.where(near, 1.0, radius))[..., None])

    def radius(self, r: FloatArray) -> FloatArray:
        """See :class:`LensModel`."""
        return self._of_angle(np.arctan(r))

    def _of_angle(self, theta: FloatArray) -> FloatArray:
        """Distorted radius at angles (...) from the axis."""
        k, t2 = self._k, theta * theta
        return np.asarray(theta * (1.0 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3])))))

    def _slope(self, theta: FloatArray) -> FloatArray:
        """Its derivative."""
        k, t2 = self._k, theta * theta
        return np.asarray(1.0 + t2 * (3 * k[0] + t2 * (5 * k[1] + t2 * (7 * k[2] + t2 * 9 * k[3]))))
