"""Propagation of state and error covariance along the IMU samples, and how long the pose stays usable on them alone.

Over a step, rate and specific force are constant, and so is the generator A of the left-invariant error: d xi/dt = A xi
+ B n, where n is the error of rate and force. The transition exp(A dt) and the input matrix, the integral of exp(A s) B
from 0 to dt, are exact; rotation and displacement of the step are blocks of them.

Sources: A. Barrau, S. Bonnabel, "The Invariant Extended Kalman Filter as a Stable Observer", IEEE TAC 2017; C. Van
Loan, "Computing Integrals Involving the Matrix Exponential", IEEE TAC 1978.
"""

from bisect import bisect_left
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from thermal_fiducial.config import PoseEkfConfig
from thermal_fiducial.core.filter.imu_buffer import Steps
from thermal_fiducial.core.filter.imu_noise import bias_walks
from thermal_fiducial.core.filter.state import (
    ACCELEROMETER_BIAS,
    BIAS,
    CORE,
    Estimate,
    FORCE_DELAY,
    GRAVITY,
    GYROSCOPE_BIAS,
    MOVED_BY,
    NavigationState,
    POSITION,
    ROTATION,
    SCALES,
    SIZE,
    TIME_OFFSET,
    VELOCITY,
)
from thermal_fiducial.core.geometry.se3 import SKEW
from thermal_fiducial.core.types import FloatArray, SECOND_NS

_IDENTITY = np.eye(9)
#: Longest time of coasting that is looked ahead [s], and its resolution [s]. A time of hover is divided into so many
#: steps: the exponential is exact for any, the deviation by white noise and walks to 3 per mille.
HORIZON, _TICK, _STEPS = 60.0, 0.05, 10


def _generators() -> FloatArray:
    """(6, 81) basis of the generator by rate and force, row by row."""
    basis = np.zeros((6, 9, 9))
    crosses = SKEW.reshape(3, 3, 3)
    for place in (ROTATION, VELOCITY, POSITION):
        basis[:3, place, place] = -crosses
    basis[3:6, VELOCITY, ROTATION] = -crosses
    return basis.reshape(6, 81)


_BY_IMU, _BY_VELOCITY = _generators(), np.zeros((9, 9))
_BY_VELOCITY[POSITION, VELOCITY] = np.eye(3)


class StepMatrices(NamedTuple):
    """For N steps: transition (N, 9, 9) of the core's error, and its Jacobian (N, 9, 6) by errors of rate and force."""

    transition: FloatArray
    by_imu: FloatArray


def step_matrices(imu: FloatArray, seconds: FloatArray) -> StepMatrices:
    """Matrices of steps of constant rate and specific force ``imu`` (N, 6) that last ``seconds`` (N,)."""
    dt = seconds[:, None, None]
    A = ((imu @ _BY_IMU).reshape(-1, 9, 9) + _BY_VELOCITY) * dt
    square = A @ A
    # The mean of the exponential over the step, sum_k (A dt)^k / (k + 1)!: exact to 1e-13 for a turn of 0.03 rad, of a
    # brisk flight sampled at 100 Hz, and to 2e-10 for 0.1 rad, over a gap.
    mean = _IDENTITY + A / 2.0 + square / 6.0 + square @ A @ (_IDENTITY / 24.0 + A / 120.0 + square / 720.0)
    return StepMatrices(_IDENTITY + A @ mean, mean[..., :6] * dt)


def random_walks(config: PoseEkfConfig) -> FloatArray:
    """Squared densities (55,) of the random walks of the parameters."""
    walks = np.zeros(SIZE)
    walks[GYROSCOPE_BIAS], walks[ACCELEROMETER_BIAS] = bias_walks(config.imu)
    walks[TIME_OFFSET] = config.time_offset_random_walk
    return np.square(walks)


def propagated(estimate: Estimate, steps: Steps, stamp_ns: int, walks: FloatArray) -> Estimate:
    """The estimate after ``steps`` that end at ``stamp_ns``; ``walks`` (55,) of :func:`random_walks`."""
    state = estimate.state
    imu = state.corrected(steps.imu)
    # A late reading of the force is that of an instant before.
    imu[:, 3:] += state.force_delay * steps.force_slope
    matrices = step_matrices(imu, steps.seconds)
    R_map_body, velocity, position = _moved(state, matrices, imu, steps.seconds)
    transitions = _transitions(matrices, R_map_body, steps)
    by_imu = matrices.by_imu
    variances = steps.densities * steps.densities / steps.seconds[:, None]
    noises = (by_imu * variances[:, None]) @ by_imu.swapaxes(-1, -2)
    P = estimate.covariance.copy()
    diagonal = P.reshape(-1)[:: SIZE + 1]
    for transition, noise, dt in zip(transitions, noises, steps.seconds.tolist(), strict=True):
        cross = transition @ P[MOVED_BY]
        P[CORE] = cross
        P[:, CORE] = cross.T
        P[CORE, CORE] = cross[:, MOVED_BY] @ transition.T + noise
        diagonal += walks * dt
    moved = replace(state, R_map_body=R_map_body[-1], velocity=velocity, position=position)
    return replace(estimate, stamp_ns=stamp_ns, state=moved, covariance=P)


def _moved(
    state: NavigationState, matrices: StepMatrices, imu: FloatArray, seconds: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """R_map_body (N, 3, 3) after each step; velocity and position (3,) after the last."""
    R, velocity, position = state.R_map_body, state.velocity, state.position
    turns = matrices.transition[:, ROTATION, ROTATION].swapaxes(-1, -2)
    # Increments of velocity and position by the specific force, in the robot frame at the end of the step.
    gained = (matrices.by_imu[:, 3:, 3:] @ imu[:, 3:, None]).reshape(-1, 2, 3)
    rotations = np.empty_like(turns)
    for step, dt in enumerate(seconds.tolist()):
        rotations[step] = R = R @ turns[step]
        faster, farther = gained[step] @ R.T
        fall = state.gravity * dt
        position = position + (velocity + 0.5 * fall) * dt + farther
        velocity = velocity + fall + faster
    return rotations, velocity, position


def _transitions(matrices: StepMatrices, R_map_body: FloatArray, steps: Steps) -> FloatArray:
    """(N, 9, 36) Jacobians of the core's error by the coordinates ``MOVED_BY``; ``R_map_body`` after each step."""
    dt = steps.seconds[:, None, None]
    transitions = np.zeros((len(dt), 9, 36))
    transitions[..., CORE] = matrices.transition
    transitions[..., BIAS] = -matrices.by_imu
    # A scale error acts as a bias of scale times reading.
    shares = matrices.by_imu.reshape(-1, 9, 2, 3, 1) * steps.imu.reshape(-1, 1, 2, 1, 3)
    transitions[..., SCALES] = -shares.reshape(-1, 9, 18)
    of_delay = matrices.by_imu[..., 3:] @ steps.force_slope[..., None]
    transitions[..., FORCE_DELAY] = of_delay[..., 0]
    fallen = R_map_body[:, :2].swapaxes(-1, -2) * dt
    transitions[:, VELOCITY, GRAVITY] = fallen
    transitions[:, POSITION, GRAVITY] = fallen * (0.5 * dt)
    return transitions


def usable_seconds(estimate: Estimate, densities: FloatArray, walks: FloatArray, position_std: float) -> float:
    """Seconds [s] of coasting until the position is worse than ``position_std`` [m]; at most ``HORIZON``."""
    ticks = range(round(HORIZON / _TICK))
    return _TICK * bisect_left(
        ticks, True, key=lambda tick: hovered(estimate, densities, walks, _TICK * tick).position_std > position_std
    )


def hovered(estimate: Estimate, densities: FloatArray, walks: FloatArray, seconds: float) -> Estimate:
    """The estimate after ``seconds`` of hover without poses.

    Parameters
    ----------
    densities : (6,) noise of gyroscope and accelerometer [rad/s/sqrt(Hz), m/s^2/sqrt(Hz)]
    walks : (55,) of :func:`random_walks`
    """
    if seconds == 0.0:
        return estimate
    state = estimate.state
    # The reading that holds the robot still in the air, by the estimate.
    hover = np.concatenate((np.zeros(3), -state.gravity @ state.R_map_body))
    exact = replace(state, bias=np.zeros(6), scale=np.zeros((2, 3, 3)), velocity=np.zeros(3))
    steps = Steps(
        imu=np.tile(hover, (_STEPS, 1)),
        seconds=np.full(_STEPS, seconds / _STEPS),
        densities=np.tile(densities, (_STEPS, 1)),
        force_slope=np.zeros((_STEPS, 3)),
    )
    # What walks in a step counts from its middle on, not from its end.
    half = np.diag(walks * (0.5 * seconds / _STEPS))
    begun = replace(estimate, state=exact, covariance=estimate.covariance + half)
    ended = propagated(begun, steps, estimate.stamp_ns + round(seconds * SECOND_NS), walks)
    return replace(ended, covariance=ended.covariance - half)
