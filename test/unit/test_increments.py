"""Inertial increments against brute force."""

import numpy as np
import pytest
from scipy.linalg import expm

from thermal_fiducial.core.filter.increments import increment, rotation_integrals
from thermal_fiducial.core.geometry.se3 import skew, so3_exp

IMU, SECONDS = np.array([0.79, -1.48, 1.97, 2.8, -0.9, 8.9]), 0.005


@pytest.mark.parametrize('angle', [0.0, 1e-9, 1e-4, 0.0099, 0.0101, 0.3, 3.0])
def test_rotation_integrals_are_those_of_the_exponential(angle):
    phi = angle * np.array([0.6, -0.48, 0.64])
    # d/ds of [exp, Gamma_1, Gamma_2] at s = 1 by one block exponential (van Loan).
    block = np.zeros((9, 9))
    block[:3, :3], block[:3, 3:6], block[3:6, 6:] = skew(phi), np.eye(3), np.eye(3)
    exact = expm(block)
    # 1e-12: double precision after the cancellations of the closed form just above the switch to the series
    np.testing.assert_allclose(rotation_integrals(phi), [exact[:3, :3], exact[:3, 3:6], exact[:3, 6:]], atol=1e-12)


def test_increment_is_the_integral_of_the_motion():
    n = 20000
    dt = SECONDS / n
    rate, force = IMU[:3], IMU[3:]
    half = so3_exp(rate * dt / 2)
    R, v, p = np.eye(3), np.zeros(3), np.zeros(3)
    for _ in range(n):
        a = R @ half @ force
        p, v, R = p + v * dt + a * dt * dt / 2, v + a * dt, R @ half @ half
    step = increment(IMU, SECONDS)
    # the midpoint sum is exact to (rate dt)^2 / 24 ~ 1e-14 of dv = 0.05; rounding over 20000 sums stays below 1e-11
    np.testing.assert_allclose(step.rotation, R, atol=1e-11)
    np.testing.assert_allclose(step.velocity, v, atol=1e-11)
    np.testing.assert_allclose(step.position, p, atol=1e-11)


def test_bias_columns_are_the_derivative_of_the_increment():
    step = increment(IMU, SECONDS)
    for axis in range(6):
        change = np.zeros(6)
        change[axis] = 1e-5
        other = increment(IMU - change, SECONDS)
        turn = step.rotation.T @ other.rotation
        velocity = step.rotation.T @ (other.velocity - step.velocity)
        position = step.rotation.T @ (other.position - step.position)
        numeric = np.concatenate(([turn[2, 1], turn[0, 2], turn[1, 0]], velocity, position))
        column = step.sample_jacobian[:, axis]
        # velocity and position by the gyroscope bias hold to first order in the step's angle, 0.013 rad
        np.testing.assert_allclose(column, numeric / 1e-5, rtol=0.02, atol=1e-3 * abs(column).max())
