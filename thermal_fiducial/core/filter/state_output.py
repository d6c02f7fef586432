"""The filter's state and covariance as the outside wants them: ROS order and frames, twist in the robot frame."""

import numpy as np

from thermal_fiducial.core.filter.prediction import Prediction
from thermal_fiducial.core.filter.state import GYROSCOPE_BIAS, POSITION, ROTATION, VELOCITY
from thermal_fiducial.core.geometry.se3 import skew
from thermal_fiducial.core.measurements import Odometry
from thermal_fiducial.core.types import FloatArray

#: (12, 12) position, rotation, velocity and rate of the robot by the core's errors and the gyroscope's bias, for a
#: robot at rest whose axes are those of the map.
_AT_REST = np.zeros((12, 12))
_AT_REST[6:9, VELOCITY] = np.eye(3)
_AT_REST[9:, 9:] = -np.eye(3)
#: Places of the rate's variances in such a matrix, row by row.
_RATE_VARIANCES = slice(9 * 13, None, 13)


def odometry(
    prediction: Prediction, core: FloatArray, with_bias: FloatArray, imu: FloatArray, rate_variance: float
) -> Odometry:
    """State at an IMU sample.

    Parameters
    ----------
    core : (9, 9) covariance of rotation, velocity and position errors
    with_bias : (9, 3) of these with the gyroscope's bias
    imu : (6,) the sample
    rate_variance : of the white noise of its rate [rad^2/s^2]
    """
    state = prediction.state
    R, velocity_body = state.R_map_body, state.velocity_body
    joint = np.empty((12, 12))
    joint[:9, :9], joint[:9, 9:], joint[9:, :9] = core, with_bias, with_bias.T
    joint[9:, 9:] = prediction.origin.covariance[GYROSCOPE_BIAS, GYROSCOPE_BIAS]
    # (p, theta) of the map are R times the error of the robot frame; v_body moves with both nu and phi.
    J = _AT_REST.copy()
    J[0:3, POSITION] = J[3:6, ROTATION] = R
    J[6:9, ROTATION] = skew(velocity_body)
    covariance = J @ joint @ J.T
    covariance.reshape(-1)[_RATE_VARIANCES] += rate_variance
    return Odometry(
        prediction.stamp_ns,
        state.T_map_body,
        velocity_body,
        state.corrected(imu)[:3],
        covariance[:6, :6],
        covariance[6:, 6:],
    )
