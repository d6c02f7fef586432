"""Checks of IMU samples at the filter's input: finite, in range, not frozen, stamps in order and on one clock."""

from enum import Enum
import math

from thermal_fiducial.core.measurements import ImuSample

#: Samples in a row that must follow each other after a jump: for a stepped clock, and for the end of a gap.
CLOCK_EVIDENCE, GAP_EVIDENCE = 10, 2
#: A step between stamps is unusual beyond this multiple of the longest recent one and beyond this length [ns]; time
#: constant [ns] with which the longest one decays.
UNUSUAL_FACTOR, UNUSUAL_NS, MEMORY_NS = 3.0, 30_000_000, 2_000_000_000
#: A sensor saturates at its full scale; a reading beyond this multiple of it is a corrupt message.
IMPOSSIBLE_RANGES = 2.0
#: Noise keeps samples from being equal, coarse quantisation of a still sensor repeats a few: equal samples for this
#: long [s], and at least this many, are one sample that is sent again and again.
FROZEN_SECONDS, FROZEN_SAMPLES = 0.045, 4


class Verdict(Enum):
    """What to do with a sample."""

    USE = ''
    NOT_FINITE = 'IMU sample is not finite'
    IMPOSSIBLE = 'IMU sample far beyond the range of its sensors'
    FROZEN = 'IMU is frozen: the same sample again and again'
    REPEATED = 'IMU stamp repeated'
    BACKWARD = 'IMU stamp went back'
    AHEAD = 'IMU stamp jumped ahead'
    RESTART = 'IMU clock jumped: reset'


class ImuInput:
    """Gives a verdict on each sample.

    A stamp that does not follow the last one is refused, as a single bad one would be. If further stamps continue from
    it, it ended a gap; where it went back, or the gap is too long, the clock was set, the bag restarted or the IMU was
    off, and the filter resets.
    """

    def __init__(self, max_gap: float, gyroscope_range: float, accelerometer_range: float) -> None:
        """``max_gap``: longest step [s] that can be bridged; full scale of the sensors [rad/s], [m/s^2]."""
        self._max_gap_ns = round(max_gap * 1e9)
        self._limits = IMPOSSIBLE_RANGES * gyroscope_range, IMPOSSIBLE_RANGES * accelerometer_range
        self._last_ns: int | None = None
        self._stray_ns = self._first_stray_ns = 0
        self._strays = 0
        self._longest_ns = 0.0
        #: jump of the stamps at the last sample that was used [ns]; 0 for a usual step
        self.jump_ns = 0
        self._reading: bytes = b''
        self._first_equal_ns = 0
        self._equal = 0

    def judge(self, sample: ImuSample) -> Verdict:
        """Verdict on ``sample``, which becomes the last sample for the next call if it is used."""
        rates, forces = sample.angular_velocity.tolist(), sample.linear_acceleration.tolist()
        if not all(map(math.isfinite, (*rates, *forces))):
            return Verdict.NOT_FINITE
        if max(map(abs, rates)) > self._limits[0] or max(map(abs, forces)) > self._limits[1]:
            return Verdict.IMPOSSIBLE
        if self._is_frozen(sample):
            return Verdict.FROZEN
        if self._last_ns is None:
            self._last_ns = sample.stamp_ns
        elif sample.stamp_ns == self._last_ns:
            return Verdict.REPEATED
        elif not 0 < sample.stamp_ns - self._last_ns <= self._usual_ns:
            return self._stray(sample.stamp_ns)
        self._follow(sample.stamp_ns)
        return Verdict.USE

    @property
    def _usual_ns(self) -> float:
        """Longest step [ns] that is accepted at once, without waiting for a sample that follows."""
        return min(max(UNUSUAL_FACTOR * self._longest_ns, UNUSUAL_NS), self._max_gap_ns)

    def _follow(self, stamp_ns: int, jump_ns: int = 0) -> None:
        assert self._last_ns is not None
        step_ns = stamp_ns - self._last_ns
        if 0 < step_ns <= self._max_gap_ns:
            self._longest_ns = max(self._longest_ns * (1.0 - step_ns / MEMORY_NS), step_ns)
        self._last_ns, self._strays, self.jump_ns = stamp_ns, 0, jump_ns

    def _is_frozen(self, sample: ImuSample) -> bool:
        reading = sample.angular_velocity.tobytes() + sample.linear_acceleration.tobytes()
        if reading != self._reading or sample.stamp_ns < self._first_equal_ns:
            self._reading, self._first_equal_ns, self._equal = reading, sample.stamp_ns, 0
        self._equal += 1
        lasting = sample.stamp_ns - self._first_equal_ns >= FROZEN_SECONDS * 1e9
        return lasting and self._equal >= FROZEN_SAMPLES

    def _stray(self, stamp_ns: int) -> Verdict:
        assert self._last_ns is not None
        if not 0 < stamp_ns - self._stray_ns <= self._max_gap_ns:
            self._strays, self._first_stray_ns = 0, stamp_ns
        self._strays += 1
        self._stray_ns = stamp_ns
        jump_ns = self._first_stray_ns - self._last_ns
        if 0 < jump_ns <= self._max_gap_ns:
            if self._strays < GAP_EVIDENCE:
                return Verdict.AHEAD
            self._follow(stamp_ns, jump_ns)
            return Verdict.USE
        if self._strays < CLOCK_EVIDENCE:
            return Verdict.BACKWARD if jump_ns < 0 else Verdict.AHEAD
        self._follow(stamp_ns, jump_ns)
        return Verdict.RESTART
