"""The filter: IMU samples and camera poses in, in any order of arrival; the robot's state at every IMU sample out."""

from collections.abc import Mapping
from dataclasses import replace
from itertools import islice
import math

import numpy as np

from thermal_fiducial.config import PoseEkfConfig
from thermal_fiducial.core.filter.camera_clock import CameraClock
from thermal_fiducial.core.filter.coasting import usable_seconds
from thermal_fiducial.core.filter.history import History, Instant, Node
from thermal_fiducial.core.filter.hypotheses import Hypotheses, NO_GRAVITY
from thermal_fiducial.core.filter.imu_input import ImuInput, Verdict
from thermal_fiducial.core.filter.imu_noise import ImuNoiseMonitor
from thermal_fiducial.core.filter.initialization import FEWEST_SAMPLES, WINDOW_SECONDS
from thermal_fiducial.core.filter.innovations import PoseUpdate
from thermal_fiducial.core.filter.recovery import Belief, Hypothesis
from thermal_fiducial.core.filter.smoothing import SmoothOutput
from thermal_fiducial.core.filter.state import Estimate, NavigationState, TIME_OFFSET
from thermal_fiducial.core.filter.state_output import odometry
from thermal_fiducial.core.measurements import CameraPose, ImuSample, Odometry
from thermal_fiducial.core.types import FloatArray

_SECOND_NS = 1_000_000_000
#: Why the filter begins anew, or a pose has to wait.
CLOCK_JUMPED = "the IMU's clock has jumped"
#: An offset known to this [s] moves a marker by a pixel or two in the fastest flights.
_KNOWN_OFFSET_STD = 0.003
#: Poses over which the normalised innovation squared is averaged for the diagnostics.
_NIS_POSES = 30
#: Verdicts on poses that are kept.
_VERDICTS = 300


class PoseEkf:
    """Left-invariant error-state Kalman filter with delayed, gated corrections.

    ``status`` says in words how it is; ``diagnostics()`` in numbers; ``decided`` has the latest verdicts on the poses.
    """

    def __init__(self, config: PoseEkfConfig) -> None:
        self._config = config
        self._restart_reason = ''
        self.reset()

    def configure(self, config: PoseEkfConfig) -> None:
        """Take over the dynamic parameters of ``config``."""
        self._config = config
        self._hypotheses.configure(config)

    def reset(self, reason: str = 'it was asked for') -> None:
        """Forget everything, for a ``reason`` in words."""
        config, self._restart_reason = self._config, reason
        self._hypotheses = Hypotheses(config)
        self._imu_refused = 0
        self._input = ImuInput(config.max_imu_gap, config.imu.gyroscope_range, config.imu.accelerometer_range)
        self._camera_clock = CameraClock()
        self._begin()

    def _begin(self) -> None:
        config = self._config
        self._noise = ImuNoiseMonitor(config.imu)
        offset_ns = round(config.camera_time_offset * _SECOND_NS)
        self._history = History(config.max_delay + WINDOW_SECONDS, offset_ns)
        self._verdicts: dict[int, PoseUpdate] = {}
        self._accepted = self._refused = 0
        self._imu_fault = ''
        self._smoother = SmoothOutput(config.smoothing_time) if config.smoothing_time > 0.0 else None
        #: the latest odometry without steps; None unless ``smoothing_time`` asks for it
        self.smooth: Odometry | None = None

    # --- input ----------------------------------------------------------------------------------------

    def add_imu(self, sample: ImuSample) -> Odometry | None:
        """Propagate to an IMU sample.

        Returns
        -------
        State at the sample's stamp; None before the filter is initialised and for a sample that it can't use
        (``status`` says why).
        """
        verdict = self._input.judge(sample)
        if verdict is Verdict.RESTART:
            self._restart_reason = CLOCK_JUMPED
            self._begin()
        self._imu_fault = verdict.value
        if verdict not in (Verdict.USE, Verdict.RESTART):
            self._imu_refused += 1
            return None
        if self._input.jump_ns:
            self._camera_clock.imu_jumped(self._input.jump_ns)
        imu = np.concatenate((sample.angular_velocity, sample.linear_acceleration))
        nodes = self._history.nodes
        if not nodes:
            nodes.append(Node(sample.stamp_ns, imu, np.zeros(6), Belief()))
            return None
        seconds = (sample.stamp_ns - nodes[-1].stamp_ns) / _SECOND_NS
        node = Node(sample.stamp_ns, imu, self._noise.densities(imu, seconds), nodes[-1].belief)
        self._history.append(node)
        self._advance(len(nodes) - 1)
        output = self._output(node)
        self.smooth = self._smoother.follow(output) if self._smoother and output else None
        return output

    def add_pose(self, pose: CameraPose) -> PoseUpdate:
        """Correct by a camera pose at its own instant, now or as soon as the IMU samples of that instant are there.

        ``pose.stamp_ns`` is the camera's stamp; ``camera_time_offset`` and the estimated rest are applied here.
        """
        pose = self._in_present_clock(pose)
        if self._belief.main is None and self._camera_clock.in_question:
            return PoseUpdate(pose.stamp_ns, False, CLOCK_JUMPED, np.nan)
        reason = self._unusable(pose)
        if reason:
            return PoseUpdate(pose.stamp_ns, False, reason, np.nan)
        self._advance_from(self._history.insert(pose))
        waiting = PoseUpdate(pose.stamp_ns, False, 'waits for the IMU', np.nan, pending=True)
        return self._verdicts.get(pose.stamp_ns, waiting)

    def _advance_from(self, first: int) -> None:
        for index in range(first, len(self._history.nodes)):
            self._advance(index)

    def _in_present_clock(self, pose: CameraPose) -> CameraPose:
        """``pose`` without the steps of the camera's clock, of which it may show another one."""
        history, pose = self._history, self._camera_clock.stamped(pose)
        if not history.nodes:
            return pose
        step_ns = self._camera_clock.proposed(pose, history.nodes[-1].stamp_ns)
        if not step_ns:
            return pose
        restamped = replace(pose, stamp_ns=pose.stamp_ns - step_ns)
        if self._camera_clock.is_of_imu(step_ns):
            # All since then was propagated over time that never was.
            self._camera_clock.follow(step_ns)
            self._restart_reason = CLOCK_JUMPED
            self._begin()
            return restamped
        if not self._contradicts(pose) or not self._fits(restamped):
            return pose
        self._advance_from(history.discard(self._camera_clock.follow(step_ns)))
        return restamped

    def _contradicts(self, pose: CameraPose) -> bool:
        """Whether poses like the one that comes are of no use by their stamps: refused, or out of time."""
        main = self._belief.main
        ahead = self._history.due_ns(pose, main) > self._history.nodes[-1].stamp_ns
        return main is not None and (main.accepted_in_row == 0 or ahead or bool(self._unusable(pose)))

    def _fits(self, pose: CameraPose) -> bool:
        """Whether a pose is right up to an unknown clock."""
        nodes, main = self._history.nodes, self._belief.main
        index = min(max(self._history.index_at(self._history.due_ns(pose, main)), 1), len(nodes) - 1)
        instant = self._history.instant(index, min(self._history.due_ns(pose, main), nodes[-1].stamp_ns))
        before = nodes[index - 1].belief.main
        if before is None:
            return False
        begin = self._history.instant(index, nodes[index - 1].stamp_ns)
        there = self._moved(before, begin, instant, nodes[index])
        return self._hypotheses.explains(there, pose, self._history.motion(instant, there))

    def move_map(self, T_new_old: FloatArray) -> None:
        """Follow a correction of the map: estimates and buffered poses move with it, T_new = T_new_old @ T_old."""
        self._history.move_map(T_new_old)

    def _unusable(self, pose: CameraPose) -> str:
        """Why a pose cannot be used; empty if it can."""
        nodes = self._history.nodes
        if not (np.isfinite(pose.T_map_camera).all() and np.isfinite(pose.covariance).all()):
            return 'refused: not finite'
        if not _is_covariance(pose.covariance):
            return 'refused: covariance is not positive definite'
        if not nodes:
            return 'refused: no IMU yet'
        newest = nodes[-1]
        due_ns = self._history.due_ns(pose, newest.belief.main)
        if due_ns - newest.stamp_ns > self._config.max_imu_gap * _SECOND_NS:
            return 'refused: far ahead of the IMU'
        oldest_ns = max(nodes[0].stamp_ns, newest.stamp_ns - round(self._config.max_delay * _SECOND_NS))
        if due_ns <= oldest_ns:
            return 'refused: too late'
        return 'refused: stamp repeated' if self._history.holds(pose.stamp_ns) else ''

    # --- the belief at each sample --------------------------------------------------------------------

    def _advance(self, index: int) -> None:
        """Compute the belief of node ``index`` from that of the node before, with the poses in between."""
        belief = self._history.nodes[index - 1].belief
        onward = self._through_step if belief.main or belief.alternative else self._begun
        self._history.nodes[index].belief = onward(belief, index)

    def _through_step(self, belief: Belief, index: int) -> Belief:
        """Both hypotheses at the end of a step; each sees a pose at its instant by its own clock."""
        refused: list[tuple[CameraPose, Instant, Hypothesis]] = []
        main = belief.main
        if main:
            main, verdicts = self._hypothesis_through(main, index)
            for pose, update, at_pose in verdicts:
                self._decide(update)
                if not update.accepted:
                    refused.append((pose, self._instant_of(pose, at_pose, index), at_pose))
        alternative = belief.alternative
        if alternative:
            alternative, verdicts = self._hypothesis_through(alternative, index)
            if main is None:
                for pose, _, _ in verdicts:
                    self._decide(PoseUpdate(pose.stamp_ns, False, 'initialising', math.nan))
        belief = replace(belief, main=main, alternative=alternative)
        if alternative is None and refused:
            belief = self._with_alternative(belief, *refused[0], index)
        return self._settled(belief)

    def _with_alternative(
        self, belief: Belief, pose: CameraPose, instant: Instant, at_pose: Hypothesis, index: int
    ) -> Belief:
        window = self._history.window(instant, WINDOW_SECONDS)
        motion = self._history.motion(instant, at_pose)
        begun = self._hypotheses.alternative_to(at_pose, pose, instant.time_ns, motion, window)
        if begun is None:
            return belief
        drifted = begun.needed == 0 or (belief.drifted and at_pose.refused_in_row > 0)
        begun = replace(begun, needed=0) if drifted else begun
        alternative, _ = self._hypothesis_through(begun, index, instant)
        return replace(belief, alternative=alternative, hits_before=at_pose.hits, drifted=drifted)

    def _settled(self, belief: Belief) -> Belief:
        settled = belief.settled(self._config)
        if settled.alternative is None and belief.main is None and belief.alternative and belief.alternative.failed:
            return Belief(pose_stamp_ns=belief.alternative.pose_stamp_ns, resets=belief.resets)
        if settled.main is not belief.main and settled.main:
            reason = 'reset' if belief.main else 'initialised'
            self._decide(PoseUpdate(settled.main.pose_stamp_ns, True, reason, math.nan))
        return settled

    def _begun(self, belief: Belief, index: int) -> Belief:
        """The belief after the poses of a step, the first usable of which begins a hypothesis."""
        history = self._history
        until_ns = history.nodes[index].stamp_ns
        while (pose := history.next_pose(belief.pose_stamp_ns, None, until_ns)) is not None:
            belief = replace(belief, pose_stamp_ns=pose.stamp_ns)
            instant = history.instant(index, history.due_ns(pose, None))
            window = history.window(instant, WINDOW_SECONDS)
            begun = self._hypotheses.from_nothing(pose, instant.time_ns, window)
            self._decide(PoseUpdate(pose.stamp_ns, False, 'initialising' if begun else NO_GRAVITY, math.nan))
            if begun:
                alternative, _ = self._hypothesis_through(begun, index, instant)
                return self._settled(replace(belief, alternative=alternative))
        return belief

    def _hypothesis_through(
        self, hypothesis: Hypothesis, index: int, begin: Instant | None = None
    ) -> tuple[Hypothesis, list[tuple[CameraPose, PoseUpdate, Hypothesis]]]:
        """A hypothesis at the end of a step, and what it says of the poses due in it, each with itself before it."""
        history, node = self._history, self._history.nodes[index]
        at = begin or history.instant(index, history.nodes[index - 1].stamp_ns)
        verdicts = []
        while (pose := history.next_pose(hypothesis.pose_stamp_ns, hypothesis, node.stamp_ns)) is not None:
            then = self._instant_of(pose, hypothesis, index)
            hypothesis, at = self._moved(hypothesis, at, then, node), then
            motion = self._history.motion(then, hypothesis)
            weighed, update = self._hypotheses.weigh(hypothesis, pose, motion)
            verdicts.append((pose, update, hypothesis))
            hypothesis = weighed
        end = Instant(node.stamp_ns, node.imu, index)
        return self._moved(hypothesis, at, end, node), verdicts

    def _instant_of(self, pose: CameraPose, hypothesis: Hypothesis, index: int) -> Instant:
        """Instant of a pose, not before what the hypothesis has gone through already."""
        time_ns = max(self._history.due_ns(pose, hypothesis), hypothesis.prediction.stamp_ns)
        return self._history.instant(index, time_ns)

    def _moved(self, hypothesis: Hypothesis, begin: Instant, end: Instant, node: Node) -> Hypothesis:
        """Trapezoid: the mean of the samples at the ends holds over the step."""
        if end.time_ns <= begin.time_ns:
            return hypothesis
        return self._hypotheses.predicted(hypothesis, 0.5 * (begin.imu + end.imu), end.time_ns, node.densities)

    def _decide(self, update: PoseUpdate) -> None:
        known = self._verdicts.pop(update.stamp_ns, None)
        if known is None:
            self._accepted += update.accepted
            self._refused += update.refused
        self._verdicts[update.stamp_ns] = update
        while len(self._verdicts) > _VERDICTS:
            del self._verdicts[next(iter(self._verdicts))]

    # --- output ---------------------------------------------------------------------------------------

    def _output(self, node: Node) -> Odometry | None:
        main = node.belief.main
        if main is None:
            return None
        covariance, with_bias = self._hypotheses.core_covariance(node.belief, node.imu)
        return odometry(main.prediction, covariance, with_bias, node.imu, self._rate_variance(node))

    def _rate_variance(self, node: Node) -> float:
        seconds = (node.stamp_ns - self._history.nodes[-2].stamp_ns) / _SECOND_NS
        return float(node.densities[0]) ** 2 / seconds

    @property
    def decided(self) -> Mapping[int, PoseUpdate]:
        """Stamp of the camera to the latest verdict on its pose, for the latest poses."""
        return self._verdicts

    @property
    def _belief(self) -> Belief:
        nodes = self._history.nodes
        return nodes[-1].belief if nodes else Belief()

    @property
    def state(self) -> NavigationState | None:
        """Estimate at the newest IMU sample."""
        main = self._belief.main
        return main.prediction.state if main else None

    @property
    def estimate(self) -> Estimate | None:
        """State and whole covariance at the newest IMU sample."""
        main = self._belief.main
        return self._hypotheses.estimate(main) if main else None

    @property
    def camera_time_offset(self) -> float | None:
        """Estimate of t_imu - t_camera [s]; None while it is not known well enough to rely on."""
        main = self._belief.main
        if main is None or self._time_offset_std(main) > _KNOWN_OFFSET_STD:
            return None
        return self._clock_offset(main)

    def _clock_offset(self, main: Hypothesis) -> float:
        steps = self._camera_clock.ahead_ns / _SECOND_NS
        return self._config.camera_time_offset + main.prediction.state.time_offset - steps

    def _time_offset_std(self, main: Hypothesis) -> float:
        """Of the estimate; before it is begun, and where there is none, what the parameter says [s]."""
        origin = main.prediction.origin
        return origin.std(TIME_OFFSET) if origin.clock_open else self._config.time_offset_std

    @property
    def resets(self) -> int:
        """How often another estimate has replaced the present one since it was begun."""
        return self._belief.resets

    @property
    def reset_reason(self) -> str:
        """Why the estimate was replaced, or given up, the last time."""
        return self._belief.reset_reason or self._restart_reason

    @property
    def status(self) -> str:
        """How the filter is, in words."""
        if self._imu_fault:
            return self._imu_fault
        if not self._history.nodes:
            return 'waiting for IMU'
        main, other = self._belief.main, self._belief.alternative
        if main is None:
            return f'initialising: {other.hits} of {self._config.initial_poses} poses' if other else self._why_waiting()
        if main.position_std > self._config.lost_position_std:
            return f'lost: position known to {main.position_std:.2f} m'
        if main.in_doubt:
            return f'in doubt: {main.refused_in_row} poses in a row contradict the estimate'
        coasting = self._coasting(main)
        return f'coasting for {coasting:.1f} s' if coasting > 0.5 else 'tracking'

    def _why_waiting(self) -> str:
        latest = next(reversed(self._verdicts.values()), None)
        if latest is None or latest.reason != NO_GRAVITY:
            return 'waiting for markers'
        force = np.mean([node.imu[3:] for node in self._history.nodes[-FEWEST_SAMPLES:]], axis=0)
        words = ' '.join(f'{value:.1f}' for value in force)
        return f'poses contradict gravity: the IMU says {words} m/s^2; its axes, sign, units? camera_orientation?'

    def _coasting(self, main: Hypothesis) -> float:
        return (self._history.nodes[-1].stamp_ns - main.accepted_ns) / _SECOND_NS

    @property
    def lost(self) -> bool:
        """Whether there is no pose to fly on: none as good as ``lost_position_std``, or poses and IMU contradict it."""
        main = self._belief.main
        if main is None or self._imu_fault == Verdict.FROZEN.value or main.in_doubt:
            return True
        return main.position_std > self._config.lost_position_std

    @property
    def usable_for(self) -> float:
        """Seconds [s] for which the pose stays as good as ``lost_position_std`` asks, if no marker comes any more."""
        main = self._belief.main
        if main is None:
            return 0.0
        estimate = self._hypotheses.estimate(main)
        return usable_seconds(estimate, self._history.nodes[-1].densities, self._config.lost_position_std)

    def _mean_nis(self) -> float:
        """Of the latest accepted poses, per degree of freedom: 1 is consistent, less is cautious."""
        latest = islice(reversed(self._verdicts.values()), _NIS_POSES)
        values = [update.nis / 6.0 for update in latest if update.accepted and not math.isnan(update.nis)]
        return float(np.mean(values or math.nan))

    def diagnostics(self) -> dict[str, float]:
        """How the filter is, in numbers (SI units)."""
        rate, force = self._noise.vibration
        numbers = {
            'poses accepted': float(self._accepted),
            'poses refused': float(self._refused),
            'IMU samples refused': float(self._imu_refused),
            'NIS per d.o.f.': self._mean_nis(),
            'vibration rad/s/sqrt(Hz)': rate,
            'vibration m/s^2/sqrt(Hz)': force,
        }
        main = self._belief.main
        return numbers if main is None else numbers | self._figures_of(main)

    def _figures_of(self, main: Hypothesis) -> dict[str, float]:
        state, noise = main.prediction.state, main.prediction.origin.pose_noise
        return {
            'seconds since accepted pose': self._coasting(main),
            'resets': float(self.resets),
            'position std': main.position_std,
            'usable for': self.usable_for,
            'time offset': self._clock_offset(main),
            'time offset std': self._time_offset_std(main),
            'white pose error': math.sqrt(noise.white),
            'systematic pose error': math.sqrt(noise.systematic),
            'stamp jitter': math.sqrt(noise.jitter),
            'gyroscope bias': float(np.linalg.norm(state.bias[:3])),
            'accelerometer bias': float(np.linalg.norm(state.bias[3:])),
            'gyroscope scale error': float(np.abs(state.scale[0]).max()),
            'accelerometer scale error': float(np.abs(state.scale[1]).max()),
            'map tilt': math.asin(float(np.hypot(*state.gravity[:2])) / self._config.gravity),
        }


def _is_covariance(matrix: FloatArray) -> bool:
    """Whether (6, 6) is symmetric, up to rounding, and positive definite."""
    if not np.allclose(matrix, matrix.T, rtol=1e-6, atol=1e-12):
        return False
    return bool(np.linalg.eigvalsh(matrix)[0] > 0.0)
