"""The estimate along the IMU samples: its state against brute force, its covariance against finite differences."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm
from support.estimates import any_estimate, difference

from thermal_fiducial.core.filter.imu_buffer import Steps
from thermal_fiducial.core.filter.propagation import propagated, step_matrices
from thermal_fiducial.core.filter.state import CORE, EXTRINSICS, SIZE
from thermal_fiducial.core.geometry.se3 import skew, so3_exp

IMU = np.array([0.8, -1.5, 2.0, 3.0, -1.0, 9.0])
DENSITIES = np.repeat((1.7e-4, 2.0e-3), 3)
SECONDS, STEP_NS = 0.005, 5_000_000
NO_WALKS = np.zeros(SIZE)
#: Derivative of the force [m/s^3].
SLOPE = np.array([30.0, -20.0, 40.0])


@pytest.fixture
def estimate():
    return any_estimate()


def after(estimate, samples=IMU[None], densities=DENSITIES, walks=NO_WALKS):
    """The estimate after steps of equal length, one for each mean sample (N, 6)."""
    count = len(samples)
    seconds, slopes = np.full(count, SECONDS), np.tile(SLOPE, (count, 1))
    steps = Steps(np.asarray(samples), seconds, np.tile(densities, (count, 1)), slopes)
    return propagated(estimate, steps, estimate.stamp_ns + count * STEP_NS, walks)


@pytest.mark.parametrize('turn', [0.0, 1e-9, 0.01, 0.1])
def test_the_matrices_of_a_step_are_those_of_the_exponential(turn):
    rate, force = turn / SECONDS * np.array([0.6, -0.48, 0.64]), IMU[3:]
    # d/dt of error and input: rotation, velocity, position; rate, force.
    generator = np.zeros((15, 15))
    for place in (0, 3, 6):
        generator[place : place + 3, place : place + 3] = -skew(rate)
    generator[3:6, 0:3], generator[6:9, 3:6] = -skew(force), np.eye(3)
    generator[0:3, 9:12] = generator[3:6, 12:15] = np.eye(3)
    exact = expm(generator * SECONDS)
    found = step_matrices(np.concatenate((rate, force))[None], np.array([SECONDS]))
    # what six terms leave of a turn, turn^6 / 7!, and rounding
    atol = turn**6 / 5040.0 + 1e-15
    np.testing.assert_allclose(found.transition[0], exact[:9, :9], atol=atol)
    np.testing.assert_allclose(found.by_imu[0], exact[:9, 9:], atol=atol)


def test_the_state_moves_by_the_error(estimate):
    error = 0.1 * np.random.default_rng(1).normal(size=SIZE)
    error[EXTRINSICS] = 0.0
    moved = estimate.state.plus(error)
    # 1e-9: double precision, but for the re-orthonormalisation, which is quadratic in rounding
    np.testing.assert_allclose(difference(estimate.state, moved), error, atol=1e-9)


def test_the_derivative_of_the_state_is_that_of_its_propagation(estimate):
    """X(t + s) = X(t) Exp(derivative s), for a robot that turns while it flies."""
    seconds = 1e-5
    steps = Steps(IMU[None], np.array([seconds]), DENSITIES[None], np.zeros((1, 3)))
    later = propagated(estimate, steps, estimate.stamp_ns + 10_000, NO_WALKS).state
    found = difference(estimate.state, later)[CORE] / seconds
    # 1e-5 s of its own change, of up to 20 a second.
    np.testing.assert_allclose(estimate.state.derivative(IMU), found, atol=2e-4)


def test_a_step_is_the_integral_of_the_motion(estimate):
    n = 20000
    dt = SECONDS / n
    state = replace(estimate.state, bias=np.zeros(6), scale=np.zeros((2, 3, 3)), force_delay=0.0)
    half = so3_exp(IMU[:3] * dt / 2)
    R, v, p = state.R_map_body, state.velocity, state.position
    for _ in range(n):
        a = R @ half @ IMU[3:] + state.gravity
        p, v, R = p + v * dt + a * dt * dt / 2, v + a * dt, R @ half @ half
    moved = after(replace(estimate, state=state)).state
    # the midpoint sum is exact to (rate dt)^2 / 24 ~ 1e-14 of dv = 0.05; rounding over 20000 sums stays below 1e-10
    np.testing.assert_allclose(moved.R_map_body, R, atol=1e-10)
    np.testing.assert_allclose(moved.velocity, v, atol=1e-10)
    np.testing.assert_allclose(moved.position, p, atol=1e-10)


def test_the_pose_error_propagates_exactly_linearly(estimate):
    """The group error of two states under the same samples, not only for small errors."""
    error = np.zeros(SIZE)
    error[CORE] = np.random.default_rng(2).normal(size=9)
    other = replace(estimate, state=estimate.state.plus(error))
    samples = IMU + 0.3 * np.random.default_rng(3).normal(size=(4, 6))
    corrected = estimate.state.corrected(samples)
    corrected[:, 3:] += estimate.state.force_delay * SLOPE
    matrices = step_matrices(corrected, np.full(4, SECONDS))
    expected = np.linalg.multi_dot(matrices.transition[::-1]) @ error[CORE]
    found = difference(after(estimate, samples).state, after(other, samples).state)[CORE]
    # half a radian and a metre of error: exact to double precision is the left-invariant error's promise
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_a_late_force_is_read_as_of_its_instant(estimate):
    """A force that grows linearly, read 7 ms late, moves the robot as one that is read at once."""
    grown = np.concatenate((np.zeros(3), SLOPE))
    prompt = IMU + np.outer(SECONDS * np.arange(6), grown)
    late = prompt - 0.007 * grown
    exact = replace(estimate, state=replace(estimate.state, scale=np.zeros((2, 3, 3)), force_delay=0.0))
    delayed = replace(estimate, state=replace(exact.state, force_delay=0.007))
    # the same numbers but for the order of sums
    np.testing.assert_allclose(
        difference(after(exact, prompt).state, after(delayed, late).state)[CORE], 0.0, atol=1e-13
    )


@pytest.mark.parametrize('count', [1, 6])
def test_the_covariance_follows_the_derivative_of_the_propagation(estimate, count):
    samples = IMU + 0.3 * np.random.default_rng(3).normal(size=(count, 6))
    ahead = after(estimate, samples, 0.0 * DENSITIES)
    columns = []
    for error in 1e-6 * np.eye(SIZE):
        other = after(replace(estimate, state=estimate.state.plus(error)), samples)
        columns.append(difference(ahead.state, other.state) / 1e-6)
    transition = np.transpose(columns)
    # No estimate of the extrinsics changes.
    transition[EXTRINSICS, EXTRINSICS] = np.eye(6)
    # errors of 1e-6 leave 1e-6 of second order, and rounding of as much
    expected = transition @ estimate.covariance @ transition.T
    np.testing.assert_allclose(ahead.covariance, expected, atol=1e-5 * abs(estimate.covariance).max())
    np.testing.assert_allclose(ahead.covariance, ahead.covariance.T, atol=1e-15)


def test_many_steps_at_once_are_one_after_another(estimate):
    samples, walks = IMU + 0.3 * np.random.default_rng(3).normal(size=(7, 6)), np.full(SIZE, 1e-6)
    at_once = after(estimate, samples, walks=walks)
    one_by_one = estimate
    for sample in samples:
        one_by_one = after(one_by_one, sample[None], walks=walks)
    # the same products, of matrices that were made one by one
    np.testing.assert_allclose(at_once.covariance, one_by_one.covariance, rtol=1e-11, atol=1e-15)
    np.testing.assert_allclose(difference(at_once.state, one_by_one.state), 0.0, atol=1e-14)
    assert at_once.stamp_ns == one_by_one.stamp_ns


def test_white_noise_of_a_step_is_that_of_its_densities(estimate):
    """Isotropic to second order in the step's angle, 0.013 rad."""
    known = replace(estimate, covariance=np.zeros((SIZE, SIZE)))
    noise = np.diag(after(known).covariance)
    np.testing.assert_allclose(noise[:3], 1.7e-4**2 * SECONDS, rtol=1e-3)
    np.testing.assert_allclose(noise[3:6], 2.0e-3**2 * SECONDS, rtol=1e-3)


def test_the_parameters_walk(estimate):
    walks = np.zeros(SIZE)
    walks[9:12] = 2e-5**2
    grown = after(estimate, walks=walks).covariance - after(estimate).covariance
    np.testing.assert_allclose(grown, np.diag(walks) * SECONDS, atol=1e-16)
