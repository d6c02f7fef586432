"""The pose update's Jacobian against finite differences, and what it learns."""

from dataclasses import replace
import math

import numpy as np
import pytest
from support.estimates import any_estimate, ELSEWHERE
from support.flights import CAMERA_POSITION, config

from thermal_fiducial.core.filter.belief import Hypothesis
from thermal_fiducial.core.filter.hypotheses import weigh
from thermal_fiducial.core.filter.imu_buffer import MotionAtPose
from thermal_fiducial.core.filter.pose_noise import BodyPose, PoseNoise, share_that_stays, WHITE
from thermal_fiducial.core.filter.state import (
    clock_offset_derivative,
    CORE,
    embedded_core,
    EXTRINSICS,
    MARKERS,
    POSE,
    POSITION,
    ROTATION,
    SIZE,
    SYSTEMATIC,
    TIME_OFFSET,
    VELOCITY,
)
from thermal_fiducial.core.filter.update import (
    adapted_noise,
    body_pose,
    corrected,
    innovation_of,
    map_jacobian,
    mount_jacobian,
    pose_error,
)
from thermal_fiducial.core.geometry.se3 import inverse, lever_arm, retract, screwed, so3_exp, so3_log, transform
from thermal_fiducial.core.measurements import CameraPose, NOTHING_KNOWN

FULL = config(stamp_jitter=0.0, mount_vibration=0.0)
RATE = np.array([0.5, -1.0, 0.7])


def motion_of(state, rate=RATE, acceleration=(0.0, 0.0, 0.0), **others):
    """A motion whose samples show this rate and this change of the velocity in the robot frame."""
    gravity = state.gravity @ state.R_map_body
    force = acceleration - gravity + np.cross(rate, state.velocity_body)
    wanted = np.concatenate((rate, force)) + state.bias
    imu = np.linalg.solve(np.eye(3) - state.scale, wanted.reshape(2, 3, 1)).reshape(6)
    return MotionAtPose(**({'imu': imu, 'turning': 0.0, 'white': np.zeros(6)} | others))


@pytest.fixture
def motion(estimate):
    return motion_of(estimate.state)


@pytest.fixture
def still(estimate):
    return motion_of(estimate.state, np.zeros(3))


@pytest.fixture
def estimate():
    return any_estimate()


def known(estimate, variance=1e-12):
    """An estimate that knows its velocity, with a little left of the rest."""
    return replace(estimate, covariance=variance * np.eye(SIZE))


def test_the_innovation_is_the_error_itself(estimate):
    error = np.zeros(SIZE)
    error[POSE] = [0.4, -0.3, 0.8, 1.0, 2.0, -3.0]
    truth = estimate.state.plus(error)
    np.testing.assert_allclose(pose_error(estimate.state, truth.T_map_body), error[POSE], atol=1e-12)


def test_covariance_of_the_body_pose_has_the_lever_arm(estimate):
    """Samples of the camera pose in the ROS convention, carried to the body one by one."""
    rng = np.random.default_rng(4)
    A = 1e-4 * rng.normal(size=(6, 6))
    T, T_body_camera = transform(so3_exp([0.5, 1.0, -2.0]), [1.0, 2.0, 3.0]), estimate.state.T_body_camera
    pose = body_pose(CameraPose(0, T, A @ A.T), T_body_camera, 1.0)
    columns = []
    for d in 1e-6 * np.eye(6):
        other = transform(so3_exp(d[3:]) @ T[:3, :3], T[:3, 3] + d[:3]) @ np.linalg.inv(T_body_camera)
        inner = np.linalg.inv(pose.T_map_body) @ other
        columns.append(np.concatenate((so3_log(inner[:3, :3]), inner[:3, 3])) / 1e-6)
    J = np.transpose(columns)
    assert np.linalg.norm(CAMERA_POSITION) > 0.1
    # 1e-5 relative: finite differences of 1e-6
    np.testing.assert_allclose(pose.covariance, J @ A @ A.T @ J.T, rtol=1e-4, atol=1e-5 * (A @ A.T).max())


def test_of_turns_that_a_pose_does_not_show_the_error_of_the_map_stays():
    """The last pose was off by a turn of the map about z, the next one says nothing of turns about z."""
    turn, rest = np.array([0.0, 0.0, 1.0, 0.0, 8.0, 0.0]), np.diag(np.repeat((1e-3, 1e-3), 3) ** 2)
    T = transform(np.eye(3), [8.0, 0.0, 0.0])
    about_z = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    last = BodyPose(T, rest, 0.05**2 * np.outer(about_z, about_z))
    now = BodyPose(T, rest + NOTHING_KNOWN**2 * np.outer(turn, turn), 1e-4 * np.diag([1.0, 1.0, 1.0, 0.0, 0.0, 0.0]))
    kept = now.as_last(last, T).map_covariance
    np.testing.assert_allclose(kept[5, 5], 0.05**2, rtol=1e-3)
    # About the origin, which the turn leaves where it is, and of all else it is that of the pose itself.
    np.testing.assert_allclose(kept[:3, :3], 1e-4 * np.eye(3), rtol=1e-3, atol=1e-9)
    shown = replace(now, covariance=rest)
    np.testing.assert_array_equal(shown.as_last(last, T).map_covariance, now.map_covariance)


@pytest.mark.parametrize('away', [-0.3, 0.3])
@pytest.mark.parametrize('farther', [-0.05, 0.05])
def test_of_turns_that_a_pose_does_not_show_nothing_is_learned(estimate, still, away, farther):
    """It is elsewhere on the arc about a marker 8 m ahead, and its distance from that is wrong by 5 cm."""
    about_y, about_z = np.array([0.0, 1.0, 0.0, 0.0, 0.0, 1.0]), np.array([0.0, 0.0, 1.0, 0.0, -1.0, 0.0])
    near, far = np.repeat((1.0, 8.0), 3), np.repeat((1.0, 8.0 + farther), 3)
    P = known(estimate).covariance
    P[POSE, POSE[:, None]] += 0.04**2 * np.outer(near * about_z, near * about_z)
    on_arc = screwed(np.eye(4), away * np.roll(near * about_z, 3))
    T = estimate.state.T_map_body @ on_arc @ transform(np.eye(3), [-farther, 0.0, 0.0])
    own = np.diag(np.array([1e-3, 1e-3, 1e-3, 0.05, 1e-3, 1e-3]) ** 2)
    unknown = NOTHING_KNOWN**2 * sum(np.outer(far * about, far * about) for about in (about_y, about_z))
    innovation = innovation_of(FULL, replace(estimate, covariance=P), BodyPose(T, own + unknown), still)
    turn = so3_log(estimate.state.R_map_body.T @ corrected(FULL, innovation).state.R_map_body)
    # A hundredth of what is not known of it, which is 0.04: left where it is, the pose turns the estimate by 0.0046.
    assert np.linalg.norm(turn) < 4e-4


def test_time_offset_and_extrinsics_columns(estimate, motion):
    """A pose taken later, and one through other extrinsics, differ as the columns of H say."""
    state = estimate.state
    later = transform(state.R_map_body @ so3_exp(1e-6 * RATE), state.position + 1e-6 * state.velocity)
    innovation = innovation_of(FULL, known(estimate), BodyPose(later, np.eye(6)), motion)
    np.testing.assert_allclose(innovation.value, 1e-6 * innovation.H[:, TIME_OFFSET], atol=1e-11)
    for axis, error in enumerate(1e-6 * np.eye(6)):
        T_true = transform(so3_exp(error[:3]), error[3:]) @ state.T_body_camera
        measured = body_pose(CameraPose(0, state.T_map_body @ T_true, 0.01 * np.eye(6)), state.T_body_camera, 1.0)
        innovation = innovation_of(FULL, known(estimate), measured, motion)
        np.testing.assert_allclose(innovation.value, 1e-6 * innovation.H[:, EXTRINSICS][:, axis], atol=1e-11)


def test_the_systematic_error_is_part_of_the_measurement(estimate, still):
    """It moves a pose as it is; in a view with nothing in common it is as large as the poses say, times a factor."""
    twice = replace(FULL, systematic_pose_std=2.0)
    A = np.random.default_rng(3).normal(size=(6, 6)) * 1e-3
    pose, error = BodyPose(estimate.state.T_map_body, A @ A.T), 1e-3 * np.arange(1.0, 7.0)
    same_view = replace(known(estimate), pose_noise=PoseNoise.of(pose))
    biased = replace(same_view, state=replace(estimate.state, systematic=error))
    np.testing.assert_allclose(innovation_of(twice, biased, pose, still).value, -error, atol=1e-12)
    # A hundred radians away: e^-333 of it are left.
    far = replace(pose, T_map_body=transform(np.eye(3), [1e6, 0.0, 0.0]))
    other_view = replace(biased, pose_noise=PoseNoise.of(far))
    innovation = innovation_of(twice, other_view, pose, still)
    np.testing.assert_allclose(innovation.value, 0.0, atol=1e-12)
    shown = innovation.prior.covariance[SYSTEMATIC, SYSTEMATIC]
    np.testing.assert_allclose(shown, 4.0 * pose.shape, rtol=1e-9, atol=1e-15)


def test_noise_of_poses_is_no_change_of_the_view(estimate, still):
    """Of a far marker, whose poses scatter by 3 deg: what it is wrong by stays while the robot is where it was."""
    R = np.diag(np.repeat((0.05, 0.15), 3) ** 2)
    here, now = estimate.state.T_map_body, known(estimate)
    now.covariance[SYSTEMATIC, SYSTEMATIC] = R
    now = replace(now, pose_noise=PoseNoise.of(BodyPose(here, R)))
    for turn, shift in ((0.05, -0.1), (-0.06, 0.15), (0.04, 0.1)):
        pose = BodyPose(here @ transform(so3_exp([turn, -turn, 0.0]), [shift, 0.0, shift]), R)
        innovation = innovation_of(FULL, now, pose, still)
        # All but what updates move the estimate by, which knows where it is; a third by noisy poses.
        np.testing.assert_allclose(innovation.prior.state.systematic, now.state.systematic, rtol=1e-4, atol=1e-9)
        now = corrected(FULL, innovation)
    assert np.linalg.norm(now.state.systematic) > 0.01


def test_a_pose_after_a_long_gap_places_the_robot_where_it_says(estimate, still):
    """Position off by 10 m, attitude by 27 mrad, a pose good to a millimetre whose attitude is half believed."""
    state = estimate.state
    lost = replace(estimate, covariance=np.zeros((SIZE, SIZE)))
    lost.covariance[ROTATION, ROTATION] = 0.02**2 * np.eye(3)
    lost.covariance[POSITION, POSITION] = 10.0**2 * np.eye(3)
    true = state.T_map_body @ transform(so3_exp([0.02, -0.01, 0.015]), [8.0, -5.0, 3.0])
    pose = BodyPose(true, np.diag(np.repeat((0.02, 1e-3), 3) ** 2))
    lost = replace(lost, pose_noise=PoseNoise.of(pose))
    after = corrected(FULL, innovation_of(FULL, lost, pose, still))
    # A third of what the pose claims; the first step alone is 18 mm off.
    np.testing.assert_allclose(after.state.position, true[:3, 3], atol=3e-4)


def at_camera_stamp(estimate, motion):
    """Covariance of the core at the camera's stamp, and with the clock offset: errors of X(t) Exp(derivative s)."""
    J = np.eye(SIZE)
    J[CORE, TIME_OFFSET] = estimate.state.derivative(motion.imu)
    P = J @ estimate.covariance @ J.T
    return P[CORE, CORE], P[CORE, TIME_OFFSET]


def test_an_error_of_the_velocity_does_not_change_the_clock_offset(estimate, motion):
    """A pose is of the state at the camera's stamp: what is not correlated with the offset there, stays so."""
    std = 0.02
    unknown = replace(estimate, covariance=np.zeros((SIZE, SIZE)))
    unknown.covariance[CORE, CORE] = np.diag(np.repeat((1e-2, 0.3, 1e-2), 3) ** 2)
    unknown.covariance[VELOCITY, POSITION] = unknown.covariance[POSITION, VELOCITY] = 1.5e-3 * np.eye(3)
    by_offset = np.zeros(SIZE)
    by_offset[CORE], by_offset[TIME_OFFSET] = -estimate.state.derivative(motion.imu), 1.0
    unknown.covariance[...] += std**2 * np.outer(by_offset, by_offset)
    np.testing.assert_allclose(at_camera_stamp(unknown, motion)[1], 0.0, atol=1e-12)
    seen = transform(estimate.state.R_map_body, estimate.state.position + 0.02)
    pose = BodyPose(seen, 1e-6 * np.eye(6))
    after = corrected(FULL, innovation_of(FULL, unknown, pose, motion))
    assert np.linalg.norm(after.state.velocity - estimate.state.velocity) > 0.1
    assert after.std(TIME_OFFSET) == pytest.approx(std)
    # of 0.02 s times 1 m/s or 1 rad/s: rounding
    np.testing.assert_allclose(at_camera_stamp(after, motion)[1], 0.0, atol=1e-9)


def test_noise_of_the_motion_is_no_information(estimate):
    """A rate that is nothing but noise shows no clock offset; a true one does."""
    std = 0.02
    P = 1e-12 * np.eye(SIZE)
    P[TIME_OFFSET, TIME_OFFSET] = std**2
    prior = replace(estimate, covariance=P, state=replace(estimate.state, velocity=np.zeros(3)))
    pose = BodyPose(prior.state.T_map_body, 1e-4 * np.eye(6))
    white = np.repeat((0.01 * float(RATE @ RATE) / 3.0, 0.0), 3)
    noisy = motion_of(prior.state, 0.1 * RATE, white=white)
    unchanged = corrected(FULL, innovation_of(FULL, prior, pose, noisy))
    assert unchanged.std(TIME_OFFSET) == pytest.approx(std, rel=1e-6)
    assert unchanged.state.time_offset == prior.state.time_offset
    learned = corrected(FULL, innovation_of(FULL, prior, pose, replace(noisy, white=np.zeros(6))))
    # (1 / std^2 + |rate|^2 / R)^-1/2
    assert learned.std(TIME_OFFSET) < 0.99 * std


@pytest.mark.parametrize(('turning', 'push'), [(0.0, 0.0), (3.0, 0.0), (0.0, 2.0)])
def test_an_uncertain_time_offset_adds_noise_by_the_acceleration(estimate, turning, push):
    """Nothing at rest; in a turn half of the acceleration times the square of the offset, of variance 3/4 a^2 s^4."""
    std = 0.02
    P = np.zeros((SIZE, SIZE))
    P[TIME_OFFSET, TIME_OFFSET] = std**2
    resting = replace(estimate, state=replace(estimate.state, velocity=np.zeros(3)), covariance=P)
    motion = motion_of(resting.state, np.zeros(3), np.array([push, 0.0, 0.0]), turning=turning)
    pose = BodyPose(resting.state.T_map_body, np.zeros((6, 6)))
    innovation = innovation_of(FULL, resting, pose, motion)
    expected = 0.75 * std**4 * np.repeat((turning**2, push**2), 3) + resting.pose_noise.variances[0] * np.diag(
        pose.shape
    )
    np.testing.assert_allclose(np.diag(innovation.R), expected, rtol=1e-9)


def learned_white(estimate, still, errors):
    """Variance of the white error that is learned from poses with ``errors`` (N, 6), in standard deviations claimed."""
    parameters = config(systematic_pose_std=0.01, stamp_jitter=0.0, estimate_time_offset=False)
    R = np.diag(np.repeat((1e-3, 2e-3), 3) ** 2)
    now = replace(known(estimate, 1e-14), pose_noise=PoseNoise.of(ELSEWHERE))
    for error in np.sqrt(R.diagonal()) * errors:
        T = now.state.T_map_body @ transform(so3_exp(error[:3]), error[3:])
        pose = BodyPose(T, R)
        innovation = innovation_of(parameters, now, pose, still)
        now = replace(now, pose_noise=replace(adapted_noise(innovation), last=pose))
    return now.pose_noise.variances[0]


def test_white_noise_of_poses_is_learned(estimate, still):
    """White errors of three times what the covariance claims, about a state that is known."""
    errors = 3.0 * np.random.default_rng(8).normal(size=(600, 6))
    # the memory of 15 poses of 6 degrees of freedom: a fifth of the variance, a tenth of the deviation; three of that
    assert np.sqrt(learned_white(estimate, still, errors)) == pytest.approx(3.0, rel=0.3)


def test_innovations_of_an_unknown_velocity_are_no_noise(estimate, still):
    """The first pose after a start shows the velocity; the next one, that it is known now, changes much."""
    parameters = config(systematic_pose_std=0.01, stamp_jitter=0.0, estimate_time_offset=False)
    pose, noise = BodyPose(estimate.state.T_map_body, np.diag(np.repeat((1e-3, 2e-3), 3) ** 2)), PoseNoise.of(ELSEWHERE)
    known_well, far = known(estimate, 1e-14), np.array([0.0, 0.0, 0.0, 0.1, 0.0, 0.0])
    R = innovation_of(parameters, replace(known_well, pose_noise=noise), pose, still)
    first = noise.adapted(R.units, far, R.S + np.diag(far**2))
    second = first.adapted(R.units, np.zeros(6), R.S)
    assert max(first.variances[0], second.variances[0]) <= noise.variances[0]


def test_poses_with_less_noise_than_claimed_keep_their_covariance(estimate, still):
    errors = 0.1 * np.random.default_rng(8).normal(size=(100, 6))
    assert learned_white(estimate, still, errors) == WHITE


@pytest.mark.parametrize('size', [5.0, 1e4])
def test_an_error_that_lasts_is_no_white_one(estimate, still, size):
    """A clock that has stepped, a marker that has moved: after the step the innovations stay the same."""
    errors = np.zeros((30, 6))
    errors[10:] = size
    assert learned_white(estimate, still, errors) == WHITE


def test_what_is_known_to_be_white_does_not_last():
    noise = PoseNoise.of(ELSEWHERE)
    # At first all of it may be either.
    assert noise.lasting == 1.0
    known = np.array([1e9, 0.0, 0.0])
    for white, lasting in ((0.2, 0.8), (1.0, 0.0), (7.0, 0.0)):
        learned = replace(noise, variances=np.array([white, 0.0, 0.0]), information=known)
        assert learned.lasting == pytest.approx(lasting, abs=1e-6)


def test_another_view_has_another_systematic_error():
    R = np.diag(np.repeat((1e-3, 2e-3), 3) ** 2)
    here = BodyPose(np.eye(4), R)
    assert here.correlation(here, 0.3) == pytest.approx(1.0)
    turned = BodyPose(transform(so3_exp([0.0, 0.3, 0.0]), np.zeros(3)), R)
    assert turned.correlation(here, 0.3) == pytest.approx(np.exp(-1.0))
    # 2 mm for 1 mrad: markers are 2 m away, so 0.6 m are 0.3 rad
    moved = BodyPose(transform(np.eye(3), [0.6, 0.0, 0.0]), R)
    assert moved.correlation(here, 0.3) == pytest.approx(np.exp(-1.0), rel=0.01)
    other_markers = BodyPose(np.eye(4), 25.0 * R)
    # Bhattacharyya's coefficient of variances 1 and 25 in six dimensions: (5 / 13)^3
    assert other_markers.correlation(here, 0.3) == pytest.approx((5.0 / 13.0) ** 3, rel=0.01)


def test_the_map_has_the_same_error_while_its_covariance_is_the_same():
    turned = so3_exp([0.3, -0.2, 1.9])
    of_map = np.diag(np.repeat((2e-2, 1e-2), 3) ** 2)
    # The robot turns, the map's error doesn't.
    for turn in (turned, turned @ so3_exp([0.0, 0.8, 0.0])):
        here = BodyPose(transform(turn, [3.0, -1.0, 0.5]), 1e-12 * np.eye(6), of_map)
        from_same, from_none, from_half = here.map_changes(np.stack((of_map, 0.0 * of_map, 0.25 * of_map)))
        # rounding, squared
        np.testing.assert_allclose(from_same, 0.0, atol=1e-15)
        # All of it is another one than none, half of it than one of half as much; to the least noise of a pose: 0.1 mm
        # beside 20 mm.
        np.testing.assert_allclose(from_none, of_map, rtol=1e-2, atol=1e-6)
        np.testing.assert_allclose(from_half, 0.25 * of_map, rtol=1e-2, atol=1e-6)


def test_what_the_noise_of_a_pose_makes_of_the_covariance_of_the_map_is_no_change():
    """A pose known to 0.3 m along an axis shows nothing of a map's error of 1 cm there."""
    vague = np.diag([1e-6, 1e-6, 1e-6, 0.09, 1e-6, 1e-6])
    of_map = np.diag([1e-4, 0.0, 0.0, 0.0, 0.0, 0.0])
    # Squares of 0.13 m and of 1 cm beside it differ by a thirtieth of 1 cm.
    assert BodyPose(np.eye(4), vague, of_map).map_changes(np.zeros((1, 6, 6)))[0, 0, 0] < 2e-7


def test_an_error_of_the_map_along_an_axis_that_turns_changes_as_the_axis_does():
    """The scale of a map moves it along the arm from its origin, which turns as the robot goes on."""
    axes = np.zeros((2, 6))
    axes[:, :2] = (1.0, 0.0), (math.cos(0.1), math.sin(0.1))
    then, now = (1e-2 * np.outer(axis, axis) for axis in axes)
    (change,) = BodyPose(np.eye(4), 1e-12 * np.eye(6), now).map_changes(then[None])
    apart = 1e-1 * (axes[1] - axes[0])
    # to the least noise of a pose, 0.03 mm, beside 10 mm
    np.testing.assert_allclose(change, np.outer(apart, apart), atol=1e-6)


def test_a_motion_of_the_map_moves_the_poses_of_its_markers(estimate):
    T, step = estimate.state.T_map_body, 1e-6
    for column, unit in enumerate(np.eye(6)):
        moved = pose_error(estimate.state, retract(np.eye(4), step * unit) @ T) / step
        # second order of the step
        np.testing.assert_allclose(moved, BodyPose(T, np.eye(6)).by_map[:, column], atol=1e-5)


def test_the_estimate_goes_on_in_the_map_of_better_markers(estimate, still):
    """Relative to these it is off by what the two maps differ by."""
    T, R = estimate.state.T_map_body, 1e-12 * np.eye(6)
    large = np.diag(np.repeat((4e-2, 3e-2), 3) ** 2)
    small = large / 400.0
    begun = replace(known(estimate), pose_noise=PoseNoise.of(BodyPose(T, R, large)))
    prior = innovation_of(FULL, begun, BodyPose(T, R, small), still).prior
    np.testing.assert_array_equal(prior.pose_noise.of_map, small)
    assert not prior.covariance[MARKERS].any()
    # The least that the two may differ by: the difference of their standard deviations.
    left = 0.95**2 * large
    to_robot = lever_arm(prior.state.position)[:3]
    grown = prior.covariance[POSITION, POSITION] - begun.covariance[POSITION, POSITION]
    # To the least noise of a pose, 0.1 mm, beside 2 mm.
    assert grown.trace() == pytest.approx((to_robot @ left @ to_robot.T).trace(), rel=1e-2)


def test_a_refused_pose_leaves_the_estimate_in_its_map(estimate, still):
    """Its claim became that of the refused markers' map, and good poses in that one were refused for ever."""
    T, R = estimate.state.T_map_body, 1e-6 * np.eye(6)
    large = 0.04 * np.diag([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])
    begun = replace(known(estimate), pose_noise=PoseNoise.of(BodyPose(T, R, large)))
    far = BodyPose(transform(np.eye(3), [3.0, 0.0, 0.0]) @ T, R, large / 400.0)
    hypothesis = Hypothesis(begun, 0, estimate.stamp_ns, estimate.stamp_ns)
    refusing, verdict = weigh(FULL, hypothesis, innovation_of(FULL, begun, far, still), 0)
    assert verdict.refused
    np.testing.assert_array_equal(refusing.estimate.pose_noise.of_map, large)
    # One standard deviation of the large map's error off.
    near = BodyPose(transform(np.eye(3), [0.2, 0.0, 0.0]) @ T, R, large / 400.0)
    assert weigh(FULL, refusing, innovation_of(FULL, refusing.estimate, near, still), 1)[1].accepted


def test_worse_markers_take_nothing_away_from_what_is_known(estimate, still):
    T, R = estimate.state.T_map_body, 1e-6 * np.eye(6)
    begun = replace(known(estimate), pose_noise=PoseNoise.of(BodyPose(T, R)))
    innovation = innovation_of(FULL, begun, BodyPose(T, R, 1e-2 * np.eye(6)), still)
    after = corrected(FULL, innovation)
    assert not after.pose_noise.of_map.any()
    assert after.position_std <= begun.position_std * (1.0 + 1e-6)


def test_of_a_drifted_estimate_and_poorly_mapped_markers_both_are_used(estimate, still):
    """After a gap the estimate is off by 0.25 m in a map known to 1 mm, the markers that show then by 0.2 m."""
    T, R = estimate.state.T_map_body, 1e-6 * np.eye(6)
    turns_no_more = np.diag([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])
    P = 1e-12 * np.eye(SIZE)
    P[POSITION, POSITION] = 0.25**2 / 3.0 * np.eye(3)
    own_map = PoseNoise.of(BodyPose(T, R, 1e-6 / 3.0 * turns_no_more))
    drifted = replace(estimate, covariance=P, pose_noise=own_map)
    after = corrected(FULL, innovation_of(FULL, drifted, BodyPose(T, R, 0.2**2 / 3.0 * turns_no_more), still))
    # Two independent errors; to the white and lasting errors of the pose, 2 mm, and the error of its own map.
    assert after.position_std == pytest.approx((0.25**-2 + 0.2**-2) ** -0.5, rel=0.02)


def test_the_estimate_goes_on_in_a_map_that_is_hardly_worse(estimate, still):
    """It stayed in that of one exact marker, and the IMU drew it 2 mm away from markers known to a millimetre."""
    T, R = estimate.state.T_map_body, 1e-6 * np.eye(6)
    begun = replace(known(estimate, 1e-4), pose_noise=PoseNoise.of(BodyPose(T, R)))
    hardly = 1e-6 * np.diag([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])
    prior = innovation_of(FULL, begun, BodyPose(T, R, hardly), still).prior
    np.testing.assert_array_equal(prior.pose_noise.of_map, hardly)


def test_a_motion_of_the_map_moves_pose_velocity_and_gravity(estimate):
    state, step = estimate.state, 1e-6
    for column in range(6):
        moved = state.plus(step * map_jacobian(state)[:, column])
        T = moved.T_map_body @ inverse(state.T_map_body)
        exact = state.in_moved_map(T)
        np.testing.assert_allclose(moved.velocity, exact.velocity, atol=1e-10)
        np.testing.assert_allclose(moved.gravity[:2], exact.gravity[:2], atol=1e-10)


def test_a_pose_that_corrects_the_error_of_the_map_is_accepted(estimate, still):
    """A loop closes: the last pose was off by 4 cm of a map known to 3 cm, this one is not."""
    pose = estimate.state.T_map_body
    last = BodyPose(pose, 1e-6 * np.eye(6), 9e-4 * np.eye(6))
    true = BodyPose(pose @ transform(np.eye(3), [0.04, 0.0, 0.0]), 1e-6 * np.eye(6), 1e-6 * np.eye(6))
    innovation = innovation_of(FULL, replace(known(estimate), pose_noise=PoseNoise.of(last)), true, still)
    assert innovation.nis < FULL.gate
    left = pose_error(corrected(FULL, innovation).state, true.T_map_body)
    # Of 40 mm: as uncertain as the pose are its white and its systematic error.
    assert np.linalg.norm(left[3:]) < 0.001


def test_what_stays_of_an_error_is_what_a_better_estimate_has_in_common_with_it():
    """Least squares from some measurements, and from these and others: errors with the covariances that follow."""
    rng = np.random.default_rng(5)
    some, others = rng.normal(size=(9, 6)), rng.normal(size=(7, 6))
    every = np.concatenate((some, others))
    then, now = np.linalg.pinv(some), np.linalg.pinv(every)
    earlier, claimed, common = then @ then.T, now @ now.T, now[:, :9] @ then.T
    # rounding
    np.testing.assert_allclose(
        share_that_stays(earlier, claimed), common @ np.linalg.inv(earlier), rtol=1e-9, atol=1e-9
    )
    # The other way round the pose has all of the error.
    np.testing.assert_allclose(share_that_stays(claimed, earlier), np.eye(6), atol=1e-9)


def test_what_rounding_makes_of_a_large_covariance_is_no_reason_to_fail():
    """A single error of a variance of 1e8, the largest accepted: beside it, rounding leaves nothing of a millimetre."""
    error = np.arange(1.0, 7.0)
    claimed = 1e8 * np.outer(error, error) / 36.0 + 1e-10 * np.eye(6)
    with pytest.raises(np.linalg.LinAlgError):
        np.linalg.cholesky(claimed)
    # Along the error a quarter, to what is left of sixteen digits of variances.
    np.testing.assert_allclose(share_that_stays(4.0 * claimed, claimed) @ error, 0.25 * error, rtol=1e-3)


@pytest.mark.parametrize('of_map', [0.0, 4e-4])
def test_the_systematic_error_is_never_larger_than_a_pose_claims(estimate, still, of_map):
    """A pose whose motion blur is not known yet claims twice as much as the next one; the map's error is no part."""
    now = BodyPose(estimate.state.T_map_body, 1e-4 * np.eye(6), of_map * np.eye(6))
    vague = replace(now, covariance=4.0 * now.covariance)
    covariance = 1e-12 * np.eye(SIZE)
    covariance[SYSTEMATIC, SYSTEMATIC] = vague.shape
    seen = replace(estimate, covariance=covariance, pose_noise=PoseNoise.of(vague))
    kept = innovation_of(FULL, seen, now, still).prior.covariance[SYSTEMATIC, SYSTEMATIC]
    assert np.linalg.eigvalsh(now.shape - kept).min() > -1e-12


def test_what_another_error_of_the_map_makes_of_a_pose_is_not_taken_for_motion(estimate, still):
    """It goes to the motion of the map that the markers of the poses have, which is as uncertain as that."""
    pose = estimate.state.T_map_body
    here = BodyPose(pose, 1e-6 * np.eye(6))
    other = replace(here, map_covariance=1e-2 * np.eye(6))
    seen = replace(known(estimate), pose_noise=PoseNoise.of(here))
    innovation = innovation_of(FULL, seen, other, still)
    shown = innovation.prior.covariance[MARKERS, MARKERS].diagonal()
    # Less what is within the noise of the pose, 1 mrad at 5 m: 0.96 to 1 of it.
    np.testing.assert_allclose(shown, 1e-2, rtol=5e-2)


@pytest.mark.parametrize('accepted', [True, False])
def test_jitter_of_the_stamps_is_learned(estimate, motion, accepted):
    """Stamps that scatter by 3 ms, about a state that is known and moves."""
    white = config(systematic_pose_std=0.01, estimate_time_offset=False, time_offset_std=0.0)
    rng = np.random.default_rng(9)
    R = np.diag(np.repeat((1e-5, 2e-5), 3) ** 2)
    noise = PoseNoise.of(ELSEWHERE, 5e-4)
    velocity = estimate.state.velocity
    for _ in range(1000):
        late = rng.normal(0.0, 3e-3)
        R_late = estimate.state.R_map_body @ so3_exp(late * RATE)
        pose = BodyPose(transform(R_late, estimate.state.position + late * velocity), R)
        now = replace(known(estimate, 1e-14), pose_noise=noise)
        innovation = innovation_of(white, now, pose, motion)
        noise = corrected(white, innovation).pose_noise if accepted else adapted_noise(innovation)
    # the memory of 300 poses of one number: 6 % of the deviation; three of that
    assert np.sqrt(noise.variances[1]) == pytest.approx(3e-3, rel=0.18)


def test_a_rotation_of_the_camera_against_the_robot_moves_the_pose_as_its_noise_says(estimate):
    turn, T_body_camera = 1e-6 * np.array([1.0, -2.0, 3.0]), estimate.state.T_body_camera
    turned = transform(so3_exp(turn) @ T_body_camera[:3, :3], T_body_camera[:3, 3])
    measured = estimate.state.T_map_body @ turned @ inverse(T_body_camera)
    moved = pose_error(estimate.state, measured)
    # Second order of a microradian, and rounding of metres.
    np.testing.assert_allclose(moved, mount_jacobian(estimate.state) @ turn, atol=1e-11)


@pytest.mark.parametrize('accepted', [True, False])
def test_vibration_of_the_mount_is_learned(estimate, still, accepted):
    """A camera that rotates by 2 mrad against the robot, in poses that claim far less."""
    parameters, rng = config(systematic_pose_std=0.01, estimate_time_offset=False), np.random.default_rng(10)
    R, noise, state = 1e-10 * np.eye(6), PoseNoise.of(ELSEWHERE, mount_vibration=5e-4), estimate.state
    for _ in range(1000):
        error = mount_jacobian(state) @ rng.normal(0.0, 2e-3, 3)
        pose = BodyPose(state.T_map_body @ transform(so3_exp(error[:3]), error[3:]), R)
        innovation = innovation_of(parameters, replace(known(estimate, 1e-14), pose_noise=noise), pose, still)
        noise = corrected(parameters, innovation).pose_noise if accepted else adapted_noise(innovation)
    # The memory of 300 poses of three numbers: 3 % of the deviation; the limit of squares takes some. Three of that.
    assert np.sqrt(noise.variances[2]) == pytest.approx(2e-3, rel=0.1)


def test_a_step_of_the_clock_of_the_imu_does_not_show_in_the_next_pose(estimate, motion):
    """The state at the camera's stamp is as well known as before; that at the IMU's is unknown along the motion."""
    before = replace(estimate, covariance=1e-6 * np.eye(SIZE))
    after = before.widened(clock_offset_derivative(estimate.state.derivative(motion.imu)), 0.01)
    J = np.eye(SIZE)
    J[CORE, TIME_OFFSET] = estimate.state.derivative(motion.imu)
    at_camera = [(J @ each.covariance @ J.T)[CORE, CORE] for each in (before, after)]
    np.testing.assert_allclose(*at_camera, atol=1e-12)
    added = after.covariance - before.covariance
    # v times 10 ms
    np.testing.assert_allclose(
        np.sqrt(np.diag(added)[POSITION]), 0.01 * np.abs(estimate.state.velocity_body), rtol=1e-9
    )
    assert added[TIME_OFFSET, TIME_OFFSET] == pytest.approx(1e-4)


def test_a_step_of_all_clocks_shows_in_the_next_pose(estimate, motion):
    """The state is unknown along the motion, the clock offset as known as before."""
    before = replace(estimate, covariance=1e-6 * np.eye(SIZE))
    derivative = estimate.state.derivative(motion.imu)
    added = before.widened(embedded_core(derivative), 0.01).covariance - before.covariance
    moved = 0.01 * derivative
    np.testing.assert_allclose(added[CORE, CORE], np.outer(moved, moved), atol=1e-12)
    assert not added[TIME_OFFSET].any()
