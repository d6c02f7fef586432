"""Which poses count: chi-square against the present belief, and recovery by evidence instead of lock-out.

A pose that the belief refuses starts a rival, a second estimate that the following refused poses support or not.
A rival that many poses agree with, while the belief accepts none, replaces it. The start of the filter is the
same thing without a belief to replace.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
import math

from thermal_fiducial.config import PoseEkfConfig
from thermal_fiducial.core.filter.error_state import ErrorStateFilter, Motion
from thermal_fiducial.core.filter.imu import ImuStep
from thermal_fiducial.core.filter.initialisation import blank_state, start, WINDOW_SECONDS
from thermal_fiducial.core.filter.innovations import PoseUpdate
from thermal_fiducial.core.filter.navigation_state import in_moved_map, NavigationState
from thermal_fiducial.core.measurements import CameraPose
from thermal_fiducial.core.types import FloatArray

_SECOND_NS = 1_000_000_000
#: Seconds whose mean motion shows a clock error. The noise of one sample would count as motion that shows none, and it
#: is in the predicted attitude too: in a slow, shaking flight the two together lead the time offset astray.
_MOTION_SECONDS = 0.2
#: Poses are linearised anew when the time offset has become known so many times better, and well enough when it is
#: known to this [s]: half an angular acceleration of 5 rad/s^2 times its square is 0.01 mrad.
_BETTER, _WELL_KNOWN = 2.0, 0.002


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

    def supported(self, state: NavigationState, time_ns: int) -> 'Track':
        """The track after a pose that it accepts."""
        return replace(self, state=state, accepted_ns=time_ns, hits=self.hits + 1)


@dataclass(frozen=True, slots=True)
class Belief:
    """Everything that the filter knows at one instant."""

    main: Track | None = None
    rival: Track | None = None
    #: stamp of the last camera pose in it
    pose_stamp_ns: int = -(1 << 62)
    #: times that it started afresh
    resets: int = 0
    #: time offset [s] that holds while there is no estimate
    time_offset: float = 0.0


@dataclass(frozen=True)
class Sighting:
    """A camera pose at its instant."""

    pose: CameraPose
    #: the instant in the clock of the IMU
    time_ns: int
    #: gives the IMU samples (N, 6) of so many seconds up to it
    samples: Callable[[float], FloatArray]

    @cached_property
    def motion(self) -> Motion:
        """The motion that shows a clock error."""
        return Motion.of(self.samples(_MOTION_SECONDS), _MOTION_SECONDS)


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

    def predict(self, belief: Belief, step: ImuStep) -> Belief:
        """Belief after an inertial step."""
        if belief.main is None and belief.rival is None:
            return belief
        main, rival = self._moved(belief.main, step), self._moved(belief.rival, step)
        return Belief(main, rival, belief.pose_stamp_ns, belief.resets, belief.time_offset)

    def _moved(self, track: Track | None, step: ImuStep) -> Track | None:
        if track is None:
            return None
        state = self.filter.predict(track.state, step)
        return Track(state, track.started_ns, track.accepted_ns, track.linearised_std, track.hits, track.misses)

    def in_moved_map(self, belief: Belief, T_new_old: FloatArray) -> Belief:
        """``belief`` in a map whose coordinates are moved by ``T_new_old`` (4, 4)."""

        def move(track: Track | None) -> Track | None:
            return track and replace(track, state=in_moved_map(track.state, T_new_old, self.filter.layout))

        return replace(belief, main=move(belief.main), rival=move(belief.rival))

    def weigh(self, belief: Belief, sighting: Sighting) -> tuple[Belief, PoseUpdate]:
        """Belief after a pose."""
        stamp_ns, time_ns, main = sighting.pose.stamp_ns, sighting.time_ns, belief.main
        if main and time_ns - main.accepted_ns > self._config.reinitialise_after * _SECOND_NS:
            main = None
        nis = math.nan
        if main:
            state, nis = self._correct(main.state, sighting)
            if nis <= self._config.gate:
                accepted = Belief(main.supported(state, time_ns), None, stamp_ns, belief.resets)
                return accepted, PoseUpdate(stamp_ns, True, '', nis)
        rival = self._challenge(belief, sighting)
        if rival and self._convincing(rival, main, time_ns):
            resets = belief.resets + (belief.main is not None)
            reason = 'started afresh' if belief.main else 'initialised'
            return Belief(rival, None, stamp_ns, resets), PoseUpdate(stamp_ns, True, reason, nis, True)
        reason = f'refused: {math.sqrt(nis):.1f} sigma' if main else 'initialising'
        if rival is None:
            reason = 'refused: contradicts gravity'
        return replace(belief, rival=rival, pose_stamp_ns=stamp_ns), PoseUpdate(stamp_ns, False, reason, nis)

    def _correct(self, state: NavigationState, sighting: Sighting) -> tuple[NavigationState, float]:
        body = self.filter.body_pose(sighting.pose, state.T_body_camera)
        return self.filter.correct(state, body, sighting.motion)

    def _challenge(self, belief: Belief, sighting: Sighting) -> Track | None:
        """The rival after a pose that the main estimate refused; one that fails too often gives way to the pose."""
        rival, time_ns = belief.rival, sighting.time_ns
        if rival:
            state, nis = self._correct(rival.state, sighting)
            if nis <= self._config.gate:
                return rival.supported(state, time_ns)
            if rival.misses + 1 < rival.hits:
                return replace(rival, misses=rival.misses + 1)
        prior = belief.main.state if belief.main else replace(self._blank, time_offset=belief.time_offset)
        body = self.filter.body_pose(sighting.pose, prior.T_body_camera)
        first = start(self._config, self.filter, body, prior, sighting.samples(WINDOW_SECONDS))
        return Track(first, time_ns, time_ns, self._config.time_offset_std) if first else None

    def outgrown(self, belief: Belief) -> bool:
        """Whether the time offset is known so much better by now that its poses should be linearised anew."""
        main = belief.main
        if main is None or not main.state.clock_open or main.linearised_std <= _WELL_KNOWN:
            return False
        return _BETTER * self.filter.time_offset_std(main.state) < main.linearised_std

    def at_offset(self, belief: Belief, time_offset: float, skipped_ns: int) -> Belief:
        """A past ``belief`` to go on from, as it would be for another ``time_offset`` [s].

        What it knew of the offset stays as uncertain as it was, about another value: the poses that follow are what
        told that value, and are not to count twice. Poses up to the stamp ``skipped_ns`` are left out.
        """
        seen_ns = max(belief.pose_stamp_ns, skipped_ns)
        if belief.main is None or not belief.main.state.clock_open:
            return Belief(None, None, seen_ns, belief.resets, time_offset)
        state = self.filter.at_offset(belief.main.state, time_offset)
        return Belief(replace(belief.main, state=state), None, seen_ns, belief.resets)

    def linearised(self, belief: Belief, std: float) -> Belief:
        """``belief``, marked as linearised at a time offset known to ``std`` [s]."""
        assert belief.main
        return replace(belief, main=replace(belief.main, linearised_std=std))

    def _convincing(self, rival: Track, main: Track | None, time_ns: int) -> bool:
        if rival.hits < self._config.initial_poses:
            return False
        if main is None or position_std(main.state) > self._config.lost_position_std:
            return True
        since = max(rival.started_ns, main.accepted_ns)
        return time_ns - since >= self._config.reset_after * _SECOND_NS and rival.hits >= 2 * rival.misses


def position_std(state: NavigationState) -> float:
    """Root of the sum of the position variances [m]."""
    P = state.covariance
    return math.sqrt(P[6, 6] + P[7, 7] + P[8, 8])
