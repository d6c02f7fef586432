"""Hypotheses: how they are initialised, and updated by poses that pass the gate; what a pose makes of the belief."""

from dataclasses import replace
import math
from typing import TYPE_CHECKING

import numpy as np

from thermal_fiducial.config import PoseEkfConfig
from thermal_fiducial.core.filter.belief import Belief, Hypothesis, PoseUpdate
from thermal_fiducial.core.filter.initialization import blank_state, cost_of_vertical, start, TWO_POSES, WINDOW_SECONDS
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
from thermal_fiducial.core.two_poses import possible_poses
from thermal_fiducial.core.types import FloatArray, SECOND_NS

if TYPE_CHECKING:
    from thermal_fiducial.core.filter.history import History

#: Standard deviation [s] below which the clock offset counts as known, and the least that an alternative hypothesis
#: begins with: in the fastest flights it moves a marker by a pixel or two.
KNOWN_OFFSET_STD = 0.003
#: Standard deviations by which the first poses must have moved the clock offset for them to be used once more.
_MOVED_OFFSET = 3.0
#: A pose is far if it fails the gate even with the estimate's standard deviations times _FAR_TOO_SURE and _FAR [rad, m]
#: added: probably a moved or duplicated marker. An alternative hypothesis that begins there needs as many poses as the
#: estimate has accepted, at most _ENOUGH_POSES. Nearer ones need fewer: coasting for long would do more harm.
_FAR_TOO_SURE, _FAR, _ENOUGH_POSES = 10.0, np.repeat([0.05, 0.2], 3), 300


def belief_after(history: 'History', pose: CameraPose) -> Belief:
    """The belief of a ``history`` after the next pose."""
    config, verdict = history.config, PoseUpdate(pose.stamp_ns, False, 'initialising', math.nan)
    belief = history.belief._replace(verdict=verdict)
    main, other = belief.main, belief.alternative
    if not belief.hypotheses:
        return _begun(history, belief, pose)
    if main:
        innovation = history.innovation(main, pose)
        main, verdict = weigh(config, main, innovation, pose.stamp_ns)
        belief = belief._replace(main=main, verdict=verdict)
        if other is None and not verdict.accepted and len(possible_poses(pose)) == 1:
            belief = _with_alternative(history, belief, main, innovation)
    if other:
        innovation = history.innovation(other, pose)
        alternative, verdict = weigh(config, other, innovation, pose.stamp_ns)
        belief = belief._replace(alternative=alternative)
        if main is None and not verdict.accepted:
            belief = belief._replace(contradiction=_contradiction(config, other, innovation))
        if belief.second:
            second, _ = weigh(config, belief.second, history.innovation(belief.second, pose), pose.stamp_ns)
            # Each by itself would adapt to what speaks against it.
            first, second = (h.with_noise(other.estimate.pose_noise) for h in (alternative, second))
            belief = belief._replace(alternative=first, second=second, contradiction=TWO_POSES)
    return belief.settled(config)


def _begun(history: 'History', belief: Belief, pose: CameraPose) -> Belief:
    """``belief``, which is empty, with an alternative hypothesis begun from a pose, or one from each of two."""
    time_ns = max(history.due_ns(pose, None, belief.first_offset), history.imu.oldest_ns)
    window = history.imu.window(time_ns, WINDOW_SECONDS)
    outcomes = [
        _first_hypothesis(history.config, possible, time_ns, window, belief.first_offset)
        for possible in possible_poses(pose)
    ]
    alternative, second, *_ = [h for h in outcomes if isinstance(h, Hypothesis)] + [None, None]
    if alternative is None:
        condition = next(outcome for outcome in outcomes if isinstance(outcome, Condition))
        why = 'two poses are possible' if condition is TWO_POSES else 'contradicts gravity'
        refused = PoseUpdate(pose.stamp_ns, False, f'refused: {why}', math.nan)
        return belief._replace(contradiction=condition, verdict=refused)
    return belief._replace(alternative=alternative, second=second).settled(history.config)


def _with_alternative(history: 'History', belief: Belief, main: Hypothesis, refused: Innovation) -> Belief:
    """``belief`` with an alternative hypothesis begun from a pose that its ``main`` one has just refused."""
    window = history.imu.window(refused.estimate.stamp_ns, WINDOW_SECONDS)
    begun = _alternative_to(history.config, main, refused, window)
    if begun is None:
        return belief
    drifted = begun.needed == 0 or (belief.drifted and main.refused_in_row > 1)
    begun = begun._replace(needed=0) if drifted else begun
    return belief._replace(alternative=begun, hits_before=main.hits, drifted=drifted)


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
        if hypothesis.in_doubt and (nis_if_off := _would_show(hypothesis, innovation)) <= config.gate:
            return hypothesis.staying_in_doubt(after, nis_if_off), accepted
        return hypothesis.accepting(after), accepted
    refusing = hypothesis.refusing(replace(estimate, pose_noise=adapted_noise(innovation)), innovation.value)
    why = f'after {coasted:.0f} s without one' if stale else f'{math.sqrt(nis):.1f} sigma'
    return refusing, PoseUpdate(stamp_ns, False, f'refused: {why}', nis)


def _would_show(hypothesis: Hypothesis, innovation: Innovation) -> float:
    """NIS of the poses accepted since the latest refused one, together, if the estimate were off as that one claims.

    Without that of its noise, which is all that a vague pose has: its mean is the number of degrees of freedom.
    """
    against = hypothesis.against
    return hypothesis.would_show + max(0.0, float(against @ innovation.S_inverse @ against) - len(against))


def _contradiction(config: PoseEkfConfig, hypothesis: Hypothesis, innovation: Innovation) -> Condition:
    """Which sensor of the IMU a pose contradicts that the ``hypothesis`` refuses."""
    turn, shift = innovation.value[:3], innovation.value[3:]
    seconds = (innovation.estimate.stamp_ns - hypothesis.accepted_ns) / SECOND_NS
    # The turn has half of the degrees of freedom.
    if turn @ np.linalg.solve(innovation.S[:3, :3], turn) > 0.5 * config.gate:
        apart = f'{math.degrees(np.linalg.norm(turn)):.0f} deg apart after {seconds:.2f} s'
        return Condition('poses contradict the gyroscope', f'{apart}; its units, axes, sign? camera_orientation?')
    apart = f'{np.linalg.norm(shift):.2f} m apart after {seconds:.2f} s'
    causes = 'its units, axes, sign? camera_position? marker_size?'
    return Condition('poses contradict the accelerometer, or each other', f'{apart}; {causes}')


def passes_with_unknown_clock(config: PoseEkfConfig, innovation: Innovation) -> bool:
    """Whether a pose passes the gate once the clock offset is treated as unknown."""
    covariance = with_unknown_clock(config, innovation.estimate.covariance)
    return with_covariance(config, innovation, covariance).nis <= config.gate


def _first_hypothesis(
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


def _alternative_to(
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
