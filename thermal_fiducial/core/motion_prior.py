"""The filter's latest odometry and clock offset, as detector and mapper use them.

Only the filter estimates motion and clock offset. Detector and mapper query this record by the stamps of their frames.

A single marker determines a camera's attitude to degrees only, and its position to that angle times the distance;
inertial odometry is far better for seconds. Until the filter has estimated the clock offset, the covariance of a camera
pose by odometry contains the motion during the standard deviation of the offset.
"""

from bisect import bisect_left, bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass
import math
from typing import Any

import numpy as np

from thermal_fiducial.core.error_model import covariance_of_motion, covariance_of_one_error, covariance_root
from thermal_fiducial.core.geometry.se3 import lever_arm, so3_exp, transform, turned
from thermal_fiducial.core.measurements import CameraPose, Odometry
from thermal_fiducial.core.types import FloatArray, SECOND_NS

#: Fastest component of a twist [m/s, rad/s]: no camera that sees markers moves like this, a filter that diverges does.
FASTEST = 50.0
#: Of a position that is known this badly [m] nothing follows for a frame: a hundred times what a filter calls lost. Its
#: velocity may be beyond all bounds by then.
LOST_M = 30.0
#: Longest time [s] over which the mapper extrapolates an odometry state to a frame.
MAX_AGE = 0.3
# A stamp farther back [ns] is not of a message that was overtaken: the clock was set, and all before is of another one.
_REORDERED_NS = 100_000_000
# Largest number of states: two seconds of odometry at 1 kHz.
_MOST = 2000


def plausible(states: Sequence[Odometry]) -> list[Odometry]:
    """The states with a twist below ``FASTEST`` of a filter that has not been lost for long."""
    twists = np.array([(state.velocity_body, state.angular_velocity_body) for state in states]).reshape(-1, 6)
    variances = np.array([state.pose_covariance.diagonal()[:3] for state in states]).reshape(-1, 3)
    usable = (np.abs(twists) < FASTEST).all(axis=1) & (variances < LOST_M**2).all(axis=1)
    return [state for state, chosen in zip(states, usable.tolist(), strict=True) if chosen]


class MotionPrior:
    """Odometry in the order of its stamps, decoded on demand, and the camera's clock offset.

    Parameters
    ----------
    camera_time_offset : initial clock offset, t_odometry = t_camera + offset [s]
    read : decodes several of what :meth:`add` was given to states; leaves unusable ones out
    """

    def __init__(
        self, camera_time_offset: float = 0.0, read: Callable[[Sequence[Any]], list[Odometry]] = plausible
    ) -> None:
        self._stamps_ns: list[int] = []
        self._states: list[Any] = []
        self._read = read
        #: t_odometry = t_camera + offset_ns
        self.offset_ns = round(camera_time_offset * SECOND_NS)
        #: whether the filter has estimated the clock offset; before that it is the parameter's
        self.clock_is_known = False

    def set_clock_offset(self, seconds: float) -> None:
        """Take over the filter's estimate, t_odometry = t_camera + ``seconds`` [s]."""
        self.offset_ns = round(seconds * SECOND_NS)
        self.clock_is_known = True

    def forget(self) -> None:
        """Drop all states: they are in a map that was replaced."""
        self._stamps_ns, self._states = [], []

    def add(self, stamp_ns: int, state: Any) -> None:
        """Keep the state of a stamp, decoded or not."""
        if self._stamps_ns and stamp_ns < self._stamps_ns[-1] - _REORDERED_NS:
            self.forget()
        place = bisect_left(self._stamps_ns, stamp_ns)
        if place < len(self._stamps_ns) and self._stamps_ns[place] == stamp_ns:
            self._states[place] = state
            return
        self._stamps_ns.insert(place, stamp_ns)
        self._states.insert(place, state)
        if len(self._stamps_ns) > _MOST:
            del self._stamps_ns[: _MOST // 2], self._states[: _MOST // 2]

    def nearest(self, stamp_ns: int) -> Odometry | None:
        """The state whose stamp, in the clock of the odometry, is nearest."""
        place = bisect_left(self._stamps_ns, stamp_ns)
        around = range(max(place - 1, 0), min(place + 1, len(self._stamps_ns)))
        best = min(around, key=lambda index: abs(self._stamps_ns[index] - stamp_ns), default=None)
        return None if best is None else next(iter(self._read([self._states[best]])), None)

    def between(self, first_ns: int, last_ns: int, at_most: int) -> list[Odometry]:
        """States between two stamps; of more than ``at_most`` that many, evenly spaced."""
        first, last = bisect_left(self._stamps_ns, first_ns), bisect_right(self._stamps_ns, last_ns)
        count = last - first
        kept = min(count, at_most)
        chosen = [first + place * (count - 1) // max(kept - 1, 1) for place in range(kept)]
        return self._read([self._states[place] for place in chosen]) if chosen else []


@dataclass(frozen=True)
class PredictedCamera:
    """Camera pose at a frame by odometry."""

    pose: CameraPose
    #: the odometry state that it is extrapolated from
    odometry: Odometry
    #: (6,) of the camera in the map [m/s, rad/s]
    velocity: FloatArray

    def velocity_covariance(self, seconds: float) -> FloatArray:
        """Covariance (6, 6) of the displacement in ``seconds`` by a constant error of the velocity."""
        R = self.odometry.T_map_body[:3, :3]
        return seconds**2 * turned(self.odometry.twist_covariance, R)


def predicted_camera(
    prior: MotionPrior | None, camera_stamp_ns: int, T_body_camera: FloatArray, time_offset_std: float
) -> PredictedCamera | None:
    """The camera at the frame ``camera_stamp_ns``; None where odometry has no state near it.

    Parameters
    ----------
    prior : the filter's odometry and clock offset
    time_offset_std : standard deviation of the clock offset before the filter has estimated it [s]
    """
    if prior is None:
        return None
    instant_ns = camera_stamp_ns + prior.offset_ns
    odometry = prior.nearest(instant_ns)
    dt = math.inf if odometry is None else (instant_ns - odometry.stamp_ns) / SECOND_NS
    if odometry is None or abs(dt) > MAX_AGE:
        return None
    clock_std = 0.0 if prior.clock_is_known else time_offset_std
    return extrapolated(odometry, dt, camera_stamp_ns, T_body_camera, clock_std)


def extrapolated(
    odometry: Odometry, dt: float, camera_stamp_ns: int, T_body_camera: FloatArray, clock_std: float
) -> PredictedCamera:
    """The camera at a frame that is ``dt`` [s] after a state of the odometry, by clocks known to ``clock_std`` [s].

    Its covariance contains what the twist and an unknown acceleration add in that time.
    """
    step = transform(so3_exp(odometry.angular_velocity_body * dt), odometry.velocity_body * dt)
    T_map_body = odometry.T_map_body @ step
    R, J = T_map_body[:3, :3], lever_arm(T_map_body[:3, :3] @ T_body_camera[:3, 3])
    of_step = turned(covariance_of_motion(odometry.twist_covariance, dt), R)
    covariance = J @ (odometry.pose_covariance + of_step) @ J.T
    velocity = J @ np.concatenate([R @ odometry.velocity_body, R @ odometry.angular_velocity_body])
    covariance += covariance_of_one_error(velocity, clock_std)
    return PredictedCamera(CameraPose(camera_stamp_ns, T_map_body @ T_body_camera, covariance), odometry, velocity)


def displacement_covariance(first: CameraPose, predicted: PredictedCamera) -> FloatArray:
    """Covariance (6, 6) of the displacement by odometry since ``first``: the smaller of two bounds.

    One is the difference of the covariances, as if the error grew by independent increments, or what is nearest to it
    of covariances; the other the error of the velocity, constant over that time.
    """
    seconds = (predicted.pose.stamp_ns - first.stamp_ns) / SECOND_NS
    root = covariance_root(predicted.pose.covariance - first.covariance)
    bounds = np.asarray(root @ root.T), predicted.velocity_covariance(seconds)
    return min(bounds, key=lambda covariance: float(np.trace(covariance)))
