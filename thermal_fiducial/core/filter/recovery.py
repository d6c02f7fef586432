"""Which poses count: chi-square against the present estimate, and recovery by evidence instead of lock-out.

A pose that the estimate refuses begins an alternative hypothesis, a second estimate that the following poses support or
not. One that many poses agree with, while the estimate accepts few, replaces it. The start of the filter is the same
thing without an estimate to replace.
"""

import math
from typing import NamedTuple

from thermal_fiducial.config import PoseEkfConfig
from thermal_fiducial.core.filter.state import Estimate, POSITION
from thermal_fiducial.core.types import FloatArray, SECOND_NS

#: An alternative must agree with so many times more poses than the estimate: one whose clock is wrong accepts some when
#: the robot slows down.
_PREFERRED = 4
#: So many refused poses in a row, and the estimate is in doubt: a tenth of a second at 30 Hz.
REFUSALS_OF_DOUBT = 3
#: So many accepted ones in a row, and the alternative is forgotten.
_REFUTED = 3
NEVER = -(1 << 62)


class Hypothesis(NamedTuple):
    """An estimate and the poses that speak for it, and against it."""

    estimate: Estimate
    #: instants of its first and of its last accepted pose, clock of the IMU
    started_ns: int
    accepted_ns: int
    hits: int = 1
    misses: int = 0
    #: latest poses that it accepted, refused, in a row
    accepted_in_row: int = 1
    refused_in_row: int = 0
    #: of an alternative: poses that must agree on it
    needed: int = 0

    def accepting(self, estimate: Estimate) -> 'Hypothesis':
        """After a pose that it accepts."""
        return self._replace(
            estimate=estimate,
            accepted_ns=estimate.stamp_ns,
            hits=self.hits + 1,
            accepted_in_row=self.accepted_in_row + 1,
            refused_in_row=0,
        )

    def refusing(self, estimate: Estimate) -> 'Hypothesis':
        """After a pose that it refuses."""
        return self._replace(
            estimate=estimate,
            misses=self.misses + 1,
            accepted_in_row=0,
            refused_in_row=self.refused_in_row + 1,
        )

    def in_moved_map(self, T_new_old: FloatArray) -> 'Hypothesis':
        """The same in a map whose coordinates are moved by ``T_new_old`` (4, 4)."""
        return self._replace(estimate=self.estimate.in_moved_map(T_new_old))

    @property
    def position_std(self) -> float:
        """Root of the sum of the position variances, those by the map's error too [m]."""
        of_map = self.estimate.pose_noise.last.map_covariance[:3, :3]
        return math.hypot(self.position_std_in_map, math.sqrt(float(of_map.trace())))

    @property
    def position_std_in_map(self) -> float:
        """The same relative to the map as it is, which is what poses can be compared with [m]."""
        return self.estimate.std(POSITION)

    @property
    def in_doubt(self) -> bool:
        """Whether the latest poses contradict it."""
        return self.refused_in_row >= REFUSALS_OF_DOUBT

    @property
    def failed(self) -> bool:
        """Whether an alternative fits too few of the poses since it began."""
        return self.misses >= self.hits


class Belief(NamedTuple):
    """Everything that the filter knows after a pose."""

    main: Hypothesis | None = None
    alternative: Hypothesis | None = None
    #: stamp of the last camera pose that was taken in
    pose_stamp_ns: int = NEVER
    #: times that an alternative has replaced an estimate
    resets: int = 0
    #: hits of the estimate when the alternative began
    hits_before: int = 0
    #: whether the first of the poses that the estimate has refused in a row was near it: it has drifted, as by a fault
    #: of the IMU; a marker that moved, or has a twin, is far off at once
    drifted: bool = False
    #: why that happened the last time
    reset_reason: str = ''
    #: before there is an estimate: what of the IMU the poses contradict, in words
    contradiction: str = ''

    @property
    def hypotheses(self) -> list[Hypothesis]:
        """Those that there are."""
        return [hypothesis for hypothesis in (self.main, self.alternative) if hypothesis]

    @property
    def stamp_ns(self) -> int:
        """Instant up to which nothing before it matters any more; that of the pose's stamp without any hypothesis."""
        return min((h.estimate.stamp_ns for h in self.hypotheses), default=self.pose_stamp_ns)

    def in_moved_map(self, T_new_old: FloatArray) -> 'Belief':
        """The belief in a map whose coordinates are moved by ``T_new_old`` (4, 4)."""
        main = self.main and self.main.in_moved_map(T_new_old)
        alternative = self.alternative and self.alternative.in_moved_map(T_new_old)
        return self._replace(main=main, alternative=alternative)

    def settled(self, config: PoseEkfConfig) -> 'Belief':
        """The belief after the alternative was weighed against the estimate: it is forgotten, replaces it, or waits."""
        main, other = self.main, self.alternative
        if other is None:
            return self
        if other.failed or (main and main.accepted_in_row >= _REFUTED):
            return self._replace(alternative=None)
        if main is None:
            return self._promoted('') if other.hits >= config.initial_poses else self
        if other.hits < config.initial_poses:
            return self
        reason = self._why_reset(main, other, config)
        return self._promoted(reason) if reason else self

    def _why_reset(self, main: Hypothesis, other: Hypothesis, config: PoseEkfConfig) -> str:
        """Why the alternative ``other`` should replace ``main``, in words; empty: it should not."""
        if other.accepted_ns - main.accepted_ns > config.reinitialise_after * SECOND_NS:
            return f'no pose was accepted for {config.reinitialise_after:.0f} s'
        if main.position_std_in_map > config.lost_position_std:
            return 'the pose was lost, and markers are seen again'
        lasting = other.accepted_ns - other.started_ns >= config.reset_after * SECOND_NS
        against = main.hits - self.hits_before
        agreed = other.hits >= max(2 * other.misses, _PREFERRED * against, other.needed)
        return 'the poses contradict the estimate and agree with each other' if lasting and agreed else ''

    def _promoted(self, reason: str) -> 'Belief':
        """With the alternative as the estimate, for a ``reason`` in words where there was one."""
        assert self.alternative
        resets = self.resets + (self.main is not None)
        fresh = self.alternative._replace(accepted_in_row=1, refused_in_row=0, needed=0)
        return self._replace(
            main=fresh,
            alternative=None,
            resets=resets,
            reset_reason=reason,
            contradiction='',
        )
