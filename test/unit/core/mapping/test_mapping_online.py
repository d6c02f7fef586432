"""The mapper over whole flights: joint refinement behind it, jumps, gaps, starts in doubt, size of the map."""

from dataclasses import replace
import time

import numpy as np
import pytest
from support.scenes import motion_prior
from support.walls import CAMERA, flight, look, see, SIZE, stamp, wall
from support.walls import rows as rows_of

from thermal_fiducial.config import MarkerMapperConfig
from thermal_fiducial.core.error_model import covariance_by_draws
from thermal_fiducial.core.geometry.se3 import difference, inverse, retract, so3_exp, transform
from thermal_fiducial.core.mapping.bundle_adjustment import refine
from thermal_fiducial.core.mapping.map_data import MapMarker, MarkerMap
from thermal_fiducial.core.mapping.mapper import CONTRADICTED, MarkerMapper
from thermal_fiducial.core.measurements import corners_px, Odometry
from thermal_fiducial.map_tools.map_editing import transformed

# The body is the camera: odometry and camera pose are one.
UNIT = np.eye(6)
AS_BODY = {'camera_orientation': (0.0, 0.0, 0.0, 1.0)}


def from_one_marker(poses, **parameters):
    return MarkerMapper(MarkerMapperConfig(**parameters), MarkerMap({0: MapMarker(0, SIZE, True, poses[0])}))


def position_errors(m, poses):
    return np.array([np.linalg.norm(difference(x.T_map_marker, poses[i])[:3]) for i, x in m.map.markers.items()])


def rotation_errors(m, poses):
    return np.array([np.linalg.norm(difference(x.T_map_marker, poses[i])[3:]) for i, x in m.map.markers.items()])


def rms(values):
    return float(np.sqrt(np.mean(values**2)))


def test_a_flight_ends_with_a_map_of_a_millimetre():
    """Eight markers, one known, 20 s: the numbers to reach are 1 mm and 0.05 deg, of corners of 0.02 px."""
    rng = np.random.default_rng(0)
    poses = wall(rng)
    m = from_one_marker(poses)
    versions, resets = [], 0
    for k in range(0, 600, 3):
        m.process(stamp(k), see(flight(k / 30), poses, 0.02, rng), CAMERA)
        if m.refinement_due(stamp(k)):
            # In the background, the mapper goes on with the next frame before the outcome comes.
            snapshot = m.snapshot()
            m.process(stamp(k) + 1, see(flight(k / 30), poses, 0.02, rng), CAMERA)
            revision = m.map.revision
            assert m.apply(refine(snapshot))
            resets += 1
            assert (m.resets, m.map.revision) == (resets, revision + 1)
        versions.append(m.map.revision)
        if k > 300:
            assert rms(position_errors(m, poses)) < 1e-3
            assert rms(rotation_errors(m, poses)) < np.deg2rad(0.05)
    assert len(m.map.markers) == 8
    assert versions == sorted(versions)
    assert 2 < resets < 12


def test_after_the_clock_is_set_back_the_map_is_still_refined():
    rng = np.random.default_rng(0)
    poses = wall(rng)
    m = from_one_marker(poses)
    refined = []
    for k in range(0, 600, 3):
        # As a computer without a battery for its clock: time comes over the network, in the middle of the flight.
        now = stamp(k) + (3600 * 10**9 if k < 300 else 0)
        m.process(now, see(flight(k / 30), poses, 0.02, rng), CAMERA)
        if m.refinement_due(now) and m.apply(refine(m.snapshot())):
            refined.append(k)
    assert min(refined) < 300 <= max(refined)


def test_a_refinement_moves_poses_by_no_more_than_they_claimed():
    """Whoever stands on the old map can follow by itself, and weighs what it knows against the poses that come."""
    rng = np.random.default_rng(1)
    poses = wall(rng)
    m = from_one_marker(poses)
    for k in range(0, 90, 3):
        m.process(stamp(k), see(flight(k / 30), poses, 0.1, rng), CAMERA)
    frames = [see(flight(k / 30), poses, 0.1, rng) for k in range(90, 100)]
    before = [m.process(stamp(90 + i), rows, CAMERA) for i, rows in enumerate(frames)]
    assert m.apply(refine(m.snapshot()))
    after = [m.process(stamp(110 + i), rows, CAMERA) for i, rows in enumerate(frames)]
    pairs = list(zip(before, after, strict=True))
    moved = [difference(y.pose.T_map_camera, x.pose.T_map_camera) for x, y in pairs]
    assert np.mean(np.linalg.norm(np.array(moved)[:, :3], axis=1)) > 1e-3
    squares = [d @ np.linalg.solve(x.pose.covariance, d) for d, (x, _) in zip(moved, pairs, strict=True)]
    # Six degrees of freedom: their mean, of frames that share nearly all of it, stays below 99.9 % of one.
    assert np.mean(squares) < 22.5


def test_a_frozen_map_takes_no_refinement():
    rng = np.random.default_rng(2)
    poses = wall(rng)
    m = from_one_marker(poses)
    for k in range(0, 60, 3):
        m.process(stamp(k), see(flight(k / 30), poses, 0.02, rng), CAMERA)
    refinement = refine(m.snapshot())
    m.frozen = True
    before = m.map.copy()
    assert not m.apply(refinement)
    assert not m.refinement_due(stamp(1000))
    assert m.map == before


def test_a_duplicated_marker_is_found_by_the_joint_refinement():
    """Its two sheets take turns, so no run of frames is long enough to condemn it online; all frames together are."""
    rng = np.random.default_rng(8)
    poses = wall(rng)
    m = from_one_marker(poses, refinement_period=0.0)
    second = poses | {5: transform(np.eye(3), [0.0, 0.0, 0.08]) @ poses[5]}
    for k in range(0, 300, 3):
        m.process(stamp(k), see(flight(k / 30), poses if k % 20 < 10 else second, 0.05, rng), CAMERA)
    assert m.map.markers[5].trusted
    refinement = m.refine()
    assert list(refinement.inconsistent) == [5]
    assert not m.map.markers[5].trusted
    # Left out of poses and of later refinements; the rest flies on.
    result = m.process(stamp(301), see(flight(10.0), poses, 0.05, rng), CAMERA)
    assert result.quarantined == (5,)
    assert 5 not in result.pose.marker_ids
    assert 5 not in m.snapshot().markers
    alone = m.process(stamp(301) + 1, see(flight(10.0), {5: poses[5]}, 0.05, rng), CAMERA)
    assert (alone.pose, alone.reason) == (None, 'all known markers in view are in quarantine')
    # It is taken back when it has agreed for a while, and not before.
    for k in range(302, 302 + 30):
        result = m.process(stamp(k), see(flight(10.0), poses, 0.05, rng), CAMERA)
    assert result.quarantined == (5,)


def test_another_map_is_taken_over_and_the_jump_returned():
    rng = np.random.default_rng(9)
    poses = wall(rng)
    m = from_one_marker(poses)
    for k in range(0, 90, 3):
        m.process(stamp(k), see(flight(k / 30), poses, 0.02, rng), CAMERA)
    m.refine()
    late = refine(m.snapshot())
    rows = see(flight(k / 30), poses, 0.02, rng)
    before = m.process(stamp(k) + 1, rows, CAMERA)
    T_new_old = transform(so3_exp([0.0, 0.0, 0.4]), [3.0, -1.0, 0.2])
    revision = m.map.revision
    np.testing.assert_allclose(m.load(transformed(m.map, T_new_old)), T_new_old, atol=1e-9)
    assert m.resets == 2
    assert m.map.revision > revision
    # A refinement that was under way knows nothing of the new map.
    assert not m.apply(late)
    after = m.process(stamp(k) + 2, rows, CAMERA)
    published = T_new_old @ before.pose.T_map_camera
    # The same corners; the weights have forgotten the running errors.
    assert np.linalg.norm(difference(after.pose.T_map_camera, published)[:3]) < 1e-4
    elsewhere = MarkerMap({90: MapMarker(90, SIZE, True, np.eye(4))})
    assert m.load(elsewhere) is None
    assert sorted(m.map.markers) == [90]


@pytest.mark.parametrize('moved', [2, 3])
def test_a_marker_whose_place_is_mended_moves_no_poses_if_a_fixed_one_stays(moved):
    """Though as many markers have moved as have not, or more."""
    T_wrong = transform(np.eye(3), [0.5, 0.0, 0.0])
    true = {key: MapMarker(key, SIZE, key == 0, T) for key, T in wall(np.random.default_rng(11), 4).items()}
    wrong = {key: replace(marker, T_map_marker=T_wrong @ marker.T_map_marker) for key, marker in true.items() if key}
    m = MarkerMapper(MarkerMapperConfig(), MarkerMap(true | dict(list(wrong.items())[:moved])))
    np.testing.assert_allclose(m.load(MarkerMap(true)), np.eye(4), atol=1e-9)
    # One that was in quarantine says nothing of where the map is.
    m = MarkerMapper(MarkerMapperConfig(), MarkerMap(true | wrong | {0: replace(true[0], trusted=False)}))
    np.testing.assert_allclose(m.load(MarkerMap(true)), inverse(T_wrong), atol=1e-9)


def test_refinement_continues_when_the_keyframe_budget_is_used_up():
    """Loops that close after hours must settle too."""
    rng = np.random.default_rng(10)
    poses = wall(rng)
    m = from_one_marker(poses, keyframe_budget=40)
    due = []
    for k in range(200):
        m.process(stamp(k), see(flight(k / 30), poses, 0.05, rng), CAMERA)
        if m.refinement_due(stamp(k)):
            due.append(k)
            m.snapshot()
    assert max(due) > 150


def odometry(k, T, T_error, covariance, twist_covariance=UNIT):
    zero = np.zeros(3)
    return motion_prior(Odometry(stamp(k), T_error @ T, zero, zero, covariance, twist_covariance))


def test_odometry_spans_a_gap_between_markers():
    """Markers 4 to 7 come into view 1 s after 0 to 3 have gone: placed, as badly as the odometry is, and saying so."""
    rng = np.random.default_rng(3)
    poses = wall(rng)
    near, far = ({i: T for i, T in poses.items() if (i < 4) == first} for first in (True, False))
    m = from_one_marker(poses, **AS_BODY)
    for k in range(0, 90, 3):
        m.process(stamp(k), see(flight(k / 30), near, 0.02, rng), CAMERA)
    assert sorted(m.map.markers) == [0, 1, 2, 3]
    drift = transform(so3_exp([0.002, -0.003, 0.001]), [0.01, 0.01, -0.02])
    covariance = np.diag([3e-4] * 3 + [1e-5] * 3)
    for k in range(120, 240, 2):
        T = flight(k / 30)
        result = m.process(stamp(k), see(T, far, 0.02, rng), CAMERA, odometry(k, T, drift, covariance))
        if m.refinement_due(stamp(k)):
            m.refine()
    assert {5, 6, 7} <= m.map.markers.keys()  # marker 4 is hardly in view
    assert result.pose is not None
    for i in (5, 6, 7):
        marker = m.map.markers[i]
        d = difference(marker.T_map_marker, poses[i])
        assert np.linalg.norm(d[:3]) < 0.06
        # 20 is three sigma of six degrees of freedom.
        assert d @ np.linalg.solve(marker.covariance, d) < 20.0
        assert np.sqrt(np.trace(marker.covariance[:3, :3])) > 0.01


def test_drift_that_grows_with_the_way_does_not_set_neighbouring_frames_apart():
    """Far from the last marker, frames still agree with each other to what the speed is known to."""
    rng = np.random.default_rng(11)
    poses = wall(rng)
    m = from_one_marker(poses, bridge_duration=30.0, **AS_BODY)
    for k in range(30):
        m.process(stamp(k), see(flight(k / 30), {i: poses[i] for i in (0, 1)}, 0.02, rng), CAMERA)
    speed = np.diag([0.01**2] * 3 + [0.002**2] * 3)
    for k in range(390, 405):
        T, seconds = flight(k / 30), (k - 30) / 30
        covariance = np.diag([(0.05 * seconds) ** 2] * 3 + [(0.01 * seconds) ** 2] * 3)
        prior = odometry(k, T, np.eye(4), covariance, speed)
        m.process(stamp(k), see(T, {6: poses[6]}, 2.0, rng), CAMERA, prior)
    apart = m.candidates[6].views[-1].viewpoint
    # The common error is that of 12 s and more, but for rounding. Within the 14 frames since, 1 cm/s is 5 mm, and
    # 2 mrad/s is 1 mrad.
    assert np.all(np.diag(covariance_by_draws(apart.draws[0]))[:3] >= (1.0 - 1e-9) * (0.05 * 12.0) ** 2)
    assert np.all(np.sqrt(np.diag(apart.covariances[0])) < [0.005] * 3 + [0.001] * 3)


def test_a_duplicated_marker_does_not_change_the_map():
    """Markers 0 and 1 are seen again 6 m away, with new ones round them: odometry, right so far, knows better."""
    rng = np.random.default_rng(12)
    poses = wall(rng)
    near = {i: poses[i] for i in (0, 1)}
    m = from_one_marker(poses, **AS_BODY)
    covariance = 1e-4 * np.eye(6)
    for k in range(60):
        T = flight(k / 30)
        m.process(stamp(k), see(T, near, 0.02, rng), CAMERA, odometry(k, T, np.eye(4), covariance))
    away = transform(np.eye(3), [6.0, 0.0, 0.0])
    for k in range(60, 120):
        T = flight((k - 60) / 30)
        result = m.process(stamp(k), see(T, poses, 0.02, rng), CAMERA, odometry(k, away @ T, np.eye(4), covariance))
        assert result.pose is not None
    assert sorted(m.map.markers) == [0, 1]
    assert set(result.candidates.values()) == {CONTRADICTED}
    # Odometry that never was in this map, as another estimator's, is no reason.
    other = from_one_marker(poses, **AS_BODY)
    for k in range(60):
        T = flight(k / 30)
        other.process(stamp(k), see(T, poses, 0.02, rng), CAMERA, odometry(k, away @ T, np.eye(4), covariance))
    assert len(other.map.markers) > 2


def test_a_gap_too_long_is_not_spanned():
    rng = np.random.default_rng(4)
    poses = wall(rng)
    m = from_one_marker(poses, bridge_duration=2.0, **AS_BODY)
    far = {i: poses[i] for i in (5, 6)}
    for k in range(30):
        m.process(stamp(k), see(flight(k / 30), {0: poses[0], 1: poses[1]}, 0.02, rng), CAMERA)
    known = sorted(m.map.markers)
    for k in range(120, 180):
        T = flight(k / 30)
        result = m.process(stamp(k), see(T, far, 0.02, rng), CAMERA, odometry(k, T, np.eye(4), 1e-5 * np.eye(6)))
    assert sorted(m.map.markers) == known
    assert 'no known marker' in result.reason


def test_markers_settle_each_other_where_each_alone_is_in_doubt():
    """Small markers far away: no single one gives a pose, but together, seen from several sides, they do."""
    rng = np.random.default_rng(5)
    poses = {i: T for i, T in wall(rng, 8, tilt=0.0).items() if i in (0, 1, 4, 5)}
    centre = np.mean([T[:3, 3] for T in poses.values()], axis=0)
    m = from_one_marker(poses)
    reasons, located = [], []
    for k in range(0, 300, 2):
        bearing = 0.7 * np.sin(k / 40)
        T = look(centre + 5.0 * np.array([-np.cos(bearing), np.sin(bearing), 0.1]), centre)
        result = m.process(stamp(k), see(T, poses, 0.15, rng), CAMERA)
        reasons.append(result.reason)
        if result.pose is not None:
            d = difference(T, result.pose.T_map_camera)
            located.append(d @ np.linalg.solve(result.pose.covariance, d))
        if m.refinement_due(stamp(k)):
            m.refine()
    assert any('ambiguity' in reason for reason in reasons)
    assert sorted(m.map.markers) == sorted(poses)
    assert len(located) > 50
    # A pose on the wrong branch would be hundreds.
    assert max(located) < 60.0
    for i, T in poses.items():
        assert np.linalg.norm(difference(m.map.markers[i].T_map_marker, T)[3:]) < np.deg2rad(5.0)


def test_an_adjustment_has_the_views_that_a_marker_was_placed_by():
    """Two small markers far away, of which neither alone gives a pose: the frames have two until the second enters."""
    rng = np.random.default_rng(3)
    poses = {i: T for i, T in wall(rng, 8, tilt=0.0).items() if i in (0, 1)}
    centre, m, k = np.mean([T[:3, 3] for T in poses.values()], axis=0), from_one_marker(poses), 0
    while 1 not in m.map.markers:
        bearing = 0.5 + 0.3 * np.sin(k / 40)
        T = look(centre + 5.0 * np.array([-np.cos(bearing), np.sin(bearing), 0.1]), centre)
        assert 'ambiguity' in m.process(stamp(k), see(T, poses, 0.15, rng), CAMERA).reason
        k += 5
    placed = m.map.markers[1]
    assert m.refine() is not None
    refined = m.map.markers[1]
    # The same views: 1.3 times the variance, as the adjustment counts the markers' shapes, too.
    assert refined.covariance.trace() < 1.5 * placed.covariance.trace()
    error = difference(poses[1], refined.T_map_marker)
    # Chi square of six degrees of freedom exceeds it once in a thousand.
    assert error @ np.linalg.solve(refined.covariance, error) < 22.5


def test_a_candidate_that_moves_never_enters():
    rng = np.random.default_rng(6)
    poses = wall(rng)
    m = from_one_marker(poses)
    for k in range(60):
        scene = {i: poses[i] for i in (0, 1)}
        scene[50] = transform(np.eye(3), [0.0, 0.01 * k, 0.3 * np.sin(k / 7)]) @ poses[6]
        result = m.process(stamp(k), see(flight(k / 30), scene, 0.05, rng), CAMERA)
    assert 50 not in m.map.markers
    assert 50 in result.candidates


def test_a_marker_of_another_size_never_enters_beside_known_ones_and_its_side_is_asked_for():
    """Of 0.2 m, without an entry in marker_size_overrides: its range is half as large again as it should be."""
    rng = np.random.default_rng(6)
    poses = wall(rng)
    m = from_one_marker(poses)
    for k in range(0, 180, 3):
        known = see(flight(k / 30), {i: poses[i] for i in (0, 1)}, 0.05, rng)
        small = see(flight(k / 30), {6: poses[6]}, 0.05, rng, size=0.2)
        as_usual = rows_of(small['id'], corners_px(small), 0.05)
        result = m.process(stamp(k), np.concatenate([known, as_usual]), CAMERA)
    assert 6 not in m.map.markers
    assert result.candidates[6] == 'marker 6: its views contradict each other; is its side 0.3 m?'


def test_a_map_of_a_thousand_costs_a_frame_no_more():
    rng = np.random.default_rng(7)
    poses = wall(rng)
    away = transform(np.eye(3), [100.0, 0.0, 0.0])
    many = {i: retract(away @ poses[i % 8], 0.1 * rng.normal(size=6)) for i in range(8, 1000)} | poses
    frames = [see(flight(k / 30), poses, 0.05, rng) for k in range(40)]

    def seconds(scene):
        known = {i: MapMarker(i, SIZE, i == 0, T, 1e-6 * np.eye(6)) for i, T in scene.items()}
        m = MarkerMapper(MarkerMapperConfig(), MarkerMap(known))
        took = []
        for k, rows in enumerate(frames):
            start = time.process_time()
            m.process(stamp(k), rows, CAMERA)
            took.append(time.process_time() - start)
        return float(np.min(took))

    # The smallest time of many frames is free of what else the machine does; 1.2 is the number to keep. Of three
    # rounds one suffices.
    assert any(seconds(many) <= 1.2 * seconds(poses) for _ in range(3))
