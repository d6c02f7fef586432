"""Pose of markers and of the camera: exact without noise, consistent covariances with it."""

import numpy as np
import pytest
from support.pose_information import information_of_poses

from thermal_fiducial.calibration.joint_pose import solve_camera_pose
from thermal_fiducial.core.geometry import se3
from thermal_fiducial.core.geometry.camera import Camera, ImagePoints
from thermal_fiducial.core.geometry.planar_pose import (
    choose_branches,
    ippe_square,
    marker_corners,
    solve_marker_poses,
)
from thermal_fiducial.errors import InputError

K = [[529.0, 0, 319.5], [0, 527.0, 255.5], [0, 0, 1]]
CAMERAS = {
    'plumb_bob': Camera(640, 512, K, 'plumb_bob', [-0.3, 0.1, 1e-3, -5e-4, 0.01]),
    'rational_polynomial': Camera(640, 512, K, 'rational_polynomial', [0.3, 0.05, 1e-3, -5e-4, 0.01, 0.5, 0.1, 0.02]),
    'equidistant': Camera(640, 512, K, 'equidistant', [-0.12, -0.016, 0.0055, 0.0019]),
}
FACING = np.diag([1.0, -1.0, -1.0])  # marker z towards the camera, marker y up
ISOTROPIC = np.broadcast_to(0.1**2 * np.eye(2), (4, 2, 2))


def pose(tilt_rad, position):
    return se3.transform(se3.so3_exp(tilt_rad) @ FACING, position)


def image(camera, T_camera_marker, size=0.3):
    return camera.project(se3.apply(T_camera_marker, marker_corners(size)))


def solve_one(corners, camera, size=0.3):
    return solve_marker_poses(corners[None], ISOTROPIC[None], np.array([size]), camera)


@pytest.mark.parametrize('model', CAMERAS)
@pytest.mark.parametrize('tilt', [(0, 0, 0), (1e-9, 0, 0), (0.3, 0, 0), (0, -0.9, 0.4), (0.5, 0.5, 3.0), (0, 0, 1.57)])
@pytest.mark.parametrize('position', [(0, 0, 1.0), (0.3, -0.2, 2.0), (-0.6, 0.4, 1.5)])
def test_noiseless_is_exact(model, tilt, position):
    camera, T = CAMERAS[model], pose(tilt, position)
    found = solve_one(image(camera, T), camera)
    # The branches differ by over 1e-3 px unless they meet; the error left is rounding times the conditioning of a
    # front-parallel square, which is quadratic in its tilt.
    best = min(found.T_camera_marker[0], key=lambda X: np.abs(X - T).max())
    np.testing.assert_allclose(best, T, atol=1e-5)
    assert found.rms_px[0, 0] < 1e-7
    assert found.rms_px[0, 0] <= found.rms_px[0, 1]


def test_front_parallel_branches_are_both_proper():
    poses = ippe_square(np.array([[[-0.1, -0.1], [0.1, -0.1], [0.1, 0.1], [-0.1, 0.1]]]), np.array([0.3]))[0]
    for T in poses:
        np.testing.assert_allclose(T, se3.transform(FACING, [0, 0, 1.5]), atol=1e-7)


def test_alternative_is_the_mirrored_tilt():
    camera, T = CAMERAS['plumb_bob'], pose((0.4, 0.0, 0.0), (0.0, 0.0, 4.0))
    found = solve_one(image(camera, T), camera)
    tilt = se3.so3_log(found.T_camera_marker[0, 1, :3, :3] @ FACING.T)
    np.testing.assert_allclose(tilt, (-0.4, 0.0, 0.0), atol=0.05)
    assert 0.01 < found.rms_px[0, 1] < 1.0


@pytest.mark.parametrize(('distance', 'allowed'), [(5.0, True), (1.0, False)])
def test_expectation_chooses_among_branches_that_the_image_allows(distance, allowed):
    camera, T = CAMERAS['plumb_bob'], pose((0.5, 0.0, 0.0), (0.0, 0.0, distance))
    corners = image(camera, T)[None]
    found = solve_marker_poses(corners, 16.0 * ISOTROPIC[None], np.array([0.3]), camera)
    assert found.ambiguous() == allowed
    for branch in (0, 1):
        chosen = choose_branches(
            found,
            ImagePoints.at(corners, camera),
            ISOTROPIC[None],
            np.array([0.3]),
            np.eye(4)[None],
            found.T_camera_marker[0, branch],
        )
        assert chosen.rms_px[0, 0] == found.rms_px[0, branch if allowed else 0]


def test_other_known_markers_choose_the_branch():
    """Of three small markers far away each alone is ambiguous; together they are not, whatever was predicted."""
    camera = CAMERAS['plumb_bob']
    T_camera_map = se3.transform(se3.so3_exp([0.2, -0.1, 0.1]), [0.1, 0.0, 5.0])
    poses_in_map = [
        se3.transform(se3.so3_exp(tilt) @ FACING, p)
        for tilt, p in [
            ((0.3, 0, 0), (-1.0, 0.3, 0.0)),
            ((0, -0.3, 0), (0.9, -0.4, 0.5)),
            ((0.2, 0.2, 0), (0, 0.8, -0.4)),
        ]
    ]
    corners = np.stack([image(camera, T_camera_map @ T, 0.2) for T in poses_in_map])
    covs = np.broadcast_to(16.0 * ISOTROPIC, (3, 4, 2, 2))
    poses = solve_marker_poses(corners, covs, np.full(3, 0.2), camera)
    assert poses.ambiguous().all()
    wrong = poses.ordered(np.array([[1, 0], [0, 1], [1, 0]]))
    known, points = np.stack(poses_in_map), ImagePoints.at(corners, camera)
    sizes = np.full(3, 0.2)
    for predicted in (None, T_camera_map, wrong.T_camera_marker[0, 0] @ se3.inverse(poses_in_map[0])):
        chosen = choose_branches(wrong, points, covs, sizes, known, predicted)
        np.testing.assert_allclose(chosen.T_camera_marker[:, 0], T_camera_map @ known, atol=1e-5)
    # A lone known marker has the prediction alone, one of unknown pose nothing.
    first = np.where([[[True]], [[False]], [[False]]], known, np.nan)
    lone = choose_branches(wrong, points, covs, sizes, first, T_camera_map)
    np.testing.assert_allclose(lone.T_camera_marker[0], poses.T_camera_marker[0])
    np.testing.assert_allclose(lone.T_camera_marker[2], wrong.T_camera_marker[2])
    assert choose_branches(wrong, points, covs, sizes, first) is wrong


@pytest.mark.parametrize(
    'corners',
    [np.full((4, 2), np.nan), np.tile([300.0, 200.0], (4, 1)), [[9, 9], [50, 9], [50, 9], [9, 9]]],
)
def test_degenerate_corners_have_no_pose(corners):
    assert np.isinf(solve_one(np.array(corners, dtype=float), CAMERAS['plumb_bob']).rms_px).all()


def test_degenerate_marker_leaves_the_others_alone():
    camera, T = CAMERAS['equidistant'], pose((0.3, 0.2, 0.1), (0.1, 0.2, 2.0))
    corners = np.stack([np.full((4, 2), np.nan), image(camera, T)])
    found = solve_marker_poses(corners, np.stack([ISOTROPIC, ISOTROPIC]), np.array([0.3, 0.3]), camera)
    assert np.isinf(found.rms_px[0]).all()
    np.testing.assert_allclose(found.T_camera_marker[1, 0], T, atol=1e-9)


def scene(camera):
    rng = np.random.default_rng(3)
    T_map_camera = se3.transform(se3.so3_exp([0.4, -1.0, 0.3]), [1.0, -2.0, 0.5])
    T_camera_markers = [
        pose(rng.normal(0, 0.4, 3), p) for p in [(-0.5, -0.3, 2.0), (0.5, 0.2, 2.5), (0.0, 0.4, 3.0), (0.4, -0.5, 2.2)]
    ]
    in_camera = np.stack([se3.apply(T, marker_corners(0.3)) for T in T_camera_markers])
    return T_map_camera, se3.apply(T_map_camera, in_camera), camera.project(in_camera)


@pytest.mark.parametrize('model', CAMERAS)
@pytest.mark.parametrize('count', [1, 4])
def test_joint_pose_is_exact_without_noise(model, count):
    T_map_camera, squares, corners = scene(CAMERAS[model])
    covs = np.broadcast_to(ISOTROPIC, (count, 4, 2, 2))
    found = solve_camera_pose(corners[:count], covs, squares[:count], CAMERAS[model])
    np.testing.assert_allclose(found.T_map_camera, T_map_camera, atol=1e-8)
    assert found.rms_px < 1e-8


def test_joint_pose_survives_a_wrong_prediction_and_a_wrong_marker():
    camera = CAMERAS['plumb_bob']
    T_map_camera, squares, corners = scene(camera)
    covs = np.broadcast_to(ISOTROPIC, (4, 4, 2, 2))
    wrong = T_map_camera @ se3.transform(se3.so3_exp([0.2, 0.3, -0.2]), [0.2, 0.1, 0.3])
    found = solve_camera_pose(corners, covs, squares, camera, initial=wrong)
    np.testing.assert_allclose(found.T_map_camera, T_map_camera, atol=1e-8)
    shifted = corners.copy()
    shifted[2] += (15.0, -8.0)
    robust = solve_camera_pose(shifted, covs, squares, camera)
    # Huber leaves an outlier an influence of 3 sigma (0.1 px) a corner: millimetres here, not the 70 mm of its shift.
    assert np.linalg.norm(robust.T_map_camera[:3, 3] - T_map_camera[:3, 3]) < 0.012


def test_prediction_decides_between_the_branches_of_a_lone_marker():
    camera, T = CAMERAS['plumb_bob'], pose((0.25, 0.0, 0.0), (0.0, 0.0, 5.0))
    covs = np.broadcast_to(25.0 * ISOTROPIC, (1, 4, 2, 2))
    corners, squares = image(camera, T)[None], marker_corners(0.3)[None]
    other = solve_marker_poses(corners, covs, np.array([0.3]), camera).T_camera_marker[0, 1]
    for expected in (T, other):
        found = solve_camera_pose(corners, covs, squares, camera, initial=se3.inverse(expected))
        # The branches lie half a radian and a metre apart; the worse one is known to a tenth of its deviation.
        np.testing.assert_allclose(found.T_map_camera, se3.inverse(expected), atol=1e-3)


def test_no_markers():
    with pytest.raises(InputError, match='no markers'):
        solve_camera_pose(np.zeros((0, 4, 2)), np.zeros((0, 4, 2, 2)), np.zeros((0, 4, 3)), CAMERAS['plumb_bob'])


def correlated_covariances(count, rng, sigma):
    L = sigma * (np.eye(2) + 0.4 * rng.normal(size=(count, 4, 2, 2)))
    return L @ np.swapaxes(L, -1, -2)


def test_marker_covariance_is_consistent():
    camera, T = CAMERAS['equidistant'], pose((0.5, -0.4, 0.2), (0.2, 0.1, 1.5))
    rng = np.random.default_rng(11)
    count = 2000
    covs = correlated_covariances(count, rng, 0.1)
    noise = np.linalg.cholesky(covs) @ rng.normal(size=(count, 4, 2, 1))
    poses = solve_marker_poses(image(camera, T) + noise[..., 0], covs, np.full(count, 0.3), camera)
    found = poses.T_camera_marker[:, 0]
    error = np.concatenate(
        [T[:3, 3] - found[:, :3, 3], se3.so3_log(T[:3, :3] @ np.swapaxes(found[:, :3, :3], -1, -2))], axis=-1
    )
    nees = np.einsum('bi,bij,bj->b', error, information_of_poses(camera, found, covs, 0.3), error)
    # Chi-square of 6: standard deviation of the mean over 2000 is 0.08; 4 of them.
    assert np.mean(nees) == pytest.approx(6.0, abs=0.31)
    assert np.mean(poses.chi2[:, 0]) == pytest.approx(2.0, abs=0.18)


def test_joint_covariance_is_consistent():
    camera = CAMERAS['plumb_bob']
    T, squares, corners = scene(camera)
    rng = np.random.default_rng(5)
    nees = []
    for _ in range(300):
        covs = correlated_covariances(4, rng, 0.1)
        noise = np.linalg.cholesky(covs) @ rng.normal(size=(4, 4, 2, 1))
        found = solve_camera_pose(corners + noise[..., 0], covs, squares, camera)
        R = T[:3, :3] @ found.T_map_camera[:3, :3].T
        error = np.concatenate([T[:3, 3] - found.T_map_camera[:3, 3], se3.so3_log(R)])
        nees.append(error @ np.linalg.solve(found.covariance, error))
    # Standard deviation of the mean over 300: 0.2; Huber clips 1 % of the corners, which costs under 0.1.
    assert np.mean(nees) == pytest.approx(6.0, abs=0.8)
