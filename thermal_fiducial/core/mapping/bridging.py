"""Odometry in place of known markers: over gaps between those that are known and new ones."""

import numpy as np

from thermal_fiducial.core.geometry.se3 import skew, so3_exp, transform
from thermal_fiducial.core.measurements import CameraPose, Odometry
from thermal_fiducial.core.types import FloatArray


def predict(odometry: Odometry, stamp_ns: int) -> FloatArray:
    """T_map_body (4, 4) at ``stamp_ns``, velocities constant since the odometry."""
    dt = (stamp_ns - odometry.stamp_ns) * 1e-9
    step = transform(so3_exp(odometry.angular_velocity_body * dt), odometry.velocity_body * dt)
    return np.asarray(odometry.T_map_body @ step, dtype=np.float64)


def camera_pose(odometry: Odometry, stamp_ns: int, T_body_camera: FloatArray) -> CameraPose:
    """The camera where the odometry has it at ``stamp_ns``, with the odometry's covariance."""
    T_map_body = predict(odometry, stamp_ns)
    A = np.eye(6)
    A[:3, 3:] = -skew(T_map_body[:3, :3] @ T_body_camera[:3, 3])
    return CameraPose(stamp_ns, T_map_body @ T_body_camera, A @ odometry.pose_covariance @ A.T)
