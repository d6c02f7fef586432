"""By how much the camera's clock differs from the odometry's, as markers tell that are off their predicted places."""

import numpy as np

from thermal_fiducial.core.types import FloatArray

# Standard deviations: of a first guess, of its change in a second [s], of predicted corners that are off for any other
# reason [px].
_UNKNOWN_S, _DRIFT_S, _OTHERWISE_PX = 0.05, 0.005, 2.0
# Images that move more slowly tell the errors of maps and poses instead [px/s].
_SLOWEST_PX_S = 100.0
# An innovation counts for no more than so many standard deviations.
_OUTLIER = 3.0
#: Larger offsets are for the parameter [s].
LIMIT_S = 0.1


class ClockOffset:
    """Kalman filter of one number that walks at random, from the image's motion.

    An image that moves with velocity w and is predicted for a time that is wrong by e shows its markers w e away.
    """

    def __init__(self) -> None:
        self._offset, self._variance = 0.0, _UNKNOWN_S**2
        self._stamp_ns: int | None = None

    @property
    def ns(self) -> int:
        """What the odometry's clock is ahead of the camera's [ns]."""
        return round(self._offset * 1e9)

    def learn(self, stamp_ns: int, off_px: FloatArray, velocity_px_s: FloatArray) -> None:
        """Take in a frame: corners of N markers off their places predicted with :attr:`ns`, and how they move.

        Parameters
        ----------
        stamp_ns : of the frame
        off_px, velocity_px_s : (N, 4, 2)
        """
        speed = (velocity_px_s * velocity_px_s).sum(axis=(1, 2))
        if len(speed) == 0 or (typical := _median(speed)) < 4.0 * _SLOWEST_PX_S**2:
            return
        # Of a single marker that is off alone, moved or wrong in the map, the others know nothing.
        innovation = _median((off_px * velocity_px_s).sum(axis=(1, 2)) / speed)
        since = 0.0 if self._stamp_ns is None else max(stamp_ns - self._stamp_ns, 0) * 1e-9
        self._variance, self._stamp_ns = min(self._variance + _DRIFT_S**2 * since, _UNKNOWN_S**2), stamp_ns
        expected = self._variance + 4.0 * _OTHERWISE_PX**2 / typical
        limit = _OUTLIER * expected**0.5
        gain = self._variance / expected
        self._offset += gain * min(max(innovation, -limit), limit)
        self._offset = min(max(self._offset, -LIMIT_S), LIMIT_S)
        self._variance *= 1.0 - gain


def _median(values: FloatArray) -> float:
    """That of a few: a sort costs a fraction of NumPy's."""
    order = np.sort(values)
    return 0.5 * float(order[(len(order) - 1) // 2] + order[len(order) // 2])
