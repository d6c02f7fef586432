"""Least squares over the intrinsics of a camera and the pose of a board in every view.

The residuals use the package's own camera model, so the estimate is consistent with its use. Distortion coefficients
have a prior that limits the displacement of the image's corner relative to its distance from the centre. It is too weak
to matter where views reach the corner, and constrains what they do not determine. What is claimed where no view
reaches follows from real lenses instead (:func:`lens_prior`).
"""

from collections.abc import Sequence

import numpy as np

from thermal_fiducial.calibration.lens_parameters import (
    by_parameters,
    camera_parameters,
    lens_prior,
    MATRIX,
    prior_sigmas,
    with_parameters,
)
from thermal_fiducial.calibration.targets import Sighting
from thermal_fiducial.core.geometry import se3
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.types import FloatArray, IntArray

# Huber threshold [standard deviations].
_HUBER = 3.0
_MAX_STEPS = 60
# Relative decrease of the cost at convergence; damping at which the fit gives up.
_CONVERGED, _MOST_DAMPED = 1e-7, 1e9
#: Convergence for fits whose errors are only compared to some per cent.
NEARLY = 1e-4
# Most updates of the circles' centroids, and largest change at convergence [px].
_ROUNDS, _SETTLED_PX = 4, 1e-4
# A polygon with the second moments of the circle, so that perspective displaces both centroids equally.
_ANGLE = np.pi / 6.0
_TURNS = np.arange(12) * _ANGLE
_CIRCLE = np.sqrt(3.0 / (2.0 + np.cos(_ANGLE))) * np.stack([np.cos(_TURNS), np.sin(_TURNS), 0.0 * _TURNS], axis=1)


class LensFit:
    """Levenberg-Marquardt for a camera and its views.

    Parameters
    ----------
    camera : initial values; coefficients that are not ``free`` are held
    radius : of the board's circles [m]; 0 for corners
    free : indices of the coefficients to estimate; None: all
    poses_only : whether the camera is held
    centroids : for each view the offsets (N, 2) of its circles' centroids from their centres [px], held fixed; None:
        computed from the radius
    converged : relative decrease of the cost at convergence
    """

    def __init__(
        self,
        sightings: Sequence[Sighting],
        camera: Camera,
        radius: float,
        free: Sequence[int] | None = None,
        *,
        poses_only: bool = False,
        centroids: Sequence[FloatArray] | None = None,
        converged: float = _CONVERGED,
    ) -> None:
        self._points = np.concatenate([sighting.points for sighting in sightings])
        self._pixels = np.concatenate([sighting.pixels for sighting in sightings])
        self._lengths = [len(sighting.points) for sighting in sightings]
        self._view = np.repeat(np.arange(len(sightings)), self._lengths)
        # Rows of each view's points, padded by repeated rows of zero weight.
        place, ends = np.arange(max(self._lengths)), np.cumsum(self._lengths)[:, None]
        self._there = place < np.array(self._lengths)[:, None]
        self._rows = np.minimum(ends - np.array(self._lengths)[:, None] + place, ends - 1)
        self._camera, self._radius = camera, radius if centroids is None else 0.0
        self._centroid = np.zeros_like(self._pixels) if centroids is None else np.concatenate(centroids)
        self._converged = converged
        coefficients = range(len(camera.D)) if free is None else sorted(free)
        shared = [] if poses_only else [*range(MATRIX), *(MATRIX + index for index in coefficients)]
        self._free: IntArray = np.array(shared, dtype=np.int64)
        sigmas = prior_sigmas(camera)
        self._prior = np.append(np.zeros(MATRIX), sigmas**-2)
        self._lacking = np.zeros(len(sigmas) - len(camera.D))

    def solve(self, T: FloatArray) -> tuple[Camera, FloatArray]:
        """Camera and poses T_camera_board (V, 4, 4), from initial poses."""
        camera = self._camera
        for _ in range(_ROUNDS):
            change = self._update_centroids(camera, T)
            camera, T = self._minimise(camera, T)
            if change < _SETTLED_PX:
                break
        return camera, T

    def covariance(self, camera: Camera, T: FloatArray) -> FloatArray:
        """Covariance of fx fy cx cy, all coefficients, held ones too, and decentring that the model lacks.

        It has two parts: the noise of the residuals, and the change by the step to the solution with all of them free,
        as far as :func:`lens_prior` lets them.
        Held-out views do not show a gain below some per cent; a coefficient of five standard deviations may gain less.
        """
        free, self._free = self._free, np.arange(len(self._prior))
        error = self.error(camera, T)
        information, _ = self._normal_equations(camera, T, error, np.inf, 0.0)
        variance = float(np.sum(error**2)) / max(1, error.size - len(information))
        count = len(self._prior)
        to_prior, known = lens_prior(camera)
        information[MATRIX:count, MATRIX:count] += variance * known
        scale = np.sqrt(np.diag(information)) + 1e-12
        inverse = np.linalg.pinv(information / np.outer(scale, scale), hermitian=True) / np.outer(scale, scale)
        _, gradient = self._normal_equations(camera, T, error, _HUBER * _noise(error), 0.0)
        gradient[MATRIX:count] -= variance * known @ to_prior
        change = (inverse @ gradient)[:count]
        self._free = free
        return np.asarray(variance * inverse[:count, :count] + np.outer(change, change))

    def residuals(self, camera: Camera, T: FloatArray) -> list[FloatArray]:
        """Measured minus predicted (N, 2) [px] of each view."""
        return self._by_view(-self.error(camera, T))

    def centroids(self, camera: Camera, T: FloatArray) -> list[FloatArray]:
        """Offsets (N, 2) [px] of the circles' centroids from their centres, per view."""
        self._update_centroids(camera, T)
        return self._by_view(self._centroid)

    def error(self, camera: Camera, T: FloatArray) -> FloatArray:
        """Predicted minus measured (N, 2) [px]; large where the model cannot project a point."""
        predicted = camera.project(_in_camera(T[self._view], self._points)) + self._centroid
        return np.asarray(np.nan_to_num(predicted - self._pixels, nan=1e3))

    def moved(self, camera: Camera, T: FloatArray, step: FloatArray) -> tuple[Camera, FloatArray]:
        """Camera and poses after a ``step`` (free parameters, then 6 V)."""
        shared = len(self._free)
        if shared:
            parameters = camera_parameters(camera)
            parameters[self._free] += step[:shared]
            camera = with_parameters(camera, parameters)
        turn = step[shared:].reshape(-1, 6)
        return camera, se3.transform(se3.so3_exp(turn[:, 3:]) @ T[:, :3, :3], T[:, :3, 3] + turn[:, :3])

    def jacobian(self, camera: Camera, T: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Of :meth:`error`, by the free parameters (N, 2, I) and by the pose of the point's view (N, 2, 6).

        Circles move like their centres to first order.
        """
        points = _in_camera(T[self._view], self._points)
        _, by_point = camera.project_jacobian(points)
        by_pose = np.concatenate([by_point, -by_point @ se3.skew(points - T[self._view, :3, 3])], axis=-1)
        by_shared = by_parameters(camera, points, self._free)
        return np.nan_to_num(by_shared), np.asarray(np.nan_to_num(by_pose))

    def _minimise(self, camera: Camera, T: FloatArray) -> tuple[Camera, FloatArray]:
        error = self.error(camera, T)
        noise = _noise(error)
        cost, damping = self._cost(camera, error, noise), 1e-3
        for _ in range(_MAX_STEPS):
            information, gradient = self._normal_equations(camera, T, error, _HUBER * noise, noise)
            while damping < _MOST_DAMPED:
                damped = information + damping * np.diag(np.diag(information) + 1e-12)
                moved = self.moved(camera, T, -np.asarray(np.linalg.solve(damped, gradient), dtype=np.float64))
                after = self.error(*moved)
                lower = self._cost(moved[0], after, noise)
                if lower < cost:
                    break
                damping *= 10.0
            else:
                break
            gain, (camera, T), error, damping = (cost - lower) / cost, moved, after, 0.1 * damping
            if gain < self._converged:
                break
            noise = min(noise, _noise(error))
            cost = self._cost(camera, error, noise)
        return camera, T

    def _cost(self, camera: Camera, error: FloatArray, noise: float) -> float:
        """Huber's: quadratic up to three times the ``noise`` [px], linear beyond; and the prior's."""
        size, limit = np.abs(error), _HUBER * noise
        misfit = float(np.sum(np.where(size <= limit, 0.5 * size**2, limit * (size - 0.5 * limit))))
        return misfit + 0.5 * noise**2 * float(self._prior[self._free] @ camera_parameters(camera)[self._free] ** 2)

    def _normal_equations(
        self, camera: Camera, T: FloatArray, error: FloatArray, limit: float, noise: float
    ) -> tuple[FloatArray, FloatArray]:
        weight = np.minimum(1.0, limit / np.maximum(np.abs(error), 1e-12))[self._rows] * self._there[..., None]
        views, shared = len(T), len(self._free)
        J = np.concatenate(self.jacobian(camera, T), axis=2)[self._rows].reshape(views, -1, shared + 6)
        weighted = (J * weight.reshape(views, -1, 1)).swapaxes(1, 2)
        blocks, slopes = weighted @ J, weighted @ error[self._rows].reshape(views, -1, 1)
        information = np.zeros((shared + 6 * views, shared + 6 * views))
        information[:shared, :shared] = blocks[:, :shared, :shared].sum(axis=0)
        information[:shared, shared:] = np.concatenate(blocks[:, :shared, shared:], axis=1)
        information[shared:, :shared] = information[:shared, shared:].T
        of_poses = np.zeros((views, 6, views, 6))
        of_poses[np.arange(views), :, np.arange(views)] = blocks[:, shared:, shared:]
        information[shared:, shared:] = of_poses.reshape(6 * views, 6 * views)
        gradient = np.concatenate([slopes[:, :shared, 0].sum(axis=0), slopes[:, shared:, 0].reshape(-1)])
        prior = noise**2 * self._prior[self._free]
        information[range(shared), range(shared)] += prior
        gradient[:shared] += prior * np.append(camera_parameters(camera), self._lacking)[self._free]
        return information, gradient

    def _update_centroids(self, camera: Camera, T: FloatArray) -> float:
        """Update the centroids' offsets; returns the largest change [px]."""
        if self._radius == 0.0:
            return 0.0
        outline = camera.project(se3.apply(T[self._view], self._points[:, None] + self._radius * _CIRCLE))
        centre = camera.project(_in_camera(T[self._view], self._points))
        before = self._centroid
        self._centroid = np.nan_to_num(_area_centroid(outline) - centre)
        return float(np.abs(self._centroid - before).max())

    def _by_view(self, rows: FloatArray) -> list[FloatArray]:
        """Rows (N, 2) of all points as those of each view."""
        return np.split(rows, np.cumsum(self._lengths)[:-1])


def _noise(error: FloatArray) -> float:
    """Standard deviation of a coordinate, from the median; at least a hundredth of a pixel."""
    return max(1.4826 * float(np.median(np.abs(error))), 0.01)


def _in_camera(T: FloatArray, points: FloatArray) -> FloatArray:
    return np.asarray(np.einsum('nij,nj->ni', T[:, :3, :3], points) + T[:, :3, 3])


def _area_centroid(outline: FloatArray) -> FloatArray:
    """Centroid (N, 2) of the areas that closed polygons (N, M, 2) enclose: what the moments of a disc measure."""
    middle = outline.mean(axis=1, keepdims=True)
    a = outline - middle
    b = np.roll(a, -1, axis=1)
    cross = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    centroid = np.sum((a + b) * cross[..., None], axis=1) / (3.0 * np.sum(cross, axis=1)[:, None])
    return np.asarray(middle[:, 0] + centroid)
