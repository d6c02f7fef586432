"""By how much a refinement moves those who stand on the map: what their localization jumps by, and no more."""

from dataclasses import replace

import numpy as np
import pytest
from support.scenes import motion_prior
from support.walls import CAMERA, flight, see, SIZE, stamp, wall

from thermal_fiducial.config import MarkerMapperConfig
from thermal_fiducial.core.geometry.reprojection import difference, retract
from thermal_fiducial.core.mapping.bundle_adjustment import refine
from thermal_fiducial.core.mapping.correction import correction
from thermal_fiducial.core.mapping.keyframes import Keyframe
from thermal_fiducial.core.mapping.mapper import MapMarker, MarkerMap, MarkerMapper
from thermal_fiducial.core.mapping.odometry_prior import predicted_camera
from thermal_fiducial.core.measurements import corner_covariances, corners_px, Odometry

AS_BODY = {'camera_orientation': (0.0, 0.0, 0.0, 1.0)}
KNOWN = np.diag([5e-3] * 3 + [2e-3] * 3) ** 2
MOVE = np.array([0.08, -0.05, 0.03, 0.01, 0.02, -0.015])


def odometry(k, ahead=0.0, sigma=(5e-3, 2e-3)):
    """The truth at frame ``k`` as the filter would publish it, of a clock that is ``ahead`` seconds ahead."""
    at, dt = k / 30, 1e-3
    T = flight(at)
    step = difference(flight(at + dt), flight(at - dt)) / (2 * dt)
    R = T[:3, :3]
    covariance = np.diag([sigma[0]] * 3 + [sigma[1]] * 3) ** 2
    return Odometry(
        stamp(k) + round(ahead * 1e9), T, R.T @ step[:3], R.T @ step[3:], covariance, np.diag([0.02] * 6) ** 2
    )


def test_what_stands_on_the_fixed_marker_alone_stays_where_it_is():
    """The adjustment moves keyframes by as much as one marker leaves them unknown, and the fixed marker not at all."""
    rng = np.random.default_rng(3)
    poses = {key: pose for key, pose in wall(rng).items() if key < 2}
    m = MarkerMapper(MarkerMapperConfig(**AS_BODY), MarkerMap({0: MapMarker(0, SIZE, True, poses[0])}))
    for k in range(0, 60):
        m.process(stamp(k), see(flight(k / 60), poses, 0.2, rng), CAMERA)
    for k in range(60, 75):
        alone = m.process(stamp(k), see(flight((k - 60) / 30), {0: poses[0]}, 0.2, rng), CAMERA)
        assert alone.pose.marker_ids == (0,)
    snapshot = m.snapshot()
    refinement = refine(snapshot)
    moved = [difference(refinement.keyframes[f.stamp_ns], f.T_map_rig)[:3] for f in snapshot.keyframes]
    assert np.max(np.linalg.norm(moved, axis=1)) > 0.02
    jump = m.apply(refinement)
    # Rounding of one pose times the inverse of another.
    np.testing.assert_allclose(jump.T_new_old, np.eye(4), atol=1e-12)


@pytest.fixture
def moved_wall():
    """Ten frames of a wall, and the wall before and after a rigid move; where the odometry was is for the test."""
    rng = np.random.default_rng(5)
    poses = wall(rng)
    T = retract(np.eye(4), MOVE)
    old = {key: MapMarker(key, SIZE, False, np.linalg.inv(T) @ pose, KNOWN) for key, pose in poses.items()}
    new = {key: replace(marker, T_map_marker=poses[key]) for key, marker in old.items()}
    frames = []
    for k in range(10):
        rows = see(flight(k / 30), poses, 0.05, rng)
        place = np.linalg.inv(T) @ flight(k / 30)
        ids, zeros = rows['id'].astype(np.int64), np.zeros(len(rows), dtype=int)
        frames.append(
            Keyframe(stamp(k), place, ids, corners_px(rows), corner_covariances(rows), zeros, place, np.eye(6))
        )
    return frames, old, new, T


def test_who_stood_on_the_old_map_goes_with_it(moved_wall):
    frames, old, new, T = moved_wall
    for belief in (KNOWN, None):
        corrected = correction(frames, [CAMERA], old, new, belief) @ frames[-1].T_map_rig
        # The corners' noise, which the two maps share but for second order, and a second of motion.
        np.testing.assert_allclose(corrected, T @ frames[-1].T_map_rig, atol=0.02)


def test_who_never_stood_on_the_old_map_stays(moved_wall):
    frames, old, new, T = moved_wall
    frames = [replace(frame, T_odometry=T @ frame.T_odometry) for frame in frames]
    np.testing.assert_array_equal(correction(frames, [CAMERA], old, new, KNOWN), np.eye(4))


def test_nothing_is_told_that_the_filter_follows_by_itself(moved_wall):
    frames, old, new, _ = moved_wall
    unsure = np.diag([0.1] * 3 + [0.03] * 3) ** 2
    np.testing.assert_array_equal(correction(frames, [CAMERA], old, new, unsure), np.eye(4))


def test_the_offset_of_the_clocks_is_the_filters_to_say():
    """With the filter's offset the prediction is right; without, it is as wrong as its covariance says."""
    ahead, config = 0.02, MarkerMapperConfig()
    for k in range(0, 150, 10):
        prior = motion_prior(odometry(k, ahead), clock_offset=None)
        before = predicted_camera(prior, stamp(k), np.eye(4), config.time_offset_std).pose
        error = difference(before.T_map_camera, flight(k / 30))
        # 20 ms where 30 ms are allowed for, as one error along the motion.
        known = odometry(k).pose_covariance
        assert 0.3 < error @ np.linalg.solve(before.covariance, error) < 0.6
        prior.set_clock_offset(ahead)
        after = predicted_camera(prior, stamp(k), np.eye(4), config.time_offset_std).pose
        # Velocities by differences over 2 ms.
        np.testing.assert_allclose(after.T_map_camera, flight(k / 30), atol=1e-9)
        np.testing.assert_allclose(after.covariance, known)
