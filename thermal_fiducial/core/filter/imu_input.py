"""What may enter the filter from the IMU: finite samples in the order of their stamps, on one clock."""

from enum import Enum
import math

from thermal_fiducial.core.measurements import ImuSample

#: So many samples in a row must agree on a new clock before it is believed; on the end of a gap.
CLOCK_EVIDENCE, GAP_EVIDENCE = 10, 2
#: A step is unusual if it is so many times longer than the longest of late, and than this [ns]; that one is forgotten
#: within so long [ns].
UNUSUAL_FACTOR, UNUSUAL_NS, MEMORY_NS = 3.0, 30_000_000, 2_000_000_000
#: A sensor saturates at its full scale; a reading so many times as large is a broken message.
IMPOSSIBLE_RANGES = 2.0
#: Noise makes no two samples equal, coarse quantisation of a still sensor a few: equal ones for so long [s], and
#: so many of them, are one sample that is sent again and again.
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
    """Judges samples one by one.

    A stamp out of line is refused, as it may be a single bad one. When the stamps go on from there, it was the end of a
    gap, or, where it goes back or lasts too long, the clock was set, the bag restarted, or the IMU was away: then
    everything begins anew.
    """

    def __init__(self, max_gap: float, gyroscope_range: float, accelerometer_range: float) -> None:
        """``max_gap``: longest step [s] that can be bridged; full scale of the sensors [rad/s], [m/s^2]."""
        self._max_gap_ns = round(max_gap * 1e9)
        self._limits = IMPOSSIBLE_RANGES * gyroscope_range, IMPOSSIBLE_RANGES * accelerometer_range
        self._last_ns: int | None = None
        self._stray_ns = self._first_stray_ns = 0
        self._strays = 0
        self._longest_ns = 0.0
        #: by how much the stamps jumped at the sample that was used last [ns]; 0: they went on as usual
        self.jump_ns = 0
        self._reading: bytes = b''
        self._first_equal_ns = 0
        self._equal = 0

    def judge(self, sample: ImuSample) -> Verdict:
        """Verdict on ``sample``; it is remembered."""
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
        """Longest step [ns] that is taken without another sample that follows it."""
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
