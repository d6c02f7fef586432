"""The estimate at a first pose: attitude and position of the pose, wide priors for all else.

That is enough: the pose error is linear in the error coordinates, so that the next two or three poses determine
velocity and tilt whatever their true values are.
"""

from dataclasses import replace
import math

import numpy as np

from thermal_fiducial.config import PoseEkfConfig
from thermal_fiducial.core.filter.pose_noise import BodyPose, PoseNoise
from thermal_fiducial.core.filter.state import (
    ACCELEROMETER_BIAS,
    ACCELEROMETER_MATRIX,
    clock_offset_derivative,
    Estimate,
    EXTRINSICS,
    FORCE_DELAY,
    GRAVITY,
    GYROSCOPE_BIAS,
    GYROSCOPE_MATRIX,
    NavigationState,
    POSE,
    POSITION,
    SIZE,
    SYSTEMATIC,
    VELOCITY,
)
from thermal_fiducial.core.geometry.se3 import camera_in_body
from thermal_fiducial.core.measurements import Condition, VAGUE
from thermal_fiducial.core.types import FloatArray

#: Window [s] of the samples that a first pose is compared with.
WINDOW_SECONDS = 0.5
#: Largest difference of the mean specific force from gravity, as a share of it: beyond it the accelerometer's units or
#: sign are wrong.
HARDLY_GRAVITY = 0.5
#: Largest angle [rad] between a first pose's vertical and the specific force: beyond it the planar branch is wrong. In
#: violent flights one instant in a thousand is beyond 57 deg, one in twelve beyond 35.
LARGEST_TILT = math.radians(60.0)
#: Standard deviation of the vertical about each axis by the mean of half a second of samples [rad]: a brisk robot
#: accelerates by 3 m/s^2 (``UNKNOWN_ACCELERATION``). In 132 rendered flights it is 0.14, in 33 violent ones 0.26.
_VERTICAL_STD = 0.3
#: Why nothing begins with a vague pose.
TWO_POSES = Condition('two poses are possible', 'neither gravity nor motion shows which; move, or show another marker')


def blank_state(config: PoseEkfConfig) -> NavigationState:
    """The state before the first pose, as the parameters give it."""
    return NavigationState(
        R_map_body=np.eye(3),
        velocity=np.zeros(3),
        position=np.zeros(3),
        bias=np.zeros(6),
        scale=np.zeros((2, 3, 3)),
        force_delay=0.0,
        gravity=np.array([0.0, 0.0, -config.gravity]),
        time_offset=0.0,
        T_body_camera=camera_in_body(config),
        systematic=np.zeros(6),
        T_map_markers=np.eye(4),
    )


def start(
    config: PoseEkfConfig, pose: BodyPose, stamp_ns: int, prior: NavigationState, imu: FloatArray
) -> Estimate | Condition:
    """Estimate at a first pose, or why nothing begins with it: two are possible, or it contradicts gravity.

    Parameters
    ----------
    stamp_ns : instant of the pose in the IMU's clock
    prior : state that gives biases, scale errors, gravity, clock offset and extrinsics
    imu : (N, 6) samples up to the pose's instant, the last one at that instant
    """
    if math.sqrt(pose.covariance[:3, :3].trace()) > VAGUE:
        return TWO_POSES
    if (contradiction := _contradiction_of_gravity(pose, imu, config.gravity)) is not None:
        return contradiction
    noise = PoseNoise.of(pose, config.stamp_jitter, config.mount_vibration)
    P = np.diag(_initial_variances(config))
    P[SYSTEMATIC, SYSTEMATIC] = config.systematic_pose_std**2 * pose.shape
    P[np.ix_(POSE, POSE)] += noise.variances[0] * pose.shape
    # A systematic error of the pose is an error of the estimate, with the opposite sign.
    for place in (SYSTEMATIC, EXTRINSICS):
        systematic = P[place, place]
        P[np.ix_(POSE, POSE)] += systematic
        P[POSE, place] -= systematic
        P[place, POSE] -= systematic
    state = replace(
        prior,
        R_map_body=pose.T_map_body[:3, :3],
        position=pose.T_map_body[:3, 3],
        velocity=np.zeros(3),
        systematic=np.zeros(6),
        T_map_markers=np.eye(4),
    )
    if config.estimate_time_offset:
        P += _of_unknown_clock(config, state, imu[-1])
    return Estimate(stamp_ns, state, P, pose_noise=noise)


def cost_of_vertical(pose: BodyPose, imu: FloatArray) -> float:
    """Chi square of the angle between a pose's vertical and the mean specific force of samples (N, 6)."""
    up, force = pose.T_map_body[2, :3], imu.mean(axis=0)[3:]
    tilt = math.atan2(float(np.linalg.norm(np.cross(up, force))), float(up @ force))
    return (tilt / _VERTICAL_STD) ** 2


def _contradiction_of_gravity(pose: BodyPose, imu: FloatArray, gravity: float) -> Condition | None:
    """That the mean specific force of samples (N, 6) is not ``gravity`` [m/s^2] in direction or size; None if it is."""
    up, force = pose.T_map_body[2, :3], imu.mean(axis=0)[3:]
    size = float(np.linalg.norm(force))
    if up @ force >= math.cos(LARGEST_TILT) * size and abs(size - gravity) <= HARDLY_GRAVITY * gravity:
        return None
    measured = ' '.join(f'{value:.1f}' for value in force)
    details = f'the IMU says {measured} m/s^2; its axes, sign, units? camera_orientation? z of the map?'
    return Condition('poses contradict gravity', details)


def _of_unknown_clock(config: PoseEkfConfig, state: NavigationState, imu: FloatArray) -> FloatArray:
    """Covariance (55, 55) by an unknown clock offset s; ``imu`` (6,) is the latest sample.

    The first pose measures the state at the camera's stamp, X(t + s) = X(t) Exp(derivative s).
    """
    error = clock_offset_derivative(state.derivative(imu))
    covariance = np.outer(error, error)
    # Second order: clock offset times the unknown velocity.
    covariance[POSITION, POSITION] += np.eye(3) * config.initial_velocity_std**2
    return np.asarray(config.time_offset_std**2 * covariance)


def _initial_variances(config: PoseEkfConfig) -> FloatArray:
    """(55,) prior variances of all that the first pose does not measure."""
    stds = np.zeros(SIZE)
    stds[VELOCITY] = config.initial_velocity_std
    stds[GYROSCOPE_BIAS] = config.initial_gyroscope_bias_std
    stds[ACCELEROMETER_BIAS] = config.initial_accelerometer_bias_std
    stds[GYROSCOPE_MATRIX] = config.imu.gyroscope_scale_std
    stds[ACCELEROMETER_MATRIX] = config.imu.accelerometer_scale_std
    stds[FORCE_DELAY] = config.imu.accelerometer_delay_std
    stds[GRAVITY] = config.gravity * config.map_tilt_std
    stds[EXTRINSICS] = np.repeat((config.extrinsics_orientation_std, config.extrinsics_position_std), 3)
    return np.square(stds)
