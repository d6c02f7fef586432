"""Markers of a map contradict each other or odometry, as one was moved or exists twice: which one, odometry says."""

from dataclasses import replace

import numpy as np
import pytest
from support.scenes import motion_prior
from support.walls import CAMERA, flight, see, SIZE, stamp, wall

from thermal_fiducial.config import MarkerMapperConfig
from thermal_fiducial.core.geometry.se3 import difference, so3_exp, transform
from thermal_fiducial.core.mapping.map_data import MapMarker, MarkerMap
from thermal_fiducial.core.mapping.mapper import MarkerMapper
from thermal_fiducial.core.measurements import Odometry

#: Odometry at poses from two markers: 0.2 deg, and 15 mm across the view.
SIGMA = (15e-3, 3.5e-3)


def odometry(k):
    """Odometry at frame ``k``, as a filter has it that has seen both markers before."""
    covariance = np.diag([SIGMA[0]] * 3 + [SIGMA[1]] * 3) ** 2
    return Odometry(stamp(k), flight(k / 30), np.zeros(3), np.zeros(3), covariance, np.diag([0.02] * 6) ** 2)


def flown(moved, shift, turn=0.0, frames=40, with_odometry=True, since=0, fixed=(1, 2)):
    """Results of frames with markers 1 and 2, of which ``moved`` hangs elsewhere than in the map from ``since`` on."""
    rng = np.random.default_rng(3)
    poses = {key: T for key, T in wall(rng).items() if key in (1, 2)}
    mapper = MarkerMapper(
        MarkerMapperConfig(mode='localization', camera_orientation=(0.0, 0.0, 0.0, 1.0)),
        MarkerMap({key: MapMarker(key, SIZE, key in fixed, T) for key, T in poses.items()}),
    )
    there = poses | {moved: poses[moved] @ transform(so3_exp([0.0, turn, 0.0]), [shift, 0.0, 0.0])}
    results = []
    for k in range(frames):
        rows = see(flight(k / 30), there if k >= since else poses, 0.02, rng)
        prior = motion_prior(odometry(k)) if with_odometry else None
        results.append(mapper.process(stamp(k), rows, CAMERA, prior))
    return results


@pytest.mark.parametrize('moved', [1, 2])
@pytest.mark.parametrize(('shift', 'turn'), [(0.1, 0.0), (0.1, 0.26)])
def test_the_pose_comes_from_the_marker_that_odometry_agrees_with(moved, shift, turn):
    results = flown(moved, shift, turn)
    for k, result in enumerate(results):
        error = difference(result.pose.T_map_camera, flight(k / 30))
        # The other marker's pose is 100 mm off: nearer to the truth than to that.
        assert np.linalg.norm(error[:3]) < 0.05
        # Six degrees of freedom, 99.9 %.
        assert error @ np.linalg.solve(result.pose.covariance, error) < 22.5
    # Most of the last 20 frames.
    assert list(results[-1].quarantined) == [moved]


@pytest.mark.parametrize('moved', [1, 2])
def test_also_a_fixed_marker_may_be_knocked_from_its_place(moved):
    """The other one alone gives the poses from then on, and is not quarantined for its lower rank."""
    results = flown(moved, 0.1, frames=60, since=20, fixed=(1,))
    assert all(result.pose for result in results)
    assert list(results[-1].quarantined) == [moved]


def test_odometry_that_has_never_agreed_with_a_fixed_marker_does_not_put_it_in_quarantine():
    """It may come from the other one, which is in the map in a wrong place."""
    results = flown(1, 0.1, fixed=(1,))
    assert list(results[-1].quarantined) == [2]


@pytest.mark.parametrize('moved', [1, 2])
def test_where_odometry_does_not_decide_the_pose_claims_what_the_markers_differ_by(moved):
    """A shift of 20 mm is within the odometry's error, and not within that of the corners."""
    results = flown(moved, 0.02)
    for k, result in enumerate(results):
        error = difference(result.pose.T_map_camera, flight(k / 30))
        assert error @ np.linalg.solve(result.pose.covariance, error) < 22.5
    # An error of the map, which the filter must not average away.
    variances = [result.pose.map_covariance[:3, :3].trace() for result in results]
    assert np.mean(variances) > 0.02**2
    assert not results[-1].quarantined


def test_without_odometry_no_pose_is_published():
    assert all(result.pose is None for result in flown(2, 0.1, with_odometry=False))


def test_markers_that_agree_are_all_used():
    for result in flown(2, 0.0):
        assert result.pose.marker_ids == (1, 2)


def alone(seen_at, frames, known=(1, 2, 3, 4), drift=None, turn=0.0):
    """Results of frames: all of ``known`` in view for 20 frames, then one alone, ``seen_at(k)``: its ID, its shift [m].

    ``frames``: their numbers, or how many. ``drift(k)``: error of odometry [m] and factor on its standard deviations.
    ``turn``: of the one alone in its own plane [rad].
    """
    rng = np.random.default_rng(4)
    poses = {key: T for key, T in wall(rng).items() if key in known}
    mapper = MarkerMapper(
        MarkerMapperConfig(mode='localization', camera_orientation=(0.0, 0.0, 0.0, 1.0)),
        MarkerMap({key: MapMarker(key, SIZE, True, T) for key, T in poses.items()}),
    )
    results = []
    for k in range(frames) if isinstance(frames, int) else frames:
        there = poses
        if k >= 20:
            key, shift = seen_at(k)
            there = {key: poses[key] @ transform(so3_exp([0.0, 0.0, turn]), [shift, 0.0, 0.0])}
        state = odometry(k)
        error, factor = drift(k) if drift else (0.0, 1.0)
        T = transform(np.eye(3), [error, 0.0, 0.0]) @ state.T_map_body
        state = replace(state, T_map_body=T, pose_covariance=factor**2 * state.pose_covariance)
        results.append(mapper.process(stamp(k), see(flight(k / 30), there, 0.02, rng), CAMERA, motion_prior(state)))
    return results


def published(results):
    """Numbers of the frames with a pose."""
    return [k for k, result in enumerate(results) if result.pose is not None]


def test_a_second_plate_of_an_id_alone_in_view_gives_no_pose_however_long_it_is_seen():
    """Also when odometry has drifted until it contradicts nothing."""
    results = alone(lambda k: (2, 0.5), 80, drift=lambda k: (0.0, 1.0 + max(k - 20, 0)))
    assert published(results) == list(range(20))
    # Its shift by 0.5 m, by odometry.
    assert results[-1].reason == 'marker 2 alone is 0.5 m, 0 deg from its place: moved, or a second one of its ID?'


@pytest.mark.parametrize('degrees', [20, 90, -90, 180])
def test_a_marker_that_was_turned_where_it_hangs_gives_no_pose_alone(degrees):
    """By a quarter its corners are those of the map, in another order: the robot seems to lie on its side."""
    results = alone(lambda k: (2, 0.0), 60, turn=np.radians(degrees))
    assert published(results) == list(range(20))
    # Odometry is known to 0.2 deg.
    assert f'0.0 m, {abs(degrees)} deg from its place' in results[-1].reason


def test_what_one_camera_has_seen_counts_for_the_other_one_on_the_robot():
    """The first has seen the markers of a wall in their places; the second sees the one alone that hangs elsewhere."""
    rng = np.random.default_rng(4)
    poses = {key: T for key, T in wall(rng).items() if key in (1, 2, 3, 4)}
    config = MarkerMapperConfig(mode='localization', camera_orientation=(0.0, 0.0, 0.0, 1.0))
    first = MarkerMapper(config, MarkerMap({key: MapMarker(key, SIZE, True, T) for key, T in poses.items()}))
    second = MarkerMapper(config, first.map)
    moved = {2: poses[2] @ transform(np.eye(3), [0.5, 0.0, 0.0])}
    for k in range(40):
        mapper, there = (first, poses) if k < 20 else (second, moved)
        second.use_map_of(first)
        result = mapper.process(stamp(k), see(flight(k / 30), there, 0.02, rng), CAMERA, motion_prior(odometry(k)))
        assert (result.pose is not None) == (k < 20)
    assert 'marker 2 alone is 0.5 m' in result.reason


def test_back_in_its_place_it_gives_poses_again():
    results = alone(lambda k: (2, 0.5 if k < 40 else 0.0), 60)
    assert published(results) == [*range(20), *range(40, 60)]


def test_two_markers_that_contradict_odometry_one_after_the_other_are_right():
    results = alone(lambda k: (2 if k < 40 else 3, 0.0), 70, drift=lambda k: (0.5 * (k >= 20), 1.0))
    assert published(results) == [*range(20), *range(40, 70)]


def test_a_marker_in_view_is_followed_when_odometry_drifts_away():
    results = alone(lambda k: (2, 0.0), 90, drift=lambda k: (0.01 * max(k - 20, 0), 1.0))
    assert published(results) == list(range(90))


def test_one_marker_against_another_is_no_majority():
    results = alone(lambda k: (2, 0.5), 60, known=(1, 2))
    assert published(results) == list(range(60))


def test_after_a_minute_odometry_counts_no_more():
    # Six frames a second of the marker alone.
    frames = [*range(20), *range(20, 20 + 62 * 30, 5)]
    results = alone(lambda k: (2, 0.5), frames, drift=lambda k: (0.0, 1.0 if k <= 20 else 1000.0))
    given = [k for k, result in zip(frames, results, strict=True) if result.pose is not None]
    # More than 60 s after the first of its frames.
    assert given == [*range(20), *range(25 + 60 * 30, 20 + 62 * 30, 5)]
