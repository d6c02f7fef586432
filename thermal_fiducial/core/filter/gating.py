"""Which poses count: chi-square against the present belief, and recovery by evidence instead of lock-out.

A pose that the belief refuses starts a rival, a second estimate that the following refused poses support or not.
A rival that many poses agree with, while the belief accepts few, replaces it. The start of the filter is the same
thing without a belief to replace.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
import math

import numpy as np

from thermal_fiducial.config import PoseEkfConfig
from thermal_fiducial.core.filter.error_state import ErrorStateFilter, Motion
from thermal_fiducial.core.filter.imu import ImuStep
from thermal_fiducial.core.filter.imu_noise import NoiseRange
from thermal_fiducial.core.filter.initialisation import blank_state, start, WINDOW_SECONDS
from thermal_fiducial.core.filter.innovations import PoseUpdate
from thermal_fiducial.core.filter.navigation_state import in_moved_map, NavigationState, POSE
from thermal_fiducial.core.measurements import CameraPose
from thermal_fiducial.core.types import FloatArray

_SECOND_NS = 1_000_000_000
#: Seconds of motion that tell over how many it should be averaged.
_GLANCE_SECONDS = 0.2
#: A rival must agree with so many times more poses than the belief: when the robot slows down, a belief whose clock is
#: wrong accepts some.
_PREFERRED = 4
#: Poses are linearised anew when the time offset has become known so many times better, and well enough when it is
#: known to this [s]: half an angular acceleration of 5 rad/s^2 times its square is 0.01 mrad.
_BETTER, _WELL_KNOWN = 2.0, 0.002
#: A pose that is off even for an estimate that claims so many times too little, and by more than a few of these
#: [rad, m], is a marker's fault, unless as many poses bear it out as have borne out the estimate, or so many. Nearer
#: ones are believed earlier: coasting on for long would do more harm.
_FAR_TOO_SURE, _FAR, _ENOUGH_POSES = 10.0, np.repeat([0.05, 0.2], 3), 300
#: So many poses that the estimate accepts refute a rival where the robot could not have gone.
_REFUTED = 3
#: What speaks against a rival is forgotten by half when it is so much.
_REMEMBERED = 16
_NEVER = -(1 << 62)
#: why a pose was refused that no attitude of a robot under gravity explains
NO_GRAVITY = 'refused: contradicts gravity'


@dataclass(frozen=True, slots=True)
class Track:
    """An estimate and the poses that speak for it."""

    state: NavigationState
    #: instants of its first and of its last accepted pose, clock of the IMU
    started_ns: int
    accepted_ns: int
    #: standard deviation of the time offset that its poses were linearised at [s]
    linearised_std: float
    hits: int = 1
    misses: int = 0
    #: of a rival: poses since its start that the other estimate accepted, and stamp of the last pose that it has seen
    against: int = 0
    pose_stamp_ns: int = _NEVER
    #: of a rival: poses that must agree on it
    needed: int = 0

    def supported(self, state: NavigationState, time_ns: int) -> 'Track':
        """The track after a pose that it accepts."""
        return replace(self, state=state, accepted_ns=time_ns, hits=self.hits + 1)

    def refusing(self, state: NavigationState) -> 'Track':
        """The track after a pose that it refuses, of which only what ``state`` has learned of the noise is kept."""
        learned = replace(self.state, aliasing=state.aliasing, clock_steps=state.clock_steps)
        return replace(self, state=learned)


@dataclass(frozen=True, slots=True)
class Belief:
    """Everything that the filter knows at one instant."""

    main: Track | None = None
    rival: Track | None = None
    #: stamp of the last camera pose in it
    pose_stamp_ns: int = _NEVER
    #: times that it started afresh
    resets: int = 0
    #: time offset [s] that holds while there is no estimate
    time_offset: float = 0.0

    @property
    def offset(self) -> float:
        """Time offset [s] that holds."""
        return self.main.state.time_offset if self.main else self.time_offset

    @property
    def rival_stamp_ns(self) -> int:
        """Stamp of the last pose that the rival has seen."""
        return self.rival.pose_stamp_ns if self.rival else _NEVER


@dataclass(frozen=True)
class Sighting:
    """A camera pose at its instant."""

    pose: CameraPose
    #: the instant in the clock of the IMU, and by how much it is too late [s]: the estimate had gone on by then
    time_ns: int
    late: float
    #: gives the IMU samples (N, 6) of so many seconds up to it
    samples: Callable[[float], FloatArray]
    #: of the IMU at that instant
    noise: NoiseRange

    @cached_property
    def motion(self) -> Motion:
        """The motion that shows a clock error."""
        glance = Motion.of(self.samples(_GLANCE_SECONDS), _GLANCE_SECONDS)
        seconds = glance.averaging_seconds(self.noise.shaken[0])
        return Motion.of(self.samples(seconds), seconds, self.time_ns, self.noise)


class PoseGate:
    """Propagates beliefs and weighs poses against them."""

    def __init__(self, config: PoseEkfConfig) -> None:
        self._config = config
        self.filter = ErrorStateFilter(config)
        self._blank = blank_state(config, self.filter.layout)

    def configure(self, config: PoseEkfConfig) -> None:
        """Take over the live parameters of ``config``."""
        self._config = config
        self.filter.configure(config)

    def predict(self, belief: Belief, imu: FloatArray, seconds: float, noise: NoiseRange) -> Belief:
        """Belief after a step of so many ``seconds`` with the mean sample ``imu`` (6,)."""
        if belief.main is None and belief.rival is None:
            return belief
        main, rival = (self._moved(track, imu, seconds, noise) for track in (belief.main, belief.rival))
        return Belief(main, rival, belief.pose_stamp_ns, belief.resets, belief.time_offset)

    def _moved(self, track: Track | None, imu: FloatArray, seconds: float, noise: NoiseRange) -> Track | None:
        if track is None:
            return None
        step = ImuStep(imu, seconds, *noise.at(track.state.aliasing.share))
        state = self.filter.predict(track.state, step)
        return Track(
            state,
            track.started_ns,
            track.accepted_ns,
            track.linearised_std,
            track.hits,
            track.misses,
            track.against,
            track.pose_stamp_ns,
            track.needed,
        )

    def in_moved_map(self, belief: Belief, T_new_old: FloatArray) -> Belief:
        """``belief`` in a map whose coordinates are moved by ``T_new_old`` (4, 4)."""

        def move(track: Track | None) -> Track | None:
            return track and replace(track, state=in_moved_map(track.state, T_new_old, self.filter.layout))

        return replace(belief, main=move(belief.main), rival=move(belief.rival))

    def weigh(self, belief: Belief, sighting: Sighting) -> tuple[Belief, PoseUpdate]:
        """Belief after a pose at its instant by the main estimate's clock, or at its first where there is none."""
        stamp_ns, time_ns, main = sighting.pose.stamp_ns, sighting.time_ns, self._fresh(belief.main, sighting)
        nis = math.nan
        if main:
            state, nis = self._correct(main.state, sighting)
            accepted = nis <= self._config.gate
            main = main.supported(state, time_ns) if accepted else main.refusing(state)
            stepped = self.filter.after_clock_step(main.state)
            if stepped:
                main = replace(main, state=stepped)
            if accepted:
                rival = None if stepped else _outdone(belief.rival)
                return Belief(main, rival, stamp_ns, belief.resets), PoseUpdate(stamp_ns, True, '', nis)
            belief = replace(belief, main=main, rival=None if stepped else belief.rival)
        rival = belief.rival or self._rival(belief, sighting)
        reason = f'refused: {math.sqrt(nis):.1f} sigma' if main else 'initialising'
        if rival is None:
            reason = NO_GRAVITY
        return replace(belief, rival=rival, pose_stamp_ns=stamp_ns), PoseUpdate(stamp_ns, False, reason, nis)

    def weigh_rival(self, belief: Belief, sighting: Sighting) -> tuple[Belief, PoseUpdate | None]:
        """Belief after a pose at its instant by the rival's clock; with a word on it where that ends another estimate.

        A rival that fails too often is none.
        """
        rival, stamp_ns, time_ns = belief.rival, sighting.pose.stamp_ns, sighting.time_ns
        assert rival
        state, nis = self._correct(rival.state, sighting)
        if nis <= self._config.gate:
            rival = replace(rival.supported(state, time_ns), pose_stamp_ns=stamp_ns)
            if self._convincing(rival, self._fresh(belief.main, sighting), time_ns):
                resets = belief.resets + (belief.main is not None)
                reason = 'started afresh' if belief.main else 'initialised'
                return Belief(rival, None, stamp_ns, resets), PoseUpdate(stamp_ns, True, reason, math.nan)
        elif rival.misses + 1 < rival.hits:
            rival = replace(rival, misses=rival.misses + 1, pose_stamp_ns=stamp_ns)
        elif belief.main is None:
            rival = self._rival(belief, sighting)
        else:
            rival = None
        told = None if belief.main else PoseUpdate(stamp_ns, False, 'initialising', math.nan)
        seen_ns = belief.pose_stamp_ns if belief.main else stamp_ns
        return replace(belief, rival=rival, pose_stamp_ns=seen_ns), told

    def _fresh(self, main: Track | None, sighting: Sighting) -> Track | None:
        """The main estimate, unless it has been without poses for too long."""
        oldest_ns = sighting.time_ns - self._config.reinitialise_after * _SECOND_NS
        return main if main and main.accepted_ns >= oldest_ns else None

    def _correct(self, state: NavigationState, sighting: Sighting) -> tuple[NavigationState, float]:
        body = self.filter.body_pose(sighting.pose, state.T_body_camera)
        return self.filter.correct(state, body, sighting.motion, sighting.late)

    def _rival(self, belief: Belief, sighting: Sighting) -> Track | None:
        """An estimate that begins with a pose."""
        stamp_ns, time_ns = sighting.pose.stamp_ns, sighting.time_ns
        first, needed = self._of_another_clock(belief, sighting), 0
        if first is None:
            first, needed = self._from_nothing(belief, sighting), self._needed(belief.main, sighting)
        if first is None:
            return None
        std = self._config.time_offset_std
        return Track(first, time_ns, time_ns, std, pose_stamp_ns=stamp_ns, needed=needed)

    def _needed(self, main: Track | None, sighting: Sighting) -> int:
        """How many poses must contradict an estimate that is said to be elsewhere all of a sudden.

        Where the robot could not have gone, a marker that was moved or that hangs in two places has. But the estimate
        itself may have begun with such a one.
        """
        if main is None:
            return 0
        covariance = _FAR_TOO_SURE**2 * main.state.covariance
        covariance[POSE, POSE] += _FAR**2
        possible = self._correct(replace(main.state, covariance=covariance), sighting)[1] <= self._config.gate
        return 0 if possible else min(main.hits, _ENOUGH_POSES)

    def _of_another_clock(self, belief: Belief, sighting: Sighting) -> NavigationState | None:
        """The main estimate, if the pose is right but for a step of the camera's clock."""
        main = self._fresh(belief.main, sighting)
        if main is None or not main.state.clock_open:
            return None
        state, nis = self._correct(self.filter.with_unknown_clock(main.state), sighting)
        return state if nis <= self._config.gate else None

    def _from_nothing(self, belief: Belief, sighting: Sighting) -> NavigationState | None:
        """An estimate that begins with the pose."""
        prior = belief.main.state if belief.main else replace(self._blank, time_offset=belief.time_offset)
        body = self.filter.body_pose(sighting.pose, prior.T_body_camera)
        return start(self._config, self.filter, body, prior, sighting.samples(WINDOW_SECONDS))

    def outgrown(self, belief: Belief) -> bool:
        """Whether the time offset is known so much better by now that its poses should be linearised anew."""
        main = belief.main
        if main is None or not main.state.clock_open or main.linearised_std <= _WELL_KNOWN:
            return False
        return _BETTER * self.filter.time_offset_std(main.state) < main.linearised_std

    def at_offset(self, belief: Belief, track: Track, skipped_ns: int) -> Belief:
        """A past ``belief`` to go on from, as it would be for the time offset that ``track`` has come to know.

        What it knew of the offset stays as uncertain as it was, about another value: the poses that follow are what
        told that value, and are not to count twice. Poses up to the stamp ``skipped_ns`` are left out. Of another
        estimate than the track, or of one that knew nothing of an offset yet, nothing is left.
        """
        time_offset = track.state.time_offset
        for own, seen_ns in (belief.main, belief.pose_stamp_ns), (belief.rival, belief.rival_stamp_ns):
            if own and own.started_ns == track.started_ns and own.state.clock_open:
                state = self.filter.at_offset(own.state, time_offset)
                return Belief(replace(own, state=state), None, max(seen_ns, skipped_ns), belief.resets)
        return Belief(None, None, max(belief.pose_stamp_ns, skipped_ns), belief.resets, time_offset)

    def linearised(self, again: Belief, belief: Belief) -> Belief:
        """``again``, which is ``belief`` gone through anew, marked as linearised at the time offset of that."""
        assert belief.main
        if again.main is None:
            again = belief
        assert again.main
        std = self.filter.time_offset_std(belief.main.state)
        main = replace(again.main, started_ns=belief.main.started_ns, linearised_std=std)
        return replace(again, main=main, resets=belief.resets)

    def contradicting(self, belief: Belief) -> NavigationState | None:
        """What poses agree on that the main estimate refuses, where only time is missing for it to be believed."""
        rival = belief.rival
        return rival.state if belief.main and rival and self._agreed(rival) else None

    def _convincing(self, rival: Track, main: Track | None, time_ns: int) -> bool:
        """Whether a rival takes over that has accepted a pose at this instant."""
        if rival.hits < self._config.initial_poses:
            return False
        if main is None or position_std(main.state) > self._config.lost_position_std:
            return True
        long_enough = time_ns - rival.started_ns >= self._config.reset_after * _SECOND_NS
        return self._agreed(rival) and long_enough and rival.hits >= rival.needed

    def _agreed(self, rival: Track) -> bool:
        enough = rival.hits >= self._config.initial_poses
        return enough and rival.hits >= 2 * rival.misses and rival.hits >= _PREFERRED * rival.against


def _outdone(rival: Track | None) -> Track | None:
    """The rival after a pose that the main estimate accepts; none unless it has more to show for itself."""
    if rival is None or rival.against + 1 >= (_REFUTED if rival.needed else rival.hits):
        return None
    if rival.against + 1 < _REMEMBERED:
        return replace(rival, against=rival.against + 1)
    return replace(rival, hits=rival.hits // 2, misses=rival.misses // 2, against=(rival.against + 1) // 2)


def position_std(state: NavigationState) -> float:
    """Root of the sum of the position variances [m]."""
    P = state.covariance
    return math.sqrt(P[6, 6] + P[7, 7] + P[8, 8])
