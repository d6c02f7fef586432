"""What the filter's odometry says of the camera's pose, beside the markers of the frame.

A single marker leaves a camera's attitude unknown by degrees, and its position by as much times the distance; inertial
sensors and gravity know both far better, for seconds. The clocks of camera and odometry differ by what the filter
learns and this part learns by itself: what poses from markers are ahead of the odometry, along its motion.
"""

from dataclasses import dataclass, replace

import numpy as np

from thermal_fiducial.core.geometry.reprojection import difference, retract
from thermal_fiducial.core.mapping.bridging import camera_pose
from thermal_fiducial.core.mapping.localization import positive
from thermal_fiducial.core.measurements import CameraPose, Odometry
from thermal_fiducial.core.types import FloatArray

# Standard deviations: of a first guess of the clocks' difference, of its change in a second [s].
_UNKNOWN_S, _DRIFT_S = 0.05, 0.0002
# Frames whose poses are wrong alike: so much less tells each.
_ALIKE = 10.0
# An innovation counts for no more than so many standard deviations.
_OUTLIER = 3.0
# Share of the variance of odometry's errors that changes between the views of a new marker.
CHANGING = 0.25
#: Squared distance (6 degrees of freedom) beyond which markers and odometry contradict each other: ten sigma.
CONTRADICTION = 100.0
# However uncertain odometry says it is, it is no worse than this while it has agreed with the markers [m, rad].
_WORST = np.repeat([0.3, 0.2], 3)
#: Larger differences are for the filter's parameter [s].
LIMIT_S = 0.1


@dataclass(frozen=True)
class Expected:
    """Where odometry has the camera, and how that moves."""

    pose: CameraPose
    #: (6,) of the camera in the map [m/s, rad/s], and (6, 6) by how much the robot's may be wrong, in the map
    motion: FloatArray
    motion_covariance: FloatArray


class ClockDifference:
    """Kalman filter of one number that walks at random: what the odometry's clock is ahead of the camera's."""

    def __init__(self) -> None:
        self._seconds, self._variance = 0.0, _UNKNOWN_S**2
        self._stamp_ns: int | None = None

    def expected(self, odometry: Odometry, stamp_ns: int, T_body_camera: FloatArray) -> Expected:
        """The camera of the frame ``stamp_ns``; its covariance has what the clocks may differ by."""
        ahead = replace(odometry, stamp_ns=odometry.stamp_ns - round(self._seconds * 1e9))
        pose = camera_pose(ahead, stamp_ns, T_body_camera)
        R = pose.T_map_camera[:3, :3] @ T_body_camera[:3, :3].T
        rate = R @ odometry.angular_velocity_body
        velocity = R @ odometry.velocity_body + np.cross(rate, R @ T_body_camera[:3, 3])
        motion = np.concatenate([velocity, rate])
        covariance = pose.covariance + self._variance * np.outer(motion, motion)
        turn = np.kron(np.eye(2), R)
        return Expected(replace(pose, covariance=covariance), motion, turn @ odometry.twist_covariance @ turn.T)

    def learn(self, expected: Expected, T_map_camera: FloatArray, covariance: FloatArray) -> None:
        """Take in the pose (4, 4) from the markers of a frame, and its covariance (6, 6)."""
        stamp_ns, motion = expected.pose.stamp_ns, expected.motion
        since = 0.0 if self._stamp_ns is None else max(stamp_ns - self._stamp_ns, 0) * 1e-9
        self._variance, self._stamp_ns = min(self._variance + _DRIFT_S**2 * since, _UNKNOWN_S**2), stamp_ns
        own = expected.pose.covariance - self._variance * np.outer(motion, motion)
        weighted = np.linalg.solve(_ALIKE * (covariance + own), motion)
        information = float(weighted @ motion)
        if not information > 0.0:
            return
        innovation = float(weighted @ difference(T_map_camera, expected.pose.T_map_camera)) / information
        limit = _OUTLIER * (self._variance + 1.0 / information) ** 0.5
        gain = self._variance / (self._variance + 1.0 / information)
        self._seconds = float(np.clip(self._seconds + gain * np.clip(innovation, -limit, limit), -LIMIT_S, LIMIT_S))
        self._variance *= 1.0 - gain


@dataclass(frozen=True)
class Fused:
    """A camera pose from markers and odometry together."""

    T_map_camera: FloatArray
    #: (6, 6) ROS convention, of errors that change from frame to frame, and of those that last
    changing: FloatArray
    lasting: FloatArray


def contradicts(T_map_camera: FloatArray, covariance: FloatArray, odometry: CameraPose) -> bool:
    """Whether a camera pose (4, 4) from markers is where odometry cannot be, even odometry that is in doubt itself."""
    worst = _WORST**2
    scale = min(1.0, float(np.min(worst / np.maximum(np.diag(odometry.covariance), 1e-12))))
    apart = difference(odometry.T_map_camera, T_map_camera)
    return bool(apart @ np.linalg.solve(covariance + scale * odometry.covariance, apart) > CONTRADICTION)


def together(T_map_camera: FloatArray, changing: FloatArray, lasting: FloatArray, odometry: CameraPose) -> Fused:
    """The pose (4, 4) from the markers of a frame and that from the odometry, each by what it is worth.

    Markers alone count where the odometry contradicts them: it is lost, or in another map.
    """
    P = odometry.covariance
    apart = difference(odometry.T_map_camera, T_map_camera)
    if apart @ np.linalg.solve(changing + lasting + P, apart) > CONTRADICTION:
        return Fused(T_map_camera, changing, lasting)
    gain = np.linalg.solve(changing + lasting + P, changing + lasting).T
    rest = np.eye(6) - gain
    inherited = gain @ P @ gain.T
    return Fused(
        np.asarray(retract(T_map_camera, gain @ apart)),
        rest @ changing @ rest.T + CHANGING * inherited,
        rest @ lasting @ rest.T + (1.0 - CHANGING) * inherited,
    )


def growth(first: CameraPose, expected: Expected) -> FloatArray:
    """Covariance (6, 6) of the odometry from ``first`` to ``pose``, from either of two bounds, whichever is closer.

    Errors of odometry that grow add up like independent ones at most as the difference of the covariances says; and a
    displacement is off by no more than the speed is, all the time.
    """
    seconds = (expected.pose.stamp_ns - first.stamp_ns) * 1e-9
    bounds = positive(expected.pose.covariance - first.covariance), seconds**2 * expected.motion_covariance
    return min(bounds, key=lambda covariance: float(np.trace(covariance)))
