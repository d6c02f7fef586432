"""What the filter does, or what it lacks, in words; what it has estimated, in numbers."""

import math

import numpy as np

from thermal_fiducial.config import PoseEkfConfig
from thermal_fiducial.core.filter.belief import Belief, Hypothesis
from thermal_fiducial.core.filter.history import History
from thermal_fiducial.core.measurements import Condition
from thermal_fiducial.core.types import FloatArray, SECOND_NS

#: Conditions that a node compares with.
TRACKING, WAITING = Condition('tracking'), Condition('waiting for markers')
#: Time without an accepted pose after which the filter is said to coast [s].
COASTING_S = 0.5


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
    if belief.contradiction is not None:
        return belief.contradiction
    begun = belief.alternative
    return Condition('initialising', f'{begun.hits} of {config.initial_poses} poses') if begun else WAITING


def figures_of(history: History, main: Hypothesis, T_map_first: FloatArray, gravity: float) -> dict[str, float]:
    """Figures of the estimate ``main`` for the diagnostics (SI units).

    ``T_map_first`` (4, 4): the map that it is in, in the present one; ``gravity``: its size.
    """
    state, noise = main.estimate.state.in_moved_map(T_map_first), main.estimate.pose_noise
    return {
        'seconds since accepted pose': coasting_seconds(history, main),
        'position std': main.estimate.position_std,
        'white pose error': math.sqrt(noise.white.value),
        'stamp jitter': math.sqrt(noise.jitter.value),
        'mount vibration': math.sqrt(noise.vibration.value),
        'gyroscope bias': float(np.linalg.norm(state.bias[:3])),
        'accelerometer bias': float(np.linalg.norm(state.bias[3:])),
        'gyroscope scale error': float(np.abs(state.scale[0]).max()),
        'accelerometer scale error': float(np.abs(state.scale[1]).max()),
        'map tilt': math.asin(float(np.hypot(*state.gravity[:2])) / gravity),
    }
