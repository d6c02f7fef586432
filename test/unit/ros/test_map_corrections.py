"""What a camera pose has of the map's error, as the mapper says it beside the pose."""

from dataclasses import replace

import numpy as np
import pytest
from support.flights import config, Flight, timeline

from thermal_fiducial.core.filter.ekf import PoseEkf
from thermal_fiducial.core.geometry.plausibility import checked_covariance
from thermal_fiducial.core.geometry.se3 import so3_exp, transform
from thermal_fiducial.core.measurements import CameraPose, ImuSample
from thermal_fiducial.ros.frames.map_corrections import LatePoses, MapCorrections

FRAME_NS = 33_333_333
ERROR = np.diag([4.0, 1.0, 0.0, 0.0, 0.0, 0.0]) * 1e-4
NOISE = 1e-6 * np.eye(6)
POSE = CameraPose(0, np.eye(4), ERROR + NOISE)


def error_of(stamp_ns):
    return CameraPose(stamp_ns, np.eye(4), ERROR)


def of_map(corrections, pose):
    """What of a pose's covariance is the map's by what was noted; the whole stays as it was."""
    seen = corrections.in_present_map(pose)
    np.testing.assert_array_equal(seen.covariance, pose.covariance)
    return seen.map_covariance


def test_each_pose_has_the_error_of_its_frame_though_later_ones_came():
    corrections = MapCorrections()
    for k in range(3):
        corrections.note_error(replace(error_of(k * FRAME_NS), covariance=(k + 1) * ERROR))
    for k in range(3):
        pose = replace(POSE, stamp_ns=k * FRAME_NS, covariance=3.0 * ERROR + NOISE)
        # rounding of an eigendecomposition
        np.testing.assert_allclose(of_map(corrections, pose), (k + 1) * ERROR, atol=1e-15)


@pytest.mark.parametrize(('frames', 'expected'), [(1, ERROR), (60, 0.0 * ERROR)])
def test_one_that_is_missing_is_that_of_the_frame_before_and_no_older(frames, expected):
    corrections = MapCorrections()
    corrections.note_error(error_of(0))
    assert np.any(of_map(corrections, POSE))
    np.testing.assert_allclose(of_map(corrections, replace(POSE, stamp_ns=frames * FRAME_NS)), expected, atol=1e-15)


def test_map_errors_with_stamps_of_another_clock_are_ignored():
    corrections = MapCorrections()
    corrections.note_error(error_of(FRAME_NS // 2))
    assert not np.any(of_map(corrections, POSE))


def test_no_more_than_the_pose_claims_is_the_maps():
    corrections = MapCorrections()
    corrections.note_error(replace(error_of(0), covariance=1e-2 * np.eye(6)))
    left = POSE.covariance - of_map(corrections, POSE)
    # rounding of an eigendecomposition
    assert np.linalg.eigvalsh(left)[0] > -1e-15


def test_of_two_map_errors_with_one_stamp_it_is_the_later():
    """A camera's clock that is set back repeats stamps, and poses had the map's error of the ones before."""
    corrections = MapCorrections()
    for share in (0.5, 1.0):
        corrections.note_error(replace(error_of(0), covariance=share * ERROR))
    np.testing.assert_allclose(of_map(corrections, POSE), ERROR, atol=1e-15)


def test_what_is_limited_is_a_covariance():
    """It had negative variances, so that the filter refused the pose."""
    rng = np.random.default_rng(0)
    for _ in range(50):
        claimed, of_other = (A @ A.T for A in rng.normal(size=(2, 6, 6)) * np.repeat((1e-2, 1e-3), 3)[:, None])
        corrections = MapCorrections()
        corrections.note_error(replace(error_of(0), covariance=of_other))
        shown = of_map(corrections, replace(POSE, covariance=claimed))
        checked_covariance(shown, 'map error', partial=True)
        checked_covariance(claimed - shown, 'what is left', partial=True)


@pytest.mark.parametrize('late_ms', [50, 600, 900, 2000])
@pytest.mark.parametrize('apart_ms', [0, 500])
def test_late_poses_around_two_corrections_end_up_in_the_present_map(apart_ms, late_ms):
    """However late: publisher and subscriber take the same corrections off and on again."""
    first = transform(so3_exp([0.0, 0.0, 0.3]), [1.0, 0.0, 0.0])
    second = transform(so3_exp([0.0, 0.0, -0.2]), [0.0, 2.0, 0.0])
    late, corrections, stamp_ns = LatePoses(), MapCorrections(), 10_000_000_000
    for T_new_old in (first, second):
        late.add(stamp_ns)
        late.moved(T_new_old)
        corrections.add(late.newest_ns, T_new_old)
        stamp_ns += apart_ms * 1_000_000
    present = transform(so3_exp([0.1, 0.2, 0.3]), [3.0, 1.0, 2.0])
    pose = replace(POSE, stamp_ns=late.newest_ns - late_ms * 1_000_000, T_map_camera=present)
    followed = corrections.in_present_map(late.as_of_its_stamp(pose))
    np.testing.assert_allclose(followed.T_map_camera, present, atol=1e-12)


def test_a_poor_map_makes_no_pose_lost_to_wrong_ones():
    """A map known to half a metre, in which the estimate is good: five poses that are off do not replace it."""
    flight = Flight(seed=2, seconds=5.0)
    of_map = np.diag(np.repeat((0.5, 0.0), 3) ** 2)
    poses = [replace(pose, covariance=pose.covariance + of_map, map_covariance=of_map) for pose in flight.poses]
    for k in range(90, 95):
        T = poses[k].T_map_camera.copy()
        T[0, 3] += 1.0
        poses[k] = replace(poses[k], T_map_camera=T)
    ekf = PoseEkf(config())
    for item in timeline(flight.samples(), poses, 0.03):
        if isinstance(item, ImuSample):
            ekf.add_imu(item)
        else:
            ekf.add_pose(item)
    assert ekf.lost
    assert ekf.resets == 0
