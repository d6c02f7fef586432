"""Distortion by lenses, in normalised image coordinates: the polynomials and the equidistant model of ``camera``."""

from typing import NamedTuple

import numpy as np

from thermal_fiducial.core.types import FloatArray

#: Newton's iteration doubles the digits: after a step this small nothing is left, and ten are enough at any lens's
#: border.
NEWTON_STEPS, NEWTON_STEP = 10, 1e-6
_EYE = np.eye(2)
# Widest angle from the axis for which x/z is of use [rad].
_WIDEST = 1.5


class Polynomial(NamedTuple):
    """Distortion of plumb_bob, and of rational_polynomial where there is a denominator."""

    #: k1 k2 k3
    k: tuple[float, ...]
    #: k4 k5 k6, or nothing
    denominator: tuple[float, ...]
    p1: float
    p2: float


def radial_factor(r2: FloatArray, model: Polynomial) -> FloatArray:
    """Factor by which points at a squared distance from the axis are moved outwards."""
    k1, k2, k3 = model.k
    top = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    if not model.denominator:
        return top
    k4, k5, k6 = model.denominator
    return np.asarray(top / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6))))


def _radial_slope(r2: FloatArray, factor: FloatArray, model: Polynomial) -> FloatArray:
    """Derivative of the ``factor`` with respect to the squared distance."""
    k1, k2, k3 = model.k
    d_top = k1 + r2 * (2.0 * k2 + 3.0 * k3 * r2)
    if not model.denominator:
        return d_top
    k4, k5, k6 = model.denominator
    d_bottom = k4 + r2 * (2.0 * k5 + 3.0 * k6 * r2)
    return np.asarray((d_top - factor * d_bottom) / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6))))


def radial_terms(x: FloatArray, model: Polynomial) -> tuple[FloatArray, FloatArray]:
    """Squared distances (...) from the axis, and their :func:`radial_factor`."""
    r2 = np.einsum('...k,...k->...', x, x)
    return r2, radial_factor(r2, model)


def distort_polynomial(x: FloatArray, r2: FloatArray, factor: FloatArray, model: Polynomial) -> FloatArray:
    """Distorted normalised coordinates (..., 2), with what :func:`radial_terms` gives."""
    if not (model.p1 or model.p2):
        return np.asarray(x * factor[..., None])
    # The tangential part is p r^2 + 2 (p . x) x with p = (p2, p1).
    p1, p2 = model.p1, model.p2
    distorted = np.empty_like(x)
    a, b = x[..., 0], x[..., 1]
    factor = factor + (2.0 * p2) * a + (2.0 * p1) * b
    distorted[..., 0], distorted[..., 1] = a * factor + p2 * r2, b * factor + p1 * r2
    return distorted


def polynomial_derivative(x: FloatArray, r2: FloatArray, factor: FloatArray, model: Polynomial) -> FloatArray:
    """Derivative (..., 2, 2) of :func:`distort_polynomial`."""
    p1, p2 = model.p1, model.p2
    a, b = x[..., 0], x[..., 1]
    slope = 2.0 * _radial_slope(r2, factor, model)
    J = np.empty((*x.shape[:-1], 2, 2))
    J[..., 0, 0] = factor + a * (a * slope + 6.0 * p2) + 2.0 * p1 * b
    J[..., 0, 1] = J[..., 1, 0] = a * (b * slope + 2.0 * p1) + 2.0 * p2 * b
    J[..., 1, 1] = factor + b * (b * slope + 6.0 * p1) + 2.0 * p2 * a
    return J


def equidistant_radius(theta: FloatArray, k: FloatArray) -> FloatArray:
    """Distorted radius at angles ``theta`` from the axis."""
    t2 = theta * theta
    return np.asarray(theta * (1.0 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3])))))


def _equidistant_slope(theta: FloatArray, k: FloatArray) -> FloatArray:
    """Its derivative."""
    t2 = theta * theta
    return np.asarray(1.0 + t2 * (3 * k[0] + t2 * (5 * k[1] + t2 * (7 * k[2] + t2 * 9 * k[3]))))


def undistort_equidistant(target: FloatArray, k: FloatArray) -> FloatArray:
    """Normalised coordinates (..., 2) of distorted ones."""
    radius = np.linalg.norm(target, axis=-1)
    theta = np.minimum(radius, _WIDEST)
    for _ in range(NEWTON_STEPS):
        slope = _equidistant_slope(theta, k)
        step = (radius - equidistant_radius(theta, k)) / np.where(np.abs(slope) < 1e-9, 1e-9, slope)
        theta = np.clip(theta + step, 0.0, _WIDEST)
        if np.all(np.abs(step) < NEWTON_STEP):
            break
    near = radius < 1e-9
    return np.asarray(target * np.where(near, 1.0, np.tan(theta) / np.where(near, 1.0, radius))[..., None])


def distort_equidistant(x: FloatArray, k: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Distorted normalised coordinates (..., 2), and their derivative (..., 2, 2)."""
    r2 = (x * x).sum(axis=-1)
    r = np.sqrt(r2)
    theta = np.arctan(r)
    theta_d, d_theta_d = equidistant_radius(theta, k), _equidistant_slope(theta, k)
    near = r < 1e-6
    safe = np.where(near, 1.0, r)
    scale = np.where(near, 1.0, theta_d / safe)
    # d(scale)/d(r^2): theta_d / r to second order at the axis is 1 + (k1 - 1/3) r^2.
    d_scale = np.where(near, k[0] - 1 / 3, (d_theta_d / (1.0 + r2) - scale) / (2.0 * safe * safe))
    J = scale[..., None, None] * _EYE + 2.0 * d_scale[..., None, None] * x[..., :, None] * x[..., None, :]
    return x * scale[..., None], J
