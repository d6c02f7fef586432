"""Intrinsics from sightings of a board: least squares on the re-projection error, with everything that goes with it.

The residuals come from the package's own camera model, so what is estimated is what is used. Z. Zhang, "A flexible
new technique for camera calibration", 2000, is where the problem's shape comes from; OpenCV only starts it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from thermal_fiducial.calibration.targets import Sighting
from thermal_fiducial.core.geometry import se3
from thermal_fiducial.core.geometry.camera import Camera, MODELS
from thermal_fiducial.core.types import FloatArray, IntArray
from thermal_fiducial.errors import InputError

#: Models from the fewest parameters to the most: a tie goes to the simpler one.
CANDIDATES = ('equidistant', 'plumb_bob', 'rational_polynomial')

# With all but one of them a camera can still be fitted.
_LEAST_VIEWS = 6
_FOLDS = 4
# A view whose rms is this many times the median view's was moving, half hidden or wrongly numbered.
_OUTLIER_RATIO = 2.5
# A model must beat a simpler one by this share of the held-out error to be chosen.
_BETTER = 0.01
# Errors beyond this many standard deviations [px after scaling] lose weight (Huber).
_HUBER = 3.0
# Step of the numerical derivative by the distortion coefficients, which are of order 0.01 to 1.
_STEP = 1e-6
_MAX_STEPS = 60
# A step that lowers the cost by less than this share is the last; damping at which no step lowers it any more.
_CONVERGED, _HOPELESS = 1e-7, 1e9
_CIRCLE = np.stack([np.cos(np.arange(24) * np.pi / 12), np.sin(np.arange(24) * np.pi / 12), np.zeros(24)], axis=1)


@dataclass(frozen=True)
class Calibration:
    """Result of a calibration.

    Parameters
    ----------
    camera : with the estimated intrinsics
    covariance : (4 + D, 4 + D) of fx fy cx cy and the distortion coefficients
    T_camera_board : (V, 4, 4)
    residuals : V arrays (N, 2) measured minus predicted [px]
    views : (V,) indices of the sightings that were used
    dropped : indices of those that were left out as outliers
    held_out_px : rms error of views that the fit had not seen
    """

    camera: Camera
    covariance: FloatArray
    T_camera_board: FloatArray
    residuals: list[FloatArray]
    views: IntArray
    dropped: list[int]
    held_out_px: float = np.nan

    @property
    def rms_px(self) -> float:
        """Over all points, of the length of the 2-vector."""
        every = np.concatenate(self.residuals)
        return float(np.sqrt(np.mean(np.sum(every**2, axis=1))))

    @property
    def sigmas(self) -> FloatArray:
        """Standard deviations of fx fy cx cy and the distortion coefficients."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


def calibrate(
    sightings: Sequence[Sighting], width: int, height: int, model: str, *, radius: float = 0.0, focal_px: float = 600.0
) -> Calibration:
    """Fit one model; views that fit far worse than the others are dropped and the rest fitted again.

    Parameters
    ----------
    radius : of the board's circles [m]; their observed centroids are compared with centroids, not with centres
    focal_px : rough focal length to start from [px]

    Raises
    ------
    InputError
        Too few views, or views from which no camera follows.
    """
    if len(sightings) < _LEAST_VIEWS:
        raise InputError(f'{len(sightings)} views of the board: a calibration needs {_LEAST_VIEWS} or more')
    camera = _start(sightings, width, height, model, focal_px)
    used = np.arange(len(sightings))
    T = np.stack([board_pose(sighting, camera) for sighting in sightings])
    while True:
        fit = _Fit([sightings[index] for index in used.tolist()], camera, radius)
        camera, T, covariance = fit.solve(T)
        residuals = fit.residuals(camera, T)
        rms = np.array([np.sqrt(np.mean(residual**2)) for residual in residuals])
        keep = rms <= _OUTLIER_RATIO * np.median(rms)
        if np.all(keep) or np.sum(keep) < _LEAST_VIEWS:
            break
        used, T = used[keep], T[keep]
    dropped = sorted(set(range(len(sightings))) - set(used.tolist()))
    return Calibration(camera, covariance, T, residuals, used, dropped)


def choose_model(
    sightings: Sequence[Sighting],
    width: int,
    height: int,
    models: Sequence[str] = CANDIDATES,
    *,
    radius: float = 0.0,
    focal_px: float = 600.0,
) -> tuple[Calibration, dict[str, float]]:
    """The calibration whose model predicts views best that it was not fitted to, and every model's held-out error."""
    fits: dict[str, Calibration] = {}
    for model in models:
        fit = calibrate(sightings, width, height, model, radius=radius, focal_px=focal_px)
        used = [sightings[index] for index in fit.views.tolist()]
        error = _held_out_error(used, fit.camera, radius)
        fits[model] = Calibration(
            fit.camera, fit.covariance, fit.T_camera_board, fit.residuals, fit.views, fit.dropped, error
        )
    errors = {model: fit.held_out_px for model, fit in fits.items()}
    # Compared on equal terms: a model that drops more views must not win by that.
    most = max(len(fit.views) for fit in fits.values())
    fair = [model for model in CANDIDATES if model in fits and len(fits[model].views) >= most - max(1, most // 10)]
    best = min(fair, key=errors.__getitem__)
    simplest = next(model for model in fair if errors[model] <= (1.0 + _BETTER) * errors[best])
    return fits[simplest], errors


def _held_out_error(sightings: Sequence[Sighting], camera: Camera, radius: float) -> float:
    """Rms [px] of views whose pose alone was fitted, with intrinsics from the other folds."""
    squares, count = 0.0, 0
    # Few views: all but one at a time.
    folds = _FOLDS if len(sightings) >= _FOLDS * (_LEAST_VIEWS - 1) else len(sightings)
    for fold in range(folds):
        training = [sighting for index, sighting in enumerate(sightings) if index % folds != fold]
        held_out = list(sightings[fold::folds])
        fit = _Fit(training, camera, radius)
        trained, _, _ = fit.solve(np.stack([board_pose(sighting, camera) for sighting in training]))
        unseen = _Fit(held_out, trained, radius, poses_only=True)
        _, T, _ = unseen.solve(np.stack([board_pose(sighting, trained) for sighting in held_out]))
        every = np.concatenate(unseen.residuals(trained, T))
        squares, count = squares + float(np.sum(every**2)), count + len(every)
    return float(np.sqrt(squares / count))


def board_pose(sighting: Sighting, camera: Camera) -> FloatArray:
    """T_camera_board (4, 4) by OpenCV on undistorted points."""
    normalised = camera.normalise(sighting.pixels)
    found, rotation, translation = cv2.solvePnP(
        sighting.points, normalised, np.eye(3), np.zeros(5), flags=cv2.SOLVEPNP_ITERATIVE
    )
    if not found or not translation[2, 0] > 0.0:
        raise InputError('a view from which no pose of the board follows')
    return se3.transform(se3.so3_exp(rotation.reshape(3)), translation.reshape(3))


def _start(sightings: Sequence[Sighting], width: int, height: int, model: str, focal_px: float) -> Camera:
    """Focal length by OpenCV without distortion; the least squares find the rest from there."""
    K = np.array([[focal_px, 0.0, 0.5 * (width - 1)], [0.0, focal_px, 0.5 * (height - 1)], [0.0, 0.0, 1.0]])
    flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_PRINCIPAL_POINT | cv2.CALIB_FIX_ASPECT_RATIO
    flags |= cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3
    points = [sighting.points.astype(np.float32) for sighting in sightings]
    pixels = [sighting.pixels.astype(np.float32) for sighting in sightings]
    try:
        _, K, _, _, _ = cv2.calibrateCamera(points, pixels, (width, height), K, np.zeros(5), flags=flags)
    except cv2.error as error:
        raise InputError(f'views from which no camera follows: {error.err}') from None
    if not 0.1 * width < K[0, 0] < 20.0 * width:
        K[0, 0] = K[1, 1] = focal_px
    return Camera(width, height, np.asarray(K, dtype=np.float64), model)


class _Fit:
    """Least squares over the intrinsics and the pose of the board in every view."""

    def __init__(
        self, sightings: Sequence[Sighting], camera: Camera, radius: float, *, poses_only: bool = False
    ) -> None:
        self._points = np.concatenate([sighting.points for sighting in sightings])
        self._pixels = np.concatenate([sighting.pixels for sighting in sightings])
        self._lengths = [len(sighting.points) for sighting in sightings]
        self._view = np.repeat(np.arange(len(sightings)), self._lengths)
        self._camera, self._radius, self._poses_only = camera, radius, poses_only
        self._intrinsics = 0 if poses_only else 4 + MODELS[camera.model]

    def solve(self, T: FloatArray) -> tuple[Camera, FloatArray, FloatArray]:
        """Camera, poses (V, 4, 4) and covariance of the intrinsics, from poses to start with (Levenberg-Marquardt)."""
        camera, limit = self._camera, _HUBER * self._noise(self._camera, T)
        cost, damping = self._cost(camera, T, limit), 1e-3
        for _ in range(_MAX_STEPS):
            information, gradient = self._normal_equations(camera, T, limit)
            while damping < _HOPELESS:
                damped = information + damping * np.diag(np.diag(information) + 1e-12)
                moved = self._moved(camera, T, -np.asarray(np.linalg.solve(damped, gradient), dtype=np.float64))
                lower = self._cost(*moved, limit)
                if lower < cost:
                    break
                damping *= 10.0
            else:
                break
            gain, (camera, T), cost, damping = (cost - lower) / cost, moved, lower, 0.1 * damping
            if gain < _CONVERGED:
                break
            limit = min(limit, _HUBER * self._noise(camera, T))
            cost = self._cost(camera, T, limit)
        return camera, T, self._covariance(camera, T)

    def _cost(self, camera: Camera, T: FloatArray, limit: float) -> float:
        """Huber's: quadratic up to ``limit`` [px], linear beyond."""
        size = np.abs(self._error(camera, T))
        return float(np.sum(np.where(size <= limit, 0.5 * size**2, limit * (size - 0.5 * limit))))

    def _normal_equations(self, camera: Camera, T: FloatArray, limit: float) -> tuple[FloatArray, FloatArray]:
        error = self._error(camera, T)
        weight = np.minimum(1.0, limit / np.maximum(np.abs(error), 1e-12))
        by_intrinsics, by_pose = self._jacobian(camera, T)
        shared = self._intrinsics
        information = np.zeros((shared + 6 * len(T), shared + 6 * len(T)))
        gradient = np.zeros(len(information))
        ends = np.cumsum(self._lengths)
        for view, (start, end) in enumerate(zip(ends - self._lengths, ends, strict=True)):
            J = np.concatenate([by_intrinsics[start:end], by_pose[start:end]], axis=2).reshape(-1, shared + 6)
            w = weight[start:end].reshape(-1)
            columns = np.concatenate([np.arange(shared), shared + 6 * view + np.arange(6)])
            information[np.ix_(columns, columns)] += (J * w[:, None]).T @ J
            gradient[columns] += J.T @ (w * error[start:end].reshape(-1))
        return information, gradient

    def residuals(self, camera: Camera, T: FloatArray) -> list[FloatArray]:
        """Measured minus predicted (N, 2) [px] of each view."""
        return np.split(-self._error(camera, T), np.cumsum(self._lengths)[:-1])

    def _moved(self, camera: Camera, T: FloatArray, step: FloatArray) -> tuple[Camera, FloatArray]:
        if not self._poses_only:
            camera = _camera(camera, _parameters(camera) + step[: self._intrinsics])
        turn = step[self._intrinsics :].reshape(-1, 6)
        return camera, se3.transform(se3.so3_exp(turn[:, 3:]) @ T[:, :3, :3], T[:, :3, 3] + turn[:, :3])

    def _noise(self, camera: Camera, T: FloatArray) -> float:
        """Standard deviation of a coordinate, from the median; at least a hundredth of a pixel."""
        return max(1.4826 * float(np.median(np.abs(self._error(camera, T)))), 0.01)

    def _error(self, camera: Camera, T: FloatArray) -> FloatArray:
        """Predicted minus measured (N, 2) [px]; large where the model cannot show a point."""
        return np.asarray(np.nan_to_num(self._predicted(camera, T) - self._pixels, nan=1e3))

    def _predicted(self, camera: Camera, T: FloatArray) -> FloatArray:
        if self._radius == 0.0:
            return camera.project(_seen_from(T[self._view], self._points))
        rims = self._points[:, None] + self._radius * _CIRCLE
        return _area_centroid(camera.project(se3.apply(T[self._view], rims)))

    def _jacobian(self, camera: Camera, T: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Of :meth:`_error`, by the intrinsics (N, 2, I) and by the pose of the point's view (N, 2, 6).

        Circles move like their centres to first order.
        """
        seen = _seen_from(T[self._view], self._points)
        uv, by_point = camera.project_jacobian(seen)
        by_pose = np.concatenate([by_point, -by_point @ se3.skew(seen - T[self._view, :3, 3])], axis=-1)
        by_intrinsics = np.zeros((len(seen), 2, self._intrinsics))
        if not self._poses_only:
            by_intrinsics[:, :, :4] = _by_matrix(camera, uv)
            parameters = _parameters(camera)
            for index in range(4, self._intrinsics):
                step = np.zeros(self._intrinsics)
                step[index] = _STEP
                ahead, behind = (_camera(camera, parameters + sign * step).project(seen) for sign in (1.0, -1.0))
                by_intrinsics[:, :, index] = (ahead - behind) / (2.0 * _STEP)
        return np.nan_to_num(by_intrinsics), np.asarray(np.nan_to_num(by_pose))

    def _covariance(self, camera: Camera, T: FloatArray) -> FloatArray:
        """Of the intrinsics, with the noise that the residuals show."""
        information, _ = self._normal_equations(camera, T, np.inf)
        scale = np.sqrt(np.diag(information)) + 1e-12
        inverse = np.linalg.pinv(information / np.outer(scale, scale), hermitian=True) / np.outer(scale, scale)
        error = self._error(camera, T)
        variance = float(np.sum(error**2)) / max(1, error.size - len(information))
        return np.asarray(variance * inverse[: self._intrinsics, : self._intrinsics])


def _seen_from(T: FloatArray, points: FloatArray) -> FloatArray:
    return np.asarray(np.einsum('nij,nj->ni', T[:, :3, :3], points) + T[:, :3, 3])


def _parameters(camera: Camera) -> FloatArray:
    """Values of fx fy cx cy and the distortion coefficients."""
    K = camera.K
    return np.concatenate([[K[0, 0], K[1, 1], K[0, 2], K[1, 2]], camera.D])


def _camera(camera: Camera, parameters: FloatArray) -> Camera:
    fx, fy, cx, cy = parameters[:4]
    K = np.array([[max(fx, 1.0), 0.0, cx], [0.0, max(fy, 1.0), cy], [0.0, 0.0, 1.0]])
    return Camera(camera.width, camera.height, K, camera.model, parameters[4:])


def _by_matrix(camera: Camera, uv: FloatArray) -> FloatArray:
    """Derivative (N, 2, 4) of pixels by fx fy cx cy."""
    J = np.zeros((len(uv), 2, 4))
    J[:, 0, 0] = (uv[:, 0] - camera.K[0, 2]) / camera.K[0, 0]
    J[:, 1, 1] = (uv[:, 1] - camera.K[1, 2]) / camera.K[1, 1]
    J[:, 0, 2] = J[:, 1, 3] = 1.0
    return J


def _area_centroid(rim: FloatArray) -> FloatArray:
    """Centroid (N, 2) of the areas that closed polygons (N, M, 2) enclose: what the moments of a disc measure."""
    middle = rim.mean(axis=1, keepdims=True)
    a = rim - middle
    b = np.roll(a, -1, axis=1)
    cross = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    centroid = np.sum((a + b) * cross[..., None], axis=1) / (3.0 * np.sum(cross, axis=1)[:, None])
    return np.asarray(middle[:, 0] + centroid)
