"""Unknowns of a recording of camera and IMU, their first values, and the errors of the IMU between frames."""

from dataclasses import dataclass, field

import numpy as np

from thermal_fiducial.calibration.preintegration import AXES, Densities, ImuTrack, Increments
from thermal_fiducial.core.geometry import se3
from thermal_fiducial.core.types import FloatArray
from thermal_fiducial.errors import InputError

#: Number of unknowns of a frame: position, rotation, velocity, biases.
OF_FRAME = 15
#: Number of shared unknowns: rotation and position of the camera in the body, time offset, direction of gravity,
#: read-out time, delay of the accelerometer behind the gyroscope, scale errors and misalignments of the IMU.
OF_ALL = 11 + AXES
#: Largest time offset that is searched [s].
LARGEST_OFFSET = 0.15
_COARSE_STEP = 0.002
# Least correlation of the turns about a second axis, over the root of their number: noise alone has 1 to 3, and from 5
# on the rotation that follows from them is right to 0.2 rad, from where the adjustment converges.
_BEYOND_NOISE = 5.0


@dataclass(frozen=True)
class State:
    """All unknowns; those of each frame have a leading dimension (N,)."""

    R: FloatArray
    p: FloatArray
    v: FloatArray
    bias: FloatArray
    R_body_camera: FloatArray
    p_body_camera: FloatArray
    offset: float
    gravity: FloatArray
    readout: float = 0.0
    force_delay: float = 0.0
    axes: FloatArray = field(default_factory=lambda: np.zeros(AXES))


def first_state(stamps: FloatArray, measured: FloatArray, imu: ImuTrack, gravity: float) -> State:
    """Initial state: clock offset and rotation by matching angular velocities, everything else from these."""
    R, p = measured[:, :3, :3], measured[:, :3, 3]
    dt = np.diff(stamps)
    turned = se3.so3_log(np.swapaxes(R[:-1], 1, 2) @ R[1:]) / dt[:, None]
    steady = dt < 2.0 * np.median(dt)
    middle = 0.5 * (stamps[:-1] + stamps[1:])[steady]
    turned = turned[steady]
    offsets = np.arange(-LARGEST_OFFSET, LARGEST_OFFSET, _COARSE_STEP)
    aligned = [_aligned(turned, imu.at(middle + offset)[0]) for offset in offsets]
    best = int(np.argmin([error for _, _, error in aligned]))
    R_body_camera, rate_bias, _ = aligned[best]
    _require_turns(turned, imu.at(middle + offsets[best])[0])
    R_body = R @ R_body_camera.T
    _, force = imu.at(stamps + offsets[best])
    up = np.mean((R_body @ force[:, :, None])[:, :, 0], axis=0)
    bias = np.tile(np.concatenate([rate_bias, np.zeros(3)]), (len(stamps), 1))
    v = np.gradient(p, stamps, axis=0)
    down = -gravity * up / np.linalg.norm(up)
    return State(R_body, p.copy(), v, bias, R_body_camera, np.zeros(3), float(offsets[best]), down)


def _aligned(camera: FloatArray, body: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """R, b and mean squared error of body = R camera + b."""
    T = se3.rigid_alignment(body, camera)
    return T[:3, :3], T[:3, 3], float(np.mean((body - se3.apply(T, camera)) ** 2))


def _require_turns(camera: FloatArray, body: FloatArray) -> None:
    """Raise InputError unless turn rates (N, 3) of camera and body share two axes, by their canonical correlations."""
    bases = [np.linalg.qr(rates - rates.mean(axis=0))[0] for rates in (camera, body)]
    if np.linalg.svd(bases[0].T @ bases[1], compute_uv=False)[1] < _BEYOND_NOISE / np.sqrt(len(body)):
        raise InputError(
            'camera and IMU turn together about fewer than two axes, which shows neither rotation nor lever arm: turn '
            f'about all three axes, with clocks that are less than {LARGEST_OFFSET:g} s apart'
        )


def horizontal(gravity: FloatArray) -> FloatArray:
    """Axes (3, 2) about which the direction of gravity (3,) can turn."""
    _, _, Vt = np.linalg.svd(gravity[None])
    return np.asarray(Vt[1:].T)


def imu_errors(
    state: State, increments: Increments, noise: Densities
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Whitened errors (K, 15) of consecutive states, and derivatives by the first, the second and the shared ones."""
    count = len(increments.dt)
    dt = increments.dt[:, None]
    R0, R1 = state.R[:-1], state.R[1:]
    R0t = np.swapaxes(R0, 1, 2)
    gravity = state.gravity
    dv = (R0t @ (state.v[1:] - state.v[:-1] - gravity * dt)[:, :, None])[:, :, 0]
    dp = (R0t @ (state.p[1:] - state.p[:-1] - state.v[:-1] * dt - 0.5 * gravity * dt**2)[:, :, None])[:, :, 0]
    turn = se3.so3_log(np.swapaxes(increments.R, 1, 2) @ R0t @ R1)
    error = np.concatenate([turn, dv - increments.v, dp - increments.p, state.bias[1:] - state.bias[:-1]], axis=1)
    first, second = np.zeros((count, OF_FRAME, OF_FRAME)), np.zeros((count, OF_FRAME, OF_FRAME))
    shared = np.zeros((count, OF_FRAME, OF_ALL))
    # log(D^T R0^T R1 exp(d)) = turn + Jr^-1 d, and Jr^-1 is the transpose of Jl^-1.
    by_turn = np.swapaxes(se3.so3_left_jacobian_inverse(turn), 1, 2)
    first[:, :3, 3:6] = -by_turn @ np.swapaxes(R1, 1, 2) @ R0
    second[:, :3, 3:6] = by_turn
    first[:, 3:6, 3:6], first[:, 3:6, 6:9], second[:, 3:6, 6:9] = se3.skew(dv), -R0t, R0t
    first[:, 6:9, 3:6], first[:, 6:9, :3], second[:, 6:9, :3] = se3.skew(dp), -R0t, R0t
    first[:, 6:9, 6:9] = -R0t * dt[:, :, None]
    first[:, :9, 9:] = -increments.by_bias
    first[:, 9:, 9:], second[:, 9:, 9:] = -np.eye(6), np.eye(6)
    by_gravity = -se3.skew(gravity) @ horizontal(gravity)
    shared[:, :9, 10] = -increments.by_delay
    shared[:, :9, 11:] = -increments.by_axes
    shared[:, 3:6, 7:9] = -R0t @ by_gravity * dt[:, :, None]
    shared[:, 6:9, 7:9] = -0.5 * R0t @ by_gravity * dt[:, :, None] ** 2
    root = np.zeros((count, OF_FRAME, OF_FRAME))
    root[:, :9, :9] = np.linalg.inv(np.linalg.cholesky(increments.covariance + 1e-18 * np.eye(9)))
    walk = np.array([max(noise.gyroscope_random_walk, 1e-9)] * 3 + [max(noise.accelerometer_random_walk, 1e-9)] * 3)
    root[:, 9:, 9:] = (1.0 / (walk * np.sqrt(dt)))[:, :, None] * np.eye(6)
    return (root @ error[:, :, None])[:, :, 0], root @ first, root @ second, root @ shared
