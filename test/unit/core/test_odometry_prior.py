"""What the filter's odometry says of the camera at a frame."""

import numpy as np
from support.scenes import motion_prior
from support.walls import flight, stamp

from thermal_fiducial.config import MarkerMapperConfig
from thermal_fiducial.core.geometry.reprojection import difference
from thermal_fiducial.core.measurements import Odometry
from thermal_fiducial.core.motion_prior import predicted_camera


def odometry(k, ahead=0.0, sigma=(5e-3, 2e-3)):
    """The truth at frame ``k`` as the filter would publish it, of a clock that is ``ahead`` seconds ahead."""
    at, dt = k / 30, 1e-3
    T = flight(at)
    step = difference(flight(at + dt), flight(at - dt)) / (2 * dt)
    R = T[:3, :3]
    covariance = np.diag([sigma[0]] * 3 + [sigma[1]] * 3) ** 2
    return Odometry(
        stamp(k) + round(ahead * 1e9), T, R.T @ step[:3], R.T @ step[3:], covariance, np.diag([0.02] * 6) ** 2
    )


def test_the_offset_of_the_clocks_is_the_filters_to_say():
    """With the filter's offset the prediction is right; without, it is as wrong as its covariance says."""
    ahead, config = 0.02, MarkerMapperConfig()
    for k in range(0, 150, 10):
        prior = motion_prior(odometry(k, ahead), clock_offset=None)
        before = predicted_camera(prior, stamp(k), np.eye(4), config.time_offset_std).pose
        error = difference(before.T_map_camera, flight(k / 30))
        # 20 ms where 30 ms are allowed for, as one error along the motion.
        known = odometry(k).pose_covariance
        assert 0.3 < error @ np.linalg.solve(before.covariance, error) < 0.6
        prior.set_clock_offset(ahead)
        after = predicted_camera(prior, stamp(k), np.eye(4), config.time_offset_std).pose
        # Velocities by differences over 2 ms.
        np.testing.assert_allclose(after.T_map_camera, flight(k / 30), atol=1e-9)
        np.testing.assert_allclose(after.covariance, known)
