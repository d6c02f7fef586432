"""What a camera pose has of the map's error, as the mapper says it beside the pose."""

from dataclasses import replace

import numpy as np
import pytest

from thermal_fiducial.core.filter.map_corrections import MapCorrections
from thermal_fiducial.core.measurements import CameraPose

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
    corrections = MapCorrections(1.0)
    for k in range(3):
        corrections.note_error(replace(error_of(k * FRAME_NS), covariance=(k + 1) * ERROR))
    for k in range(3):
        pose = replace(POSE, stamp_ns=k * FRAME_NS, covariance=3.0 * ERROR + NOISE)
        # rounding of an eigendecomposition
        np.testing.assert_allclose(of_map(corrections, pose), (k + 1) * ERROR, atol=1e-15)


@pytest.mark.parametrize(('frames', 'expected'), [(1, ERROR), (60, 0.0 * ERROR)])
def test_one_that_is_missing_is_that_of_the_frame_before_and_no_older(frames, expected):
    corrections = MapCorrections(1.0)
    corrections.note_error(error_of(0))
    assert np.any(of_map(corrections, POSE))
    np.testing.assert_allclose(of_map(corrections, replace(POSE, stamp_ns=frames * FRAME_NS)), expected, atol=1e-15)


def test_errors_of_poses_of_another_mapper_do_not_count():
    corrections = MapCorrections(1.0)
    corrections.note_error(error_of(FRAME_NS // 2))
    assert not np.any(of_map(corrections, POSE))


def test_no_more_than_the_pose_claims_is_the_maps():
    corrections = MapCorrections(1.0)
    corrections.note_error(replace(error_of(0), covariance=1e-2 * np.eye(6)))
    left = POSE.covariance - of_map(corrections, POSE)
    # rounding of an eigendecomposition
    assert np.linalg.eigvalsh(left)[0] > -1e-15
