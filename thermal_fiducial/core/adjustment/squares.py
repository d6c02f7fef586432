"""What is known of a marker's outline beforehand: that it is a square.

A square's view has 6 unknowns, its four corners 8 numbers. The homography ``(h1 h2 h3)`` from it to normalised image
coordinates has ``h1 . h2 = 0`` and ``|h1| = |h2|`` (Z. Zhang, "A flexible new technique for camera calibration", 2000,
eq. 3 and 4), whatever its size.
"""

from typing import NamedTuple

import numpy as np

from thermal_fiducial.core.types import FloatArray

#: Standard deviation of what markers, flat and cut to size, and calibrations of lenses make of that.
SQUARE_STD = 0.003
_STEP = 1e-6


class Squareness(NamedTuple):
    """How far N outlines are from those of squares, and the derivative of that by their corners."""

    #: (N, 2) cosine of the angle, and difference of the sides over their length
    value: FloatArray
    #: (N, 2, 8) [1/px]
    derivative: FloatArray


def squareness(x: FloatArray, inverse: FloatArray) -> Squareness:
    """Of corners (N, 4, 2) in normalised coordinates, with the derivatives (N, 4, 2, 2) of these by pixels."""
    size = np.sqrt(np.abs(_twice_area(x)))
    steps = _STEP * np.eye(8).reshape(8, 4, 2)
    values = _shear(x[:, None] + size[:, None, None, None] * np.concatenate([np.zeros((1, 4, 2)), steps]))
    by_x = (values[:, 1:] - values[:, :1]) / (_STEP * size)[:, None, None]
    by_corner = np.swapaxes(by_x.reshape(-1, 4, 2, 2), -1, -2) @ inverse
    return Squareness(values[:, 0], np.moveaxis(by_corner, 2, 1).reshape(-1, 2, 8))


def _twice_area(x: FloatArray) -> FloatArray:
    """Of quadrilaterals (..., 4, 2)."""
    a, b = x[..., 2, :] - x[..., 0, :], x[..., 3, :] - x[..., 1, :]
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


def _shear(x: FloatArray) -> FloatArray:
    """The two conditions (..., 2) on the homography from a square to (..., 4, 2) (P. Heckbert, 1989, for that)."""
    p, q, r, s = (x[..., k, :] for k in range(4))
    sums, to_q, to_s = p - q + r - s, q - r, s - r
    determinant = to_q[..., 0] * to_s[..., 1] - to_s[..., 0] * to_q[..., 1]
    g = (sums[..., 0] * to_s[..., 1] - to_s[..., 0] * sums[..., 1]) / determinant
    h = (to_q[..., 0] * sums[..., 1] - sums[..., 0] * to_q[..., 1]) / determinant
    a, b = q - p + g[..., None] * q, s - p + h[..., None] * s
    product = np.sum(a * b, axis=-1) + g * h
    first, second = np.sum(a * a, axis=-1) + g * g, np.sum(b * b, axis=-1) + h * h
    return np.asarray(np.stack([2.0 * product, first - second], axis=-1) / (first + second)[..., None])
