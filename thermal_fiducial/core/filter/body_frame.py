"""The robot's state as that of another frame that is fixed on it."""

from dataclasses import replace

import numpy as np

from thermal_fiducial.core.geometry.se3 import skew
from thermal_fiducial.core.measurements import Odometry
from thermal_fiducial.core.types import FloatArray


def in_frame(odometry: Odometry, T_body_frame: FloatArray) -> Odometry:
    """State of the frame at ``T_body_frame`` (4, 4) on the body of ``odometry``, in the same conventions."""
    T_map_body, R, lever = odometry.T_map_body, T_body_frame[:3, :3], T_body_frame[:3, 3]
    pose = np.eye(6)
    pose[:3, 3:] = -skew(T_map_body[:3, :3] @ lever)
    twist = np.zeros((6, 6))
    twist[:3, :3] = twist[3:, 3:] = R.T
    twist[:3, 3:] = -R.T @ skew(lever)
    velocities = twist @ np.concatenate((odometry.velocity_body, odometry.angular_velocity_body))
    return replace(
        odometry,
        T_map_body=T_map_body @ T_body_frame,
        velocity_body=velocities[:3],
        angular_velocity_body=velocities[3:],
        pose_covariance=pose @ odometry.pose_covariance @ pose.T,
        twist_covariance=twist @ odometry.twist_covariance @ twist.T,
    )
