"""The difference of two cameras' clocks, estimated from their poses where the robot moves."""

import numpy as np

from thermal_fiducial.config import PoseEkfConfig
from thermal_fiducial.core.error_model import of_correlated_odometry, of_single_error
from thermal_fiducial.core.types import FloatArray, SECOND_NS

#: Random walk of the difference [s/sqrt(s)]: that of a camera's clock against the IMU's.
RANDOM_WALK = PoseEkfConfig.time_offset_random_walk
#: Factor on its variance by poses that contradict each other: a clock may have stepped.
_DOUBT = 2.0


class SecondClock:
    """A scalar Kalman filter: t_first = t_second + ``seconds``.

    Parameters
    ----------
    std : standard deviation of the difference before any pose [s]; 0: the clocks are one
    """

    def __init__(self, std: float) -> None:
        self.seconds = 0.0
        self.variance = self._prior = std**2
        self._stamp_ns: int | None = None

    def covariance(self, velocity: FloatArray) -> FloatArray:
        """Covariance (6, 6) of a pose of the second camera in the first one's clock.

        Parameters
        ----------
        velocity : (6,) of the camera in the map [m/s, rad/s]
        """
        return of_single_error(velocity, np.sqrt(self.variance))

    def add(self, stamp_ns: int, apart: FloatArray, velocity: FloatArray, covariance: FloatArray) -> None:
        """Update with both cameras' poses of one instant.

        Parameters
        ----------
        apart : (6,) difference, second less first, with the present ``seconds``
        velocity : (6,) of the camera in the map [m/s, rad/s]
        covariance : (6, 6) of ``apart`` by both poses; their errors last as long as the view
        """
        if self._stamp_ns is not None:
            walked = RANDOM_WALK**2 * abs(stamp_ns - self._stamp_ns) / SECOND_NS
            self.variance = min(self.variance + walked, self._prior)
        self._stamp_ns = stamp_ns
        weighted = np.linalg.solve(of_correlated_odometry(covariance), velocity)
        information = float(velocity @ weighted)
        gain = self.variance / (1.0 + self.variance * information)
        self.seconds += gain * float(weighted @ apart)
        self.variance = gain

    def doubt(self) -> None:
        """Widen the variance, as poses contradict each other."""
        self.variance = min(_DOUBT * self.variance, self._prior)
