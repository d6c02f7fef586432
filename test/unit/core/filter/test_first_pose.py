"""What a first pose needs: an attitude that is known, by itself or with the vertical."""

import numpy as np
import pytest
from support.flights import GRAVITY

from thermal_fiducial.core.filter.initialization import settled_by_gravity
from thermal_fiducial.core.filter.pose_noise import BodyPose
from thermal_fiducial.core.geometry.se3 import inverse, rotation_angle, so3_exp, so3_left_jacobian, transform
from thermal_fiducial.core.measurements import NOTHING_KNOWN, VAGUE


def screw(axis, angle):
    """(6,) turn by an angle about an axis, in the robot frame, through a marker 8 m ahead: rotation and position."""
    turn = angle * np.asarray(axis) / np.linalg.norm(axis)
    return np.concatenate((turn, np.cross([8.0, 0.0, 0.0], turn)))


def two_poses(axis, angle):
    """A pose that says nothing of the turn to the other one, and the other one, which is right."""
    T = transform(so3_exp([0.02, -0.03, 0.7]), [1.0, 2.0, 3.0])
    d = screw(axis, angle)
    truth = T @ transform(so3_exp(d[:3]), so3_left_jacobian(d[:3]) @ d[3:])
    known, unknown = np.diag(np.repeat((0.01, 0.02), 3) ** 2), screw(axis, NOTHING_KNOWN)
    return BodyPose(T, known + np.outer(unknown, unknown)), truth


def samples(T_map_body):
    """Half a second at rest."""
    return np.tile(np.concatenate((np.zeros(3), GRAVITY * T_map_body[2, :3])), (100, 1))


@pytest.mark.parametrize('angle', [-0.9, -0.3, 0.3, 0.9])
def test_gravity_settles_which_of_two_poses_that_differ_in_tilt(angle):
    pose, truth = two_poses([0.0, 1.0, 0.3], angle)
    settled = settled_by_gravity(pose, samples(truth))
    # The vertical is exact here; what else the pose is known to, 0.01 rad and 0.02 m, may give way by a share.
    assert rotation_angle(settled.T_map_body[:3, :3].T @ truth[:3, :3]) < 0.03
    assert np.linalg.norm(inverse(settled.T_map_body)[:3, 3] - inverse(truth)[:3, 3]) < 0.2
    assert np.sqrt(settled.covariance[:3, :3].trace()) < VAGUE


def test_gravity_does_not_settle_which_of_two_poses_that_differ_in_heading():
    pose, truth = two_poses([0.0, 0.0, 1.0], 0.6)
    assert settled_by_gravity(pose, samples(truth)) is None


def test_a_pose_that_is_known_needs_no_gravity():
    pose = BodyPose(np.eye(4), 1e-4 * np.eye(6))
    assert settled_by_gravity(pose, samples(transform(so3_exp([0.1, 0.0, 0.0]), np.zeros(3)))) is pose
