"""Preintegrated motions against brute force."""

import numpy as np
import pytest
from scipy.linalg import expm

from thermal_fiducial.core.filter.imu_buffer import Steps
from thermal_fiducial.core.filter.inertial_motion import preintegrated
from thermal_fiducial.core.filter.rotation_integrals import rotation_integrals
from thermal_fiducial.core.geometry.se3 import skew, so3_exp

IMU, SECONDS = np.array([0.79, -1.48, 1.97, 2.8, -0.9, 8.9]), 0.005
NO_BIAS, NO_SCALE = np.zeros(6), np.zeros((2, 3, 3))
rng = np.random.default_rng(3)


def motion_over(samples, seconds=SECONDS):
    """Over as many steps of equal length as there are mean samples (N, 6)."""
    count = len(samples)
    steps = Steps(np.asarray(samples), np.full(count, seconds), np.full((count, 6), 0.002))
    return preintegrated(steps, NO_BIAS, NO_SCALE)


@pytest.mark.parametrize('angle', [0.0, 1e-9, 1e-4, 0.01, 0.3, 3.0, 3.2, 12.0])
def test_rotation_integrals_are_those_of_the_exponential(angle):
    phi = angle * np.array([0.6, -0.48, 0.64])
    # d/ds of [exp, Gamma_1, Gamma_2] at s = 1 by one block exponential (van Loan).
    block = np.zeros((9, 9))
    block[:3, :3], block[:3, 3:6], block[3:6, 6:] = skew(phi), np.eye(3), np.eye(3)
    exact = expm(block)
    # 1e-12: double precision after fourteen terms of the series up to 3.16 rad, and of the closed form beyond
    np.testing.assert_allclose(rotation_integrals(phi), [exact[:3, :3], exact[:3, 3:6], exact[:3, 6:]], atol=1e-12)


def test_a_step_is_the_integral_of_the_motion():
    n = 20000
    dt = SECONDS / n
    rate, force = IMU[:3], IMU[3:]
    half = so3_exp(rate * dt / 2)
    R, v, p = np.eye(3), np.zeros(3), np.zeros(3)
    for _ in range(n):
        a = R @ half @ force
        p, v, R = p + v * dt + a * dt * dt / 2, v + a * dt, R @ half @ half
    moved = motion_over([IMU]).motion
    # the midpoint sum is exact to (rate dt)^2 / 24 ~ 1e-14 of dv = 0.05; rounding over 20000 sums stays below 1e-11
    np.testing.assert_allclose(moved[:, :3], R, atol=1e-11)
    np.testing.assert_allclose(moved[:, 3], v, atol=1e-11)
    np.testing.assert_allclose(moved[:, 4], p, atol=1e-11)


def test_bias_columns_are_the_derivative_of_the_motion():
    step = motion_over([IMU])
    turned_back = step.motion[:, :3].T
    for axis in range(6):
        change = np.zeros(6)
        change[axis] = 1e-5
        other = turned_back @ (motion_over([IMU - change]).motion - step.motion)
        numeric = np.concatenate(([other[2, 1], other[0, 2], other[1, 0]], other[:, 3], other[:, 4]))
        column = step.error[:, 9 + axis]
        # velocity and position by the gyroscope bias hold to first order in the step's angle, 0.013 rad
        np.testing.assert_allclose(column, numeric / 1e-5, rtol=0.02, atol=1e-3 * abs(column).max())


@pytest.mark.parametrize('count', [2, 3, 7, 16])
def test_many_steps_at_once_are_one_after_another(count):
    """Whatever their number: pairs of pairs, and what is left over."""
    samples = IMU + 0.3 * rng.normal(size=(count, 6))
    at_once, one_by_one = motion_over(samples), motion_over(samples[:1])
    for sample in samples[1:]:
        one_by_one = one_by_one.then(motion_over([sample]))
    for name in ('motion', 'seconds', 'error'):
        # the same products in another order
        np.testing.assert_allclose(getattr(at_once, name), getattr(one_by_one, name), rtol=1e-11, atol=1e-15)
