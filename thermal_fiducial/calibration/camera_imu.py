"""Camera against IMU: rotation, lever arm and time offset from one recording in front of known markers.

A batch over the whole recording. Every camera pose has a body state (pose, velocity, biases); consecutive states are
held together by the preintegrated IMU samples between them, and the camera poses hold them to the map through the
extrinsics. States stand at the camera's stamps plus the offset; a change of the offset moves them along their own
velocity, and the samples are then preintegrated anew. J. Rehder et al., "Extending kalibr", ICRA 2016, estimates the
same quantities with splines.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solveh_banded

from thermal_fiducial.calibration.preintegration import ImuTrack, Increments, preintegrate
from thermal_fiducial.config import ImuNoise
from thermal_fiducial.core import geometry
from thermal_fiducial.core.measurements import CameraPose
from thermal_fiducial.core.types import FloatArray
from thermal_fiducial.errors import InputError

_STATE = 15
#: Shared unknowns: rotation and position of the camera in the body, time offset, direction of gravity.
_SHARED = 9
_LEAST_POSES = 100
_LARGEST_OFFSET = 0.15
_COARSE_STEP = 0.002
_MAX_STEPS = 15
# Change of the shared unknowns [rad, m, s] that no digit of the answer shows.
_CONVERGED = 1e-7
# Mahalanobis distance of a pose (six degrees of freedom, 99 %) beyond which it loses weight.
_INLIER = 4.1
# What biases may be at most, as a prior on the first state [rad/s, m/s^2].
_BIAS_PRIOR = np.array([0.1] * 3 + [1.0] * 3)


@dataclass(frozen=True)
class CameraImuCalibration:
    """Result.

    Parameters
    ----------
    T_body_camera : (4, 4)
    time_offset : t_imu = t_camera + offset [s]; the bolometers' lag is part of it where the poses carry it
    covariance : (7, 7) of the rotation about the camera's axes [rad], position [m], offset [s]
    gravity_map : (3,) [m/s^2]
    bias : (6,) mean gyroscope and accelerometer bias
    residuals : (N, 6) of the camera poses, position and rotation, in the map [m, rad]
    poses : number that was used
    scale : factor on the given covariances at which the residuals are what they should be
    """

    T_body_camera: FloatArray
    time_offset: float
    covariance: FloatArray
    gravity_map: FloatArray
    bias: FloatArray
    residuals: FloatArray
    poses: int
    scale: float


@dataclass(frozen=True)
class _State:
    """All unknowns; leading dimension (N,) where there is one a pose."""

    R: FloatArray
    p: FloatArray
    v: FloatArray
    bias: FloatArray
    R_body_camera: FloatArray
    p_body_camera: FloatArray
    offset: float
    gravity: FloatArray


def calibrate_camera_imu(
    poses: Sequence[CameraPose],
    imu: ImuTrack,
    start_ns: int,
    noise: ImuNoise,
    gravity: float = 9.80665,
) -> CameraImuCalibration:
    """Estimate the extrinsics.

    Parameters
    ----------
    poses : of the camera in the map, stamped by the camera's clock, in order
    imu : samples; times are seconds of the IMU's clock since ``start_ns``
    gravity : its magnitude [m/s^2]

    Raises
    ------
    InputError
        Too few poses, no IMU samples around them, or motion that the answer cannot be read from.
    """
    stamps = np.array([(pose.stamp_ns - start_ns) * 1e-9 for pose in poses])
    margin = _LARGEST_OFFSET + 0.05
    inside = (stamps > imu.seconds[0] + margin) & (stamps < imu.seconds[-1] - margin)
    inside[1:] &= np.diff(stamps) > 1e-4
    if inside.sum() < _LEAST_POSES:
        raise InputError(f'{inside.sum()} camera poses with IMU samples around them: {_LEAST_POSES} or more are needed')
    stamps = stamps[inside]
    kept = [pose for pose, use in zip(poses, inside, strict=True) if use]
    measured = np.stack([pose.T_map_camera for pose in kept])
    root = np.stack([_root_information(pose.covariance) for pose in kept])
    problem = _Problem(stamps, measured, root, imu, noise)
    state = _first_state(stamps, measured, imu, gravity)
    for _ in range(_MAX_STEPS):
        state, change, covariance = problem.improved(state)
        if change < _CONVERGED:
            break
    return problem.result(state, covariance)


def _root_information(covariance: FloatArray) -> FloatArray:
    """W (6, 6) with W^T W the inverse of ``covariance``."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray((vectors / np.sqrt(np.maximum(values, 1e-14))).T)


def _first_state(stamps: FloatArray, measured: FloatArray, imu: ImuTrack, gravity: float) -> _State:
    """Offset and rotation from the angular velocities, everything else from these."""
    R, p = measured[:, :3, :3], measured[:, :3, 3]
    dt = np.diff(stamps)
    turned = geometry.so3_log(np.swapaxes(R[:-1], 1, 2) @ R[1:]) / dt[:, None]
    steady = dt < 2.0 * np.median(dt)
    middle = 0.5 * (stamps[:-1] + stamps[1:])[steady]
    turned = turned[steady]
    if np.min(np.std(turned, axis=0)) < 0.01:
        raise InputError('the camera turned about fewer than three axes: neither rotation nor lever arm show in that')
    offsets = np.arange(-_LARGEST_OFFSET, _LARGEST_OFFSET, _COARSE_STEP)
    aligned = [_aligned(turned, imu.at(middle + offset)[0]) for offset in offsets]
    best = int(np.argmin([error for _, _, error in aligned]))
    R_body_camera, rate_bias, _ = aligned[best]
    R_body = R @ R_body_camera.T
    _, force = imu.at(stamps + offsets[best])
    up = np.mean((R_body @ force[:, :, None])[:, :, 0], axis=0)
    bias = np.tile(np.concatenate([rate_bias, np.zeros(3)]), (len(stamps), 1))
    v = np.gradient(p, stamps, axis=0)
    down = -gravity * up / np.linalg.norm(up)
    return _State(R_body, p.copy(), v, bias, R_body_camera, np.zeros(3), float(offsets[best]), down)


def _aligned(camera: FloatArray, body: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """R, b and mean squared error of body = R camera + b (Kabsch)."""
    mean_camera, mean_body = camera.mean(axis=0), body.mean(axis=0)
    U, _, Vt = np.linalg.svd((body - mean_body).T @ (camera - mean_camera))
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    b = mean_body - R @ mean_camera
    return R, b, float(np.mean((body - camera @ R.T - b) ** 2))


class _Problem:
    """Gauss-Newton on states in a band and shared unknowns beside it."""

    def __init__(
        self, stamps: FloatArray, measured: FloatArray, root: FloatArray, imu: ImuTrack, noise: ImuNoise
    ) -> None:
        self._stamps, self._measured, self._root, self._imu, self._noise = stamps, measured, root, imu, noise

    def improved(self, state: _State) -> tuple[_State, float, FloatArray]:
        """The next state, the largest change of a shared unknown, and the covariance (9, 9) of these."""
        count = len(self._stamps)
        H = np.zeros((count, 2, _STATE, _STATE))  # of each state with itself, and with the next one
        B = np.zeros((count, _STATE, _SHARED))
        C, c = np.zeros((_SHARED, _SHARED)), np.zeros(_SHARED)
        g = np.zeros((count, _STATE))
        self._add_poses(state, H, B, C, g, c)
        self._add_imu(state, H, B, C, g, c)
        H[0, 0, 9:, 9:] += np.diag(1.0 / _BIAS_PRIOR**2)
        g[0, 9:] += state.bias[0] / _BIAS_PRIOR**2
        solved = solveh_banded(_band(H), np.concatenate([g.reshape(-1, 1), B.reshape(-1, _SHARED)], axis=1), lower=True)
        by_shared = solved[:, 1:]
        flat = B.reshape(-1, _SHARED)
        reduced = C - flat.T @ by_shared
        covariance = np.linalg.inv(reduced)
        shared = -covariance @ (c - flat.T @ solved[:, 0])
        own = (-solved[:, 0] - by_shared @ shared).reshape(count, _STATE)
        return self._moved(state, own, shared), float(np.abs(shared).max()), covariance

    def result(self, state: _State, covariance: FloatArray) -> CameraImuCalibration:
        """What the converged state says."""
        error, _, _ = self._pose_errors(state)
        whitened = (self._root @ error[:, :, None])[:, :, 0]
        scale = max(1.0, 1.4826 * float(np.median(np.abs(whitened))))
        return CameraImuCalibration(
            geometry.transform(state.R_body_camera, state.p_body_camera),
            state.offset,
            covariance[:7, :7] * scale**2,
            state.gravity,
            state.bias.mean(axis=0),
            error,
            len(error),
            scale,
        )

    def _pose_errors(self, state: _State) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Predicted minus measured (N, 6), and its derivatives by state (N, 6, 15) and shared unknowns (N, 6, 9)."""
        count = len(state.p)
        rate, _ = self._imu.at(self._stamps + state.offset)
        rate = rate - state.bias[:, :3]
        arm = state.p_body_camera
        R = state.R @ state.R_body_camera
        error = np.zeros((count, 6))
        error[:, :3] = state.p + state.R @ arm - self._measured[:, :3, 3]
        error[:, 3:] = geometry.so3_log(R @ np.swapaxes(self._measured[:, :3, :3], 1, 2))
        own, shared = np.zeros((count, 6, _STATE)), np.zeros((count, 6, _SHARED))
        own[:, :3, :3] = np.eye(3)
        own[:, :3, 3:6] = -state.R @ geometry.skew(arm)
        own[:, 3:, 3:6] = state.R
        shared[:, 3:, :3] = R
        shared[:, :3, 3:6] = state.R
        shared[:, :3, 6] = state.v + (state.R @ np.cross(rate, arm)[:, :, None])[:, :, 0]
        shared[:, 3:, 6] = (state.R @ rate[:, :, None])[:, :, 0]
        return error, own, shared

    def _add_poses(
        self, state: _State, H: FloatArray, B: FloatArray, C: FloatArray, g: FloatArray, c: FloatArray
    ) -> None:
        error, own, shared = self._pose_errors(state)
        e = (self._root @ error[:, :, None])[:, :, 0]
        distance = np.linalg.norm(e, axis=1)
        weight = np.sqrt(np.minimum(1.0, _INLIER / np.maximum(distance, 1e-12)))[:, None]
        e, own, shared = weight * e, weight[:, :, None] * (self._root @ own), weight[:, :, None] * (self._root @ shared)
        H[:, 0] += np.swapaxes(own, 1, 2) @ own
        B += np.swapaxes(own, 1, 2) @ shared
        C += np.einsum('nij,nik->jk', shared, shared)
        g += (np.swapaxes(own, 1, 2) @ e[:, :, None])[:, :, 0]
        c += np.einsum('nij,ni->j', shared, e)

    def _add_imu(
        self, state: _State, H: FloatArray, B: FloatArray, C: FloatArray, g: FloatArray, c: FloatArray
    ) -> None:
        increments = preintegrate(self._imu, self._stamps + state.offset, state.bias[:-1], self._noise)
        e, first, second, shared = _imu_errors(state, increments, self._noise)
        for index, J in ((slice(None, -1), first), (slice(1, None), second)):
            H[index, 0] += np.swapaxes(J, 1, 2) @ J
            B[index] += np.swapaxes(J, 1, 2) @ shared
            g[index] += (np.swapaxes(J, 1, 2) @ e[:, :, None])[:, :, 0]
        H[:-1, 1] += np.swapaxes(second, 1, 2) @ first
        C += np.einsum('nij,nik->jk', shared, shared)
        c += np.einsum('nij,ni->j', shared, e)

    def _moved(self, state: _State, own: FloatArray, shared: FloatArray) -> _State:
        moved = replace(
            state,
            R=state.R @ geometry.so3_exp(own[:, 3:6]),
            p=state.p + own[:, :3],
            v=state.v + own[:, 6:9],
            bias=state.bias + own[:, 9:],
            R_body_camera=state.R_body_camera @ geometry.so3_exp(shared[:3]),
            p_body_camera=state.p_body_camera + shared[3:6],
            gravity=geometry.so3_exp(_horizontal(state.gravity) @ shared[7:]) @ state.gravity,
        )
        return self._shifted(moved, float(np.clip(shared[6], -0.05, 0.05)))

    def _shifted(self, state: _State, delay: float) -> _State:
        """States moved along their motion to the new instants."""
        rate, force = self._imu.at(self._stamps + state.offset + 0.5 * delay)
        acceleration = (state.R @ (force - state.bias[:, 3:])[:, :, None])[:, :, 0] + state.gravity
        return replace(
            state,
            R=state.R @ geometry.so3_exp((rate - state.bias[:, :3]) * delay),
            p=state.p + state.v * delay,
            v=state.v + acceleration * delay,
            offset=state.offset + delay,
        )


def _horizontal(gravity: FloatArray) -> FloatArray:
    """Axes (3, 2) about which the direction of gravity can turn."""
    _, _, Vt = np.linalg.svd(gravity[None])
    return np.asarray(Vt[1:].T)


def _imu_errors(
    state: _State, increments: Increments, noise: ImuNoise
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Whitened errors (K, 15) of consecutive states, and derivatives by the first, the second and the shared ones."""
    count = len(increments.dt)
    dt = increments.dt[:, None]
    R0, R1 = state.R[:-1], state.R[1:]
    R0t = np.swapaxes(R0, 1, 2)
    gravity = state.gravity
    dv = (R0t @ (state.v[1:] - state.v[:-1] - gravity * dt)[:, :, None])[:, :, 0]
    dp = (R0t @ (state.p[1:] - state.p[:-1] - state.v[:-1] * dt - 0.5 * gravity * dt**2)[:, :, None])[:, :, 0]
    turn = geometry.so3_log(np.swapaxes(increments.R, 1, 2) @ R0t @ R1)
    error = np.concatenate([turn, dv - increments.v, dp - increments.p, state.bias[1:] - state.bias[:-1]], axis=1)
    first, second = np.zeros((count, _STATE, _STATE)), np.zeros((count, _STATE, _STATE))
    shared = np.zeros((count, _STATE, _SHARED))
    # log(D^T R0^T R1 exp(d)) = turn + Jr^-1 d, and Jr^-1 is the transpose of Jl^-1.
    by_turn = np.swapaxes(geometry.so3_left_jacobian_inverse(turn), 1, 2)
    first[:, :3, 3:6] = -by_turn @ np.swapaxes(R1, 1, 2) @ R0
    second[:, :3, 3:6] = by_turn
    first[:, 3:6, 3:6], first[:, 3:6, 6:9], second[:, 3:6, 6:9] = geometry.skew(dv), -R0t, R0t
    first[:, 6:9, 3:6], first[:, 6:9, :3], second[:, 6:9, :3] = geometry.skew(dp), -R0t, R0t
    first[:, 6:9, 6:9] = -R0t * dt[:, :, None]
    first[:, :9, 9:] = -increments.by_bias
    first[:, 9:, 9:], second[:, 9:, 9:] = -np.eye(6), np.eye(6)
    by_gravity = -geometry.skew(gravity) @ _horizontal(gravity)
    shared[:, 3:6, 7:] = -R0t @ by_gravity * dt[:, :, None]
    shared[:, 6:9, 7:] = -0.5 * R0t @ by_gravity * dt[:, :, None] ** 2
    root = np.zeros((count, _STATE, _STATE))
    root[:, :9, :9] = np.linalg.inv(np.linalg.cholesky(increments.covariance + 1e-18 * np.eye(9)))
    walk = np.array([max(noise.gyroscope_random_walk, 1e-9)] * 3 + [max(noise.accelerometer_random_walk, 1e-9)] * 3)
    root[:, 9:, 9:] = (1.0 / (walk * np.sqrt(dt)))[:, :, None] * np.eye(6)
    return (root @ error[:, :, None])[:, :, 0], root @ first, root @ second, root @ shared


def _band(H: FloatArray) -> FloatArray:
    """Lower band (2 * 15, 15 N) of the block tridiagonal matrix, as LAPACK stores it."""
    count = len(H)
    band = np.zeros((2 * _STATE, count, _STATE))
    column = np.arange(_STATE)
    for row in range(_STATE):
        inside = column <= row
        band[row - column[inside], :, column[inside]] = H[:, 0, row, inside].T
        band[_STATE + row - column, :, column] = H[:, 1, row, :].T
    return band.reshape(2 * _STATE, -1)
