"""The simulator's own lens: it shares nothing with the camera models that it tests.

Sources: OpenCV's documentation of ``calib3d`` (pinhole with radial, rational and tangential terms) and of
``fisheye`` (equidistant).
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from thermal_fiducial.core.types import FloatArray
from thermal_fiducial.errors import InputError

COEFFICIENTS = {'plumb_bob': 5, 'rational_polynomial': 8, 'equidistant': 4}

# Steps of Newton's method with a numerical Jacobian at most: four leave 1e-11 px at the border of the worst lens. What
# is left in units of the focal length once another step would not help: ten times the rounding of the lens's terms.
_STEPS = 6
_CONVERGED = 1e-14
_DIFFERENCE = 1e-6


@dataclass(frozen=True)
class Lens:
    """Intrinsics of the simulated camera.

    Parameters
    ----------
    focal : fx, fy [px]
    centre : cx, cy [px], the centre of the top-left pixel is (0, 0)
    model : plumb_bob, rational_polynomial or equidistant
    distortion : coefficients in the order of camera_info
    width, height : [px]
    """

    focal: tuple[float, float]
    centre: tuple[float, float]
    model: str = 'plumb_bob'
    distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)
    width: int = 640
    height: int = 512

    def __post_init__(self) -> None:
        if self.model not in COEFFICIENTS:
            raise InputError(f'lens model {self.model!r} is not one of {", ".join(COEFFICIENTS)}')
        if len(self.distortion) != COEFFICIENTS[self.model]:
            raise InputError(f'{self.model} takes {COEFFICIENTS[self.model]} coefficients, not {len(self.distortion)}')

    @property
    def matrix(self) -> FloatArray:
        """Camera matrix (3, 3) [px]."""
        return np.array([[self.focal[0], 0, self.centre[0]], [0, self.focal[1], self.centre[1]], [0, 0, 1.0]])

    def project(self, points_camera: npt.ArrayLike) -> FloatArray:
        """Pixels (..., 2) of points (..., 3) in front of the camera [m]."""
        points = np.asarray(points_camera, dtype=np.float64)
        return self.project_slopes(points[..., :2] / points[..., 2:])

    def project_slopes(self, slopes: npt.ArrayLike) -> FloatArray:
        """Pixels (..., 2) of the rays (x/z, y/z) (..., 2)."""
        return np.asarray(self._bend(np.asarray(slopes, dtype=np.float64)) * self.focal + self.centre)

    def slopes(self, pixels: npt.ArrayLike) -> FloatArray:
        """Rays (x/z, y/z) (..., 2) of pixels (..., 2), by Newton's method."""
        target = (np.asarray(pixels, dtype=np.float64) - self.centre) / self.focal
        x = self._start(target)
        for _ in range(_STEPS):
            residual = self._bend(x) - target
            if np.abs(residual).max(initial=0.0) < _CONVERGED:
                break
            x = x - np.sum(_inverse(_derivative(self._bend, x)) * residual[..., None, :], axis=-1)
        return x

    def slopes_jacobian(self, slopes: npt.ArrayLike) -> FloatArray:
        """Derivative (..., 2, 2) of the rays by their pixels [1/px]."""
        return _inverse(_derivative(self.project_slopes, np.asarray(slopes, dtype=np.float64)))

    def _start(self, target: FloatArray) -> FloatArray:
        if self.model != 'equidistant':
            return target
        theta = np.minimum(np.linalg.norm(target, axis=-1, keepdims=True), 1.4)
        return np.asarray(target * np.tan(theta) / np.maximum(theta, 1e-9))

    def _bend(self, slopes: FloatArray) -> FloatArray:
        return _equidistant(slopes, self.distortion) if self.model == 'equidistant' else _brown(slopes, self.distortion)


def _derivative(function: Callable[[FloatArray], FloatArray], x: FloatArray) -> FloatArray:
    steps = np.eye(2) * _DIFFERENCE
    columns = [(function(x + d) - function(x - d)) / (2 * _DIFFERENCE) for d in steps]
    return np.stack(columns, axis=-1)


def _inverse(J: FloatArray) -> FloatArray:
    """Inverse of matrices (..., 2, 2)."""
    a, b, c, d = J[..., 0, 0], J[..., 0, 1], J[..., 1, 0], J[..., 1, 1]
    adjugate = np.stack([np.stack([d, -b], axis=-1), np.stack([-c, a], axis=-1)], axis=-2)
    return np.asarray(adjugate / (a * d - b * c)[..., None, None])


def _brown(slopes: FloatArray, distortion: tuple[float, ...]) -> FloatArray:
    k1, k2, p1, p2, k3, k4, k5, k6 = (*distortion, 0.0, 0.0, 0.0)[:8]
    x, y = slopes[..., 0], slopes[..., 1]
    r2 = x * x + y * y
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    return np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        ],
        axis=-1,
    )


def _equidistant(slopes: FloatArray, distortion: tuple[float, ...]) -> FloatArray:
    k1, k2, k3, k4 = distortion
    r = np.linalg.norm(slopes, axis=-1, keepdims=True)
    theta = np.arctan(r)
    t2 = theta * theta
    theta_d = theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
    return np.asarray(slopes * np.where(r < 1e-9, 1.0, theta_d / np.maximum(r, 1e-9)))
