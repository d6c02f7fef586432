"""The error's transition against finite differences of the state."""

from dataclasses import replace

import numpy as np
import pytest
from support.estimates import any_estimate, difference

from thermal_fiducial.core.filter.imu_buffer import Steps
from thermal_fiducial.core.filter.prediction import Prediction
from thermal_fiducial.core.filter.state import SIZE

IMU = np.array([0.8, -1.5, 2.0, 3.0, -1.0, 9.0])
DENSITIES = np.repeat((1.7e-4, 2.0e-3), 3)
STEP_NS = 5_000_000


@pytest.fixture
def estimate():
    return any_estimate()


def after(estimate, steps=1, imu=IMU):
    prediction = Prediction.begin(estimate)
    one = Steps(imu[None], np.array([1e-9 * STEP_NS]), DENSITIES[None])
    for step in range(1, steps + 1):
        prediction = prediction.after(one, estimate.stamp_ns + step * STEP_NS)
    return prediction


def test_the_state_moves_by_the_error(estimate):
    error = 0.1 * np.random.default_rng(1).normal(size=SIZE)
    moved = estimate.state.plus(error)
    # 1e-9: double precision, but for the re-orthonormalisation, which is quadratic in rounding
    np.testing.assert_allclose(difference(estimate.state, moved), error, atol=1e-9)


def test_the_pose_error_propagates_exactly_linearly(estimate):
    """The group error of two states under the same samples, not only for small errors."""
    error = np.zeros(SIZE)
    error[:9] = np.random.default_rng(2).normal(size=9)
    other = replace(estimate, state=estimate.state.plus(error))
    ahead = after(estimate, 4)
    # half a radian and a metre of error: exact to double precision is the left-invariant error's promise
    propagated = difference(ahead.state, after(other, 4).state)[:9]
    np.testing.assert_allclose(propagated, ahead.transition[:, :9] @ error[:9], atol=1e-12)


@pytest.mark.parametrize('steps', [1, 6])
def test_the_transition_is_the_derivative_of_the_propagation(estimate, steps):
    ahead = after(estimate, steps)
    columns = []
    for error in 1e-6 * np.eye(SIZE):
        other = after(replace(estimate, state=estimate.state.plus(error)), steps)
        columns.append(difference(ahead.state, other.state)[:9] / 1e-6)
    # second-order effects of biases over the steps' angle (0.013 rad each), and of shares of a reading of 9 m/s^2
    np.testing.assert_allclose(ahead.transition, np.transpose(columns)[:, :35], rtol=0.02, atol=2e-5 * steps)
    np.testing.assert_allclose(np.transpose(columns)[:, 35:], 0.0, atol=1e-9)


def test_the_covariance_follows_the_error(estimate):
    """Accumulated over steps and folded once, it is what folding at each step gives."""
    walks = np.zeros(SIZE)
    at_once = after(estimate, 6).estimate(walks)
    step_by_step = estimate
    for _ in range(6):
        step_by_step = after(step_by_step).estimate(walks)
    np.testing.assert_allclose(at_once.covariance, step_by_step.covariance, rtol=1e-9, atol=1e-14)
    np.testing.assert_allclose(at_once.covariance, at_once.covariance.T, atol=1e-15)


def test_white_noise_of_a_step_is_that_of_its_densities(estimate):
    """Isotropic to second order in the step's angle, 0.013 rad."""
    noise, seconds = after(estimate).noise, STEP_NS * 1e-9
    np.testing.assert_allclose(np.diag(noise)[:3], 1.7e-4**2 * seconds, rtol=1e-3)
    np.testing.assert_allclose(np.diag(noise)[3:6], 2.0e-3**2 * seconds, rtol=1e-3)


def test_the_parameters_walk(estimate):
    walks = np.zeros(SIZE)
    walks[9:12] = 2e-5**2
    grown = after(estimate).estimate(walks).covariance - after(estimate).estimate(np.zeros(SIZE)).covariance
    np.testing.assert_allclose(grown, np.diag(walks) * STEP_NS * 1e-9, atol=1e-16)
