"""Algorithm 1: the camera from known markers, and new markers from the camera."""

from dataclasses import replace
import re

import numpy as np
import pytest
from support.scenes import motion_prior
from support.walls import CAMERA, flight, look, see, SIZE, stamp, wall

from thermal_fiducial.config import MarkerMapperConfig
from thermal_fiducial.core.error_model import NO_DRAWS
from thermal_fiducial.core.geometry.se3 import difference, retract, so3_exp, transform
from thermal_fiducial.core.mapping.map_data import MapMarker, MarkerMap
from thermal_fiducial.core.mapping.mapper import MarkerMapper
from thermal_fiducial.core.measurements import MARKER_DTYPE, Odometry, VAGUE


def known(poses, ids=None):
    return MarkerMap({i: MapMarker(i, SIZE, True, poses[i]) for i in (poses if ids is None else ids)})


def mapper(marker_map, **parameters):
    return MarkerMapper(MarkerMapperConfig(**parameters), marker_map)


def test_noiseless_corners_give_the_exact_pose():
    poses = wall(np.random.default_rng(0))
    for k in range(0, 300, 50):
        T = flight(k / 30)
        m = mapper(known(poses))
        result = m.process(stamp(k), see(T, poses, 0.0, np.random.default_rng(k)), CAMERA)
        assert result.pose is not None
        # The rows carry corners as float32: 3e-5 px at 600 px, which is micrometres here.
        assert np.max(np.abs(difference(result.pose.T_map_camera, T))) < 1e-5
        assert max(m.map.markers[key].reprojection_error_px for key in result.in_view) < 1e-4


def test_one_known_marker_starts_a_map_of_all():
    rng = np.random.default_rng(1)
    poses = wall(rng)
    m = mapper(known(poses, [0]))
    changed = [m.process(stamp(k), see(flight(k / 30), poses, 0.02, rng), CAMERA).map_changed for k in range(90)]
    assert sorted(m.map.markers) == sorted(poses)
    assert m.map.revision > 1
    assert sum(changed) == m.map.revision - 1
    for key, marker in m.map.markers.items():
        d = difference(marker.T_map_marker, poses[key])
        # A marker placed through the pose from a single small one is centimetres off, and must know it: five sigma of
        # six degrees of freedom is 35.
        assert np.linalg.norm(d[:3]) < 0.05
        assert marker.fixed or d @ np.linalg.solve(marker.covariance, d) < 35.0
    assert m.map.markers[0].observations == 90
    assert m.map.markers[0].first_seen_ns == stamp(0)
    assert m.map.markers[0].last_seen_ns == stamp(89)


def test_no_pose_has_a_reason_in_words():
    poses = wall(np.random.default_rng(0))
    rng = np.random.default_rng(0)
    rows = see(flight(0.0), poses, 0.02, rng)
    empty = np.zeros(0, MARKER_DTYPE)
    assert 'map has no marker' in mapper(MarkerMap()).process(1, rows, CAMERA).reason
    assert 'no known marker' in mapper(known(poses)).process(1, empty, CAMERA).reason
    foreign = {40: poses[0]}
    assert 'no known marker' in mapper(known(foreign)).process(1, rows, CAMERA).reason


def test_localization_never_changes_the_map():
    rng = np.random.default_rng(2)
    poses = wall(rng)
    m = mapper(known(poses, [0, 1]), mode='localization')
    before = m.map.copy()
    for k in range(30):
        result = m.process(stamp(k), see(flight(k / 30), poses, 0.05, rng), CAMERA)
        assert result.pose is not None
        assert not result.map_changed
    assert m.map.markers == before.markers
    assert m.map.revision == before.revision


def test_frozen_maps_stay_and_reset_forgets():
    rng = np.random.default_rng(3)
    poses = wall(rng)
    m = mapper(known(poses, [0]))
    m.frozen = True
    for k in range(20):
        m.process(stamp(k), see(flight(k / 30), poses, 0.02, rng), CAMERA)
    assert list(m.map.markers) == [0]
    m.frozen = False
    for k in range(20, 60):
        m.process(stamp(k), see(flight(k / 30), poses, 0.02, rng), CAMERA)
    assert len(m.map.markers) > 1
    m.reset()
    assert list(m.map.markers) == [0]
    assert m.map.markers[0].observations == 0


def test_an_unsettled_ambiguity_claims_both_poses():
    """A lone small marker far away: the pose is right within its covariance, or there is none."""
    poses = {0: wall(np.random.default_rng(0), tilt=0.0)[0]}
    rng = np.random.default_rng(4)
    unsettled = []
    for trial in range(100):
        bearing = rng.uniform(-0.6, 0.6)
        T = look(poses[0][:3, 3] + 7.0 * np.array([-np.cos(bearing), np.sin(bearing), 0.0]), poses[0][:3, 3])
        result = mapper(known(poses)).process(stamp(trial), see(T, poses, 0.3, rng), CAMERA)
        if result.pose is None:
            assert 'degrees only' in result.reason
            continue
        d = difference(T, result.pose.T_map_camera)
        chi2 = d @ np.linalg.solve(result.pose.covariance, d)
        if 'ambiguity' in result.reason:
            assert np.sqrt(result.pose.covariance[3:, 3:].trace()) > VAGUE
            unsettled.append(chi2)
            continue
        # Chi square of six degrees of freedom exceeds 50 once in 10^8; a flip is in the hundreds.
        assert chi2 < 50.0
    assert len(unsettled) > 20
    # 0.5; 7.4 without the covariance of the other pose, which may be the right one.
    assert np.mean(unsettled) / 6.0 < 1.5


def test_a_marker_seen_twice_in_a_frame_is_left_out():
    rng = np.random.default_rng(6)
    poses = wall(rng)
    rows = see(flight(0.0), poses, 0.02, rng)
    twice = np.concatenate([rows, rows[:1]])
    result = mapper(known(poses)).process(1, twice, CAMERA)
    assert result.pose is not None
    assert int(rows['id'][0]) not in result.pose.marker_ids
    assert set(result.pose.marker_ids) == {int(key) for key in rows['id'][1:]}


def test_unusable_rows_are_left_out():
    rng = np.random.default_rng(7)
    poses = wall(rng)
    rows = see(flight(0.0), poses, 0.02, rng)
    rows['u0'][0] = np.nan
    rows['c1uu'][1] = -1.0
    result = mapper(known(poses)).process(1, rows, CAMERA)
    assert result.pose is not None
    assert len(result.pose.marker_ids) == len(rows) - 2


def test_new_markers_without_a_pose_wait():
    """Of corners that no square explains the detector knows the ID alone."""
    rng = np.random.default_rng(3)
    poses = wall(rng)
    m = mapper(known(poses, [0]))
    for k in range(0, 150, 6):
        rows = see(flight(k / 30), poses, 0.05, rng)
        for name in ('x', 'y', 'z', 'ax', 'ay', 'az'):
            rows[name][rows['id'] == 1] = np.nan
        assert m.process(stamp(k), rows, CAMERA).pose is not None
    assert sorted(m.map.markers) == [0, 2, 3, 4, 5, 6, 7]


def test_a_moved_marker_is_quarantined_and_the_rest_flies_on():
    rng = np.random.default_rng(8)
    poses = wall(rng)
    m = mapper(known(poses), mode='localization')
    moved = dict(poses)
    moved[2] = poses[2].copy()
    moved[2][:3, 3] += [0.0, 0.05, 0.02]
    quarantined = []
    for k in range(60):
        T = flight(k / 30)
        result = m.process(stamp(k), see(T, moved, 0.05, rng), CAMERA)
        assert result.pose is not None
        quarantined.append(result.quarantined)
        if k and quarantined[k - 1]:
            # As good as without the marker: its weight is none. 10 mm is four sigma of seven markers at 0.05 px.
            assert np.linalg.norm(difference(result.pose.T_map_camera, T)[:3]) < 0.01
            assert 2 not in result.pose.marker_ids
    assert quarantined[-1] == (2,)
    assert quarantined.index((2,)) > 15
    # Five centimetres at three metres are nine pixels, and some of that the pose takes up.
    error_px, sigmas = map(float, re.match(r'([\d.]+) px off, ([\d.]+) sigma', result.quarantine_reasons[2]).groups())
    assert 4.0 < error_px < 15.0
    assert sigmas > 4.0
    for k in range(60, 200):
        result = m.process(stamp(k), see(flight(k / 30), poses, 0.05, rng), CAMERA)
    assert result.quarantined == ()


def test_the_covariance_carries_the_uncertainty_of_the_map():
    rng = np.random.default_rng(9)
    poses = wall(rng)
    sure = known(poses)
    covariance = np.diag([1e-4] * 3 + [1e-5] * 3)
    # Placed by a mapper, one by another: their errors are common.
    unsure = MarkerMap({i: MapMarker(i, SIZE, False, poses[i], covariance, observations=1) for i in poses})
    rows = see(flight(0.0), poses, 0.02, rng)
    small, large = (mapper(m).process(1, rows, CAMERA).pose for m in (sure, unsure))
    assert small is not None
    assert large is not None
    # A common error of all markers moves the camera as much: no number of markers averages it away.
    assert np.trace(large.covariance[:3, :3]) > np.trace(covariance[:3, :3])
    # 12 mm, by a lens of which nothing is known yet; the markers have 17.
    assert np.trace(small.covariance[:3, :3]) < 0.5 * np.trace(covariance[:3, :3])
    assert np.linalg.eigvalsh(large.covariance)[0] > 0.0


@pytest.mark.parametrize('count', [1, 3, 8])
def test_the_white_covariance_of_the_pose_is_the_spread_of_its_errors(count):
    rng = np.random.default_rng(10)
    poses = wall(rng, count)
    m = mapper(known(poses), mode='localization')
    nees = []
    for k in range(0, 600, 3):
        T = flight(k / 30)
        frame = m.locate(stamp(k), see(T, poses, 0.02, rng), CAMERA)
        m.learn(frame)
        if frame.pose is not None:
            d = difference(T, frame.pose.T_map_camera)
            nees.append(d @ np.linalg.solve(frame.outcome.noise, d))
    assert len(nees) > 100
    # Six degrees of freedom; the mean of 130 or more has one of 0.3. The covariance never shrinks below the declared
    # noise but grows with the residuals, which takes a little off.
    assert 4.0 < np.mean(nees) < 6.8


def test_the_running_error_is_the_mean_at_first_and_then_forgets():
    marker = MapMarker(0, 0.3, False, np.eye(4))
    for stamp_ns, error in ((5, 0.1), (8, 0.3)):
        marker = marker.observed(stamp_ns, error)
    np.testing.assert_allclose(marker.reprojection_error_px, np.sqrt((0.1**2 + 0.3**2) / 2.0))
    assert (marker.observations, marker.first_seen_ns, marker.last_seen_ns) == (2, 5, 8)
    for stamp_ns in range(10, 210):
        marker = marker.observed(stamp_ns, 0.2)
    # 0.95^180 of the start is left.
    np.testing.assert_allclose(marker.reprojection_error_px, 0.2, rtol=1e-3)


def test_a_map_in_memory_gives_the_poses_of_one_from_its_file():
    """Which has the covariances of its markers, and no draws."""
    rng = np.random.default_rng(11)
    poses = wall(rng)
    m = MarkerMapper(MarkerMapperConfig(), MarkerMap({0: MapMarker(0, SIZE, True, poses[0])}))
    for k in range(0, 300, 10):
        m.process(stamp(k), see(flight(k / 30), poses, 0.05, rng), CAMERA)
    m.refine()
    bare = MarkerMap({key: replace(marker, draws=NO_DRAWS) for key, marker in m.map.markers.items()})
    rows = see(flight(10.0), poses, 0.05, rng)
    on_both = [
        MarkerMapper(MarkerMapperConfig(), start).process(stamp(400), rows, CAMERA).pose for start in (m.map, bare)
    ]
    np.testing.assert_array_equal(on_both[0].covariance, on_both[1].covariance)
    # Not only of the corners: of the map.
    assert np.all(np.linalg.eigvalsh(on_both[0].map_covariance) > 0.0)


def test_errors_of_surveyed_markers_are_independent_until_a_refinement_relates_them():
    rng = np.random.default_rng(6)
    poses, covariance = wall(rng), np.diag([1e-4] * 3 + [1e-5] * 3)
    surveyed = MarkerMap({i: MapMarker(i, SIZE, i == 0, poses[i], covariance * (i > 0)) for i in range(4)})
    m = mapper(surveyed, refinement_period=1.0)
    for k in range(0, 300, 5):
        m.process(stamp(k), see(flight(k / 30), poses, 0.05, rng), CAMERA)
    # Those that the mapper places have errors by the flight.
    assert len(m.map.markers) > 4
    assert {i for i, marker in m.map.markers.items() if marker.surveyed} == {1, 2, 3}
    assert m.refine() is not None
    assert not any(marker.surveyed for marker in m.map.markers.values())


def test_a_marker_that_was_read_as_another_once_does_not_keep_that_out_of_the_map():
    rng = np.random.default_rng(3)
    poses = wall(rng)
    m, misread = mapper(known(poses, [key for key in poses if key != 5])), False
    for k in range(0, 150, 6):
        rows = see(flight(k / 30), poses, 0.1, rng)
        if not misread and {3, 5} <= set(rows['id'].tolist()):
            rows = rows[rows['id'] != 5].copy()
            rows['id'][rows['id'] == 3] = 5
            misread = True
        m.process(stamp(k), rows, CAMERA)
    assert misread
    assert 5 in m.map.markers
    d = difference(m.map.markers[5].T_map_marker, poses[5])
    # 99.9 % of chi square of six degrees of freedom.
    assert d @ np.linalg.solve(m.map.markers[5].covariance, d) < 22.5


def test_a_marker_that_has_just_entered_is_none_that_was_surveyed():
    """To the next mapper, even if no further frame has shown it."""
    rng = np.random.default_rng(1)
    poses = wall(rng)
    m = mapper(known(poses, [0]))
    for k in range(90):
        placed = m.process(stamp(k), see(flight(k / 30), poses, 0.02, rng), CAMERA).map_changed
        if placed and len(m.map.markers) > 2:
            break
    entered = [marker for marker in m.map.markers.values() if not marker.fixed]
    assert min(marker.observations for marker in entered) > 0


def test_flights_over_a_part_of_a_large_map_leave_its_claims_as_they_are():
    """Forty markers whose correlations are unknown, without a fixed one in view; four of them are flown over."""
    rng = np.random.default_rng(5)
    poses, covariance = wall(rng, 40), np.diag([1e-4] * 3 + [1e-4] * 3)
    few = {key: poses[key] for key in range(4)}
    before = MarkerMap({key: MapMarker(key, SIZE, False, T, covariance, 0.1, 100) for key, T in poses.items()})
    for _ in range(3):
        m = mapper(before)
        for k in range(0, 300, 10):
            m.process(stamp(k), see(flight(k / 30), few, 0.1, rng), CAMERA)
        assert m.refine() is not None
        before = MarkerMap({key: replace(marker, draws=NO_DRAWS) for key, marker in m.map.markers.items()})
    # Twice the variance for the bound and the lens; each flight had tripled the claim.
    stds = [np.sqrt(np.diag(before.markers[key].covariance)) for key in few]
    assert np.max(stds) < 0.02


def test_what_only_odometry_connects_keeps_its_place_in_a_refinement():
    """Markers of an earlier map before the filter has started, one beside odometry, and then new ones by that alone."""
    rng = np.random.default_rng(0)
    first = wall(rng, 1)[0]
    places = {**{i: 0.8 * i for i in range(3)}, **{10 + i: 5.2 + 0.8 * i for i in range(2)}}
    poses = {key: retract(first, [0.0, y, 0.0, 0.0, 0.0, 0.0]) for key, y in places.items()}
    m = mapper(
        MarkerMap({key: MapMarker(key, SIZE, False, poses[key], 2.5e-5 * np.eye(6), 0.1, 100) for key in range(3)}),
        camera_orientation=(0.0, 0.0, 0.0, 1.0),
        bridge_duration=10.0,
    )
    legs = [(0.8, False, (0, 1, 2))] * 30 + [(1.6, True, (2,))] * 20 + [(5.6, True, (10, 11))] * 60
    for k, (y, has_odometry, ids) in enumerate(legs):
        y += first[1, 3]
        position = [-1.6 + 0.3 * np.sin(k / 5), y + 0.4 * np.sin(k / 9), 1.0 + 0.4 * np.sin(k / 7)]
        T, seen_at = look(position, [0.0, y, 1.0]), stamp(3 * k)
        prior = None
        if has_odometry:
            stds = np.repeat((0.01, 0.0025), 3)
            prior = motion_prior(
                Odometry(seen_at, T, np.zeros(3), np.zeros(3), np.diag(stds**2), np.diag((2.0 * stds) ** 2))
            )
        m.process(seen_at, see(T, {key: poses[key] for key in ids}, 0.1, rng), CAMERA, prior)
    assert m.refine() is not None
    for key in (10, 11):
        marker = m.map.markers[key]
        # As when it was placed: 11 mm; where its frames float, 7 m.
        assert np.sqrt(np.diag(marker.covariance)).max() < 0.02
        d = difference(marker.T_map_marker, poses[key])
        assert d @ np.linalg.solve(marker.covariance, d) < 22.5


def test_an_exact_rotation_beside_a_vague_position_is_a_prior_too():
    """As ``map move --sigma-deg 0`` writes it."""
    rng = np.random.default_rng(2)
    poses = wall(rng)
    vague = np.diag([1e-4] * 3 + [0.0] * 3)
    m = mapper(MarkerMap({key: MapMarker(key, SIZE, False, T, vague, 0.1, 100) for key, T in poses.items()}))
    for k in range(0, 300, 10):
        m.process(stamp(k), see(flight(k / 30), poses, 0.1, rng), CAMERA)
    assert m.refine() is not None
    assert np.isfinite([marker.covariance for marker in m.map.markers.values()]).all()


def test_a_count_beyond_what_a_row_holds_is_the_largest():
    marker = replace(MapMarker(0, SIZE, True, wall(np.random.default_rng(0))[0]), observations=2**40)
    assert MarkerMap({0: marker}).rows()['observations'][0] == 2**32 - 1


def test_after_a_load_a_second_camera_forgets_its_pose_in_the_map_before():
    rng = np.random.default_rng(7)
    poses = wall(rng, 1, tilt=0.0)
    T = look(poses[0][:3, 3] + [-9.0, 0.2, 0.0], poses[0][:3, 3])
    owner, second = mapper(known(poses)), mapper(known(poses))
    second.use_map_of(owner)
    for k in range(20):
        second.process(stamp(k), see(T, poses, 0.3, rng), CAMERA)
    turned = transform(so3_exp([0.0, 0.0, np.pi / 2]), np.zeros(3))
    moved = {key: turned @ pose for key, pose in poses.items()}
    owner.load(known(moved))
    second.use_map_of(owner)
    rows = see(turned @ T, moved, 0.3, rng)
    after = second.process(stamp(21), rows, CAMERA)
    fresh = mapper(known(moved)).process(stamp(21), rows, CAMERA)
    assert (after.pose is None, after.reason) == (fresh.pose is None, fresh.reason)
