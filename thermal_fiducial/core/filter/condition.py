"""What the filter does, or what it lacks, in words."""

from thermal_fiducial.config import PoseEkfConfig
from thermal_fiducial.core.filter.belief import Belief, Hypothesis
from thermal_fiducial.core.filter.history import History
from thermal_fiducial.core.measurements import Condition
from thermal_fiducial.core.types import SECOND_NS

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
