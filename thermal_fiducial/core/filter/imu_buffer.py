"""Buffer of the latest IMU samples: integration steps, interpolated samples and the motion at a pose's instant."""

from bisect import bisect_left, bisect_right
from dataclasses import dataclass
import math
from typing import NamedTuple

import numpy as np

from thermal_fiducial.core.filter.imu_input import GAP_NS
from thermal_fiducial.core.types import FloatArray, SECOND_NS

#: The motion at a pose is the mean of the samples this long [s] before and after it, as far as they have arrived.
_MOTION_SECONDS = 0.05
#: Initial capacity [samples]: five seconds at 200 Hz.
_CAPACITY = 1000


class Steps(NamedTuple):
    """N consecutive steps.

    Mean sample ``imu`` (N, 6), ``seconds`` (N,), noise ``densities`` (N, 6), derivative ``force_slope`` (N, 3) of the
    specific force [m/s^3].
    """

    imu: FloatArray
    seconds: FloatArray
    densities: FloatArray
    force_slope: FloatArray


class LastSample(NamedTuple):
    """The newest sample ``imu`` (6,); ``seconds`` and noise ``densities`` (6,) of the step that ends with it."""

    imu: FloatArray
    seconds: float
    densities: FloatArray


@dataclass(frozen=True, slots=True)
class MotionAtPose:
    """What the IMU shows of the motion at a pose's instant.

    Attributes
    ----------
    imu : (6,) mean of equally many samples before and after it: a one-sided mean would bias the clock offset
    turning : magnitude of the angular acceleration [rad/s^2]
    white : (6,) variances by white noise alone, of the mean rate [rad^2/s^2] and of what that of the accelerometer has
        added to the velocity since the last accepted pose [m^2/s^2]
    """

    imu: FloatArray
    turning: float
    white: FloatArray


class ImuBuffer:
    """Samples in the order of their stamps; between two of them rate and force are linear in time."""

    def __init__(self) -> None:
        self._stamps_ns: list[int] = []
        #: (capacity, 2, 6) samples, and noise densities of the steps that end with them
        self._rows = np.zeros((_CAPACITY, 2, 6))
        #: stamps of the last sample and of the first one that is kept; 0 before the first
        self.newest_ns = self.oldest_ns = 0
        self.last = LastSample(np.zeros(6), math.inf, np.zeros(6))
        #: present densities of the white noise of rate and force alone
        self.white = (0.0, 0.0)

    def __len__(self) -> int:
        """Number of samples."""
        return len(self._stamps_ns)

    def append(self, stamp_ns: int, imu: FloatArray, densities: FloatArray) -> None:
        """Add a sample (6,) and the noise densities (6,) of the step that ends with it; gaps are interpolated."""
        place = len(self._stamps_ns)
        if place == 0:
            self.oldest_ns = stamp_ns
        elif stamp_ns - self.newest_ns > GAP_NS:
            self._fill_gap(stamp_ns, imu, densities)
            place = len(self._stamps_ns)
        if place == len(self._rows):
            self._rows = np.concatenate((self._rows, np.zeros_like(self._rows)))
        self._stamps_ns.append(stamp_ns)
        self._rows[place, 0], self._rows[place, 1] = imu, densities
        seconds = (stamp_ns - self.newest_ns) / SECOND_NS if place else math.inf
        self.last = LastSample(imu, seconds, densities)
        self.newest_ns = stamp_ns

    def _fill_gap(self, stamp_ns: int, imu: FloatArray, densities: FloatArray) -> None:
        """Interpolate between the newest sample and the next one, ``imu`` (6,) at ``stamp_ns``.

        Over a gap the error of rate and force is noise, not a constant.
        """
        begin_ns, begin = self.newest_ns, self.last.imu
        parts = -((begin_ns - stamp_ns) // GAP_NS)
        for part in range(1, parts):
            part_ns = begin_ns + (stamp_ns - begin_ns) * part // parts
            self.append(part_ns, begin + part / parts * (imu - begin), densities)

    def forget_before(self, stamp_ns: int) -> None:
        """Remove samples before ``stamp_ns``, except the last one, which interpolation needs."""
        first = max(bisect_left(self._stamps_ns, stamp_ns) - 1, 0)
        kept = self._rows[first : len(self._stamps_ns)].copy()
        self._rows[: len(kept)] = kept
        del self._stamps_ns[:first]
        self.oldest_ns = self._stamps_ns[0]

    def steps(self, begin_ns: int, end_ns: int) -> Steps:
        """The steps between two arbitrary instants within the samples (trapezoid rule)."""
        first = bisect_right(self._stamps_ns, begin_ns) - 1
        last = bisect_left(self._stamps_ns, end_ns)
        stamps_ns, imu = self._stamps_ns[first : last + 1], self._rows[first : last + 1, 0]
        if stamps_ns[0] != begin_ns or stamps_ns[-1] != end_ns:
            imu = imu.copy()
            imu[0], imu[-1] = self.at(begin_ns), self.at(end_ns)
            stamps_ns[0], stamps_ns[-1] = begin_ns, end_ns
        times_ns = np.array(stamps_ns)
        seconds = (times_ns[1:] - times_ns[:-1]) / SECOND_NS
        slope = (imu[1:, 3:] - imu[:-1, 3:]) / seconds[:, None]
        return Steps(0.5 * (imu[:-1] + imu[1:]), seconds, self._rows[first + 1 : last + 1, 1], slope)

    def at(self, time_ns: int) -> FloatArray:
        """(6,) sample at an instant, interpolated linearly."""
        index = bisect_left(self._stamps_ns, time_ns)
        after = self._rows[index, 0]
        after_ns = self._stamps_ns[index]
        if after_ns == time_ns:
            return np.asarray(after)
        before, before_ns = self._rows[index - 1, 0], self._stamps_ns[index - 1]
        return np.asarray(before + (time_ns - before_ns) / (after_ns - before_ns) * (after - before))

    def window(self, until_ns: int, seconds: float) -> FloatArray:
        """Samples (N, 6) of the last ``seconds`` up to an instant, the last one at it."""
        first = bisect_left(self._stamps_ns, until_ns - round(seconds * SECOND_NS))
        return np.vstack((self._rows[first : bisect_left(self._stamps_ns, until_ns), 0], self.at(until_ns)))

    def motion(self, time_ns: int, accepted_ns: int) -> MotionAtPose:
        """The motion at the instant of a pose, from the samples around it that have arrived.

        ``accepted_ns``: instant of the last accepted pose before it.
        """
        stamps_ns, imu = self._stamps_ns, self._rows[:, 0]
        index = max(bisect_left(stamps_ns, time_ns), 1)
        seconds = (stamps_ns[index] - stamps_ns[index - 1]) / SECOND_NS
        each_side = max(min(round(_MOTION_SECONDS / seconds), len(stamps_ns) - index, index), 1)
        first, end = index - each_side, index + each_side
        # For as many steps as there are samples.
        white_seconds = (stamps_ns[end - 1] - stamps_ns[first]) / SECOND_NS * (end - first) / (end - first - 1)
        of_rate, of_force = self.white
        since_accepted = (time_ns - accepted_ns) / SECOND_NS
        return MotionAtPose(
            imu=imu[first:end].mean(axis=0),
            turning=float(np.linalg.norm(imu[index, :3] - imu[index - 1, :3])) / seconds,
            white=np.repeat((of_rate**2 / white_seconds, of_force**2 * since_accepted), 3),
        )
