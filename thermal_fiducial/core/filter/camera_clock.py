"""Steps of the camera's clock.

A step shows in two ways. A stamp is off the grid of frames, at once, but not after a step by whole frames. And the
delay of poses changes by the whole step, but a pipeline that stalls changes it too: a step is proposed once several
poses agree on it.

Small ones are left to the offset in the state; its variance grows before the first pose after the step. Of those that
are too large for it the filter accepts one if restamped poses pass the gate that they fail as they came.

A step of the IMU's clock looks the same, but then the stamps of the IMU have jumped by the same amount.
"""

from collections import deque
from dataclasses import replace
from statistics import median

from thermal_fiducial.core.measurements import CameraPose

#: Smallest step [ns] that is removed. Smaller ones are left to the estimated clock offset, as motion is nearly straight
#: over that time.
SMALLEST_STEP_NS = 35_000_000
#: Smallest change of the delay [ns] that may be a step: three quarters of a frame at 60 Hz. Smaller steps are off the
#: grid of frames.
_CHANGED_NS = 12_500_000
#: Poses in a row that must agree on a step; poses kept for the usual delay, and the fewest for it to be known.
_POSES, _USUAL, _ENOUGH = 5, 30, 15
#: Largest range [ns] of the delays of agreeing poses where usual ones scatter by less, beside half of the step; a tenth
#: of the usual ones.
_AGREEMENT_NS, _END = 50_000_000, _USUAL // 10
#: A stamp is off the grid of frames beyond this multiple of the largest recent distance, which is jitter, and this
#: length [ns]. After this time [ns] the grid is lost, as errors of the period add up.
_OFF_GRID, _OFF_GRID_NS, _LOST_NS = 3, 1_000_000, 1_000_000_000
#: Poses with an unusual delay after a jump of the IMU's stamps that are held back until a cause is found.
_PATIENCE = 15


class CameraClock:
    """Monitors the delay of poses in the IMU's clock, and takes the clock's steps out of their stamps."""

    def __init__(self) -> None:
        #: sum of the camera clock's steps since the filter began [ns]
        self.ahead_ns = 0
        #: stamp of the newest sample at arrival, and delay of the pose by that sample [ns]
        self._usual: deque[tuple[int, int]] = deque(maxlen=_USUAL)
        self._latest: deque[tuple[int, int]] = deque(maxlen=_POSES)
        #: newest sample by which a delay was measured
        self._newest_ns = 0
        self._imu_jump_ns = 0
        self._waited = 0

    def imu_jumped(self, jump_ns: int) -> None:
        """Take note that the stamps of the IMU jumped by ``jump_ns``: samples are missing, or their clock stepped.

        Delays that were measured against the last sample before the jump are dropped.
        """
        self._imu_jump_ns, self._waited = jump_ns, 0
        last_ns = max((newest_ns for newest_ns, _ in self._usual), default=0)
        self._usual = deque((entry for entry in self._usual if entry[0] != last_ns), maxlen=_USUAL)

    @property
    def in_question(self) -> bool:
        """Whether poses have an unusual delay since a jump of the IMU's stamps, with no cause found yet."""
        return self.suspects_imu and self._waited > 0

    @property
    def suspects_imu(self) -> bool:
        """Whether the IMU's clock may have stepped at the last jump of its stamps: no delay has shown it yet."""
        return self._imu_jump_ns != 0 and self._waited < _PATIENCE

    def is_step_of_imu(self, step_ns: int) -> bool:
        """Whether an apparent step of the camera's clock is a step of the IMU's."""
        return self._imu_jump_ns != 0 and abs(step_ns + self._imu_jump_ns) < _AGREEMENT_NS

    def stamped(self, pose: CameraPose) -> CameraPose:
        """``pose`` with the known steps taken out of its stamp."""
        return replace(pose, stamp_ns=pose.stamp_ns - self.ahead_ns) if self.ahead_ns else pose

    def proposed(self, pose: CameraPose, newest_ns: int, interval_ns: float) -> int:
        """Step of the camera's clock [ns] that the delays of the latest poses suggest, 0 for none.

        Parameters
        ----------
        newest_ns : stamp of the newest IMU sample when ``pose`` arrives
        interval_ns : longest recent interval between samples; delays scatter by it, as they are measured by samples
        """
        if newest_ns == self._newest_ns:
            return 0  # The IMU is silent: the pose is later than that.
        self._newest_ns = newest_ns
        late_ns = newest_ns - pose.stamp_ns
        usual_ns = median(late for _, late in self._usual) if len(self._usual) >= _ENOUGH else late_ns
        if abs(late_ns - usual_ns) < min(max(_CHANGED_NS, interval_ns), SMALLEST_STEP_NS):
            # Those before it were no step either: delays scatter.
            self._usual.extend((stamp + late, late) for stamp, late in self._latest)
            self._usual.append((newest_ns, late_ns))
            self._latest.clear()
            self._imu_jump_ns = 0
            return 0
        self._waited += 1
        self._latest.append((pose.stamp_ns, late_ns))
        delays = [delay for _, delay in self._latest]
        step_ns = round(usual_ns - median(delays))
        if len(delays) < _POSES or max(delays) - min(delays) > min(abs(step_ns) // 2, self._agreement_ns):
            return 0
        return step_ns

    @property
    def _agreement_ns(self) -> int:
        """Largest range of agreeing delays [ns]: as usual ones without the tenths at either end, and not less."""
        usual = sorted(late for _, late in self._usual)[_END:-_END]
        return max(_AGREEMENT_NS, usual[-1] - usual[0]) if usual else _AGREEMENT_NS

    def take_for_usual(self) -> int:
        """Take the delay of the latest poses for the usual one; returns the stamp of the first of them."""
        newest_ns, late_ns = self._usual[-1]
        # After a step back the first stamps repeat those of poses before it.
        new = (stamp for stamp, _ in self._latest if stamp > newest_ns - late_ns)
        first_ns = min(new, default=self._latest[-1][0])
        self._usual.clear()
        self._latest.clear()
        return first_ns

    def uncertainty_ns(self, interval_ns: float) -> int:
        """Standard deviation [ns], at most, of the step that :meth:`proposed` has just found.

        Half of what its delays are apart, or of ``interval_ns``: the median of five has half of a single one's
        deviation, which is less than half of their range.
        """
        delays = [delay for _, delay in self._latest]
        return round(0.5 * max(max(delays) - min(delays), interval_ns))

    @property
    def suspects(self) -> set[int]:
        """Stamps of the latest poses with an unusual delay: after a step they were applied at wrong instants."""
        return {stamp for stamp, _ in self._latest}

    def follow(self, step_ns: int) -> None:
        """Accept a step."""
        self.ahead_ns += step_ns
        self._latest.clear()
        self._imu_jump_ns = 0


class FrameGrid:
    """The grid of the camera's stamps: whole periods apart, as poses of some frames may be missing."""

    def __init__(self) -> None:
        self._last_ns = 0
        #: latest steps between stamps, and their distances from a whole number of periods [ns]
        self._steps: deque[int] = deque(maxlen=_USUAL)
        self._distances: deque[int] = deque(maxlen=_USUAL)

    def off_grid(self, stamp_ns: int) -> int:
        """Distance [ns] of a stamp from the grid of the last ones; 0 unless it is far larger than all recent ones."""
        step_ns, known = stamp_ns - self._last_ns, sorted(self._steps)
        if -_LOST_NS < step_ns <= 0:
            return 0
        self._last_ns = stamp_ns
        if not 0 < step_ns < _LOST_NS:
            return 0
        self._steps.append(step_ns)
        if len(known) < _ENOUGH:
            return 0
        # The shortest step may be that of a clock that went back.
        period_ns = known[1]
        distance_ns = abs(step_ns - max(round(step_ns / period_ns), 1) * period_ns)
        usual_ns = max(self._distances) if len(self._distances) >= _ENOUGH else distance_ns
        self._distances.append(distance_ns)
        return distance_ns if distance_ns > _OFF_GRID * usual_ns + _OFF_GRID_NS else 0
