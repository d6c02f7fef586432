"""The constraint that a marker's outline is a square: two pseudo-measurements for its four corners.

A view of a square has 6 unknowns, its four corners have 8 coordinates. The homography ``(h1 h2 h3)`` from a square of
any size to normalised image coordinates has ``h1 . h2 = 0`` and ``|h1| = |h2|`` (Z. Zhang, "A flexible new technique
for camera calibration", 2000, eq. 3 and 4). With corners ``p q r s``, third coordinate 1, and ``[p q r]`` for
determinants, Cramer's rule gives ``h3 = [q r s] p``, ``h1 + h3 = [p r s] q``, ``h2 + h3 = [p q r] s``.
"""

from typing import NamedTuple

import numpy as np

from thermal_fiducial.core.geometry.camera import ImagePoints, inverse_2x2
from thermal_fiducial.core.types import FloatArray

# Standard deviation of the two constraints, by the cut of markers and by lens calibrations.
_SQUARE_STD = 0.003
# Linearisation error of the constraints as a share of their values.
_BENT = 0.1
# The constraints are nonlinear: largest number of linearisations, and the step below which they are not repeated [px].
_STEPS, _BENDS_PX = 3, 0.05
# Squared Mahalanobis distances (2 d.o.f.): beyond which a square of the second planar pose is tried, and beyond which
# an outline is inconsistent with any square.
_OTHER_TILT, _TOO_FAR = 9.0, 12.0
_EYE, _MIRRORED = np.eye(2), np.array([[1.0], [-1.0]])


def _quadratic_forms() -> FloatArray:
    """Matrices (8, 4 * 8) whose quadratic forms of the corners (8,) are the determinants without each corner, twice."""
    forms = np.zeros((8, 4, 8))
    for left_out in range(4):
        a, b, c = (2 * corner for corner in range(4) if corner != left_out)
        for k, m in ((a, b), (b, c), (c, a)):
            forms[k, left_out, m + 1] = forms[m + 1, left_out, k] = 1.0
            forms[k + 1, left_out, m] = forms[m, left_out, k + 1] = -1.0
    return forms.reshape(8, 32)


def _own_corners() -> FloatArray:
    """Derivative (4, 2 * 3 * 8) of h1 and h2 by the corners, for each determinant of 1, held fast."""
    by_corner = np.zeros((4, 2, 3, 8))
    for axis in range(2):
        by_corner[0, :, axis, axis] = -1.0
        by_corner[1, 0, axis, 2 + axis] = by_corner[3, 1, axis, 6 + axis] = 1.0
    return by_corner.reshape(4, 48)


_FORMS, _OWN = _quadratic_forms(), _own_corners()


class Squareness(NamedTuple):
    """The two constraints of N outlines, 0 for squares, and their derivatives by the corners."""

    #: (N, 2, 1) cosine of the angle, and difference of the sides over their length
    value: FloatArray
    #: (N, 2, 8) [1/px]
    derivative: FloatArray


class Squared(NamedTuple):
    """Corners of N markers after the constraints."""

    #: (N, 8, 1) displacements of the corners, and their covariances (N, 8, 8) [px]
    moved: FloatArray
    covariance: FloatArray
    #: (N,) squared Mahalanobis distance from the nearest square
    chi2: FloatArray
    #: (N,) squared residual of the constraints where the outline is inconsistent with a square, else 0
    doubt: FloatArray
    #: (N,) number of the two degrees of freedom that the constraints determine rather than the image
    constrained: FloatArray


def as_squares(at: ImagePoints, seen: FloatArray, covariance: FloatArray) -> Squared:
    """Displacements of corners with the constraint of a square.

    Two planar poses of a small square look almost alike. The one nearer to the initial corners, translated, is taken
    unless the image rules it out.

    Parameters
    ----------
    at : (N, 4) initial corners
    seen, covariance : (N, 8, 1), (N, 8, 8) measured displacements of the corners [px]
    """
    together = np.empty((len(seen), 4, 2))
    together[:] = seen.reshape(-1, 4, 2).mean(axis=1, keepdims=True)
    nearest = _corrected(at, together.reshape(-1, 8, 1), seen, covariance)
    refuted = np.flatnonzero(nearest.chi2 > _OTHER_TILT)
    if len(refuted):
        other = _corrected(at.only(refuted), seen[refuted], seen[refuted], covariance[refuted])
        better = other.chi2 < nearest.chi2[refuted]
        for mine, its in zip(nearest, other, strict=True):
            mine[refuted[better]] = its[better]
    return nearest


def _corrected(at: ImagePoints, moved: FloatArray, seen: FloatArray, covariance: FloatArray) -> Squared:
    """Update of an iterated Kalman filter, linearised first at the displacements ``moved`` (N, 8, 1)."""
    for _ in range(_STEPS):
        value, J = squareness(at.x + (at.inverse @ moved.reshape(-1, 4, 2, 1))[..., 0], at.inverse)
        error = value + J @ (seen - moved)
        spread = covariance @ J.swapaxes(1, 2)
        variance = _SQUARE_STD**2 + (_BENT * value) ** 2
        information = inverse_2x2(J @ spread + variance * _EYE)
        weighted = information @ error
        before, moved = moved, seen - spread @ weighted
        if np.abs(moved - before).max() < _BENDS_PX:
            break
    chi2, left = (error * weighted).sum(axis=(1, 2)), ((variance * weighted) ** 2).sum(axis=(1, 2))
    constrained = 2.0 - (variance * information * _EYE).sum(axis=(1, 2))
    doubt = np.where(chi2 > _TOO_FAR, left, 0.0)
    return Squared(moved, covariance - spread @ information @ spread.swapaxes(1, 2), chi2, doubt, constrained)


def squareness(x: FloatArray, inverse: FloatArray) -> Squareness:
    """Constraints of corners (N, 4, 2) in normalised coordinates, which have derivatives (N, 4, 2, 2) by pixels."""
    count, flat = len(x), x.reshape(-1, 8, 1)
    by_corner = (flat[..., 0] @ _FORMS).reshape(count, 4, 8)
    determinant = 0.5 * (by_corner @ flat)
    corner = np.ones((count, 4, 3))
    corner[..., :2] = x
    weighted, by_determinant = determinant * corner, corner[..., None] * by_corner[:, :, None]
    h = weighted[:, 1::2] - weighted[:, :1]
    d_h = (by_determinant[:, 1::2] - by_determinant[:, :1]).reshape(count, 6, 8)
    d_h += (determinant[..., 0] @ _OWN).reshape(count, 6, 8)
    # Twice the product and the difference of the squares are those of h with itself, swapped or mirrored.
    turned = np.empty((count, 2, 2, 3))
    turned[:, 0], turned[:, 1] = h[:, ::-1], _MIRRORED * h
    both, by_both = h.reshape(count, 6, 1), turned.reshape(count, 2, 6)
    length = (both * both).sum(axis=1, keepdims=True)
    value = (by_both @ both) / length
    derivative = (by_both - value * both.reshape(count, 1, 6)) @ d_h * (2.0 / length)
    by_pixel = derivative.reshape(count, 2, 4, 1, 2) @ inverse[:, None]
    return Squareness(value, by_pixel.reshape(count, 2, 8))
