"""Motion of the camera from frame to frame, estimated from its markers and from odometry.

The camera's twist is that of the odometry around the frame, else that of the last frame, corrected by the displacement
of the markers' corners since the last frame.
"""

from dataclasses import dataclass, field, replace
import math

import numpy as np

from thermal_fiducial.core.detection.prediction.frame import LEAST_DEPTH
from thermal_fiducial.core.detection.prediction.known_markers import ExpectedMarkers
from thermal_fiducial.core.detection.prediction.twist import Twist, twist_by_odometry, UNKNOWN_TWIST, updated
from thermal_fiducial.core.error_model import UNKNOWN_ACCELERATION
from thermal_fiducial.core.geometry import se3
from thermal_fiducial.core.geometry.reprojection import interaction
from thermal_fiducial.core.geometry.se3 import twist_transfer
from thermal_fiducial.core.motion_prior import extrapolated, MotionPrior
from thermal_fiducial.core.types import FloatArray, IntArray, SECOND_NS

# Longest time between frames, or from odometry to a frame, over which motion is known well enough to predict by [ns].
_STALE_NS = 150_000_000
# Jitter of the camera's stamps [s].
_JITTER_S = 0.001
# Number of coordinates of the corners of a marker.
_COORDINATES = 8
# Odometry that gives the twist of a frame: from 3 time constants of the lag before the frame to one after it, a window
# about the velocity of one time constant before, which causes the blur. Largest number of states; time constant that is
# assumed without lag [ns].
_LAGS_BEFORE, _STATES, _SHORTEST_LAG_NS = 3, 10, 5_000_000
# Fewest states of that, since the noise of a gyroscope averages out; else those of so long before the frame [ns].
_FEWEST, _LONGEST_NS = 4, 100_000_000


@dataclass(frozen=True, slots=True)
class MeasuredCorners:
    """Corners of N markers in a frame, by which the camera's motion since the last one is measured.

    Parameters
    ----------
    ids : (N,)
    x : (N, 4, 2) normalised corners: without the displacement by lag if a twist is predicted, else as observed
    depth : (N, 4) [m]
    noise : (N,) standard deviation of a corner in normalised coordinates
    """

    ids: IntArray
    x: FloatArray
    depth: FloatArray
    noise: FloatArray


@dataclass(frozen=True, slots=True)
class MotionTrack:
    """The camera's twist and markers at the last frame, from which the next frame is predicted.

    Parameters
    ----------
    T_body_camera : (4, 4)
    lag : time constant of the bolometers [s]
    stamp_ns, twist, markers : of the last frame; the acceleration is what the last two frames show
    last_seen_ns : stamp of the last frame that showed markers
    """

    T_body_camera: FloatArray
    lag: float
    stamp_ns: int | None = None
    twist: Twist | None = None
    markers: ExpectedMarkers = field(default_factory=ExpectedMarkers.none)
    last_seen_ns: int | None = None

    def predict(self, stamp_ns: int) -> Twist | None:
        """Twist predicted for a frame by those before it; None without any information."""
        dt = self._since(stamp_ns)
        # Without markers the twist is not extrapolated: a wrong one would keep them from being found again.
        saw_lately = self.last_seen_ns is not None and abs(stamp_ns - self.last_seen_ns) < _STALE_NS
        if self.twist is None or dt is None or not saw_lately:
            return None
        return Twist(self.twist.ago(-dt), self.twist.covariance + dt**2 * UNKNOWN_ACCELERATION, self.twist.acceleration)

    def expected(self, stamp_ns: int, twist: Twist | None) -> ExpectedMarkers:
        """The last frame's markers, predicted at this frame with its twist."""
        dt = self._since(stamp_ns)
        if dt is None or twist is None or self.twist is None or len(self.markers.ids) == 0:
            return ExpectedMarkers.none()
        step = (0.5 * dt) * (twist.value + self.twist.value)
        moved = se3.inverse(se3.transform(se3.so3_exp(step[3:]), step[:3]))
        points = self.markers.depth[..., None] * (self.markers.x @ moved[:3, :2].T + moved[:3, 2]) + moved[:3, 3]
        depth = np.maximum(points[..., 2], LEAST_DEPTH)
        return ExpectedMarkers(self.markers.ids, points[..., :2] / depth[..., None], depth, self.markers.cnr)

    def correct(self, stamp_ns: int, predicted: Twist | None, corners: MeasuredCorners) -> Twist | None:
        """Twist corrected by the displacement of corners since the last frame."""
        now, before = np.nonzero(corners.ids[:, None] == self.markers.ids)
        dt = self._since(stamp_ns)
        if len(now) == 0 or dt is None:
            return predicted
        # Corners of a frame without a twist still lag: they are where they were one time constant before it.
        from_ago, to_ago = dt + (self.lag if self.twist is None else 0.0), self.lag if predicted is None else 0.0
        seconds, start = from_ago - to_ago, predicted or UNKNOWN_TWIST
        x, x_before = corners.x[now], self.markers.x[before]
        rates = interaction(0.5 * (x + x_before), corners.depth[now]).reshape(-1, 6)
        A, moved = seconds * rates, (x - x_before).reshape(-1)
        # Jitter of both stamps scales all displacements of a frame by a common factor.
        stretch = rates @ (math.sqrt(2.0) * _JITTER_S * start.value)
        weight = np.repeat((1.5 * corners.noise[now]) ** -2.0, _COORDINATES)
        # Weighted least squares whose residuals have one common error: the Sherman-Morrison formula.
        weighted, stretched = A.T * weight, weight * stretch
        spread = weighted @ stretch
        share = spread / (1.0 + stretched @ stretch)
        information = weighted @ A - spread[:, None] * share
        information_times_twist = weighted @ moved - share * (stretched @ moved)
        middle_ago = 0.5 * (from_ago + to_ago)
        return updated(start, information, information_times_twist, middle_ago, self.lag - middle_ago)

    def all_clearer_than(self, cnr: float) -> bool:
        """Whether the last frame had markers, all with a contrast-to-noise ratio above ``cnr``."""
        return len(self.markers.ids) > 0 and bool(np.abs(self.markers.cnr).min() > cnr)

    def after(self, stamp_ns: int, twist: Twist | None, markers: ExpectedMarkers) -> 'MotionTrack':
        """The track after a frame with its twist and markers; unchanged by a frame that comes late."""
        if self.stamp_ns is not None and 0 < self.stamp_ns - stamp_ns < _STALE_NS:
            return self
        last_seen_ns = stamp_ns if len(markers.ids) else self.last_seen_ns
        dt, acceleration = self._since(stamp_ns), np.zeros(6)
        if twist is not None and self.twist is not None and dt is not None:
            # As far as it exceeds the noise of both.
            noise = (twist.covariance.diagonal() + self.twist.covariance.diagonal()) / dt**2
            share = UNKNOWN_ACCELERATION.diagonal() / (UNKNOWN_ACCELERATION.diagonal() + noise)
            acceleration = share * (twist.value - self.twist.value) / dt
        if twist is not None:
            twist = replace(twist, acceleration=acceleration)
        return MotionTrack(self.T_body_camera, self.lag, stamp_ns, twist, markers, last_seen_ns)

    def _since(self, stamp_ns: int) -> float | None:
        """Time since the last frame [s], negative for a late frame; None if it is too long for the motion to hold."""
        if self.stamp_ns is None or not 0 < abs(stamp_ns - self.stamp_ns) < _STALE_NS:
            return None
        return (stamp_ns - self.stamp_ns) / SECOND_NS


@dataclass(frozen=True, slots=True)
class Guide:
    """Pose of the camera at a frame by recent odometry, by which known markers are looked for."""

    #: (4, 4)
    T_camera_map: FloatArray
    #: (6, 6), ROS convention, in ``map`` [m, rad]
    covariance: FloatArray


def predict_frame(
    stamp_ns: int, prior: MotionPrior | None, track: MotionTrack, time_offset_std: float
) -> tuple[Twist | None, Guide | None]:
    """Motion and pose of the camera at a frame, from odometry and the last frames' markers, before its image is used.

    Parameters
    ----------
    stamp_ns : of the frame, in the camera's clock
    time_offset_std : standard deviation of the clock offset before the filter has estimated it [s]

    Returns
    -------
    Its twist, None if that is unknown, and its pose by recent odometry, None without.
    """
    if prior is None:
        return track.predict(stamp_ns), None
    lag_ns = max(round(SECOND_NS * track.lag), _SHORTEST_LAG_NS)
    odometry_ns = stamp_ns + prior.offset_ns
    clock_std_s = 0.0 if prior.clock_is_known else time_offset_std
    states = prior.between(odometry_ns - _LAGS_BEFORE * lag_ns, odometry_ns + lag_ns, _STATES)
    if len(states) < _FEWEST:
        states = prior.between(odometry_ns - _LONGEST_NS, odometry_ns + lag_ns, _STATES)
    if not states and (other := prior.nearest(odometry_ns)) is not None:
        states = [other]
    twist = track.predict(stamp_ns)
    if not states or abs(odometry_ns - states[-1].stamp_ns) >= _STALE_NS:
        return twist, None
    by_odometry = twist_by_odometry(odometry_ns, states, twist_transfer(track.T_body_camera), track.lag, clock_std_s)
    # That of a filter which is lost says less than the markers of the last frames, or than nothing.
    if np.trace(by_odometry.covariance) < np.trace((twist or UNKNOWN_TWIST).covariance):
        twist = by_odometry
    if twist is None:
        return None, None
    nearest = min(states, key=lambda state: abs(odometry_ns - state.stamp_ns))
    dt = (odometry_ns - nearest.stamp_ns) / SECOND_NS
    pose = extrapolated(nearest, dt, stamp_ns, track.T_body_camera, clock_std_s).pose
    return twist, Guide(se3.inverse(pose.T_map_camera), pose.covariance)
