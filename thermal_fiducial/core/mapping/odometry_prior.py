"""What the filter's odometry says of the camera's pose, beside the markers of the frame.

A single marker leaves a camera's attitude unknown by degrees, and its position by as much times the distance; inertial
sensors and gravity know both far better, for seconds. The offset between the clocks of camera and odometry is the
filter's to estimate; as long as it has not, the motion during what the offset may be wrong by is part of the
covariance.
"""

from dataclasses import dataclass, replace

import numpy as np

from thermal_fiducial.core.error_model import bounded_odometry, of_single_error, positive
from thermal_fiducial.core.geometry.reprojection import difference
from thermal_fiducial.core.geometry.se3 import skew, so3_exp, transform
from thermal_fiducial.core.measurements import CameraPose, Odometry
from thermal_fiducial.core.motion_prior import MotionPrior
from thermal_fiducial.core.types import FloatArray, SECOND_NS

#: A state of the filter stands for frames up to this far from it [ns].
NEAR_NS = 300_000_000
#: Squared distance (6 degrees of freedom) beyond which markers and odometry contradict each other: ten sigma.
CONTRADICTION = 100.0


@dataclass(frozen=True)
class PredictedCamera:
    """Where odometry has the camera at a frame, and how well its velocity is known."""

    pose: CameraPose
    #: (6, 6) of the body's velocity [m/s, rad/s], in the map
    velocity_covariance: FloatArray


def predicted_camera(
    prior: MotionPrior | None, camera_stamp_ns: int, T_body_camera: FloatArray, time_offset_std: float
) -> PredictedCamera | None:
    """The camera at the frame ``camera_stamp_ns``; None where odometry has no state near it.

    Parameters
    ----------
    prior : the filter's states, and the offset of the two clocks
    time_offset_std : how far that offset may be wrong while the filter has not estimated it [s]
    """
    if prior is None:
        return None
    instant_ns = prior.in_odometry_clock(camera_stamp_ns)
    odometry = prior.nearest(instant_ns)
    if odometry is None or abs(instant_ns - odometry.stamp_ns) >= NEAR_NS:
        return None
    pose = replace(camera_pose(odometry, instant_ns, T_body_camera), stamp_ns=camera_stamp_ns)
    R = pose.T_map_camera[:3, :3] @ T_body_camera[:3, :3].T
    turn = np.kron(np.eye(2), R)
    if not prior.clock_is_known:
        rate = R @ odometry.angular_velocity_body
        velocity = R @ odometry.velocity_body + np.cross(rate, R @ T_body_camera[:3, 3])
        unknown = of_single_error(np.concatenate([velocity, rate]), time_offset_std)
        pose = replace(pose, covariance=pose.covariance + unknown)
    return PredictedCamera(pose, turn @ odometry.twist_covariance @ turn.T)


def camera_pose(odometry: Odometry, stamp_ns: int, T_body_camera: FloatArray) -> CameraPose:
    """The camera where the odometry, its velocities constant, has it at ``stamp_ns``, with its covariance."""
    dt = (stamp_ns - odometry.stamp_ns) / SECOND_NS
    step = transform(so3_exp(odometry.angular_velocity_body * dt), odometry.velocity_body * dt)
    T_map_body = odometry.T_map_body @ step
    A = np.eye(6)
    A[:3, 3:] = -skew(T_map_body[:3, :3] @ T_body_camera[:3, 3])
    return CameraPose(stamp_ns, T_map_body @ T_body_camera, A @ odometry.pose_covariance @ A.T)


def contradicts(T_map_camera: FloatArray, covariance: FloatArray, odometry: CameraPose) -> bool:
    """Whether a camera pose (4, 4) from markers is where odometry cannot be, even odometry that is in doubt itself."""
    apart = difference(odometry.T_map_camera, T_map_camera)
    return bool(apart @ np.linalg.solve(covariance + bounded_odometry(odometry.covariance), apart) > CONTRADICTION)


def growth(first: CameraPose, predicted: PredictedCamera) -> FloatArray:
    """Covariance (6, 6) of the odometry from ``first`` to ``pose``, from either of two bounds, whichever is closer.

    Errors of odometry that grow add up like independent ones at most as the difference of the covariances says; and a
    displacement is off by no more than the speed is, all the time.
    """
    seconds = (predicted.pose.stamp_ns - first.stamp_ns) / SECOND_NS
    bounds = positive(predicted.pose.covariance - first.covariance), seconds**2 * predicted.velocity_covariance
    return min(bounds, key=lambda covariance: float(np.trace(covariance)))
