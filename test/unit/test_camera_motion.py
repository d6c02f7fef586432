"""What motion leaves unknown of camera poses."""

import numpy as np

from thermal_fiducial.core.error_model import SystematicErrors
from thermal_fiducial.core.geometry.se3 import so3_exp, transform
from thermal_fiducial.core.mapping.motion import CameraMotion

PERIOD_NS = 33_333_333
DT = PERIOD_NS * 1e-9
ERRORS = SystematicErrors()
SPEED, RATE = np.array([1.0, -0.5, 0.2]), np.array([0.3, 0.0, 1.5])


def test_a_delay_moves_position_and_attitude_together():
    motion = CameraMotion()
    for k in range(3):
        unknown = motion.delay_covariance(k * PERIOD_NS, transform(so3_exp(RATE * k * DT), SPEED * k * DT), ERRORS)
        assert np.any(unknown) == (k > 0)
    both = ERRORS.delay_std * np.concatenate([SPEED, RATE])
    # Exact but for rounding: the velocity is constant, so no acceleration adds to it.
    np.testing.assert_allclose(unknown, np.outer(both, both), rtol=1e-9, atol=1e-18)


def test_acceleration_adds_an_error_of_its_own():
    motion, acceleration = CameraMotion(), np.array([0.0, 3.0, 0.0])
    for k in range(3):
        unknown = motion.delay_covariance(
            k * PERIOD_NS, transform(np.eye(3), 0.5 * acceleration * (k * DT) ** 2), ERRORS
        )
    # The velocity is the mean one since the last frame.
    expected = (ERRORS.delay_std * 3.0 * 1.5 * DT) ** 2 + (ERRORS.delay_half_square_std * 3.0) ** 2
    np.testing.assert_allclose(unknown, np.diag([0.0, expected, 0.0, 0.0, 0.0, 0.0]), rtol=1e-6, atol=1e-18)


def test_gaps_and_repeated_stamps_tell_nothing():
    motion = CameraMotion()
    motion.delay_covariance(0, np.eye(4), ERRORS)
    moved = transform(np.eye(3), SPEED)
    assert not np.any(motion.delay_covariance(0, moved, ERRORS))
    assert not np.any(motion.delay_covariance(10**9, np.eye(4), ERRORS))
