"""A first pose that may be one of two: found in their mean, by gravity, and by how each goes on."""

import math

import numpy as np
import pytest
from support.flights import config, GRAVITY, START_NS, T_BODY_CAMERA

from thermal_fiducial.core.error_model import covariance_of_one_error
from thermal_fiducial.core.filter.ekf import PoseEkf
from thermal_fiducial.core.filter.initialization import TWO_POSES
from thermal_fiducial.core.geometry.se3 import (
    difference,
    lever_arm,
    rotation_angle,
    screw_difference,
    so3_exp,
    transform,
)
from thermal_fiducial.core.measurements import CameraPose, ImuSample, NOTHING_KNOWN
from thermal_fiducial.core.two_poses import mean_of_two, possible_poses

MARKER = np.array([8.0, 0.5, 1.0])
LEVEL = transform(so3_exp([0.0, 0.0, 0.1]), [0.0, 0.0, 1.0])
UPRIGHT, AHEAD = [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]


def about_marker(axis, angle):
    """(4, 4) motion of the map: a turn by an angle [rad] about an axis through the marker."""
    R = so3_exp(angle * np.asarray(axis))
    return transform(R, MARKER - R @ MARKER)


def by_marker(stamp_ns, T_map_camera, turn_std):
    """A camera pose whose turn about the marker the corners know to ``turn_std`` [rad]."""
    at_marker = np.diag(np.repeat((0.003, turn_std), 3) ** 2)
    to_camera, to_map = lever_arm(T_map_camera[:3, 3] - MARKER), lever_arm(T_map_camera[:3, 3])
    of_map = to_map @ np.diag(np.repeat((1e-3, 1e-4), 3) ** 2) @ to_map.T
    return CameraPose(stamp_ns, T_map_camera, to_camera @ at_marker @ to_camera.T + of_map, of_map)


def either(stamp_ns, T_map_body, axis, angle, turn_std=0.02):
    """What the mapper publishes where the pose turned about the marker is possible, too: corners know each to 1 deg."""
    T = about_marker(axis, 0.5 * angle) @ T_map_body @ T_BODY_CAMERA
    mean = by_marker(stamp_ns, T, turn_std)
    return mean_of_two(mean, screw_difference(T_map_body @ T_BODY_CAMERA, T))


def flown(axis, angle, speed=0.0, seconds=1.5):
    """A filter after a level flight to the left, from rest to ``speed`` [m/s] in a second, and the pose at its end.

    The pose that is possible, too, is mirrored at the line of sight: as that turns, it turns by twice as much.
    """
    ekf, T = PoseEkf(config()), LEVEL.copy()
    for k in range(round(100 * seconds)):
        t, stamp_ns = k / 100.0, START_NS + 10_000_000 * k
        ekf.add_imu(ImuSample(stamp_ns, np.zeros(3), np.array([0.0, speed * (t < 1.0), GRAVITY])))
        if k % 4 == 3:
            T[:3, 3] = LEVEL[:3, 3] + speed * (0.5 * t**2 if t < 1.0 else t - 0.5) * LEVEL[:3, 1]
            (x, y), (x_first, y_first) = T[:2, 3] - MARKER[:2], LEVEL[:2, 3] - MARKER[:2]
            turned = math.atan2(y, x) % math.tau - math.atan2(y_first, x_first) % math.tau
            ekf.add_pose(either(stamp_ns, T, axis, angle - 2.0 * turned))
    return ekf, T


def off_by(ekf, T_map_body):
    """Angle [rad] between the filter's attitude and the true one."""
    return float(rotation_angle(ekf.state.R_map_body.T @ T_map_body[:3, :3]))


@pytest.mark.parametrize('angle', [-1.2, 0.5, 1.2])
def test_two_poses_are_found_in_their_mean(angle):
    pose = either(0, LEVEL, UPRIGHT, angle)
    right, other = LEVEL @ T_BODY_CAMERA, about_marker(UPRIGHT, angle) @ LEVEL @ T_BODY_CAMERA
    found = possible_poses(pose)
    assert len(found) == 2
    for T in (right, other):
        nearest = min(found, key=lambda each: rotation_angle(each.T_map_camera[:3, :3].T @ T[:3, :3]))
        # What each is uncertain by along the turn is added to its square: 0.02 rad to 0.25 at the least.
        assert np.abs(difference(nearest.T_map_camera, T)).max() < 0.02
        relative = nearest.covariance - nearest.map_covariance
        assert np.sqrt(np.diag(relative)[3:]) == pytest.approx([0.02] * 3, rel=0.05)
        assert np.linalg.eigvalsh(relative).min() > 0.0


@pytest.mark.parametrize('angle', [-1.6, 0.5, 1.2])
def test_each_of_two_poses_is_within_the_claim_of_their_mean(angle):
    """The two are on an arc about the marker, 8 m away: tangents of it at the mean pass them by a metre."""
    pose = either(0, LEVEL, UPRIGHT, angle)
    for T in (LEVEL @ T_BODY_CAMERA, about_marker(UPRIGHT, angle) @ LEVEL @ T_BODY_CAMERA):
        error = difference(T, pose.T_map_camera)
        # One standard deviation across the line of sight, and one along it.
        assert error @ np.linalg.solve(pose.covariance, error) < 2.0


def test_a_pose_that_is_known_and_one_that_does_not_show_a_turn_are_one():
    known = CameraPose(0, LEVEL, 1e-4 * np.eye(6))
    turn = np.array([0.0, 8.0, 0.0, 0.0, 0.0, 1.0])
    unknown = CameraPose(0, LEVEL, 1e-4 * np.eye(6) + covariance_of_one_error(turn, NOTHING_KNOWN))
    assert possible_poses(known) == [known]
    assert possible_poses(unknown) == [unknown]


def test_a_pose_that_is_uncertain_about_two_axes_is_no_mean_of_two_and_begins_nothing():
    uncertain = CameraPose(START_NS + 20_000_000, LEVEL @ T_BODY_CAMERA, np.diag([0.01, 0.01, 0.01, 0.05, 0.05, 1e-4]))
    assert possible_poses(uncertain) == [uncertain]
    ekf = PoseEkf(config())
    for k in range(3):
        ekf.add_imu(ImuSample(START_NS + 10_000_000 * k, np.zeros(3), np.array([0.0, 0.0, GRAVITY])))
    assert ekf.add_pose(uncertain).reason == 'refused: two poses are possible'


@pytest.mark.parametrize('heading_std', [0.3, 0.8])
def test_a_pose_that_does_not_know_its_heading_is_no_mean_of_two(heading_std):
    """Of somebody else: its place does not go with its turn."""
    vague = CameraPose(0, LEVEL @ T_BODY_CAMERA, np.diag([0.01, 0.01, 0.01, 1e-4, 1e-4, heading_std**2]))
    assert possible_poses(vague) == [vague]


@pytest.mark.parametrize('angle', [-1.2, 0.5])
def test_gravity_shows_which_of_two_poses_that_differ_in_tilt(angle):
    ekf, T = flown(AHEAD, angle, seconds=1.0)
    # Exact poses and samples; their biases are not known yet.
    assert off_by(ekf, T) < 0.02


@pytest.mark.parametrize('forward', [-6.0, 6.0])
def test_the_right_one_of_two_poses_is_found_by_a_robot_that_accelerates(forward):
    """The mean specific force is along the vertical of the wrong one, and decided alone while it was known to 6 deg."""
    ekf, T = PoseEkf(config()), LEVEL.copy()
    for k in range(100):
        t, stamp_ns = k / 100.0, START_NS + 10_000_000 * k
        ekf.add_imu(ImuSample(stamp_ns, np.zeros(3), np.array([forward, 0.0, GRAVITY])))
        if k % 4 == 3:
            T[:3, 3] = LEVEL[:3, 3] + 0.5 * forward * t**2 * LEVEL[:3, 0]
            ekf.add_pose(either(stamp_ns, T, AHEAD, -math.atan2(forward, GRAVITY)))
    # As below, with exact poses and samples.
    assert off_by(ekf, T) < 0.02


def test_two_poses_that_differ_in_heading_wait_at_rest():
    ekf, _ = flown(UPRIGHT, 0.8)
    assert ekf.state is None
    assert ekf.condition == TWO_POSES


@pytest.mark.parametrize('angle', [-0.8, 0.5])
def test_motion_around_the_marker_shows_which_heading_is_right(angle):
    """By how the two go on: the wrong one turns with the line of sight. At first, a bias of the gyroscope does, too."""
    ekf, T = flown(UPRIGHT, angle, speed=1.0, seconds=2.0)
    assert off_by(ekf, T) < 0.02


def test_two_poses_that_others_have_brought_together_are_one():
    """Vague poses move the wrong one to the right one before they show that it was wrong: odds of e^-6 stayed."""
    ekf = PoseEkf(config())
    for k in range(4 * 160):
        stamp_ns = START_NS + 10_000_000 * k
        ekf.add_imu(ImuSample(stamp_ns, np.zeros(3), np.array([0.0, 0.0, GRAVITY])))
        if k % 4 == 3:
            vague = by_marker(stamp_ns, LEVEL @ T_BODY_CAMERA, 0.1)
            ekf.add_pose(either(stamp_ns, LEVEL, UPRIGHT, 0.42, 0.06) if k < 8 else vague)
    # As above, with exact poses and samples.
    assert off_by(ekf, LEVEL) < 0.02
