"""The filter: IMU samples and camera poses in, in any order of arrival; the robot's state at every IMU sample out.

The belief at a sample is a function of the samples and poses up to it, ordered by time, never of the order in which
they came: a pose that comes late goes where it belongs, and everything after it is computed again.
"""

from bisect import bisect_left, bisect_right, insort
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
import math
from typing import NamedTuple

import numpy as np

from thermal_fiducial.config import PoseEkfConfig
from thermal_fiducial.core.filter.coasting import usable_seconds
from thermal_fiducial.core.filter.error_state import doubted
from thermal_fiducial.core.filter.gating import Belief, NO_GRAVITY, PoseGate, position_std, Sighting, Track
from thermal_fiducial.core.filter.imu_input import ImuInput, Verdict
from thermal_fiducial.core.filter.imu_noise import NoiseMonitor, NoiseRange
from thermal_fiducial.core.filter.initialisation import FEWEST_SAMPLES, WINDOW_SECONDS
from thermal_fiducial.core.filter.innovations import PoseUpdate
from thermal_fiducial.core.filter.navigation_state import NavigationState
from thermal_fiducial.core.filter.smoothing import SmoothOutput
from thermal_fiducial.core.filter.state_output import odometry
from thermal_fiducial.core.measurements import CameraPose, ImuSample, in_moved_map, Odometry
from thermal_fiducial.core.types import FloatArray

_SECOND_NS = 1_000_000_000
#: Farther than this [ns] an estimated time offset never goes: the history is searched from there.
_LARGEST_OFFSET_NS = 200_000_000
#: An offset known to this [s] moves a marker by a pixel or two in the fastest flights.
_KNOWN_OFFSET_STD = 0.003
#: Poses whose mean normalised innovation squared is told.
_NIS_POSES = 30
#: The last seconds that are linearised anew when the time offset has become known [s].
AGAIN_SECONDS = 2.0
#: Nodes that a second pass goes on for each node that comes.
STEPS_AGAIN = 6


@dataclass(slots=True)
class _Node:
    """An IMU sample, the noise of the step that ends with it, and the belief there."""

    stamp_ns: int
    imu: FloatArray
    noise: NoiseRange
    belief: Belief
    #: the last seconds gone through again, if they are just now
    again: '_Again | None' = None


@dataclass(frozen=True, slots=True)
class _Again:
    """A second pass: its belief at the node of a stamp, the node it was begun at, and the start of its track [ns]."""

    belief: Belief
    stamp_ns: int
    begun_ns: int
    started_ns: int


class _Due(NamedTuple):
    """A pose, its instant in the clock of the IMU by one of the estimates, and by which."""

    time_ns: int
    pose: CameraPose
    by_rival: bool


class PoseEkf:
    """Left-invariant error-state Kalman filter with delayed, gated corrections.

    ``status`` says in words how it is; ``diagnostics()`` in numbers; ``decided`` has the latest words on the poses.
    """

    def __init__(self, config: PoseEkfConfig) -> None:
        self._config = config
        self._offset_ns = round(config.camera_time_offset * _SECOND_NS)
        self.reset()

    def configure(self, config: PoseEkfConfig) -> None:
        """Take over the live parameters of ``config``."""
        self._config = config
        self._gate.configure(config)

    def reset(self) -> None:
        """Forget everything."""
        config = self._config
        self._gate = PoseGate(config)
        self._imu_refused = 0
        self._input = ImuInput(config.max_imu_gap, config.imu.gyroscope_range, config.imu.accelerometer_range)
        self._begin()

    def _begin(self) -> None:
        self._noise = NoiseMonitor(self._config.imu)
        self._nodes: list[_Node] = []
        self._poses: list[CameraPose] = []
        #: stamp of the camera to the latest word on its pose, for the poses in the buffer
        self.decided: dict[int, PoseUpdate] = {}
        self._accepted = self._refused = 0
        self._imu_fault = ''
        seconds = self._config.smoothing_time
        self._smoother = SmoothOutput(seconds) if seconds > 0.0 else None
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
            self._begin()
        self._imu_fault = verdict.value
        if verdict not in (Verdict.USE, Verdict.RESTART):
            self._imu_refused += 1
            return None
        imu = np.concatenate((sample.angular_velocity, sample.linear_acceleration))
        if not self._nodes:
            self._nodes.append(_Node(sample.stamp_ns, imu, NoiseRange(), Belief()))
            return None
        last = self._nodes[-1]
        seconds = (sample.stamp_ns - last.stamp_ns) / _SECOND_NS
        node = _Node(sample.stamp_ns, imu, self._noise.densities(imu, seconds), last.belief)
        self._nodes.append(node)
        self._advance(len(self._nodes) - 1)
        self._prune()
        output = self._output(node)
        self.smooth = self._smoother.follow(output) if self._smoother and output else None
        return output

    def add_pose(self, pose: CameraPose) -> PoseUpdate:
        """Correct by a camera pose at its own instant, now or as soon as the IMU samples of that instant are there.

        ``pose.stamp_ns`` is the camera's stamp; ``camera_time_offset`` and the estimated rest are applied here.
        """
        update = self._unusable(pose)
        if update is None:
            insort(self._poses, pose, key=lambda item: item.stamp_ns)
            first = self._first_node_after(pose)
            for index in range(first, len(self._nodes)):
                self._advance(index, self._nodes[first].stamp_ns)
            waiting = PoseUpdate(pose.stamp_ns, False, 'waits for the IMU', np.nan, pending=True)
            update = self.decided.get(pose.stamp_ns, waiting)
        return update

    def move_map(self, T_new_old: FloatArray) -> None:
        """Follow a correction of the map: estimates and buffered poses move with it, T_new = T_new_old @ T_old."""
        for node in self._nodes:
            node.belief = self._gate.in_moved_map(node.belief, T_new_old)
            if node.again:
                node.again = replace(node.again, belief=self._gate.in_moved_map(node.again.belief, T_new_old))
        self._poses = [in_moved_map(pose, T_new_old) for pose in self._poses]

    def _unusable(self, pose: CameraPose) -> PoseUpdate | None:
        reason = ''
        if not (np.isfinite(pose.T_map_camera).all() and np.isfinite(pose.covariance).all()):
            reason = 'refused: not finite'
        elif not self._nodes:
            reason = 'refused: no IMU yet'
        elif pose.stamp_ns + self._offset_ns - self._nodes[-1].stamp_ns > self._config.max_imu_gap * _SECOND_NS:
            reason = 'refused: far ahead of the IMU'
        elif self._is_too_late(pose):
            reason = 'refused: too late'
        else:
            place = bisect_left(self._poses, pose.stamp_ns, key=lambda item: item.stamp_ns)
            if place < len(self._poses) and self._poses[place].stamp_ns == pose.stamp_ns:
                reason = 'refused: stamp repeated'
        return PoseUpdate(pose.stamp_ns, False, reason, np.nan) if reason else None

    def _is_too_late(self, pose: CameraPose) -> bool:
        first, last = self._nodes[0], self._nodes[-1]
        oldest_ns = max(first.stamp_ns, last.stamp_ns - round(self._config.max_delay * _SECOND_NS))
        return (
            self._due_ns(last.belief.offset, pose) <= oldest_ns
            or self._due_ns(first.belief.offset, pose) <= first.stamp_ns
        )

    # --- the history ----------------------------------------------------------------------------------

    def _due_ns(self, time_offset: float, pose: CameraPose) -> int:
        """Instant of a pose in the clock of the IMU, for what is left of the time offset [s]."""
        return pose.stamp_ns + self._offset_ns + round(time_offset * _SECOND_NS)

    def _first_node_after(self, pose: CameraPose) -> int:
        """First node with a belief that ``pose`` takes part in."""
        earliest = pose.stamp_ns + self._offset_ns - _LARGEST_OFFSET_NS
        index = max(self._index_at(earliest), 1)
        while index < len(self._nodes):
            belief = self._nodes[index - 1].belief
            offset = min(belief.offset, belief.rival.state.time_offset) if belief.rival else belief.offset
            if self._due_ns(offset, pose) <= self._nodes[index].stamp_ns:
                break
            index += 1
        return index

    def _advance(self, index: int, change_ns: int = 0) -> None:
        """Compute the belief of node ``index`` from the node before; once more if something changed at an instant."""
        node = self._nodes[index]
        belief = self._step(index, self._nodes[index - 1].belief, self._poses)
        again = self._nodes[index - 1].again
        if again is None and self._gate.outgrown(belief):
            again = self._begin_again(index, belief)
        if again and belief.main and belief.main.started_ns == again.started_ns:
            done = node.again
            # What was begun before the change, and has come nowhere near it by then, is what it would be now.
            holds = done and max(done.begun_ns, done.stamp_ns + _LARGEST_OFFSET_NS) < change_ns
            again = done if holds else self._go_on(again, index, belief)
        else:
            again = None
        if again and again.stamp_ns == node.stamp_ns:
            belief, again = self._gate.linearised(again.belief, belief), None
        node.belief, node.again = belief, again

    def _begin_again(self, index: int, belief: Belief) -> '_Again':
        """Begin to go through the last seconds of ``belief`` at node ``index`` with the time offset they have shown.

        An offset that is wrong by tens of milliseconds is more than the filter's first order can bear: in a turn it
        would leave errors in the biases that last. That is work for tens of milliseconds, and spread over the nodes
        that follow, a few steps each, until the second pass has caught up.
        """
        assert belief.main
        first = self._nodes[self._first_to_linearise(index, belief.main)]
        skipped_ns = first.stamp_ns - self._offset_ns - round(belief.main.state.time_offset * _SECOND_NS)
        again = self._gate.at_offset(first.belief, belief.main, skipped_ns)
        return _Again(again, first.stamp_ns, self._nodes[index].stamp_ns, belief.main.started_ns)

    def _go_on(self, again: '_Again', index: int, belief: Belief) -> '_Again':
        """A few more steps, with the poses that ``belief`` of node ``index`` has, as far as that."""
        # Those that were not due yet are for the nodes that follow, as they will be if they come late.
        poses = self._poses[: _place_after(belief.pose_stamp_ns, self._poses)]
        begin = self._index_at(again.stamp_ns) + 1
        end = min(begin + STEPS_AGAIN, index + 1)
        state = again.belief
        for i in range(begin, end):
            state = self._step(i, state, poses)
        return replace(again, belief=state, stamp_ns=self._nodes[end - 1].stamp_ns)

    def _first_to_linearise(self, index: int, track: Track) -> int:
        """Node to go back to: some seconds, but not to another track, whose poses are no more to be trusted now."""
        first = self._index_at(self._nodes[index].stamp_ns - round(AGAIN_SECONDS * _SECOND_NS))
        main = self._nodes[first].belief.main
        return first if main is None or main.started_ns == track.started_ns else self._index_at(track.started_ns)

    def _step(self, index: int, belief: Belief, poses: list[CameraPose]) -> Belief:
        """Belief at node ``index`` after ``belief`` at the node before, with those of ``poses`` in between.

        A pose is due at one instant by the main estimate's clock, and at another by the rival's.
        """
        before, node = self._nodes[index - 1], self._nodes[index]
        time_ns, imu = before.stamp_ns, before.imu
        while (due := self._next_due(belief, poses)) is not None and due.time_ns <= node.stamp_ns:
            due_ns = max(due.time_ns, time_ns)
            share = (due_ns - before.stamp_ns) / (node.stamp_ns - before.stamp_ns)
            imu_there = before.imu + share * (node.imu - before.imu)
            belief = self._propagate(belief, (imu, imu_there), due_ns - time_ns, node.noise)
            time_ns, imu = due_ns, imu_there
            late = (due_ns - due.time_ns) / _SECOND_NS
            sighting = Sighting(due.pose, due_ns, late, partial(self._window, index, imu), node.noise)
            weigh = self._gate.weigh_rival if due.by_rival else self._gate.weigh
            belief, update = weigh(belief, sighting)
            if update:
                self._decide(update)
        return self._propagate(belief, (imu, node.imu), node.stamp_ns - time_ns, node.noise)

    def _next_due(self, belief: Belief, poses: list[CameraPose]) -> _Due | None:
        """The first pose that either estimate has to weigh."""
        due = []
        if belief.main or not belief.rival:
            due += self._due(belief.pose_stamp_ns, belief.offset, poses, by_rival=False)
        if belief.rival:
            due += self._due(belief.rival.pose_stamp_ns, belief.rival.state.time_offset, poses, by_rival=True)
        return min(due, key=lambda item: item.time_ns, default=None)

    def _due(self, seen_ns: int, time_offset: float, poses: list[CameraPose], *, by_rival: bool) -> list[_Due]:
        place = _place_after(seen_ns, poses)
        return [_Due(self._due_ns(time_offset, pose), pose, by_rival) for pose in poses[place : place + 1]]

    def _propagate(
        self, belief: Belief, ends: tuple[FloatArray, FloatArray], nanoseconds: int, noise: NoiseRange
    ) -> Belief:
        """Trapezoid: the mean of the samples at the ends holds over the step."""
        if nanoseconds <= 0:
            return belief
        return self._gate.predict(belief, 0.5 * (ends[0] + ends[1]), nanoseconds / _SECOND_NS, noise)

    def _window(self, index: int, imu: FloatArray, seconds: float) -> FloatArray:
        """Samples (N, 6) of the last ``seconds`` before node ``index``, then ``imu``."""
        first = self._index_at(self._nodes[index].stamp_ns - round(seconds * _SECOND_NS))
        return np.array([*(node.imu for node in self._nodes[first:index]), imu])

    def _index_at(self, stamp_ns: int) -> int:
        """First node at ``stamp_ns`` or later."""
        return bisect_left(self._nodes, stamp_ns, key=lambda node: node.stamp_ns)

    def _decide(self, update: PoseUpdate) -> None:
        if update.stamp_ns not in self.decided:
            self._accepted += update.accepted
            self._refused += not update.accepted
        self.decided[update.stamp_ns] = update

    def _prune(self) -> None:
        """Forget what no pose may reach any more; in blocks, as deleting from a list's head moves the rest."""
        kept_ns = round((self._config.max_delay + AGAIN_SECONDS + WINDOW_SECONDS) * _SECOND_NS)
        horizon = self._nodes[-1].stamp_ns - kept_ns
        if self._nodes[len(self._nodes) // 2].stamp_ns >= horizon:
            return
        del self._nodes[: self._index_at(horizon)]
        stale = _place_after(self._nodes[0].belief.pose_stamp_ns, self._poses)
        for pose in self._poses[:stale]:
            self.decided.pop(pose.stamp_ns, None)
        del self._poses[:stale]

    # --- output ---------------------------------------------------------------------------------------

    def _output(self, node: _Node) -> Odometry | None:
        if node.belief.main is None:
            return None
        state = self._gate.filter.in_clock_of_imu(node.belief.main.state, node.imu)
        other = self._gate.contradicting(node.belief)
        if other is not None:
            state = doubted(state, other)
        return odometry(node.stamp_ns, state, node.imu[:3], self._rate_variance(node))

    def _rate_variance(self, node: _Node) -> float:
        return node.noise.shaken[0] ** 2 * _SECOND_NS / (node.stamp_ns - self._nodes[-2].stamp_ns)

    @property
    def state(self) -> NavigationState | None:
        """Estimate at the newest IMU sample."""
        main = self._nodes[-1].belief.main if self._nodes else None
        return main.state if main else None

    @property
    def camera_time_offset(self) -> float | None:
        """Estimate of t_imu - t_camera [s]; None while it is not known well enough to rely on."""
        if self.state is None or self._gate.filter.time_offset_std(self.state) > _KNOWN_OFFSET_STD:
            return None
        return self._config.camera_time_offset + self.state.time_offset

    @property
    def resets(self) -> int:
        """How often it has started afresh since it was begun."""
        return self._nodes[-1].belief.resets if self._nodes else 0

    @property
    def status(self) -> str:
        """How the filter is, in words."""
        if self._imu_fault:
            return self._imu_fault
        if not self._nodes:
            return 'waiting for IMU'
        belief = self._nodes[-1].belief
        if belief.main is None:
            hits = belief.rival.hits if belief.rival else 0
            return f'initialising: {hits} of {self._config.initial_poses} poses' if hits else self._why_waiting()
        uncertainty = position_std(belief.main.state)
        if uncertainty > self._config.lost_position_std:
            return f'lost: position known to {uncertainty:.2f} m'
        if self._gate.contradicting(belief) is not None:
            return 'in doubt: poses agree on another place'
        coasting = self._coasting(belief.main)
        return f'coasting for {coasting:.1f} s' if coasting > 0.5 else 'tracking'

    def _why_waiting(self) -> str:
        latest = next(reversed(self.decided.values()), None)
        if latest is None or latest.reason != NO_GRAVITY:
            return 'waiting for markers'
        force = np.mean([node.imu[3:] for node in self._nodes[-FEWEST_SAMPLES:]], axis=0)
        words = ' '.join(f'{value:.1f}' for value in force)
        return f'poses contradict gravity: the IMU says {words} m/s^2; its axes, sign, units? camera_orientation?'

    def _coasting(self, track: Track) -> float:
        return (self._nodes[-1].stamp_ns - track.accepted_ns) / _SECOND_NS

    @property
    def lost(self) -> bool:
        """Whether there is no pose, or none as good as ``lost_position_std`` asks."""
        return self.state is None or position_std(self.state) > self._config.lost_position_std

    @property
    def usable_for(self) -> float:
        """Seconds [s] for which the pose stays as good as ``lost_position_std`` asks, if no marker comes any more."""
        if self.state is None:
            return 0.0
        densities = self._nodes[-1].noise.at(self.state.aliasing.share)
        return usable_seconds(self.state, self._gate.filter.layout, densities, self._config.lost_position_std)

    def _mean_nis(self) -> float:
        """Of the latest poses; 6 where their covariances are the truth, less where the parameters allow for more."""
        values = [update.nis for update in islice(reversed(self.decided.values()), _NIS_POSES)]
        return float(np.mean([value for value in values if not math.isnan(value)] or math.nan))

    def diagnostics(self) -> dict[str, float]:
        """How the filter is, in numbers (SI units)."""
        rate, force = self._noise.vibration
        numbers = {
            'poses accepted': float(self._accepted),
            'poses refused': float(self._refused),
            'IMU samples refused': float(self._imu_refused),
            'nis': self._mean_nis(),
            'vibration rad/s': rate,
            'vibration m/s^2': force,
        }
        if self.state is not None:
            belief = self._nodes[-1].belief
            assert belief.main
            numbers |= {
                'seconds since accepted pose': self._coasting(belief.main),
                'starts afresh': float(belief.resets),
                'position std': position_std(self.state),
                'usable for': self.usable_for,
                'time offset': self._config.camera_time_offset + self.state.time_offset,
                'time offset std': self._gate.filter.time_offset_std(self.state),
                'clock steps': float(self.state.clock_steps.found),
                'stamp jitter': math.sqrt(self.state.stamp_jitter.variance),
                'vibration share': self.state.aliasing.share,
                'gyroscope bias': float(np.linalg.norm(self.state.bias[:3])),
                'accelerometer bias': float(np.linalg.norm(self.state.bias[3:])),
                'gyroscope scale error': float(np.abs(self.state.gyroscope_scale).max()),
                'map tilt': math.asin(float(np.hypot(*self.state.gravity[:2])) / self._config.gravity),
            }
        return numbers


def _place_after(stamp_ns: int, poses: list[CameraPose]) -> int:
    """Index of the first pose that is later."""
    return bisect_right(poses, stamp_ns, key=lambda pose: pose.stamp_ns)
