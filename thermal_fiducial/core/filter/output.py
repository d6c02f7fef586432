"""What the filter gives: odometry in ROS conventions, of another frame or without steps if asked for; its condition."""

from dataclasses import replace
import math
from typing import NamedTuple

import numpy as np

from thermal_fiducial.config import PoseEkfConfig
from thermal_fiducial.core.filter.belief import Belief, Hypothesis
from thermal_fiducial.core.filter.history import History, STEPS
from thermal_fiducial.core.filter.state import (
    CORE,
    Estimate,
    FORCE_DELAY,
    GRAVITY,
    NavigationState,
    POSE,
    POSITION,
    PUBLISHED,
    ROTATION,
    SIZE,
    VELOCITY,
)
from thermal_fiducial.core.filter.update import pose_error
from thermal_fiducial.core.geometry.se3 import inverse, lever_arm, skew, so3_exp, so3_log, transform, twist_transfer
from thermal_fiducial.core.measurements import Condition, Odometry
from thermal_fiducial.core.types import FloatArray, SECOND_NS

#: (12, 18) Jacobian of position, rotation, velocity and rate of the robot by the core's errors, the gyroscope's bias
#: and a motion of the map about its origin, without the blocks that depend on attitude, velocity and position.
_AT_REST = np.zeros((12, 18))
_AT_REST[6:9, VELOCITY] = np.eye(3)
_AT_REST[9:, 9:12] = -np.eye(3)
_AT_REST[:6, 12:] = np.eye(6)
#: Flat indices of the rate's variances in a (12, 12) matrix.
_RATE_VARIANCES = slice(9 * 13, None, 13)
# Shortest time [ns] in which a refused pose may have moved the robot.
_SHORTEST_NS = 10_000_000
#: A correction beyond this [m] is a new start of the filter: spreading it would only prolong the error.
LARGEST_STEP = 1.0
# 99.9 % quantile of chi square with two degrees of freedom. Recorded maps lean by 1 deg, and are at 12.3 at most.
_LEANS = 13.8
#: Conditions that a node compares with.
TRACKING, WAITING = Condition('tracking'), Condition('waiting for markers')
#: Time without an accepted pose after which the filter is said to coast [s].
COASTING_S = 0.5


class OtherEstimate(NamedTuple):
    """Another estimate of the same instant, and the odds, 0 to 1, that it is the right one."""

    estimate: Estimate
    odds: float


def contradicting(history: History) -> OtherEstimate | None:
    """Another estimate at the newest sample, if the latest poses contradict the main one.

    It is the alternative if they support it, else, as with an IMU that contradicts all poses, where the last of them
    has the robot. Also one without the time of a jump of the IMU's stamps, until the delay of poses shows whether it
    has passed.
    """
    if history.stepped:
        return OtherEstimate(history.stepped.estimate, STEPS)
    main, other, newest_ns = history.main, history.belief.alternative, history.imu.newest_ns
    if main is None or not main.in_doubt:
        return None
    if other is None or other.hits < history.config.initial_poses:
        return OtherEstimate(_by_refused(main, newest_ns), 1.0)
    return OtherEstimate(history.carried(other, newest_ns).estimate, 1.0)


def _by_refused(main: Hypothesis, newest_ns: int) -> Estimate:
    """``main`` where its last refused pose has it, at the mean velocity that has led there since it was right."""
    error = np.zeros(SIZE)
    seconds = max(newest_ns - main.accepted_ns, _SHORTEST_NS) / SECOND_NS
    error[POSE], error[VELOCITY] = main.against, main.against[3:] / seconds
    return replace(main.estimate, state=main.estimate.state.plus(error))


def odometry(history: History, main: Hypothesis) -> Odometry:
    """Odometry at the newest IMU sample, to which ``main`` is propagated.

    Another estimate that contradicts it widens the covariance by its own, and by the square of the difference times its
    odds.
    """
    estimate, sample, against = main.estimate, history.imu.last, contradicting(history)
    state = estimate.state
    R, velocity_body = state.R_map_body, state.velocity_body
    joint = np.zeros((18, 18))
    joint[PUBLISHED, PUBLISHED] = estimate.covariance[PUBLISHED, PUBLISHED]
    joint[12:, 12:] = estimate.pose_noise.of_map
    if against:
        other = against.estimate
        apart = _difference(state, other.state)
        joint[CORE, CORE] += other.covariance[CORE, CORE] + against.odds * np.outer(apart, apart)
    # Position and rotation errors turn from the robot frame into the map; that of v_body depends on nu and phi.
    J = _AT_REST.copy()
    J[0:3, POSITION] = J[3:6, ROTATION] = R
    J[6:9, ROTATION], J[:3, 15:] = skew(velocity_body), -skew(state.position)
    covariance = J @ joint @ J.T
    covariance.reshape(-1)[_RATE_VARIANCES] += float(sample.densities[0]) ** 2 / sample.seconds
    return Odometry(
        estimate.stamp_ns,
        state.T_map_body,
        velocity_body,
        state.corrected(sample.imu)[:3],
        covariance[:6, :6],
        covariance[6:, 6:],
    )


def _difference(state: NavigationState, other: NavigationState) -> FloatArray:
    """Core error (9,) of ``state`` if ``other`` is the true state."""
    apart = pose_error(state, other.T_map_body)
    velocity = (other.velocity - state.velocity) @ state.R_map_body
    return np.concatenate((apart[:3], velocity, apart[3:]))


def in_frame(odometry: Odometry, T_body_frame: FloatArray) -> Odometry:
    """Odometry of another frame on the same rigid body, at ``T_body_frame`` (4, 4)."""
    T_map_body = odometry.T_map_body
    pose, twist = lever_arm(T_map_body[:3, :3] @ T_body_frame[:3, 3]), twist_transfer(T_body_frame)
    velocities = twist @ np.concatenate((odometry.velocity_body, odometry.angular_velocity_body))
    return replace(
        odometry,
        T_map_body=T_map_body @ T_body_frame,
        velocity_body=velocities[:3],
        angular_velocity_body=velocities[3:],
        pose_covariance=pose @ odometry.pose_covariance @ pose.T,
        twist_covariance=twist @ odometry.twist_covariance @ twist.T,
    )


class SmoothOutput:
    """A pose without steps, for controllers that need one: it lags behind, and its covariance is not consistent.

    It integrates the filter's twist, and approaches the filter's pose with a time constant. Where stamps go back it
    begins again.
    """

    def __init__(self, seconds: float) -> None:
        """``seconds``: time constant [s]."""
        self._seconds = seconds
        #: number of poses that do not continue the one before
        self.jumps = 0
        self._consistent: Odometry | None = None
        self._T = np.eye(4)

    def follow(self, odometry: Odometry) -> Odometry:
        """Odometry with the smooth pose; its covariance and twist are the filter's."""
        if self._consistent is None or odometry.stamp_ns <= self._consistent.stamp_ns:
            self._T, share = odometry.T_map_body, 0.0
        else:
            dt = (odometry.stamp_ns - self._consistent.stamp_ns) / SECOND_NS
            left = inverse(odometry.T_map_body) @ self._T @ _motion(self._consistent, odometry, dt)
            share = math.exp(-dt / self._seconds) if np.linalg.norm(left[:3, 3]) < LARGEST_STEP else 0.0
            rotation = so3_exp(share * so3_log(left[:3, :3]))
            self._T = odometry.T_map_body @ transform(rotation, share * left[:3, 3])
        self.jumps += share == 0.0
        self._consistent = odometry
        return replace(odometry, T_map_body=self._T)

    def begin_again(self) -> None:
        """Take over the filter's next pose as it is: nobody flies on those before."""
        self._consistent = None


def _motion(before: Odometry, now: Odometry, dt: float) -> FloatArray:
    """T_before_now (4, 4) by the mean of both twists."""
    rotation = so3_exp(0.5 * dt * (before.angular_velocity_body + now.angular_velocity_body))
    return transform(rotation, 0.5 * dt * (before.velocity_body + rotation @ now.velocity_body))


def coasting_seconds(history: History, main: Hypothesis) -> float:
    """Time from the last accepted pose to the newest sample [s]."""
    return (history.imu.newest_ns - main.accepted_ns) / SECOND_NS


def condition_of(history: History, config: PoseEkfConfig) -> Condition:
    """The condition of the filter."""
    if not history.imu:
        return Condition('waiting for IMU')
    main = history.main
    if main is None:
        return _without_estimate(history.belief, config)
    if main.estimate.position_std > config.lost_position_std:
        return Condition('lost', f'position known to {main.estimate.position_std:.2f} m')
    if main.in_doubt:
        return Condition('in doubt', f'{main.refused_in_row} poses in a row contradict the estimate')
    coasting = coasting_seconds(history, main)
    return Condition('coasting', f'{coasting:.1f} s without a pose') if coasting > COASTING_S else TRACKING


def _without_estimate(belief: Belief, config: PoseEkfConfig) -> Condition:
    """The condition before there is an estimate: what contradicts the poses, how many agree, or that none has come."""
    if belief.contradiction is not None:
        return belief.contradiction
    begun = belief.alternative
    return Condition('initialising', f'{begun.hits} of {config.initial_poses} poses') if begun else WAITING


def leaning_map(estimate: Estimate, state: NavigationState, config: PoseEkfConfig) -> Condition | None:
    """That the present map leans against gravity by more than is declared.

    Before one heading an accelerometer's bias looks the same; only turns show which of the two it is. What the map
    itself is bent by is no lean.

    Parameters
    ----------
    state : that of ``estimate``, in the present map
    """
    tilt, covariance = state.gravity[:2], estimate.covariance[GRAVITY, GRAVITY]
    in_first = tilt @ (state.R_map_body @ estimate.state.R_map_body.T)[:2, :2]
    of_map = float(estimate.pose_noise.of_map.diagonal()[3:5].sum())
    square, claimed = float(tilt @ tilt), config.gravity**2 * (config.map_tilt_std**2 + of_map)
    if square**2 <= _LEANS * (claimed * square + float(in_first @ covariance @ in_first)):
        return None
    # What is declared keeps the estimate near to it.
    off, says = math.sqrt(square) / config.gravity, math.degrees(config.map_tilt_std)
    by = f'by {math.degrees(off):.1f} deg or more against gravity, map_tilt_std says {says:.1f}'
    return Condition('the map leans', f'{by}: level it, or write map_tilt_std: {off:.3f}')


def figures_of(history: History, main: Hypothesis, state: NavigationState) -> dict[str, float]:
    """Figures of the estimate ``main`` for the diagnostics (SI units).

    ``state``: that of ``main``, in the present map.
    """
    white, jitter, vibration = main.estimate.pose_noise.stds
    return {
        'seconds since accepted pose': coasting_seconds(history, main),
        'position std': main.estimate.position_std,
        'white pose error': white,
        'stamp jitter': jitter,
        'mount vibration': vibration,
        'gyroscope bias': float(np.linalg.norm(state.bias[:3])),
        'accelerometer bias': float(np.linalg.norm(state.bias[3:])),
        'gyroscope scale error': float(np.abs(state.scale[0]).max()),
        'accelerometer scale error': float(np.abs(state.scale[1]).max()),
        'accelerometer delay': state.force_delay,
        'accelerometer delay std': main.estimate.std(FORCE_DELAY),
        'map tilt': math.atan2(np.hypot(*state.gravity[:2]), -state.gravity[2]),
    }
