"""What the filter estimates, and the coordinates of its error.

The pose and velocity are an element X = (R, v, p) of SE_2(3), the error is left-invariant, X_true = X Exp(xi):
rotation, velocity and position errors are all expressed in the robot frame. A measured pose then has a constant
Jacobian, and the error propagates exactly linearly for given inertial increments.

Sources: A. Barrau, S. Bonnabel, "The Invariant Extended Kalman Filter as a Stable Observer", IEEE TAC 2017;
M. Brossard, A. Barrau, P. Chauchat, S. Bonnabel, "Associating Uncertainty to Extended Poses for on Lie Group IMU
Preintegration", IEEE T-RO 2022.
"""

from dataclasses import dataclass, replace
import math

import numpy as np

from thermal_fiducial.config import PoseEkfConfig
from thermal_fiducial.core.filter.clock_steps import ClockSteps
from thermal_fiducial.core.filter.imu import rotation_integrals
from thermal_fiducial.core.filter.learned_noise import Aliasing, StampJitter
from thermal_fiducial.core.geometry.se3 import transform
from thermal_fiducial.core.types import FloatArray

#: Places of the error coordinates, in the robot frame [rad, m/s, m, rad/s, m/s^2].
ROTATION, VELOCITY, POSITION = slice(0, 3), slice(3, 6), slice(6, 9)
GYROSCOPE_BIAS, ACCELEROMETER_BIAS, BIAS = slice(9, 12), slice(12, 15), slice(9, 15)
#: A pose measures the rotation and the position error.
POSE = np.r_[ROTATION, POSITION]


@dataclass(frozen=True, slots=True)
class Layout:
    """Places of the error coordinates that are estimated on request, after the first 15.

    ``gravity``: its two horizontal components in the map [m/s^2]; ``time_offset`` [s]; ``extrinsics``: rotation
    and position of T_body_camera, perturbed from the left, thus in the robot frame [rad, m]; ``gyroscope_scale``: the
    matrix of scale and cross-axis errors, row by row.
    """

    gravity: slice | None
    time_offset: int | None
    extrinsics: slice | None
    gyroscope_scale: slice | None
    size: int

    @classmethod
    def of(cls, config: PoseEkfConfig) -> 'Layout':
        """Layout that ``config`` asks for."""
        size = BIAS.stop
        gravity = slice(size, size + 2) if config.map_tilt_std > 0.0 else None
        size += 2 if gravity else 0
        time_offset = size if config.estimate_time_offset else None
        size += 0 if time_offset is None else 1
        extrinsics = slice(size, size + 6) if config.estimate_extrinsics else None
        size += 6 if extrinsics else 0
        scale = slice(size, size + 9) if config.imu.gyroscope_scale_std > 0.0 else None
        size += 9 if scale else 0
        return cls(gravity, time_offset, extrinsics, scale, size)


@dataclass(slots=True)
class NavigationState:
    """Estimate and covariance at one instant; never changed in place."""

    #: (3, 3)
    R_map_body: FloatArray
    #: (3,) in the map [m/s]
    velocity: FloatArray
    #: (3,) in the map [m]
    position: FloatArray
    #: (6,) gyroscope [rad/s], then accelerometer [m/s^2]
    bias: FloatArray
    #: (3, 3) error of the measured rate, in shares of it
    gyroscope_scale: FloatArray
    #: (3,) in the map [m/s^2]
    gravity: FloatArray
    #: [s], t_imu = t_camera + camera_time_offset + time_offset
    time_offset: float
    #: whether the time offset is being estimated: it is once the velocity is known
    clock_open: bool
    #: (4, 4)
    T_body_camera: FloatArray
    #: what the innovations have shown of the noise
    stamp_jitter: StampJitter
    aliasing: Aliasing
    #: whether the camera's clock has stepped
    clock_steps: ClockSteps
    #: (n, n) of the error coordinates of :class:`Layout`
    covariance: FloatArray

    @property
    def T_map_body(self) -> FloatArray:
        """(4, 4)."""
        return transform(self.R_map_body, self.position)

    @property
    def velocity_body(self) -> FloatArray:
        """(3,) velocity in the robot frame [m/s]."""
        return self.velocity @ self.R_map_body

    def rate_error(self, rate: FloatArray) -> FloatArray:
        """(3,) of a measured ``rate`` (3,) [rad/s]."""
        return self.bias[:3] + self.gyroscope_scale @ rate


def inject(state: NavigationState, error: FloatArray, covariance: FloatArray, layout: Layout) -> NavigationState:
    """``state`` moved by ``error`` (n,), X Exp(xi) for the group part, with a new covariance (n, n)."""
    R, R_left = state.R_map_body @ rotation_integrals(error[ROTATION])[:2]
    moved = replace(
        state,
        R_map_body=orthonormal(R),
        velocity=state.velocity + R_left @ error[VELOCITY],
        position=state.position + R_left @ error[POSITION],
        bias=state.bias + error[BIAS],
        covariance=covariance,
    )
    if layout.gravity:
        moved.gravity = with_horizontal(state.gravity, state.gravity[:2] + error[layout.gravity])
    if layout.time_offset is not None:
        moved.time_offset = state.time_offset + float(error[layout.time_offset])
    if layout.extrinsics:
        rotation, left, _ = rotation_integrals(error[layout.extrinsics][:3])
        moved.T_body_camera = transform(rotation, left @ error[layout.extrinsics][3:]) @ state.T_body_camera
    if layout.gyroscope_scale:
        moved.gyroscope_scale = state.gyroscope_scale + error[layout.gyroscope_scale].reshape(3, 3)
    return moved


def in_moved_map(state: NavigationState, T_new_old: FloatArray, layout: Layout) -> NavigationState:
    """``state`` in a map whose coordinates are moved by ``T_new_old`` (4, 4).

    The error is one of the robot frame, so only the horizontal gravity's coordinates turn.
    """
    R = T_new_old[:3, :3]
    moved = replace(
        state,
        R_map_body=orthonormal(R @ state.R_map_body),
        velocity=R @ state.velocity,
        position=R @ state.position + T_new_old[:3, 3],
        gravity=R @ state.gravity,
    )
    if layout.gravity:
        turn = np.eye(layout.size)
        turn[layout.gravity, layout.gravity] = R[:2, :2]
        moved.covariance = turn @ state.covariance @ turn.T
        moved.clock_steps = state.clock_steps.turned(turn)
    return moved


def with_horizontal(gravity: FloatArray, horizontal: FloatArray) -> FloatArray:
    """Downward vector as long as ``gravity`` (3,) with the given horizontal components (2,) [m/s^2]."""
    down = math.sqrt(max(float(gravity @ gravity - horizontal @ horizontal), 0.0))
    return np.array([horizontal[0], horizontal[1], -down])


def orthonormal(R: FloatArray) -> FloatArray:
    """The rotation next to a matrix (3, 3) that rounding has moved: one Newton step of the polar decomposition."""
    return np.asarray(1.5 * R - 0.5 * (R @ (R.T @ R)))
