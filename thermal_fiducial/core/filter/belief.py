"""The main and the alternative hypothesis, and when the alternative replaces the main one (a reset).

A pose that fails the gate of the estimate begins an alternative hypothesis, a second estimate. It replaces the first
when many poses pass its gate while the estimate refuses them, so that the gate cannot lock the filter out. The filter
is initialised in the same way, without an estimate to replace. Each pose gets a verdict, which is logged.
"""

from dataclasses import dataclass, replace
from itertools import islice
import math
from operator import attrgetter
from typing import NamedTuple

import numpy as np

from thermal_fiducial.config import PoseEkfConfig
from thermal_fiducial.core.filter.pose_noise import PoseNoise
from thermal_fiducial.core.filter.state import Estimate, POSITION, ROTATION
from thermal_fiducial.core.geometry.se3 import so3_log
from thermal_fiducial.core.measurements import Condition
from thermal_fiducial.core.two_poses import DECISIVE
from thermal_fiducial.core.types import FloatArray, SECOND_NS

#: Poses that the alternative must accept for each one that the estimate accepts: an estimate with a wrong clock offset
#: still accepts some when the robot slows down.
_PREFERRED = 4
#: Refused poses in a row from which on the estimate is in doubt: a tenth of a second at 30 Hz.
REFUSALS_OF_DOUBT = 3
#: Poses that the estimate must accept in a row for the alternative to be dropped.
_REFUTED = 3
NEVER = -(1 << 62)
#: Verdicts kept, and poses over which the diagnostics average the normalised innovation squared (NIS).
_KEPT, _NIS_POSES = 300, 30
#: Reasons of a reset. In fast motion poses are off together by a clock, a line readout or a lag not as declared; an IMU
#: with wrong axes passes for a good one at rest, and contradicts all poses as soon as the robot moves, and so do poses
#: of another scale, and those of a camera that is elsewhere on the robot.
_AGAIN = 'if again and again: axes, sign, units of the IMU, camera_position, camera_orientation, marker_size?'
OUTVOTED = (
    'the poses contradict the estimate and agree with each other; if in fast motion: camera_time_offset, '
    f'readout_time, bolometer_lag? {_AGAIN}'
)
LOST = f'the pose was lost, and poses agree with each other; {_AGAIN}'


@dataclass(frozen=True, slots=True)
class PoseUpdate:
    """Verdict on a camera pose."""

    #: stamp of the camera, as it came
    stamp_ns: int
    #: whether it moved the estimate
    accepted: bool
    #: in words; empty when accepted, except for the pose that initialised or reset the filter
    reason: str
    #: squared Mahalanobis distance (6 degrees of freedom), NaN where there was nothing to compare with
    nis: float
    #: whether it waits for the IMU samples of its instant; the final word is in ``PoseEkf.decided``
    pending: bool = False

    @property
    def refused(self) -> bool:
        """Whether it was compared with the estimate and found beyond the gate."""
        return not self.accepted and not math.isnan(self.nis)


class Hypothesis(NamedTuple):
    """An estimate with the numbers of poses that passed and failed its gate."""

    estimate: Estimate
    #: instants in the IMU's clock: of its first pose, of the last accepted one that showed where it is, of the last one
    started_ns: int
    accepted_ns: int
    compared_ns: int
    hits: int = 1
    misses: int = 0
    #: number of latest poses accepted in a row, or refused in a row
    accepted_in_row: int = 1
    refused_in_row: int = 0
    #: innovation (6,) of the latest refused pose; zero before the first
    against: FloatArray = np.zeros(6)
    #: NIS of the poses accepted since, together, if the estimate were off as that one claims
    would_show: float = 0.0
    #: of an alternative: poses that it must accept before it may replace the estimate
    needed: int = 0
    #: minus twice the log likelihood of its poses, up to a constant
    cost: float = 0.0

    def accepting(self, estimate: Estimate) -> 'Hypothesis':
        """The hypothesis after an accepted pose, with the updated ``estimate``."""
        return self._replace(
            estimate=estimate,
            accepted_ns=estimate.stamp_ns,
            compared_ns=estimate.stamp_ns,
            hits=self.hits + 1,
            accepted_in_row=self.accepted_in_row + 1,
            refused_in_row=0,
        )

    def refusing(self, estimate: Estimate, innovation: FloatArray) -> 'Hypothesis':
        """The hypothesis after a refused pose with its ``innovation`` (6,)."""
        return self._replace(
            estimate=estimate,
            compared_ns=estimate.stamp_ns,
            misses=self.misses + 1,
            accepted_in_row=0,
            refused_in_row=self.refused_in_row + 1,
            against=innovation,
            would_show=0.0,
        )

    def staying_in_doubt(self, estimate: Estimate, would_show: float) -> 'Hypothesis':
        """The hypothesis after an accepted pose that would not have shown what the refused ones claim."""
        return self._replace(estimate=estimate, compared_ns=estimate.stamp_ns, would_show=would_show)

    def with_noise(self, noise: PoseNoise) -> 'Hypothesis':
        """The hypothesis with variances of the poses' white errors as in ``noise``, not adapted to its own poses."""
        own = replace(self.estimate.pose_noise, variances=noise.variances, information=noise.information)
        return self._replace(estimate=replace(self.estimate, pose_noise=own))

    def is_apart_from(self, other: 'Hypothesis') -> bool:
        """Whether the attitudes of the two still differ by more than is not known of this one's.

        A pose may be vague enough to bring both to the same estimate before it shows which one was wrong.
        """
        turn = so3_log(self.estimate.state.R_map_body.T @ other.estimate.state.R_map_body)
        variance = turn @ self.estimate.covariance[ROTATION, ROTATION] @ turn
        return float(turn @ turn) ** 2 >= float(variance)

    @property
    def in_doubt(self) -> bool:
        """Whether the latest poses were refused, ``REFUSALS_OF_DOUBT`` or more in a row."""
        return self.refused_in_row >= REFUSALS_OF_DOUBT

    @property
    def failed(self) -> bool:
        """Whether at least half of the poses since it began were refused."""
        return self.misses >= self.hits


class Belief(NamedTuple):
    """Everything that the filter knows after a pose; immutable, so that older ones can be returned to."""

    main: Hypothesis | None = None
    alternative: Hypothesis | None = None
    #: while initialising with two possible poses: by the other one
    second: Hypothesis | None = None
    #: on the last pose that was applied
    verdict: PoseUpdate = PoseUpdate(NEVER, False, '', math.nan)
    #: times that an alternative has replaced an estimate
    resets: int = 0
    #: ``hits`` of the estimate when the alternative began
    hits_before: int = 0
    #: whether the first of the poses refused in a row was near the estimate: then the estimate has drifted, for example
    #: by a fault of the IMU; a moved or duplicated marker is far off at once
    drifted: bool = False
    #: clock offset [s], beyond the parameter's, about which an initialisation is linearised
    first_offset: float = 0.0
    #: reason of the latest reset, in words
    reset_reason: str = ''
    #: while initialising: which sensor of the IMU the last refused pose contradicts, if any
    contradiction: Condition | None = None

    @property
    def hypotheses(self) -> list[Hypothesis]:
        """Main, alternative, and second, as far as they exist."""
        return [hypothesis for hypothesis in (self.main, self.alternative, self.second) if hypothesis]

    @property
    def stamp_ns(self) -> int:
        """Earliest instant of its hypotheses, older samples are not needed; without any, the stamp of the pose."""
        return min((h.estimate.stamp_ns for h in self.hypotheses), default=self.verdict.stamp_ns)

    def settled(self, config: PoseEkfConfig) -> 'Belief':
        """The belief after the alternative was compared with the estimate: dropped, promoted, or kept."""
        main, other = self.main, self.alternative
        if other is None:
            return self
        if self.second:
            likelier, less_likely = sorted((other, self.second), key=attrgetter('cost'))
            undecided = less_likely.cost - likelier.cost <= DECISIVE and likelier.is_apart_from(less_likely)
            if undecided and not likelier.failed:
                return self
            return self._replace(alternative=likelier, second=None).settled(config)
        if other.failed or (main and main.accepted_in_row >= _REFUTED):
            return self._replace(alternative=None)
        if main is None:
            return self._promoted('') if other.hits >= config.initial_poses else self
        if other.hits < config.initial_poses:
            return self
        reason = self._why_reset(main, other, config)
        return self._promoted(reason) if reason else self

    def _why_reset(self, main: Hypothesis, other: Hypothesis, config: PoseEkfConfig) -> str:
        """Why the alternative ``other`` replaces ``main``, in words; empty if it does not."""
        if other.accepted_ns - main.accepted_ns > config.reinitialise_after * SECOND_NS:
            return f'no pose was accepted for {config.reinitialise_after:.0f} s'
        # Relative to the map: in one that is known poorly the pose may not be flown on, but the estimate is good.
        if main.estimate.std(POSITION) > config.lost_position_std:
            return LOST
        lasting = other.accepted_ns - other.started_ns >= config.reset_after * SECOND_NS
        against = main.hits - self.hits_before
        agreed = other.hits >= max(2 * other.misses, _PREFERRED * against, other.needed)
        return OUTVOTED if lasting and agreed else ''

    def _promoted(self, reason: str) -> 'Belief':
        """The belief with the alternative as its estimate; ``reason`` in words, empty at initialisation."""
        assert self.alternative
        resets = self.resets + (self.main is not None)
        words = 'reset' if self.main else 'initialised'
        fresh = self.alternative._replace(accepted_in_row=1, refused_in_row=0, needed=0)
        return self._replace(
            main=fresh,
            alternative=None,
            verdict=PoseUpdate(self.verdict.stamp_ns, True, words, math.nan),
            resets=resets,
            reset_reason=reason,
            contradiction=None,
        )


class PoseLog:
    """The latest verdicts, in the order in which they were given, and the numbers of accepted and refused poses."""

    def __init__(self) -> None:
        #: stamp of the camera to the latest verdict on its pose
        self.latest: dict[int, PoseUpdate] = {}
        self.accepted = self.refused = 0

    def add(self, update: PoseUpdate) -> None:
        """Log a verdict; a pose that is applied again after a late one counts once."""
        if self.latest.pop(update.stamp_ns, None) is None:
            self.accepted += update.accepted
            self.refused += update.refused
        self.latest[update.stamp_ns] = update
        if len(self.latest) > _KEPT:
            del self.latest[next(iter(self.latest))]

    def mean_nis(self) -> float:
        """Mean NIS per degree of freedom of the latest accepted poses: 1 is consistent, less conservative."""
        latest = islice(reversed(self.latest.values()), _NIS_POSES)
        values = [update.nis / 6.0 for update in latest if update.accepted and not math.isnan(update.nis)]
        return float(np.mean(values or math.nan))
