"""What the filter's odometry says of the camera at a frame."""

import numpy as np
import pytest
from support.flights import config, Flight, run, START_NS, T_BODY_CAMERA, timeline
from support.scenes import motion_prior
from support.walls import flight, stamp

from thermal_fiducial.config import MarkerMapperConfig
from thermal_fiducial.core.filter.ekf import PoseEkf
from thermal_fiducial.core.geometry.se3 import difference, so3_exp, transform
from thermal_fiducial.core.measurements import Odometry
from thermal_fiducial.core.motion_prior import extrapolated, predicted_camera


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


@pytest.mark.parametrize('age', [0.01, *(pytest.param(age, marks=pytest.mark.nightly) for age in (0.05, 0.1)), 0.3])
def test_the_covariance_of_an_extrapolated_camera_has_what_motion_may_have_changed(age):
    """In a brisk flight of the filter; without it NEES was 4 after 0.05 s, 61 after 0.1, 4635 after 0.3 s."""
    data = Flight(seed=2, seconds=8.0, rotation_std=(0.003, 0.003, 0.001), translation_std=(0.0003, 0.0003, 0.003))
    states, _ = run(PoseEkf(config()), timeline(data.samples(), data.poses, 0.03))
    squares = []
    for state in states[600:1500:20]:
        camera = extrapolated(state, age, state.stamp_ns, T_BODY_CAMERA, 0.0).pose
        truth = data.motion.pose((state.stamp_ns - START_NS) * 1e-9 + age) @ T_BODY_CAMERA
        error = difference(truth, camera.T_map_camera)
        squares.append(error @ np.linalg.solve(camera.covariance, error) / 6.0)
    # one where the claim is right; a smooth flight has less acceleration than a brisk one may have
    assert np.mean(squares) < 1.0


def test_odometry_that_is_late_says_less_of_the_frame():
    """A robot at rest begins to move, and odometry stays 0.2 s behind: the IMU is late, or the filter stalls."""
    seconds, begun = 0.2, np.array([2.0, 0.0, 0.0, 0.0, 0.0, 2.0])
    still = Odometry(stamp(0), np.eye(4), np.zeros(3), np.zeros(3), 1e-6 * np.eye(6), 1e-4 * np.eye(6))
    moved = 0.5 * seconds**2 * begun
    frame = stamp(0) + round(seconds * 1e9)
    predicted = predicted_camera(motion_prior(still), frame, np.eye(4), time_offset_std=0.0).pose
    error = difference(predicted.T_map_camera, transform(so3_exp(moved[3:]), moved[:3]))
    # Two thirds of the linear acceleration that is allowed for, half of the angular one; without allowance it is 3200.
    allowed_for = (2.0 / 3.0) ** 2 + (2.0 / 4.0) ** 2
    # What the state itself claims adds 2 %.
    np.testing.assert_allclose(error @ np.linalg.solve(predicted.covariance, error), allowed_for, rtol=0.02)
