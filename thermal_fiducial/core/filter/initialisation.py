"""The state at a first pose: the pose itself, gravity and gyroscope bias from stillness, the rest wide open.

Nothing else is needed in motion: the pose error is linear in the error coordinates, thus the next two or three
poses settle velocity and tilt whatever they were.
"""

from dataclasses import dataclass, replace
import math

import numpy as np

from thermal_fiducial.config import PoseEkfConfig
from thermal_fiducial.core.filter.clock_steps import ClockSteps
from thermal_fiducial.core.filter.error_state import BodyPose, ErrorStateFilter
from thermal_fiducial.core.filter.learned_noise import Aliasing, StampJitter
from thermal_fiducial.core.filter.navigation_state import (
    ACCELEROMETER_BIAS,
    GYROSCOPE_BIAS,
    Layout,
    NavigationState,
    POSE,
    POSITION,
    ROTATION,
    VELOCITY,
)
from thermal_fiducial.core.geometry.se3 import transform_from_quaternion
from thermal_fiducial.core.types import FloatArray

#: Seconds of samples that stillness is judged on, and the fewest of them.
WINDOW_SECONDS, FEWEST_SAMPLES = 0.5, 20
#: At rest the samples scatter less than this [rad/s, m/s^2] ...
STILL_RATE_STD, STILL_FORCE_STD = 0.02, 0.3
#: ... and their mean is a plausible gyroscope bias [rad/s] and gravity with accelerometer bias [m/s^2].
STILL_RATE, STILL_FORCE = 0.1, 0.6
#: At rest no accelerometer is off gravity by so much [m/s^2], nor by such a share of it over a window of a flight: its
#: units are others.
NO_GRAVITY, HARDLY_GRAVITY = 2.0, 0.5
#: What the mean of such a window is worth: a drone on its legs or in a hand still moves a little [rad/s, m/s^2].
RATE_STD, FORCE_STD = 0.005, 0.05
#: A first pose whose vertical is further than this [rad] from the specific force is of the wrong planar branch.
LARGEST_TILT = math.radians(35.0)


@dataclass(frozen=True, slots=True)
class Rest:
    """Mean rate (3,) [rad/s] and specific force (3,) [m/s^2] of a robot at rest."""

    rate: FloatArray
    force: FloatArray


def rest(imu: FloatArray, gravity: float) -> Rest | None:
    """What an IMU window (N, 6) says if the robot stood still in it."""
    mean = imu.mean(axis=0)
    level = abs(np.linalg.norm(mean[3:]) - gravity) < STILL_FORCE
    return Rest(mean[:3], mean[3:]) if level and _quiet(imu) else None


def _quiet(imu: FloatArray) -> bool:
    """Whether samples (N, 6) hardly scatter, about hardly any rate."""
    if len(imu) < FEWEST_SAMPLES:
        return False
    std = imu.std(axis=0)
    quiet = std[:3].max() < STILL_RATE_STD and std[3:].max() < STILL_FORCE_STD
    return bool(quiet and np.linalg.norm(imu.mean(axis=0)[:3]) < STILL_RATE)


def blank_state(config: PoseEkfConfig, layout: Layout) -> NavigationState:
    """What is known before the first pose: the parameters."""
    return NavigationState(
        R_map_body=np.eye(3),
        velocity=np.zeros(3),
        position=np.zeros(3),
        bias=np.zeros(6),
        gyroscope_scale=np.zeros((3, 3)),
        gravity=np.array([0.0, 0.0, -config.gravity]),
        time_offset=0.0,
        clock_open=False,
        T_body_camera=transform_from_quaternion(config.camera_position, config.camera_orientation),
        stamp_jitter=StampJitter.of(config.stamp_jitter),
        aliasing=Aliasing(),
        clock_steps=ClockSteps.none(layout.size),
        covariance=np.zeros((layout.size, layout.size)),
    )


def start(
    config: PoseEkfConfig, filter_: ErrorStateFilter, pose: BodyPose, prior: NavigationState, imu: FloatArray
) -> NavigationState | None:
    """State at a first pose, or None where the pose contradicts gravity, or there is none in what the IMU measures.

    Parameters
    ----------
    prior : biases, gravity and offsets to begin with; its covariance doesn't count
    imu : (N, 6) samples up to the pose's instant, the last one at that instant
    """
    up = pose.T_map_body[2, :3]
    force = imu.mean(axis=0)[3:]
    if up @ force < math.cos(LARGEST_TILT) * np.linalg.norm(force):
        return None
    off = abs(float(np.linalg.norm(force)) - config.gravity)
    if off > (NO_GRAVITY if _quiet(imu) else HARDLY_GRAVITY * config.gravity):
        return None
    state = _unaligned(config, filter_.layout, pose, prior)
    still = rest(imu, config.gravity)
    if still:
        # A slow flight may be as quiet: the larger the mean rate, the rather it is one, and the less it says.
        doubt = max(float(np.linalg.norm(still.rate)) / RATE_STD, 1.0)
        state, _ = filter_.align(state, still.force, doubt * FORCE_STD)
        state, _ = filter_.settle(state, still.rate, doubt * RATE_STD)
    return state


def _unaligned(config: PoseEkfConfig, layout: Layout, pose: BodyPose, prior: NavigationState) -> NavigationState:
    variances = np.zeros(layout.size)
    variances[ROTATION], variances[POSITION] = config.attitude_floor**2, config.position_floor**2
    variances[VELOCITY] = config.initial_velocity_std**2
    variances[GYROSCOPE_BIAS] = config.initial_gyroscope_bias_std**2
    variances[ACCELEROMETER_BIAS] = config.initial_accelerometer_bias_std**2
    if layout.gravity:
        variances[layout.gravity] = (config.gravity * config.map_tilt_std) ** 2
    if layout.extrinsics:
        stds = (config.extrinsics_orientation_std, config.extrinsics_position_std)
        variances[layout.extrinsics] = np.repeat(np.square(stds), 3)
    if layout.gyroscope_scale:
        variances[layout.gyroscope_scale] = config.imu.gyroscope_scale_std**2
    P = np.diag(variances)
    P[np.ix_(POSE, POSE)] += pose.covariance
    return replace(
        prior,
        R_map_body=pose.T_map_body[:3, :3],
        position=pose.T_map_body[:3, 3],
        velocity=np.zeros(3),
        clock_open=False,
        clock_steps=ClockSteps.none(layout.size, prior.clock_steps.found),
        covariance=P,
    )
