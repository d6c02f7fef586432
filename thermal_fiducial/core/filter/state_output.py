"""The filter's state and covariance as the outside wants them: ROS order and frames, twist in the robot frame."""

import numpy as np

from thermal_fiducial.core.filter.navigation_state import GYROSCOPE_BIAS, NavigationState, POSITION, ROTATION, VELOCITY
from thermal_fiducial.core.geometry.se3 import skew
from thermal_fiducial.core.measurements import Odometry
from thermal_fiducial.core.types import FloatArray

_ORDER = np.r_[POSITION, ROTATION, VELOCITY, GYROSCOPE_BIAS]
_ALL = np.ix_(_ORDER, _ORDER)


def odometry(stamp_ns: int, state: NavigationState, rate: FloatArray, rate_variance: float) -> Odometry:
    """State at an IMU sample whose ``rate`` (3,) has white noise of ``rate_variance`` [rad^2/s^2]."""
    R, velocity_body = state.R_map_body, state.velocity_body
    # (p, theta) of the map are R times the error of the robot frame; v_body moves with both nu and phi.
    J = np.zeros((12, 12))
    J[0:3, 0:3] = J[3:6, 3:6] = R
    J[6:9, 3:6] = skew(velocity_body)
    J[6, 6] = J[7, 7] = J[8, 8] = 1.0
    J[9, 9] = J[10, 10] = J[11, 11] = -1.0
    covariance = J @ state.covariance[_ALL] @ J.T
    twist_covariance = covariance[6:, 6:]
    twist_covariance[(3, 4, 5), (3, 4, 5)] += rate_variance
    return Odometry(
        stamp_ns,
        state.T_map_body,
        velocity_body,
        rate - state.rate_error(rate),
        covariance[:6, :6],
        twist_covariance,
    )
