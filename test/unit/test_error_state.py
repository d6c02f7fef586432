"""The error state's matrices against finite differences of the nominal state."""

from dataclasses import replace

import numpy as np
import pytest
from support.flights import CAMERA_POSITION, config

from thermal_fiducial.core.filter.clock_steps import ClockSteps
from thermal_fiducial.core.filter.error_state import BodyPose, ErrorStateFilter, Motion, pose_innovation
from thermal_fiducial.core.filter.imu import ImuStep
from thermal_fiducial.core.filter.initialisation import blank_state
from thermal_fiducial.core.filter.learned_noise import StampJitter
from thermal_fiducial.core.filter.navigation_state import inject, Layout, POSE, VELOCITY
from thermal_fiducial.core.geometry.se3 import so3_exp, so3_left_jacobian, so3_log, transform
from thermal_fiducial.core.measurements import CameraPose

FULL = config(estimate_extrinsics=True, pose_noise_scale=1.0)
LAYOUT = Layout.of(FULL)
STEP = ImuStep(np.array([0.8, -1.5, 2.0, 3.0, -1.0, 9.0]), 0.005, 1.7e-4, 2.0e-3)


@pytest.fixture
def state():
    rng = np.random.default_rng(5)
    A = rng.normal(size=(LAYOUT.size, LAYOUT.size)) * 0.01
    return replace(
        blank_state(FULL, LAYOUT),
        R_map_body=so3_exp([0.3, -0.2, 1.9]),
        velocity=np.array([1.0, -0.5, 0.2]),
        position=np.array([4.0, 2.0, -1.0]),
        bias=0.01 * rng.normal(size=6),
        clock_open=True,
        covariance=A @ A.T,
    )


def difference(state, other):
    """Error coordinates that carry ``state`` to ``other``."""
    rotation = so3_log(state.R_map_body.T @ other.R_map_body)
    J = np.linalg.inv(state.R_map_body @ so3_left_jacobian(rotation))
    extrinsics = other.T_body_camera @ np.linalg.inv(state.T_body_camera)
    phi = so3_log(extrinsics[:3, :3])
    return np.concatenate(
        (
            rotation,
            J @ (other.velocity - state.velocity),
            J @ (other.position - state.position),
            other.bias - state.bias,
            other.gravity[:2] - state.gravity[:2],
            [other.time_offset - state.time_offset],
            phi,
            np.linalg.inv(so3_left_jacobian(phi)) @ extrinsics[:3, 3],
            (other.gyroscope_scale - state.gyroscope_scale).ravel(),
        )
    )


def intercepted(filter_):
    """Innovation and Jacobian of the next update, which isn't made."""
    seen = {}

    def update(state, innovation, H, noise):
        seen.update(y=innovation, H=H)
        filter_._algebra.K = np.zeros((LAYOUT.size, 6))
        return state, 0.0

    filter_._update = update
    return seen


def steady(rate):
    """Motion of a constant rate (3,) without specific force."""
    return Motion(np.concatenate((rate, np.zeros(3))), np.zeros(3), 0.1)


def test_inject_moves_the_state_by_the_error(state):
    error = 0.1 * np.random.default_rng(1).normal(size=LAYOUT.size)
    moved = inject(state, error, state.covariance, LAYOUT)
    # 1e-9: double precision, but for the re-orthonormalisation, which is quadratic in rounding
    np.testing.assert_allclose(difference(state, moved), error, atol=1e-9)


def test_the_pose_error_propagates_exactly_linearly(state):
    """The group error of two states under the same samples, not only for small errors."""
    filter_ = ErrorStateFilter(FULL)
    error = np.zeros(LAYOUT.size)
    error[:9] = np.random.default_rng(2).normal(size=9)
    other = inject(state, error, state.covariance, LAYOUT)
    after = filter_.predict(state, STEP)
    F = filter_._transition.F.copy()
    # half a radian and a metre of error: exact to double precision is the left-invariant error's promise
    np.testing.assert_allclose(difference(after, filter_.predict(other, STEP))[:9], (F @ error)[:9], atol=1e-12)


def test_transition_is_the_derivative_of_the_propagation(state):
    filter_ = ErrorStateFilter(FULL)
    state = replace(state, gyroscope_scale=0.01 * np.random.default_rng(3).normal(size=(3, 3)))
    after = filter_.predict(state, STEP)
    F = filter_._transition.F.copy()
    columns = []
    for error in 1e-6 * np.eye(LAYOUT.size):
        other = filter_.predict(inject(state, error, state.covariance, LAYOUT), STEP)
        columns.append(difference(after, other) / 1e-6)
    # 1e-6: rounding of the differences; the gyroscope bias' second-order effect on v and p is within it at 5 ms, and
    # that of a share of the rate as many times larger as the rate is
    tolerance = np.full(LAYOUT.size, 1e-6)
    tolerance[LAYOUT.gyroscope_scale] *= np.tile(np.maximum(np.abs(STEP.imu[:3]), 1.0), 3)
    np.testing.assert_array_less(np.abs(F - np.transpose(columns)), np.broadcast_to(tolerance, F.shape))


def test_the_covariance_follows_the_error(state):
    filter_ = ErrorStateFilter(FULL)
    after = filter_.predict(state, STEP)
    F, Q = filter_._transition.F, filter_._transition.Q
    np.testing.assert_allclose(after.covariance, F @ state.covariance @ F.T + Q, atol=1e-15)


def test_the_innovation_is_the_error_itself(state):
    error = np.zeros(LAYOUT.size)
    error[[0, 1, 2, 6, 7, 8]] = [0.4, -0.3, 0.8, 1.0, 2.0, -3.0]
    truth = inject(state, error, state.covariance, LAYOUT)
    np.testing.assert_allclose(pose_innovation(state, truth.T_map_body), error[[0, 1, 2, 6, 7, 8]], atol=1e-12)


def test_covariance_of_the_body_pose_has_the_lever_arm():
    """Samples of the camera pose in the ROS convention, carried to the body one by one."""
    filter_ = ErrorStateFilter(FULL)
    state = blank_state(FULL, LAYOUT)
    rng = np.random.default_rng(4)
    A = 1e-4 * rng.normal(size=(6, 6))
    T = transform(so3_exp([0.5, 1.0, -2.0]), [1.0, 2.0, 3.0])
    pose = filter_.body_pose(CameraPose(0, T, A @ A.T), state.T_body_camera)
    columns = []
    for d in 1e-6 * np.eye(6):
        other = transform(so3_exp(d[3:]) @ T[:3, :3], T[:3, 3] + d[:3]) @ np.linalg.inv(state.T_body_camera)
        inner = np.linalg.inv(pose.T_map_body) @ other
        columns.append(np.concatenate((so3_log(inner[:3, :3]), inner[:3, 3])) / 1e-6)
    J = np.transpose(columns)
    assert np.linalg.norm(CAMERA_POSITION) > 0.1
    # 1e-5 relative: finite differences of 1e-6
    np.testing.assert_allclose(pose.covariance, J @ A @ A.T @ J.T, rtol=1e-4, atol=1e-5 * (A @ A.T).max())


def test_time_offset_and_extrinsics_columns(state):
    """A pose taken earlier, and one through other extrinsics, differ as the columns of H say."""
    filter_ = ErrorStateFilter(FULL)
    seen = intercepted(filter_)
    motion = steady(np.array([0.5, -1.0, 0.7]) + state.bias[:3])
    later = transform(state.R_map_body @ so3_exp([0.5e-6, -1e-6, 0.7e-6]), state.position + 1e-6 * state.velocity)
    pose = CameraPose(0, later @ state.T_body_camera, np.eye(6))
    filter_.correct(state, filter_.body_pose(pose, state.T_body_camera), motion)
    np.testing.assert_allclose(seen['y'], 1e-6 * seen['H'][:, LAYOUT.time_offset], atol=1e-11)
    for axis, error in enumerate(1e-6 * np.eye(6)):
        T_true = transform(so3_exp(error[:3]), error[3:]) @ state.T_body_camera
        pose = CameraPose(0, state.T_map_body @ T_true, np.eye(6))
        filter_.correct(state, filter_.body_pose(pose, state.T_body_camera), motion)
        np.testing.assert_allclose(seen['y'], 1e-6 * seen['H'][:, LAYOUT.extrinsics][:, axis], atol=1e-11)


def test_motion_is_the_mean_of_a_window_and_the_slope_of_its_rate():
    t = np.arange(-39, 1) * 0.005
    samples = np.stack([0.3 + 2.0 * t, -1.0 * t, 0.0 * t, 1.0 + t, 0.0 * t, 9.8 + 0.0 * t], axis=1)
    motion = Motion.of(samples, 0.2)
    np.testing.assert_allclose(motion.angular_acceleration, [2.0, -1.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(motion.imu, samples.mean(axis=0))
    assert motion.age == pytest.approx(0.1)
    assert not Motion.of(samples[:1], 0.2).angular_acceleration.any()


def test_rates_are_averaged_as_their_noise_asks_and_the_turning_allows():
    def turning(rate, acceleration):
        return Motion(np.array([rate, 0, 0, 0, 0, 9.8]), np.array([0, acceleration, 0]), 0.1)

    swinging = turning(0.1, 0.4)
    # (density / acceleration)^(2/3), the acceleration 3 times the rate at least: 0.5 rad/s^2 here
    assert swinging.averaging_seconds(2e-3) == pytest.approx(14.0 * 0.004 ** (2 / 3))
    assert swinging.averaging_seconds(2e-2) == turning(0.0, 0.0).averaging_seconds(1e-4) == 0.5
    assert turning(2.0, 5.0).averaging_seconds(5e-4) == 0.05


@pytest.mark.parametrize(('turning', 'push'), [(0.0, 0.0), (3.0, 0.0), (0.0, 2.0)])
def test_an_uncertain_time_offset_costs_what_the_acceleration_makes_of_it(state, turning, push):
    """Nothing at rest; half of it times the square of the offset, and what a turn's rate changes since the window."""
    exact = config(
        attitude_floor=0.0, position_floor=0.0, motion_floor=0.0, stamp_jitter=0.0, pose_noise_scale=1.0,
    )  # fmt: skip
    filter_ = ErrorStateFilter(exact)
    place, std = filter_.layout.time_offset, 0.02
    P = 1e3 * np.eye(filter_.layout.size)
    P[VELOCITY, VELOCITY], P[place, place] = 0.0, std**2
    steps = ClockSteps.none(filter_.layout.size)
    resting = replace(state, velocity=np.zeros(3), covariance=P, clock_steps=steps)
    lift = np.concatenate((resting.bias[:3], resting.bias[3:] - resting.gravity @ resting.R_map_body))
    motion = Motion(lift + np.eye(6)[3] * push, np.array([turning, 0.0, 0.0]), 0.1)
    corrected, _ = filter_.correct(resting, BodyPose(resting.T_map_body, 1e-12 * np.eye(6)), motion)
    attitude = 0.75 * (turning * std**2) ** 2 + (0.1 * turning * std) ** 2
    position = 0.75 * (push * std**2) ** 2
    expected = [attitude + 1e-12] * 3 + [position + 1e-12] * 3
    np.testing.assert_allclose(np.diag(corrected.covariance)[POSE], expected, rtol=1e-4, atol=1e-12)


def test_before_the_time_offset_is_estimated_the_covariance_counts_it(state):
    """A state in the camera's clock is off by the motion in the offset, and goes on to be so when that is opened."""
    filter_ = ErrorStateFilter(FULL)
    known = replace(state, clock_open=False, covariance=1e-8 * np.eye(LAYOUT.size))
    imu = np.array([0.5, -1.0, 0.7, 3.0, -1.0, 9.0])
    P = filter_.in_clock_of_imu(known, imu).covariance
    step = ImuStep(imu, 1e-6, 0.0, 0.0)
    slide = difference(filter_.predict(known, step), known)[:9] / 1e-6
    # 1e-3: the rest of the covariance, and the second order of the difference
    np.testing.assert_allclose(P[:9, LAYOUT.time_offset], FULL.time_offset_std**2 * slide, rtol=1e-3)
    np.testing.assert_allclose(P[:9, :9], FULL.time_offset_std**2 * np.outer(slide, slide), rtol=1e-2, atol=1e-7)
    opened = replace(state, clock_open=True)
    assert filter_.in_clock_of_imu(opened, imu) is opened


def test_another_time_offset_moves_what_depends_on_it(state):
    """The state's mean given the offset; as uncertain as before."""
    filter_ = ErrorStateFilter(FULL)
    moved = filter_.at_offset(state, 0.02)
    column = state.covariance[:, LAYOUT.time_offset]
    assert moved.time_offset == pytest.approx(0.02)
    # 1e-9: rounding
    np.testing.assert_allclose(difference(state, moved), 0.02 * column / column[LAYOUT.time_offset], atol=1e-9)
    assert moved.covariance is state.covariance


def test_alignment_column_of_tilt_bias_and_gravity(state):
    filter_ = ErrorStateFilter(FULL)
    seen = intercepted(filter_)
    for place in (0, 1, 2, 12, 13, 14, LAYOUT.gravity.start, LAYOUT.gravity.start + 1):
        error = np.zeros(LAYOUT.size)
        error[place] = 1e-6
        truth = inject(state, error, state.covariance, LAYOUT)
        filter_.align(state, truth.bias[3:] - truth.gravity @ truth.R_map_body, 0.1)
        # 1e-10: second order of a tilt of 1e-6 under 10 m/s^2, with rounding
        np.testing.assert_allclose(seen['y'], seen['H'] @ error, atol=1e-10)


def test_motion_adds_to_the_floors_in_all_directions(state):
    """A perfect pose is worth its floors: what the corners' covariances leave out."""
    floors = config(
        attitude_floor=1e-4, position_floor=1e-3, motion_floor=2e-3, stamp_jitter=0.0, estimate_time_offset=False,
        time_offset_std=0.0,
    )  # fmt: skip
    filter_ = ErrorStateFilter(floors)
    exact = StampJitter.of(floors.stamp_jitter)
    wide = replace(state, clock_open=False, stamp_jitter=exact, covariance=1e3 * np.eye(filter_.layout.size))
    body = BodyPose(state.T_map_body, np.zeros((6, 6)))
    rate = np.array([0.1, -0.2, 0.4])
    corrected, _ = filter_.correct(wide, body, steady(rate + state.bias[:3]))
    speed = np.linalg.norm(state.velocity)
    expected = [1e-4**2 + (2e-3 * np.linalg.norm(rate)) ** 2] * 3 + [1e-3**2 + (2e-3 * speed) ** 2] * 3
    np.testing.assert_allclose(np.diag(corrected.covariance)[POSE], expected, rtol=1e-6)
