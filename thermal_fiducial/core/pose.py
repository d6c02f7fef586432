"""Pose of a marker, and of the camera from all markers of a frame, with covariances.

A square seen in one image has two poses that explain its corners almost equally well. Both are computed in closed
form (IPPE: T. Collins, A. Bartoli, "Infinitesimal plane-based pose estimation", IJCV 2014), which unlike OpenCV's
implementation also holds for an exactly front-parallel square, and each is then polished by Levenberg-Marquardt on
the re-projection error in the distorted image, weighted with the corner covariances. Covariances are
``inv(J^T W J)`` with every cross term, in the ROS convention: translation, then rotation, in the parent frame.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from thermal_fiducial.core import geometry
from thermal_fiducial.core.camera import Camera
from thermal_fiducial.core.types import BoolArray, FloatArray
from thermal_fiducial.errors import InputError

_MAX_STEPS = 20
# A step below this [m and rad, relative to unit scene] changes no published digit.
_CONVERGED = 1e-9
# A cost that falls by less than this share of itself is at its minimum to a thousandth of a standard deviation.
_GAIN = 1e-7
# Damping at which Levenberg-Marquardt finds no better pose at all.
_HOPELESS = 1e6
# Stands in for a start that does not exist; the square it shows is in front of the camera.
_AHEAD = geometry.transform(np.diag([1.0, -1.0, -1.0]), [0.0, 0.0, 1.0])
# Mahalanobis distance of a corner (99 % of a chi-square of two degrees of freedom) beyond which it loses weight.
_INLIER = 3.0
_NO_OUTLIERS = 1e9
# Two branches whose chi-squares differ by less than this factor are ambiguous: then the prediction decides.
_AMBIGUOUS_RATIO = 4.0
# Condition number at which corners no longer form a square.
_SINGULAR = 1e12

#: What Levenberg-Marquardt needs at poses (B, 4, 4): cost (B,), gradient (B, 6), information (B, 6, 6).
_Evaluation = tuple[FloatArray, FloatArray, FloatArray]


@dataclass(frozen=True, slots=True)
class PlanarPose:
    """Both poses of one marker in the camera; the better one first."""

    #: (4, 4)
    T_camera_marker: FloatArray
    #: (6, 6), ROS convention, in the camera frame [m, rad]
    covariance: FloatArray
    #: re-projection error, rms over the four corners (length of the 2-vector) [px]; inf: no pose found
    rms_px: float
    #: (4, 4) the other branch; the same pose where both branches meet
    T_alternative: FloatArray
    alternative_rms_px: float
    #: (6, 6) of the other branch
    alternative_covariance: FloatArray
    #: weighted squared errors of both: with honest corner covariances, chi-square of two degrees of freedom
    chi2: float
    alternative_chi2: float

    def swapped(self) -> 'PlanarPose':
        """The other branch first."""
        return PlanarPose(
            self.T_alternative,
            self.alternative_covariance,
            self.alternative_rms_px,
            self.T_camera_marker,
            self.rms_px,
            self.covariance,
            self.alternative_chi2,
            self.chi2,
        )


@dataclass(frozen=True, slots=True)
class JointPose:
    """The camera in the map from all corners of a frame."""

    #: (4, 4)
    T_map_camera: FloatArray
    #: (6, 6), ROS convention, in the map [m, rad]
    covariance: FloatArray
    #: (N, 4, 2) measured minus predicted
    residuals_px: FloatArray
    #: rms over all corners (length of the 2-vector)
    rms_px: float
    #: robust weighted squared error; with honest covariances, chi-square of 8 N - 6 degrees of freedom
    chi2: float


def marker_corners(size: float) -> FloatArray:
    """Corners (4, 3) [m] in the marker frame, clockwise from the top-left, of a marker of side ``size``."""
    s = 0.5 * size
    return np.array([[-s, s, 0.0], [s, s, 0.0], [s, -s, 0.0], [-s, -s, 0.0]])


def solve_marker_pose(corners_px: npt.ArrayLike, corner_cov: npt.ArrayLike, size: float, camera: Camera) -> PlanarPose:
    """Both poses of one marker.

    Parameters
    ----------
    corners_px : (4, 2) in the raw image, in the order of :func:`marker_corners`
    corner_cov : (4, 2, 2) [px^2]
    size : side [m]

    Raises
    ------
    InputError
        Corners from which no pose in front of the camera follows.
    """
    corners = np.asarray(corners_px, dtype=np.float64)[None]
    pose = solve_marker_poses(corners, np.asarray(corner_cov, dtype=np.float64)[None], np.array([size]), camera)[0]
    if not np.isfinite(pose.rms_px):
        raise InputError(f'no pose of a marker follows from the corners {corners[0].tolist()}')
    return pose


def solve_marker_poses(
    corners_px: FloatArray, corner_covs: FloatArray, sizes: FloatArray, camera: Camera
) -> list[PlanarPose]:
    """Both poses of N markers: (N, 4, 2), (N, 4, 2, 2), (N,); where there is none, ``rms_px`` is inf."""
    count = len(corners_px)
    points = sizes[:, None, None] * marker_corners(1.0)
    starts = ippe_square(camera.normalise(corners_px), sizes).reshape(2 * count, 4, 4)
    both = np.repeat(np.arange(count), 2)
    whitening = _whitening(corner_covs)

    def evaluate(T: FloatArray) -> _Evaluation:
        return _marker_evaluation(T, points[both], corners_px[both], whitening[both], camera)

    T, chi2, information = _minimise(evaluate, starts)
    residuals = corners_px[both] - camera.project(geometry.apply(T, points[both]))
    rms = np.sqrt(np.mean(np.sum(residuals**2, axis=-1), axis=-1))
    facing = np.sum(T[:, :3, 2] * T[:, :3, 3], axis=-1) < 0.0
    rms = np.where(np.isfinite(rms) & np.isfinite(chi2) & facing, rms, np.inf)
    covariance = _inverse(information)
    poses = []
    for first in range(0, 2 * count, 2):
        a, b = first, first + 1
        if not np.isfinite(rms[a]) or (np.isfinite(rms[b]) and chi2[b] < chi2[a]):
            a, b = b, a
        if not np.isfinite(rms[b]):
            b = a
        poses.append(
            PlanarPose(T[a], covariance[a], float(rms[a]), T[b], float(rms[b]), covariance[b], chi2[a], chi2[b])
        )
    return poses


def choose_branch(pose: PlanarPose, T_camera_marker_expected: FloatArray, ratio: float = 10.0) -> PlanarPose:
    """``pose`` with that branch first whose rotation is closer to the expected one.

    The expectation (from other markers of the frame, or the filter) decides only between branches that the image
    allows: one whose squared error is over ``ratio`` times the other's (or its expectation, 2) stays second.
    """
    if not pose.alternative_chi2 <= ratio * max(pose.chi2, 2.0):
        return pose
    R = T_camera_marker_expected[:3, :3]
    branches = np.stack([pose.T_camera_marker[:3, :3], pose.T_alternative[:3, :3]])
    angle = np.linalg.norm(geometry.so3_log(branches @ R.T), axis=-1)
    return pose.swapped() if angle[1] < angle[0] else pose


def solve_camera_pose(
    corners: npt.ArrayLike,
    covs: npt.ArrayLike,
    corners_in_map: npt.ArrayLike,
    camera: Camera,
    initial: FloatArray | None = None,
    weights: npt.ArrayLike | None = None,
    compete: bool = True,
) -> JointPose:
    """Pose of the camera from N markers of known pose jointly.

    Both planar poses of every marker compete as the start (the one that explains all markers best wins), and so
    does ``initial``, which also wins a tie between the branches of a lone marker. The error is the squared Mahalanobis
    distance d of each corner up to c = 3, and ``c^2 (1 + 2 log(d / c))`` beyond, so that outliers lose all influence.

    Parameters
    ----------
    corners : (N, 4, 2) [px] in the raw image
    covs : (N, 4, 2, 2) [px^2]
    corners_in_map : (N, 4, 3) [m] squares, in the order of :func:`marker_corners`
    initial : (4, 4) predicted T_map_camera
    weights : (N,) factors on the information of each marker; default 1
    compete : False: ``initial`` is good, nothing else need be tried

    Raises
    ------
    InputError
        No markers, or no pose that sees them.
    """
    corners = np.asarray(corners, dtype=np.float64)
    squares = np.asarray(corners_in_map, dtype=np.float64)
    if len(corners) == 0:
        raise InputError('no markers to compute a camera pose from')
    whitening = _whitening(np.asarray(covs, dtype=np.float64))
    if weights is not None:
        whitening = whitening * np.sqrt(np.asarray(weights, dtype=np.float64))[:, None, None, None]
    measured, points = corners.reshape(-1, 2), squares.reshape(-1, 3)
    whitening = whitening.reshape(-1, 2, 2)

    def evaluate(T: FloatArray) -> _Evaluation:
        return _camera_evaluation(T, points, measured, whitening, camera)

    starts = np.empty((0, 4, 4)) if initial is None else np.asarray(initial, dtype=np.float64)[None]
    if compete or initial is None:
        others = _camera_starts(corners, squares, camera)
        cost = evaluate(others)[0]
        starts = np.concatenate([starts, others[np.argsort(cost)[:2]]])
    T, chi2, information = _minimise(evaluate, starts)
    best = int(np.argmin(chi2))
    if not np.isfinite(chi2[best]):
        raise InputError(f'no camera pose explains the {len(corners)} markers')
    if initial is not None and chi2[0] <= _AMBIGUOUS_RATIO * max(chi2[best], 8.0 * len(corners) - 6.0):
        best = 0
    residuals = corners - camera.project(geometry.apply(geometry.inverse(T[best]), squares))
    return JointPose(
        T[best],
        _inverse(information[best]),
        residuals,
        float(np.sqrt(np.mean(np.sum(residuals**2, axis=-1)))),
        float(chi2[best]),
    )


def ippe_square(normalised: FloatArray, sizes: FloatArray) -> FloatArray:
    """Both poses (N, 2, 4, 4) of squares from normalised image corners (N, 4, 2) and sides (N,).

    Collins and Bartoli, section 4.1: with J the derivative of the homography at the square's centre, v the centre's
    image and R_v the rotation of the optical axis to it, ``J t_z = [I | -v] R_v R'`` leaves R' up to the sign of
    the tilt.
    """
    J, v = _homography_derivative(normalised, 0.5 * sizes)
    R_v = _axis_to(v)
    B = R_v[:, :2, :2] - v[:, :, None] * R_v[:, 2:, :2]
    A = np.linalg.solve(B, J)
    gram = np.swapaxes(A, -1, -2) @ A
    trace, difference = gram[:, 0, 0] + gram[:, 1, 1], gram[:, 0, 0] - gram[:, 1, 1]
    gamma = np.sqrt(0.5 * (trace + np.hypot(difference, 2.0 * gram[:, 0, 1])))
    upper = A / gamma[:, None, None]
    h = np.eye(2) - np.swapaxes(upper, -1, -2) @ upper
    tilt = np.sqrt(np.maximum(np.stack([h[:, 0, 0], h[:, 1, 1]], axis=-1), 0.0))
    tilt[:, 1] *= np.where(h[:, 0, 1] < 0.0, -1.0, 1.0)
    poses = np.empty((len(J), 2, 4, 4))
    for branch, sign in enumerate((1.0, -1.0)):
        columns = np.concatenate([upper, sign * tilt[:, None, :]], axis=1)
        third = np.cross(columns[..., 0], columns[..., 1])
        R = R_v @ np.concatenate([columns, third[..., None]], axis=-1)
        centre = np.concatenate([v, np.ones((len(v), 1))], axis=-1) / gamma[:, None]
        poses[:, branch] = geometry.transform(R, centre)
    return poses


def _homography_derivative(image: FloatArray, s: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Derivative (N, 2, 2) at, and image (N, 2) of, the centre under the square's homography."""
    count = len(image)
    xy = np.broadcast_to(marker_corners(2.0)[:, :2], (count, 4, 2))
    equations = np.zeros((count, 4, 2, 8))
    for row in range(2):
        equations[:, :, row, 3 * row : 3 * row + 2] = xy
        equations[:, :, row, 3 * row + 2] = 1.0
        equations[:, :, row, 6:] = -image[:, :, row, None] * xy
    A = np.nan_to_num(equations.reshape(count, 8, 8))
    # Three corners on a line, or NaN, have no homography: the pose becomes NaN.
    solvable = (np.linalg.cond(A) < _SINGULAR)[:, None]
    h = np.linalg.solve(np.where(solvable[..., None], A, np.eye(8)), image.reshape(count, 8, 1))[..., 0]
    h = np.where(solvable, h, np.nan)
    v = h[:, [2, 5]]
    J = np.stack([h[:, 0:2], h[:, 3:5]], axis=1) - v[:, :, None] * h[:, None, 6:]
    return J / s[:, None, None], np.asarray(v)


def _axis_to(v: FloatArray) -> FloatArray:
    """Shortest rotations (N, 3, 3) of the optical axis to the directions (v, 1), v (N, 2)."""
    direction = np.concatenate([v, np.ones((len(v), 1))], axis=-1)
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    axis = np.stack([-direction[:, 1], direction[:, 0], np.zeros(len(v))], axis=-1)
    K = geometry.skew(axis)
    return np.asarray(np.eye(3) + K + K @ K / (1.0 + direction[:, 2])[:, None, None])


def _marker_evaluation(
    T: FloatArray, points: FloatArray, measured: FloatArray, whitening: FloatArray, camera: Camera
) -> _Evaluation:
    """Re-projection at T_camera_marker (B, 4, 4) of points (B, K, 3)."""
    rotated = points @ np.swapaxes(T[:, :3, :3], -1, -2)
    uv, d_uv = camera.project_jacobian(rotated + T[:, None, :3, 3])
    J = np.concatenate([d_uv, -d_uv @ geometry.skew(rotated)], axis=-1)
    return _normal_equations(whitening @ (uv - measured)[..., None], whitening @ J, _NO_OUTLIERS)


def _camera_evaluation(
    T: FloatArray, points: FloatArray, measured: FloatArray, whitening: FloatArray, camera: Camera
) -> _Evaluation:
    """Re-projection at T_map_camera (B, 4, 4) of points (K, 3)."""
    offset = points - T[:, None, :3, 3]
    uv, d_uv = camera.project_jacobian(offset @ T[:, :3, :3])
    d_offset = d_uv @ np.swapaxes(T[:, None, :3, :3], -1, -2)
    J = np.concatenate([-d_offset, d_offset @ geometry.skew(offset)], axis=-1)
    return _normal_equations(whitening @ (uv - measured)[..., None], whitening @ J, _INLIER)


def _normal_equations(residual: FloatArray, J: FloatArray, inlier: float) -> _Evaluation:
    """Cost, gradient and information of whitened residuals (B, K, 2, 1) with whitened Jacobians (B, K, 2, 6)."""
    distance = np.linalg.norm(residual[..., 0], axis=-1)
    excess = np.maximum(distance / inlier, 1.0)
    cost = np.where(excess > 1.0, inlier**2 * (1.0 + 2.0 * np.log(excess)), distance**2)
    weighted = np.swapaxes(J / (excess**2)[..., None, None], -1, -2)
    gradient = np.sum(weighted @ residual, axis=1)[..., 0]
    return np.sum(cost, axis=-1), gradient, np.sum(weighted @ J, axis=1)


def _move(T: FloatArray, step: FloatArray) -> FloatArray:
    """Poses (B, 4, 4) after steps (B, 6): translation added, rotation from the left."""
    return geometry.transform(geometry.so3_exp(step[:, 3:]) @ T[:, :3, :3], T[:, :3, 3] + step[:, :3])


def _minimise(evaluate: Callable[[FloatArray], _Evaluation], T: FloatArray) -> _Evaluation:
    """Levenberg-Marquardt on a batch: poses (B, 4, 4), their costs (B,) and information matrices (B, 6, 6)."""
    possible: BoolArray = np.asarray(np.isfinite(T).all(axis=(-1, -2)))
    T = np.where(possible[:, None, None], T, _AHEAD)
    cost, gradient, information = _finite(evaluate(T))
    damping = np.full(len(T), 1e-6)
    for _ in range(_MAX_STEPS):
        step = -_solve(information, damping, gradient)
        trial = _move(T, step)
        new = _finite(evaluate(trial))
        better = new[0] <= cost
        T = np.where(better[:, None, None], trial, T)
        gradient = np.where(better[:, None], new[1], gradient)
        information = np.where(better[:, None, None], new[2], information)
        unchanged = (new[0] >= (1.0 - _GAIN) * cost) & (new[0] <= (1.0 + _GAIN) * cost)
        still = (np.abs(step).max(axis=-1) < _CONVERGED) | unchanged
        cost = np.where(better, new[0], cost)
        damping = np.where(better, 0.1 * damping, 10.0 * damping)
        if np.all(still | (damping > _HOPELESS)):
            break
    return T, np.where(possible, cost, np.inf), information


def _finite(evaluation: _Evaluation) -> _Evaluation:
    """A pose from which a corner cannot be seen costs infinitely much and leads nowhere."""
    cost, gradient, information = evaluation
    seen = np.isfinite(cost)
    return (
        np.where(seen, cost, np.inf),
        np.where(seen[:, None], gradient, 0.0),
        np.where(seen[:, None, None], information, np.eye(6)),
    )


def _solve(information: FloatArray, damping: FloatArray, gradient: FloatArray) -> FloatArray:
    diagonal = np.einsum('bii->bi', information)
    floor = 1e-12 * np.maximum(diagonal.max(axis=-1, keepdims=True), 1e-12)
    damped = information + (damping[:, None] * diagonal + floor)[..., None] * np.eye(6)
    return np.asarray(np.linalg.solve(damped, gradient[..., None])[..., 0])


def _inverse(information: FloatArray) -> FloatArray:
    """Covariances; where nothing is known of some direction, the pseudo-inverse would hide it: inf."""
    scale = np.sqrt(np.maximum(np.einsum('...ii->...i', information), 1e-300))
    unit = information / (scale[..., :, None] * scale[..., None, :])
    known = np.linalg.cond(unit) < 1e14
    unit = np.where(known[..., None, None], unit, np.eye(6))
    covariance = np.linalg.inv(unit) / (scale[..., :, None] * scale[..., None, :])
    covariance = 0.5 * (covariance + np.swapaxes(covariance, -1, -2))
    return np.where(known[..., None, None], covariance, np.inf)


def _whitening(covs: FloatArray) -> FloatArray:
    """Matrices (..., 2, 2) with ``|W r|^2 == r^T inv(C) r``: inverses of the Cholesky factors."""
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covs)))


def _camera_starts(corners: FloatArray, squares: FloatArray, camera: Camera) -> FloatArray:
    """T_map_camera (2 N, 4, 4) from both poses of each marker."""
    right = squares[:, 1] - squares[:, 0]
    up = squares[:, 0] - squares[:, 3]
    sizes = np.linalg.norm(right, axis=-1)
    x = right / sizes[:, None]
    y = up / np.linalg.norm(up, axis=-1, keepdims=True)
    T_map_marker = geometry.transform(np.stack([x, y, np.cross(x, y)], axis=-1), squares.mean(axis=1))
    T_camera_marker = ippe_square(camera.normalise(corners), sizes)
    return (T_map_marker[:, None] @ geometry.inverse(T_camera_marker)).reshape(-1, 4, 4)
