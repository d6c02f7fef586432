"""Checks of IMU samples at the filter's input: finite, in range, not frozen, stamps in order and on one clock."""

from collections import deque
from dataclasses import dataclass
from enum import Enum
import math
from operator import gt

from thermal_fiducial.core.filter.camera_clock import SMALLEST_STEP_NS
from thermal_fiducial.core.measurements import Condition, ImuSample
from thermal_fiducial.core.stamp_clock import NO_CLOCK, StampClock
from thermal_fiducial.core.types import SECOND_NS

#: Samples in a row that must follow each other after a jump: for a stepped clock, and for the end of a gap.
CLOCK_EVIDENCE, GAP_EVIDENCE = 10, 3
#: A longer step between stamps is a gap [ns]: the motion in it is not known from the samples at its ends.
GAP_NS = 30_000_000
#: A gap is unusual beyond this multiple of the longest recent step: at 50 Hz beyond 50 ms, which leaves steps of the
#: clock by 30 ms to the estimated offset. Time constant [ns] with which the longest step decays.
UNUSUAL_FACTOR, MEMORY_NS = 2.5, 2_000_000_000
#: A step longer than this multiple of the longest recent one is due to lost samples, or to a step of the clock: at 50
#: Hz one by 10 ms. Recorded IMUs seldom exceed it.
LOST_FACTOR = 1.4
#: A sensor saturates at its full scale; a reading beyond this multiple of it is a corrupt message.
IMPOSSIBLE_RANGES = 2.0
#: An axis is frozen once it has repeated a value for this long [s], in at least this many samples, and in this multiple
#: of its longest run so far, which is due to quantisation: runs of up to 4 and 30 samples in two recorded IMUs. Before
#: its first change it may be at rest, in a simulator without noise or behind a dead zone.
FROZEN_SECONDS, FROZEN_SAMPLES, FROZEN_FACTOR = 0.045, 4, 3
#: A sample is corrupt where it is farther from the one before than this multiple of the usual distance, unless the next
#: one is as far: twelve flights of an independent renderer are within 8 times, three recordings within 9. Nearer than
#: this [rad/s, m/s^2] it does no harm, 1 mrad and 10 mm/s over 5 ms. Usual is the mean of the last so many samples, and
#: of this many at least.
JUMP_FACTOR, LEAST_JUMPS, JUMP_MEMORY, FIRST_JUMPS = 10.0, (0.2, 2.0), 400, 20
#: An accelerometer that stays at full scale for longer [s] is dead: impacts are over by then, and thrust is less than
#: its range. A gyroscope may turn faster than its range for as long as it likes.
SATURATED_SECONDS = 0.1


class Verdict(Enum):
    """What to do with a sample."""

    USE = Condition('')
    NOT_FINITE = Condition('IMU sample is not finite')
    IMPOSSIBLE = Condition('IMU sample far beyond the range of its sensors')
    FROZEN = Condition('IMU is frozen', 'the same value again and again')
    EMPTY = Condition('IMU sample is zero', 'all six values')
    CORRUPT = Condition('IMU sample far from those around it')
    REPEATED = Condition('IMU stamp repeated', 'two publishers, or a driver that sets none?')
    NO_CLOCK = Condition('IMU has no clock', NO_CLOCK)
    BACKWARD = Condition('IMU stamp went back')
    AHEAD = Condition('IMU stamp jumped ahead')
    RESTART = Condition('IMU clock jumped', 'reset')


@dataclass
class StrayRun:
    """Samples in a row whose stamps do not follow those before them, but each other."""

    first_ns: int
    last_ns: int
    count: int = 1


class Axis:
    """Runs of equal values of one of the six axes; at ``full_scale`` they may last for ``saturated`` [s]."""

    def __init__(self, full_scale: float, saturated: float) -> None:
        self._full_scale, self._saturated = full_scale, saturated
        self._value = math.nan
        self._since_ns = self._count = 0
        self._longest = 0

    def is_frozen(self, stamp_ns: int, value: float) -> bool:
        """Whether the run that a sample's value continues is too long."""
        too_many = max(FROZEN_SAMPLES, FROZEN_FACTOR * self._longest)
        if value != self._value or stamp_ns < self._since_ns:
            if self._count < too_many or not self._longest:
                self._longest = max(self._longest, self._count)
            self._value, self._since_ns, self._count = value, stamp_ns, 0
        self._count += 1
        seconds = (stamp_ns - self._since_ns) / SECOND_NS
        if abs(value) >= self._full_scale:
            return seconds >= self._saturated
        return seconds >= FROZEN_SECONDS and self._count >= too_many and self._longest > 0


class Jumps:
    """Distances of rate and force from sample to sample."""

    def __init__(self) -> None:
        self._last: list[float] = []
        self._last_ns = 0
        #: mean squares, of so many samples
        self._usual, self._count = [0.0, 0.0], 0
        self._one_left_out = False

    def is_corrupt(self, stamp_ns: int, values: list[float]) -> bool:
        """Whether a sample is far from the last one, and the first that is; what changes in a gap is not known."""
        last = self._last or values
        squares = [math.dist(values[:3], last[:3]) ** 2, math.dist(values[3:], last[3:]) ** 2]
        limits = [max(JUMP_FACTOR**2 * usual, least**2) for usual, least in zip(self._usual, LEAST_JUMPS, strict=True)]
        follows = 0 < stamp_ns - self._last_ns <= GAP_NS and self._count >= FIRST_JUMPS
        far = follows and any(map(gt, squares, limits))
        self._one_left_out = far and not self._one_left_out
        if self._one_left_out:
            return True
        self._count = min(self._count + 1, JUMP_MEMORY)
        changes = (square - usual for usual, square in zip(self._usual, squares, strict=True))
        self._usual = [usual + change / self._count for usual, change in zip(self._usual, changes, strict=True)]
        self._last_ns, self._last = stamp_ns, values
        return False


class ImuInput:
    """Gives a verdict on each sample.

    A stamp that does not follow the last one is refused, as a single bad one would be. If further stamps continue from
    it, it ended a gap; where it went back, or the gap is too long, the clock was set, the bag restarted or the IMU was
    off, and the filter resets; also where stamps that went back have soon passed the last one again.
    """

    def __init__(self, max_gap: float, gyroscope_range: float, accelerometer_range: float) -> None:
        """``max_gap``: longest step [s] that can be bridged; full scale of the sensors [rad/s], [m/s^2]."""
        self._max_gap_ns = round(max_gap * SECOND_NS)
        ranges = [gyroscope_range] * 3 + [accelerometer_range] * 3
        self._limits = [IMPOSSIBLE_RANGES * full_scale for full_scale in ranges]
        saturated = [math.inf] * 3 + [SATURATED_SECONDS] * 3
        self._axes = [Axis(*of_axis) for of_axis in zip(ranges, saturated, strict=True)]
        self._jumps = Jumps()
        self._clock = StampClock()
        self._last_ns: int | None = None
        #: the last samples that were used, which may come once more
        self._used: deque[tuple[int, list[float]]] = deque(maxlen=CLOCK_EVIDENCE)
        #: since the last sample that was used; None: no sample
        self._strays: StrayRun | None = None
        #: longest recent step [ns]
        self._longest_ns = 0.0
        #: the longest of those that may hide a small step of the clock: a long gap says nothing of these
        self.longest_short_ns = 0.0
        #: by how much the step to the last sample that was used exceeds the longest recent short one, if by far [ns]
        self.excess_ns = 0
        #: jump of the stamps at the last sample that was used [ns]; 0 for a usual step
        self.jump_ns = 0

    def judge(self, sample: ImuSample) -> Verdict:
        """Verdict on ``sample``, which becomes the last sample for the next call if it is used."""
        values = sample.angular_velocity.tolist() + sample.linear_acceleration.tolist()
        if not all(map(math.isfinite, values)):
            return Verdict.NOT_FINITE
        if any(abs(value) > limit for value, limit in zip(values, self._limits, strict=True)):
            return Verdict.IMPOSSIBLE
        if not any(values):
            return Verdict.EMPTY
        if self._clock.shows_none(sample.stamp_ns):
            return Verdict.NO_CLOCK
        frozen = [axis.is_frozen(sample.stamp_ns, value) for axis, value in zip(self._axes, values, strict=True)]
        if any(frozen):
            return Verdict.FROZEN
        # A longer step waits for samples that follow.
        usual_ns = min(max(UNUSUAL_FACTOR * self._longest_ns, GAP_NS), self._max_gap_ns)
        if self._last_ns is None:
            self._last_ns = sample.stamp_ns
        elif sample.stamp_ns == self._last_ns:
            return Verdict.REPEATED
        elif not 0 < sample.stamp_ns - self._last_ns <= usual_ns:
            return Verdict.REPEATED if (sample.stamp_ns, values) in self._used else self._stray(sample.stamp_ns)
        jump_ns = self._passed_again_ns(self._strays) if self._strays else 0
        self._used.append((sample.stamp_ns, values))
        self._follow(sample.stamp_ns, jump_ns)
        if jump_ns:
            return Verdict.RESTART
        return Verdict.CORRUPT if self._jumps.is_corrupt(sample.stamp_ns, values) else Verdict.USE

    def _passed_again_ns(self, run: StrayRun) -> int:
        """Jump back of the stamps [ns] whose ``run`` has now passed the last sample again; 0 if they had not jumped.

        Samples that were overtaken lie between those that were used. After a step of the clock both lie among each
        other: the robot has moved on while stamps were refused.
        """
        assert self._last_ns is not None
        among = any(run.first_ns <= stamp_ns <= run.last_ns for stamp_ns, _ in self._used)
        return run.first_ns - self._last_ns if among and run.count >= GAP_EVIDENCE else 0

    def _follow(self, stamp_ns: int, jump_ns: int = 0) -> None:
        """Take a sample as the last one: what its step says of usual steps, and of steps of the clock."""
        assert self._last_ns is not None
        step_ns = stamp_ns - self._last_ns
        gap_ns = jump_ns or step_ns
        unusual = gap_ns > LOST_FACTOR * self.longest_short_ns > 0.0
        self.excess_ns = round(gap_ns - self.longest_short_ns) if unusual else 0
        if 0 < step_ns <= self._max_gap_ns:
            decayed = 1.0 - step_ns / MEMORY_NS
            self._longest_ns = max(decayed * self._longest_ns, step_ns)
            short_ns = step_ns if self.excess_ns < SMALLEST_STEP_NS else 0
            self.longest_short_ns = max(decayed * self.longest_short_ns, short_ns)
        self._last_ns, self._strays, self.jump_ns = stamp_ns, None, jump_ns

    def _stray(self, stamp_ns: int) -> Verdict:
        """Verdict on a sample whose stamp does not follow the last one: enough of them in a row are right."""
        assert self._last_ns is not None
        run = self._strays
        if run is not None and run.first_ns <= stamp_ns <= run.last_ns:
            # Messages that come twice, or in another order, end no run.
            return Verdict.REPEATED if stamp_ns == run.last_ns else Verdict.BACKWARD
        # One that was overtaken is no part of a jump ahead behind it.
        overtaken = run is not None and run.last_ns < self._last_ns < stamp_ns
        if run is None or overtaken or not 0 < stamp_ns - run.last_ns <= self._max_gap_ns:
            run = self._strays = StrayRun(stamp_ns, stamp_ns)
        else:
            run.last_ns, run.count = stamp_ns, run.count + 1
        jump_ns = run.first_ns - self._last_ns
        if 0 < jump_ns <= self._max_gap_ns:
            if run.count < GAP_EVIDENCE:
                return Verdict.AHEAD
            self._follow(stamp_ns, jump_ns)
            return Verdict.USE
        if run.count < CLOCK_EVIDENCE:
            return Verdict.BACKWARD if jump_ns < 0 else Verdict.AHEAD
        self._follow(stamp_ns, jump_ns)
        return Verdict.RESTART
