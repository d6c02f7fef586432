"""The last pose before a restart in flight keeps implausible first poses out, for as long as it says anything."""

import math

import numpy as np
import pytest

from thermal_fiducial.core.filter.initialization import HINT_SECONDS, LastPose, RestartHint
from thermal_fiducial.core.geometry.se3 import so3_exp, transform
from thermal_fiducial.core.measurements import CameraPose

SECOND = 1_000_000_000
#: t_imu - t_camera [s]
OFFSET = 0.004
LAST = LastPose(5 * SECOND, transform(so3_exp([0.0, 0.0, 0.3]), [1.0, 2.0, 3.0]), OFFSET)


def camera_pose(seconds, x):
    """A camera at x along the first axis from the map's origin, ``seconds`` after the last pose."""
    stamp_ns = LAST.stamp_ns + round((seconds - OFFSET) * SECOND)
    return CameraPose(stamp_ns, transform(np.eye(3), [x, 2.0, 3.0]), np.eye(6))


@pytest.fixture
def hint():
    return RestartHint(LAST, np.eye(4))


@pytest.mark.parametrize('rate', [7.5, 30.0, 60.0])
def test_a_pose_that_no_flight_could_have_reached_is_kept_out_for_a_second(hint, rate):
    assert hint.contradiction(camera_pose(1.0, 1.2)) == 0.0
    assert hint.contradiction(camera_pose(1.0, 9.0)) == pytest.approx(8.0)
    # Three metres a second, not more.
    assert hint.contradiction(camera_pose(2.0, 7.0)) == 0.0
    # Just less than the second, at whose end rounding decides.
    kept_out = math.ceil(rate - 0.01)
    frames = [hint.contradiction(camera_pose(1.0 + k / rate, 40.0)) > 0.0 for k in range(kept_out + 10)]
    assert frames == [True] * kept_out + [False] * 10


def test_a_few_poses_do_not_outvote_the_last_one_before_the_restart(hint):
    assert all(hint.contradiction(camera_pose(1.0 + 0.5 * k, 60.0)) > 0.0 for k in range(5))


# Half a metre, and three metres a second: a centimetre on either side of that.
@pytest.mark.parametrize('seconds', [0.0, 1.0, HINT_SECONDS])
def test_it_is_plausible_within_reach_of_the_last_pose(hint, seconds):
    reach = 0.5 + 3.0 * seconds
    assert hint.contradiction(camera_pose(seconds, 1.0 + reach - 0.01)) == 0.0
    assert hint.contradiction(camera_pose(seconds, 1.0 + reach + 0.01)) == pytest.approx(reach + 0.01)


@pytest.mark.parametrize('seconds', [-1.0, 1.1 * HINT_SECONDS])
def test_poses_at_other_times_are_not_compared(hint, seconds):
    assert hint.contradiction(camera_pose(seconds, 900.0)) == 0.0


def test_after_one_plausible_pose_among_the_others_the_second_begins_anew(hint):
    far = [camera_pose(0.5 + 0.1 * k, 40.0) for k in range(30)]
    assert all(hint.contradiction(pose) > 0.0 for pose in far[:9])
    assert hint.contradiction(camera_pose(1.4, 1.0)) == 0.0
    frames = [hint.contradiction(pose) > 0.0 for pose in far[9:]]
    assert frames == [True] * 10 + [False] * 11


def test_what_is_compared_is_the_robot_not_the_camera():
    """A camera on an arm of 2 m, looking back: the pose is plausible by the robot's place alone."""
    T_body_camera = transform(so3_exp([0.0, 0.0, np.pi]), [2.0, 0.0, 0.0])
    pose = camera_pose(0.0, -1.0)
    assert RestartHint(LAST, T_body_camera).contradiction(pose) == 0.0
    assert RestartHint(LAST, np.eye(4)).contradiction(pose) == pytest.approx(2.0)
