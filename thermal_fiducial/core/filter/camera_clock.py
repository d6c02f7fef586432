"""Steps of the camera's clock that are too large for the estimated offset: all at once poses arrive later or earlier.

How late a pose arrives by its stamp says nothing about a clock by itself, as a pipeline may stall. So a step is only
proposed here, when several poses agree on it; it is one if poses that contradict the estimate fit it then.

A step of the IMU's clock shows as one of the camera's: it is known by the IMU's own stamps, which jumped by as much.
"""

from collections import deque
from collections.abc import Iterable
from dataclasses import replace
from statistics import median

from thermal_fiducial.core.measurements import CameraPose

#: Smaller steps [ns] are found by the clock offset that is estimated: a frame's time, in which motion is hardly curved.
_SMALLEST_NS = 35_000_000
#: Poses in a row that must agree on a step, those that say what was usual before, and how many of these are enough.
_POSES, _USUAL, _ENOUGH = 5, 30, 15
#: They agree to half of the step, and to this [ns].
_AGREEMENT_NS = 50_000_000
#: So many poses that arrive unlike those before a jump of the IMU's stamps wait for an explanation.
_PATIENCE = 15


class CameraClock:
    """Follows how late poses arrive in the clock of the IMU, and takes steps out of their stamps."""

    def __init__(self) -> None:
        #: by how much the stamps are ahead of what they were when the filter began [ns]
        self.ahead_ns = 0
        #: newest sample at the arrival, and how late that makes the pose
        self._usual: deque[tuple[int, int]] = deque(maxlen=_USUAL)
        self._latest: deque[tuple[int, int]] = deque(maxlen=_POSES)
        self._imu_jump_ns = 0
        self._waited = 0

    def imu_jumped(self, jump_ns: int) -> None:
        """Take note that the stamps of the IMU jumped [ns]: they missed samples, or their clock stepped.

        Poses that have come since then were timed by a sample of long before.
        """
        self._imu_jump_ns, self._waited = jump_ns, 0
        last_ns = max((newest_ns for newest_ns, _ in self._usual), default=0)
        self._usual = deque((entry for entry in self._usual if entry[0] != last_ns), maxlen=_USUAL)

    @property
    def in_question(self) -> bool:
        """Whether poses since a jump of the IMU's stamps came unlike those before, and nothing says why."""
        return self._imu_jump_ns != 0 and 0 < self._waited < _PATIENCE

    def is_of_imu(self, step_ns: int) -> bool:
        """Whether what looks like a step of the camera's clock is one of the IMU's."""
        return self._imu_jump_ns != 0 and abs(step_ns + self._imu_jump_ns) < _AGREEMENT_NS

    def stamped(self, pose: CameraPose) -> CameraPose:
        """``pose`` with the stamp that it had without the steps."""
        return replace(pose, stamp_ns=pose.stamp_ns - self.ahead_ns) if self.ahead_ns else pose

    def proposed(self, pose: CameraPose, newest_ns: int) -> int:
        """By how much stamps have jumped ahead [ns] for all that arrival shows, 0: not at all.

        ``newest_ns``: stamp of the newest IMU sample when ``pose`` arrives.
        """
        late_ns = newest_ns - pose.stamp_ns
        usual_ns = median(late for _, late in self._usual) if len(self._usual) >= _ENOUGH else late_ns
        if abs(late_ns - usual_ns) < _SMALLEST_NS:
            self._usual.append((newest_ns, late_ns))
            self._latest.clear()
            self._imu_jump_ns = 0
            return 0
        self._waited += 1
        self._latest.append((pose.stamp_ns, late_ns))
        delays = [delay for _, delay in self._latest]
        step_ns = round(usual_ns - median(delays))
        if len(delays) < _POSES or max(delays) - min(delays) > min(abs(step_ns) // 2, _AGREEMENT_NS):
            return 0
        return step_ns

    def follow(self, step_ns: int) -> Iterable[int]:
        """Take a step of the stamps for true; the stamps of the poses that came with it and were believed."""
        self.ahead_ns += step_ns
        wrong = [stamp for stamp, _ in self._latest]
        self._latest.clear()
        self._imu_jump_ns = 0
        return wrong
