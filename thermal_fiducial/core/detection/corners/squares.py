"""What is known of a marker's outline beforehand: that it is a square.

A square's view has 6 unknowns, its four corners 8 numbers. The homography ``(h1 h2 h3)`` from it to normalised image
coordinates has ``h1 . h2 = 0`` and ``|h1| = |h2|`` (Z. Zhang, "A flexible new technique for camera calibration", 2000,
eq. 3 and 4), whatever its size. With corners ``p q r s``, third coordinate 1, and ``[p q r]`` for determinants,
Cramer's rule gives it: ``h3 = [q r s] p``, ``h1 + h3 = [p r s] q``, ``h2 + h3 = [p q r] s``.
"""

from typing import NamedTuple

import numpy as np

from thermal_fiducial.core.geometry.camera import ImagePoints, inverse_2x2
from thermal_fiducial.core.types import FloatArray

# Standard deviation of what markers, flat and cut to size, and calibrations of lenses make of that.
_SQUARE_STD = 0.003
# Standard deviation of the linear form of an outline that is far from a square, as a share of how far it is.
_BENT = 0.1
# Perspective comes into it squared: it is taken again where the corners are by then, if these are so far away [px].
_STEPS, _BENDS_PX = 3, 0.05
# Squared Mahalanobis distances, of two degrees of freedom, from a square near the last corners beyond which one of the
# other tilt may be nearer, and from any beyond which an outline is not that of the marker alone.
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
    """How far N outlines are from those of squares, and the derivative of that by their corners."""

    #: (N, 2, 1) cosine of the angle, and difference of the sides over their length
    value: FloatArray
    #: (N, 2, 8) [1/px]
    derivative: FloatArray


class Squared(NamedTuple):
    """Corners of N markers by what is known of squares."""

    #: (N, 8, 1) how far they are off, and its covariance (N, 8, 8) [px]
    moved: FloatArray
    covariance: FloatArray
    #: (N,) squared Mahalanobis distance from the nearest square
    chi2: FloatArray
    #: (N,) squares of the errors of shapes that are none of squares, zero of the others
    doubt: FloatArray
    #: (N,) how many of the two conditions, rather than the image, constrain the corners
    constrained: FloatArray


def as_squares(at: ImagePoints, seen: FloatArray, covariance: FloatArray) -> Squared:
    """Corners corrected by what is known of squares.

    Two tilts of a small square look almost alike. That of the corners so far, which are seen to have moved together
    first of all, is taken unless the image refutes it.

    Parameters
    ----------
    at : (N, 4) corners
    seen, covariance : (N, 8, 1), (N, 8, 8) how far they are off, as the image shows [px]
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
    """Update of an iterated Kalman filter, its derivatives at first where corners have ``moved`` (N, 8, 1) to."""
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
    """Of corners (N, 4, 2) in normalised coordinates, with the derivatives (N, 4, 2, 2) of these by pixels."""
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
