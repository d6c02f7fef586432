"""Hypotheses: how they are initialised, and updated by poses that pass the gate."""

from dataclasses import replace
import math

import numpy as np

from thermal_fiducial.config import PoseEkfConfig
from thermal_fiducial.core.filter.belief import Hypothesis, PoseUpdate
from thermal_fiducial.core.filter.initialization import blank_state, cost_of_vertical, start
from thermal_fiducial.core.filter.state import POSE, TIME_OFFSET
from thermal_fiducial.core.filter.update import (
    adapted_noise,
    body_pose,
    corrected,
    Innovation,
    with_covariance,
    with_unknown_clock,
)
from thermal_fiducial.core.measurements import CameraPose, Condition
from thermal_fiducial.core.types import FloatArray, SECOND_NS

#: Standard deviation [s] below which the clock offset counts as known, and the least that an alternative hypothesis
#: begins with: in the fastest flights it moves a marker by a pixel or two.
KNOWN_OFFSET_STD = 0.003
#: Standard deviations by which the first poses must have moved the clock offset for them to be used once more.
_MOVED_OFFSET = 3.0
#: A pose is far if it fails the gate even with the estimate's standard deviations times _FAR_TOO_SURE and _FAR [rad, m]
#: added: probably a moved or duplicated marker. An alternative hypothesis that begins there needs as many poses as the
#: estimate has accepted, at most _ENOUGH_POSES. Nearer ones need fewer: coasting for long would do more harm.
_FAR_TOO_SURE, _FAR, _ENOUGH_POSES = 10.0, np.repeat([0.05, 0.2], 3), 300


def weigh(
    config: PoseEkfConfig, hypothesis: Hypothesis, innovation: Innovation, stamp_ns: int
) -> tuple[Hypothesis, PoseUpdate]:
    """A hypothesis after a pose with a camera stamp, and the verdict on the pose.

    One that has coasted longer than ``reinitialise_after`` must not be corrected any more. One in doubt stays so until
    the poses that it accepts would have shown the error that the refused ones claim: a pose of a single marker may be
    so vague that it agrees with an estimate which is metres off.
    """
    estimate, nis = innovation.estimate, innovation.nis
    hypothesis = hypothesis._replace(cost=hypothesis.cost + min(nis, config.gate))
    coasted = (estimate.stamp_ns - hypothesis.accepted_ns) / SECOND_NS
    stale = coasted > config.reinitialise_after
    if nis <= config.gate and not stale:
        accepted, after = PoseUpdate(stamp_ns, True, '', nis), corrected(config, innovation)
        if hypothesis.in_doubt and (shown := _shown(hypothesis, innovation)) <= config.gate:
            return hypothesis.staying_in_doubt(after, shown), accepted
        return hypothesis.accepting(after), accepted
    refusing = hypothesis.refusing(replace(estimate, pose_noise=adapted_noise(innovation)), innovation.value)
    why = f'after {coasted:.0f} s without one' if stale else f'{math.sqrt(nis):.1f} sigma'
    return refusing, PoseUpdate(stamp_ns, False, f'refused: {why}', nis)


def _shown(hypothesis: Hypothesis, innovation: Innovation) -> float:
    """NIS that the poses accepted since the latest refused one would have together if they were off as that one.

    Without that of its noise, which is all that a vague pose has: its mean is the number of degrees of freedom.
    """
    against = hypothesis.against
    return hypothesis.shown + max(0.0, float(against @ innovation.S_inverse @ against) - len(against))


def contradiction(config: PoseEkfConfig, hypothesis: Hypothesis, innovation: Innovation) -> Condition:
    """Which sensor of the IMU a pose contradicts that the ``hypothesis`` refuses."""
    turn, shift = innovation.value[:3], innovation.value[3:]
    seconds = (innovation.estimate.stamp_ns - hypothesis.accepted_ns) / SECOND_NS
    # The turn has half of the degrees of freedom.
    if turn @ np.linalg.solve(innovation.S[:3, :3], turn) > 0.5 * config.gate:
        apart = f'{math.degrees(np.linalg.norm(turn)):.0f} deg apart after {seconds:.2f} s'
        return Condition('poses contradict the gyroscope', f'{apart}; its units, axes, sign? camera_orientation?')
    apart = f'{np.linalg.norm(shift):.2f} m apart after {seconds:.2f} s'
    return Condition(
        'poses contradict the accelerometer, or each other', f'{apart}; its units, axes, sign? marker_size?'
    )


def passes_with_unknown_clock(config: PoseEkfConfig, innovation: Innovation) -> bool:
    """Whether a pose passes the gate once the clock offset is treated as unknown."""
    covariance = with_unknown_clock(config, innovation.estimate.covariance)
    return with_covariance(config, innovation, covariance).nis <= config.gate


def first_hypothesis(
    config: PoseEkfConfig, pose: CameraPose, time_ns: int, window: FloatArray, time_offset: float
) -> Hypothesis | Condition:
    """A hypothesis initialised from a pose without prior, or why none begins with it.

    Parameters
    ----------
    window : (N, 6) the latest samples up to the pose's instant ``time_ns``
    time_offset : clock offset [s], beyond the parameter's, about which to linearise
    """
    blank = replace(blank_state(config), time_offset=time_offset)
    measured = body_pose(pose, blank.T_body_camera, config.pose_noise_scale)
    estimate = start(config, measured, time_ns, blank, window)
    if isinstance(estimate, Condition):
        return estimate
    return Hypothesis(estimate, time_ns, time_ns, time_ns, cost=cost_of_vertical(measured, window))


def relinearises(begun: Hypothesis, first_offset: float) -> bool:
    """Whether a hypothesis that began at ``first_offset`` [s] has learned another clock offset."""
    estimate = begun.estimate
    moved = abs(estimate.state.time_offset - first_offset)
    return moved > max(KNOWN_OFFSET_STD, _MOVED_OFFSET * estimate.std(TIME_OFFSET))


def alternative_to(
    config: PoseEkfConfig, main: Hypothesis, innovation: Innovation, window: FloatArray
) -> Hypothesis | None:
    """A hypothesis initialised from a pose that ``main`` refuses; None where nothing begins with it.

    Position and attitude are those of the pose; biases, scale errors and extrinsics are those of ``main``. The clock
    offset is as uncertain as the parameter says where that explains why the pose is refused, else as that of ``main``.

    Parameters
    ----------
    window : (N, 6) the latest samples up to the pose's instant
    """
    estimate = innovation.estimate
    if not passes_with_unknown_clock(config, innovation):
        known = math.hypot(estimate.std(TIME_OFFSET), KNOWN_OFFSET_STD)
        config = replace(config, time_offset_std=min(config.time_offset_std, known))
    begun = start(config, innovation.pose, estimate.stamp_ns, estimate.state, window)
    if isinstance(begun, Condition):
        return None
    needed = min(main.hits, _ENOUGH_POSES) if _is_far(config, innovation) else 0
    begun_ns = estimate.stamp_ns
    return Hypothesis(begun, begun_ns, begun_ns, begun_ns, needed=needed)


def _is_far(config: PoseEkfConfig, innovation: Innovation) -> bool:
    """Whether a pose is far from the estimate, see ``_FAR_TOO_SURE`` and ``_FAR``."""
    widened = _FAR_TOO_SURE**2 * innovation.estimate.covariance
    widened[POSE, POSE] += np.square(_FAR)
    return with_covariance(config, innovation, widened).nis > config.gate
