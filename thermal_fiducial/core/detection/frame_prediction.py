"""What the filter's states and the frames before say of a frame: the camera's motion, and where it is."""

from dataclasses import dataclass
import math

import numpy as np

from thermal_fiducial.core.detection.tracking import MotionTrack
from thermal_fiducial.core.detection.twist import plausible, Twist
from thermal_fiducial.core.geometry import se3
from thermal_fiducial.core.measurements import Odometry
from thermal_fiducial.core.motion_prior import MotionPrior
from thermal_fiducial.core.types import FloatArray

# The filter's states from so many time constants before a frame to one after it, symmetric about the velocity that
# blurs it, say how it moved; so many of them at most. Without lag, those of so long a time.
_LAGS_BEFORE, _STATES, _SHORTEST_LAG_S = 3, 10, 0.005
# Standard deviation of the offset between the clocks before the filter has estimated it: that of drivers' stamps, and
# what the filter itself starts from (``time_offset_std``) [s].
_UNKNOWN_CLOCK_S = 0.03


@dataclass(frozen=True, slots=True)
class FramePrediction:
    """What is known of a frame before it is looked at."""

    #: of the camera; None: nothing is known
    twist: Twist | None
    #: (4, 4); None: no odometry that is fresh enough
    T_camera_map: FloatArray | None
    #: standard deviation of the camera's position in it [m]
    position_std_m: float


class Predictor:
    """Predicts a frame from the filter's states and from the last frames' markers.

    Parameters
    ----------
    T_body_camera : (4, 4)
    lag : time constant of the bolometers [s]
    """

    def __init__(self, T_body_camera: FloatArray, lag: float) -> None:
        self._T_body_camera = T_body_camera
        self._lag_ns = round(1e9 * max(lag, _SHORTEST_LAG_S))

    def predict(
        self, stamp_ns: int, prior: MotionPrior | None, track: MotionTrack, max_age_s: float
    ) -> FramePrediction:
        """Of a frame at ``stamp_ns`` in the camera's clock; odometry older than ``max_age_s`` says no pose."""
        if prior is None:
            return FramePrediction(track.predict(stamp_ns, []), None, math.inf)
        odometry_ns = prior.in_odometry_clock(stamp_ns)
        clock_std_s = 0.0 if prior.clock_is_known else _UNKNOWN_CLOCK_S
        states = self._states(odometry_ns, prior)
        twist = track.predict(stamp_ns, states, odometry_ns, clock_std_s)
        nearest = min(states, key=lambda state: abs(odometry_ns - state.stamp_ns), default=None)
        if nearest is None or twist is None or abs(odometry_ns - nearest.stamp_ns) * 1e-9 > max_age_s:
            return FramePrediction(twist, None, math.inf)
        T_map_camera = _carried_on(odometry_ns, nearest, self._T_body_camera, twist)
        moved = clock_std_s * float(np.linalg.norm(nearest.velocity_body))
        position_std_m = math.sqrt(np.trace(nearest.pose_covariance[:3, :3]) + moved**2)
        return FramePrediction(twist, se3.inverse(T_map_camera), position_std_m)

    def _states(self, odometry_ns: int, prior: MotionPrior) -> list[Odometry]:
        """The filter's states while a frame came about, or the nearest."""
        states = prior.between(odometry_ns - _LAGS_BEFORE * self._lag_ns, odometry_ns + self._lag_ns, _STATES)
        if not states and (nearest := prior.nearest(odometry_ns)) is not None:
            states = [nearest]
        return [state for state in states if plausible(state)]


def _carried_on(odometry_ns: int, odometry: Odometry, T_body_camera: FloatArray, twist: Twist) -> FloatArray:
    """T_map_camera (4, 4) at a frame, from the odometry near it carried on with the camera's twist."""
    dt = (odometry_ns - odometry.stamp_ns) * 1e-9
    mean = twist.ago(0.5 * dt)
    moved = se3.transform(se3.so3_exp(mean[3:] * dt), mean[:3] * dt)
    return np.asarray(odometry.T_map_body @ T_body_camera @ moved)
