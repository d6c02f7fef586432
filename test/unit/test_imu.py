"""Inertial increments against brute force."""

import numpy as np
import pytest
from scipy.linalg import expm

from thermal_fiducial.core.filter.imu import ImuStep, rotation_integrals, Transition
from thermal_fiducial.core.geometry.se3 import skew, so3_exp

STEP = ImuStep(np.array([0.8, -1.5, 2.0, 3.0, -1.0, 9.0]), 0.005, 1.7e-4, 2.0e-3)
BIAS = np.array([0.01, -0.02, 0.03, 0.2, -0.1, 0.1])


@pytest.mark.parametrize('angle', [0.0, 1e-9, 1e-4, 0.0099, 0.0101, 0.3, 3.0])
def test_rotation_integrals_are_those_of_the_exponential(angle):
    phi = angle * np.array([0.6, -0.48, 0.64])
    # d/ds of [exp, Gamma_1, Gamma_2] at s = 1 by one block exponential (van Loan).
    block = np.zeros((9, 9))
    block[:3, :3], block[:3, 3:6], block[3:6, 6:] = skew(phi), np.eye(3), np.eye(3)
    exact = expm(block)
    # 1e-12: double precision after the cancellations of the closed form just above the switch to the series
    np.testing.assert_allclose(rotation_integrals(phi), [exact[:3, :3], exact[:3, 3:6], exact[:3, 6:]], atol=1e-12)


def _increment(bias):
    rotation, dv, dp = Transition(15, np.zeros(15)).compute(STEP, bias)
    return rotation.copy(), dv.copy(), dp.copy()


def test_increment_is_the_integral_of_the_motion():
    n = 20000
    dt = STEP.seconds / n
    rate, force = STEP.imu[:3] - BIAS[:3], STEP.imu[3:] - BIAS[3:]
    half = so3_exp(rate * dt / 2)
    R, v, p = np.eye(3), np.zeros(3), np.zeros(3)
    for _ in range(n):
        a = R @ half @ force
        p, v, R = p + v * dt + a * dt * dt / 2, v + a * dt, R @ half @ half
    rotation, dv, dp = _increment(BIAS)
    # the midpoint sum is exact to (rate dt)^2 / 24 ~ 1e-14 of dv = 0.05; rounding over 20000 sums stays below 1e-11
    np.testing.assert_allclose(rotation, R, atol=1e-11)
    np.testing.assert_allclose(dv, v, atol=1e-11)
    np.testing.assert_allclose(dp, p, atol=1e-11)


def test_bias_columns_are_the_derivative_of_the_increment():
    transition = Transition(15, np.zeros(15))
    rotation, dv, dp = transition.compute(STEP, BIAS)
    for axis in range(6):
        change = np.zeros(6)
        change[axis] = 1e-5
        R2, dv2, dp2 = _increment(BIAS + change)
        column = transition.F[:9, 9 + axis]
        turn = rotation.T @ R2
        numeric = np.concatenate(
            ([turn[2, 1], turn[0, 2], turn[1, 0]], rotation.T @ (dv2 - dv), rotation.T @ (dp2 - dp))
        )
        # velocity and position by the gyroscope bias hold to first order in the step's angle, 0.013 rad
        np.testing.assert_allclose(column, numeric / 1e-5, rtol=0.02, atol=1e-3 * abs(column).max())


def test_noise_of_a_step_is_that_of_its_densities():
    transition = Transition(15, np.repeat((0.0, 2e-5, 3e-4), (9, 3, 3)))
    transition.compute(STEP, BIAS)
    dt, Q = STEP.seconds, transition.Q
    # isotropic to second order in the step's angle, 0.013 rad
    np.testing.assert_allclose(np.diag(Q)[:3], 1.7e-4**2 * dt, rtol=1e-3)
    np.testing.assert_allclose(np.diag(Q)[3:6], 2.0e-3**2 * dt, rtol=1e-3)
    np.testing.assert_allclose(np.diag(Q)[9:12], 2e-5**2 * dt)
    np.testing.assert_allclose(np.diag(Q)[12:], 3e-4**2 * dt)
    np.testing.assert_allclose(Q, Q.T, atol=1e-20)
