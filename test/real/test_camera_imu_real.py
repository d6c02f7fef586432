"""Camera against IMU on a real rig before a board: both cameras, against each other and what is published."""

from functools import cache
import os

import numpy as np
import pytest
from support.real_flights import april_board, camera_against_imu

from thermal_fiducial.core.geometry import se3

pytestmark = pytest.mark.skipif(not os.environ.get('THERMAL_FIDUCIAL_DATA'), reason='no real data at hand')


@cache
def calibrated(camera, seconds, every):
    """Calibration of a camera from every so many frames of the first seconds, and T_body_camera as published."""
    flight = april_board(camera, seconds=seconds, every=every)
    return camera_against_imu(flight), flight.T_body_camera


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
    # And the claim is of that order: 2 to 4 mm by the scatter of parts, 5 with a lens of which 0.1 px are declared. One
    # that is estimated from the same corners moves the camera by 8 mm. About one axis 0.193 and 0.199 deg are claimed
    # for the noise and walk of the accelerometer, 0.200 and 0.199 with the instability of its data sheet: a tenth more.
    assert np.degrees(sigma[:3].max()) < 0.22
    assert sigma[3:].max() < 0.006
    # Gyroscope axes read half a per cent too little or too much; lens and focal length are known no better.
    assert np.all(np.abs(found.axes[[0, 4, 8]]) < 0.015)
    assert np.all(found.axes_sigma[[0, 4, 8]] < 0.006)


@pytest.mark.nightly
def test_cameras_are_known_against_each_other_better_than_against_the_imu():
    (one, T_one), (other, T_other) = (calibrated(camera, *WHOLE[:2]) for camera in ('cam0', 'cam1'))
    apart = difference(one.T_body_camera, T_one) - difference(other.T_body_camera, T_other)
    sigmas = [np.sqrt(np.diag(found.covariance))[:6] for found in (one, other)]
    assert np.all(np.abs(apart) < 3.0 * np.hypot(*sigmas))
