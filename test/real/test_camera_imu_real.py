"""Camera against IMU on a real rig before a board: both cameras, against each other and what is published."""

from functools import cache
import os

import numpy as np
import pytest
from support.real_flights import april_board

from thermal_fiducial.calibration.camera_imu import calibrate_camera_imu
from thermal_fiducial.calibration.joint_pose import solve_camera_pose
from thermal_fiducial.calibration.preintegration import ImuTrack
from thermal_fiducial.core.geometry import se3
from thermal_fiducial.core.geometry.reprojection import corners_in_map
from thermal_fiducial.core.measurements import CameraPose, corner_covariances, corners_px

pytestmark = pytest.mark.skipif('THERMAL_FIDUCIAL_DATA' not in os.environ, reason='no real data at hand')


@cache
def calibrated(camera, seconds, every):
    """Calibration of a camera from every so many frames of the first seconds, and T_body_camera as published."""
    flight = april_board(camera, seconds=seconds, every=every)
    stamps = np.array([sample.stamp_ns for sample in flight.samples])
    rate = np.array([sample.angular_velocity for sample in flight.samples])
    force = np.array([sample.linear_acceleration for sample in flight.samples])
    imu = ImuTrack((stamps - stamps[0]) * 1e-9, rate, force)
    poses = []
    for stamp, rows in sorted(flight.frames.items()):
        markers = [flight.marker_map.markers[marker_id] for marker_id in rows['id'].tolist()]
        T = np.stack([marker.T_map_marker for marker in markers])
        points = corners_in_map(T, np.array([marker.size for marker in markers]))
        near = poses[-1].T_map_camera if poses else None
        measured = corners_px(rows), corner_covariances(rows)
        pose = solve_camera_pose(*measured, points, flight.camera, near, compete=near is None)
        poses.append(CameraPose(stamp, pose.T_map_camera, pose.covariance))
    return calibrate_camera_imu(poses, imu, int(stamps[0]), flight.imu_noise), flight.T_body_camera


def difference(T, T_other):
    """Rotation [rad] and position [m] of one extrinsic pose from another, as their covariances have them."""
    return np.concatenate([se3.so3_log(T[:3, :3].T @ T_other[:3, :3]), T_other[:3, 3] - T[:3, 3]])


#: Seconds, one of how many frames, and the bounds of error and claim [deg, m]. Whole recordings are off by 0.10 deg and
#: 4.2 mm, 0.09 deg and 1.8 mm (without scale and misalignment 0.19 deg and 7.5 mm) and claim 0.09 deg and 2 mm; a third
#: of the frames of half of cam1's is off by 0.16 deg and 2.7 mm, and claims 0.09 deg and 2.7 mm.
WHOLE = (40.0, 1, (0.13, 0.005))
PART = (20.0, 3, (0.2, 0.005))


@pytest.mark.parametrize(
    ('camera', 'seconds', 'every', 'off'),
    [('cam1', *PART), *(pytest.param(camera, *WHOLE, marks=pytest.mark.nightly) for camera in ('cam0', 'cam1'))],
)
def test_extrinsics_are_consistent_with_their_covariance(camera, seconds, every, off):
    found, published = calibrated(camera, seconds, every)
    error, sigma = difference(found.T_body_camera, published), np.sqrt(np.diag(found.covariance))[:6]
    assert np.all(np.abs(error) < 3.0 * sigma)
    assert np.degrees(np.linalg.norm(error[:3])) < off[0]
    assert np.linalg.norm(error[3:]) < off[1]
    # And the claim is of that order.
    assert np.degrees(sigma[:3].max()) < 0.2
    assert sigma[3:].max() < 0.004
    # Every gyroscope axis reads half a per cent too little or too much: what a board or two can show.
    scale = found.axes[[0, 4, 8]]
    assert np.all(np.abs(scale) < 0.015)
    assert np.any(np.abs(scale) > 3.0 * found.axes_sigma[[0, 4, 8]])


@pytest.mark.nightly
def test_cameras_are_known_against_each_other_better_than_against_the_imu():
    (one, T_one), (other, T_other) = (calibrated(camera, *WHOLE[:2]) for camera in ('cam0', 'cam1'))
    apart = difference(one.T_body_camera, T_one) - difference(other.T_body_camera, T_other)
    sigmas = [np.sqrt(np.diag(found.covariance))[:6] for found in (one, other)]
    assert np.all(np.abs(apart) < 3.0 * np.hypot(*sigmas))
