"""Rows that are read over another time than is declared: estimated from where corners are, and taken out of them."""

from dataclasses import replace

import numpy as np
import pytest
from support.scenes import motion_prior
from support.walls import (
    brisk,
    CAMERA,
    flight,
    NOISE_PX,
    odometry,
    read_row_by_row,
    rows,
    SIZE,
    stamp,
    TWIST_STD,
    wall,
)

from thermal_fiducial.config import ArucoDetectorConfig, MarkerMapperConfig
from thermal_fiducial.core.detection.corners.squares import as_squares
from thermal_fiducial.core.geometry.camera import ImagePoints
from thermal_fiducial.core.geometry.se3 import difference
from thermal_fiducial.core.mapping.map_data import MapMarker, MarkerMap
from thermal_fiducial.core.mapping.mapper import MarkerMapper
from thermal_fiducial.core.mapping.undeclared_readout import ReadoutEstimate, UndeclaredReadout
from thermal_fiducial.core.measurements import corner_covariances, corners_px
from thermal_fiducial.core.motion_prior import MotionPrior
from thermal_fiducial.core.two_poses import possible_poses

#: The camera is the body.
CONFIG = MarkerMapperConfig(
    mode='localization', camera_position=(0.0, 0.0, 0.0), camera_orientation=(0.0, 0.0, 0.0, 1.0)
)


def pulled(seen, sigma):
    """Rows whose outlines the detector has pulled towards squares, as far as noise of ``sigma`` [px] allows."""
    at = ImagePoints.at(corners_px(seen), CAMERA)
    covariance = np.tile(sigma**2 * np.eye(8), (len(seen), 1, 1))
    moved = as_squares(at, np.zeros((len(seen), 8, 1)), covariance).moved.reshape(-1, 4, 2)
    return rows(seen['id'].astype(np.int64), at.px + moved, sigma)


def flown(
    path, readout, seconds=5.0, lens=None, lost=TWIST_STD, mode='localization', pulling=0.0, markers=99, **changes
):
    """A mapper that knows the map after a flight, or the first marker, and each frame's time, pose and true pose.

    ``readout``: the time that is not declared [s], negative where too much is; ``lost``: standard deviations of the
    twist in every other frame; ``pulling``: noise of the corners of a detector that knows of squares [px];
    ``markers``: how many there are at most.
    """
    rng = np.random.default_rng(5)
    poses = dict(sorted(wall(rng).items())[:markers])
    known = [min(poses)] if mode == 'mapping' else poses
    start = MarkerMap({key: MapMarker(key, SIZE, True, poses[key]) for key in known})
    mapper = MarkerMapper(replace(CONFIG, mode=mode, **changes), start)
    located = []
    for k in range(0, round(30 * seconds), 2):
        t, prior = k / 30, motion_prior(odometry(path, k, rng, lost if k % 4 else TWIST_STD))
        seen = read_row_by_row(path, t, poses, readout, rng, lens)
        seen = pulled(seen, pulling) if pulling and len(seen) else seen
        located.append((t, mapper.process(stamp(k), seen, CAMERA, prior).pose, path(t)))
        if mapper.refinement_due(stamp(k)):
            mapper.refine()
    return mapper, located


def nees(located):
    """Mean squared errors of poses over their claims, per degree of freedom."""
    errors = [(difference(pose.T_map_camera, truth), pose.covariance) for _, pose, truth in located if pose is not None]
    return np.mean([error @ np.linalg.solve(C, error) / 6.0 for error, C in errors])


@pytest.mark.parametrize('readout', [0.016, -0.016])
def test_it_is_found_and_poses_are_within_their_claims(readout):
    mapper, located = flown(brisk, readout)
    found = mapper.readout.estimate
    assert abs(found.seconds - readout) < 3.0 * found.std
    assert found.std < 0.1 * abs(readout)
    # Errors of the lens are claimed and there are none: 0.22. Uncorrected it is 2.2.
    assert nees([frame for frame in located if frame[0] > 4.0]) < 0.5


@pytest.mark.parametrize('readout', [0.033, 0.016, -0.016])
@pytest.mark.parametrize('markers', [1, 2, 3])
def test_outlines_that_the_detector_has_pulled_towards_squares_hide_nothing(readout, markers):
    """Taken as they are, 33 ms were 2 +- 3, 28.1 +- 0.4 and 32.0 +- 0.2 by one, two and three markers."""
    found = flown(brisk, readout, markers=markers, pulling=NOISE_PX)[0].readout.estimate
    assert abs(found.seconds - readout) < 3.0 * found.std
    # One marker shows next to nothing: of the prior's 15 ms 14 are left.
    assert (found.std < 0.001) == (markers > 1)


@pytest.mark.parametrize('readout', [0.033, 0.008])
def test_half_a_second_shows_it(readout):
    """While errors of the lens counted as other ones in each second, it took three, and 8 ms were not found in four."""
    found = flown(brisk, readout, seconds=0.5)[0].readout
    assert abs(found.estimate.seconds - readout) < 3.0 * found.estimate.std
    assert found.doubt


def test_velocities_that_a_filter_does_not_know_show_nothing():
    """In every other frame the filter is lost, and claims so; as information these would find 1 ms."""
    found = flown(brisk, 0.016, lost=(3.0, 3.0))[0].readout.estimate
    assert abs(found.seconds - 0.016) < 2.0 * found.std


def test_what_is_declared_is_named_by_nothing():
    mapper, located = flown(brisk, 0.0)
    found = mapper.readout
    assert found.doubt == ''
    # Three standard deviations, which are small by then: poses claim next to nothing of it.
    assert abs(found.estimate.seconds) < 3.0 * found.estimate.std < 0.003
    assert nees(located) < 0.5


@pytest.mark.parametrize('mode', ['localization', 'mapping'])
@pytest.mark.parametrize('readout', [0.016, 0.0, -0.016])
def test_poses_claim_what_is_not_known_of_it_yet(readout, mode):
    """In the first frames of a brisk flight; while nothing was claimed before it was found, 16 ms had 3 to 4."""
    _, located = flown(brisk, readout, seconds=0.2, mode=mode)
    assert nees(located) < 1.0


def at_first_sight(readout, markers, frames, rng):
    """Camera poses of a brisk flight by so many markers, each the first one or the second of a mapper; true poses."""
    poses = wall(rng)
    known = MarkerMap({key: MapMarker(key, SIZE, True, T) for key, T in poses.items()})
    for t in np.arange(0.0, 6.0, 4.0 / 30.0):
        mapper = MarkerMapper(CONFIG, known)
        for k in range(frames):
            seen = read_row_by_row(brisk, t + k / 30.0, poses, readout, rng)[:markers]
            pose = mapper.process(stamp(k), seen, CAMERA, MotionPrior()).pose
        if pose is not None:
            yield possible_poses(pose), brisk(t + k / 30.0)


@pytest.mark.parametrize('readout', [0.016, 0.0, -0.016])
@pytest.mark.parametrize('markers', [1, 3])
@pytest.mark.parametrize('frames', [1, 2])
def test_poses_before_any_odometry_claim_what_late_rows_may_do(readout, markers, frames):
    """While they claimed nothing of it, 16 ms had 6 by one marker and 8 by three."""
    located = list(at_first_sight(readout, markers, frames, np.random.default_rng(5)))
    nearest = [min(((0.0, pose, truth) for pose in poses), key=lambda one: nees([one])) for poses, truth in located]
    assert len(nearest) > 35
    # By one marker the claim is linear, and late rows turn a marker from the front by more.
    assert nees(nearest) < 1.2


def test_a_camera_at_rest_claims_little_of_late_rows_from_its_second_frame_on():
    """Before one marker far away, with what robots usually do in its claim, there was no pose for seconds."""
    rng = np.random.default_rng(5)
    poses = wall(rng)
    mapper = MarkerMapper(CONFIG, MarkerMap({key: MapMarker(key, SIZE, True, T) for key, T in poses.items()}))
    known = MarkerMapper(replace(CONFIG, readout_time_std=0.0), mapper.map)
    variances = []
    for k in range(2):
        seen = read_row_by_row(lambda t: brisk(0.0), 0.0, poses, 0.016, rng)
        located = [one.process(stamp(k), seen, CAMERA, MotionPrior()).pose for one in (mapper, known)]
        variances.append([np.trace(pose.covariance) for pose in located])
    (first, least), (second, _) = variances
    # An unknown acceleration of a frame's time is left, an eighth of what it may be at first sight.
    assert second - least < 0.04 * (first - least)


def test_pictures_of_a_camera_without_odometry_claim_no_motion():
    rng = np.random.default_rng(5)
    poses = wall(rng)
    known = MarkerMap({key: MapMarker(key, SIZE, True, T) for key, T in poses.items()})
    seen = read_row_by_row(brisk, 0.0, poses, 0.0, rng)
    still, moving = (
        MarkerMapper(CONFIG, known).process(0, seen, CAMERA, prior).pose for prior in (None, MotionPrior())
    )
    assert np.trace(still.covariance) < 0.5 * np.trace(moving.covariance)


@pytest.mark.parametrize('readout', [0.033, 0.016, 0.0, -0.016])
def test_new_markers_claim_what_is_not_known_of_it(readout):
    """Before the first adjustment; while the corners that they are placed by claimed nothing: 2, and 10 for 33 ms."""
    mapper, _ = flown(brisk, readout, seconds=2.0, mode='mapping', refinement_period=0.0)
    true = wall(np.random.default_rng(5))
    placed = [marker for marker in mapper.map.markers.values() if not marker.fixed]
    assert len(placed) == len(true) - 1
    errors = [(difference(marker.T_map_marker, true[marker.id]), marker.covariance) for marker in placed]
    # 1.0 where the time is 2.2 of its standard deviations, else at most 0.4.
    assert np.mean([error @ np.linalg.solve(C, error) / 6.0 for error, C in errors]) < 1.2


def test_keyframes_before_any_odometry_have_the_velocities_of_their_corners():
    """Without these an adjustment takes corners for undisplaced that are pixels off."""
    poses = wall(np.random.default_rng(5))
    known = MarkerMap({key: MapMarker(key, SIZE, True, T) for key, T in poses.items()})
    mapper, rng = MarkerMapper(replace(CONFIG, mode='mapping'), known), np.random.default_rng(6)
    for k in range(2):
        seen = read_row_by_row(brisk, k / 30.0, poses, 0.016, rng)
        mapper.process(stamp(k), seen, CAMERA, MotionPrior())
    now = mapper.snapshot()
    first, second = now.frame == 0, now.frame == 1
    stds = np.sqrt(np.trace(now.covariances, axis1=-2, axis2=-1))
    # At first sight nothing is known of them, and corners far from the middle row may move by pixels; noise is 0.05.
    assert not now.rates[first].any()
    assert stds[first].max() > 1.0
    at_once = corners_px(read_row_by_row(brisk, 1.0 / 30.0, poses, 0.0, rng))
    displaced = 0.016 * now.rates[second]
    # Of 1 to 4 px an acceleration of half a frame's time leaves a tenth.
    assert np.sqrt(np.mean((now.corners[second] - at_once - displaced) ** 2)) < 0.2 * np.sqrt(np.mean(displaced**2))
    assert stds[second].max() < 0.5 * stds[first].max()


def test_corners_of_pictures_are_weighed_by_their_noise():
    """A few a second, without odometry: nothing says how the camera moves."""
    poses = wall(np.random.default_rng(5))
    known = MarkerMap({key: MapMarker(key, SIZE, True, T) for key, T in poses.items()})
    mapper, rng = MarkerMapper(replace(CONFIG, mode='mapping'), known), np.random.default_rng(6)
    noise = []
    for k in range(3):
        seen = read_row_by_row(brisk, k / 3.0, poses, 0.0, rng)
        mapper.process(stamp(10 * k), seen, CAMERA, MotionPrior())
        noise.append(corner_covariances(seen))
    assert np.allclose(mapper.snapshot().covariances, np.concatenate(noise), rtol=1e-6)


def test_what_is_exactly_as_declared_is_not_estimated():
    mapper, _ = flown(brisk, 0.016, mode='mapping', readout_time_std=0.0)
    assert (mapper.readout.estimate, mapper.readout.doubt) == (ReadoutEstimate(0.0, 0.0), '')


@pytest.mark.parametrize('lens', [1, 4, 6])
def test_an_error_of_the_lens_is_no_readout(lens):
    """Slow flights turn one way for seconds: by noise alone these are 10, -9 and 8 ms, 13 to 17 standard deviations."""
    assert flown(flight, 0.0, seconds=4.0, lens=lens)[0].readout.doubt == ''


def test_the_warning_says_what_to_write():
    found = UndeclaredReadout(0.015)
    assert found.doubt == ''
    found.adopt(ReadoutEstimate(0.0147, 0.0003))
    assert found.doubt == 'rows are read over 14.7 +- 0.3 ms more than readout_time says: add 0.0147'
    found.adopt(ReadoutEstimate(-0.0074, 0.0003))
    assert found.doubt == 'rows are read over 7.4 +- 0.3 ms less than readout_time says: subtract 0.0074'
    # Also from 0, where the driver turns pictures upside down.
    assert ArucoDetectorConfig(readout_time=found.estimate.seconds).readout_time == -0.0074


def away_mm(located, since):
    """Distances [mm] of camera poses from the truth from a time [s] on."""
    poses = [(pose, truth) for t, pose, truth in located if pose is not None and t > since]
    return 1e3 * np.array([np.linalg.norm(pose.T_map_camera[:3, 3] - truth[:3, 3]) for pose, truth in poses])


@pytest.mark.parametrize('readout', [0.016, -0.016])
def test_a_map_made_by_displaced_corners_shows_it_in_its_adjustment(readout):
    """Frames alone said 9 +- 5 ms after 12 s, as the map had taken up the rest: poses 91 mm off, at a NEES of 3."""
    mapper, located = flown(brisk, readout, mode='mapping')
    found = mapper.readout.estimate
    assert abs(found.seconds - readout) < 3.0 * found.std
    assert found.std < 0.1 * abs(readout)
    # With the time declared it is 3 mm; the keyframes from before, too, have been corrected.
    assert np.sqrt(np.mean(away_mm(located, 3.0) ** 2)) < 10.0
    assert nees([frame for frame in located if frame[0] > 3.0]) < 0.5


@pytest.mark.parametrize(('path', 'lens'), [(flight, 4), (flight, 5), (brisk, 3)])
def test_an_error_of_the_lens_is_no_readout_of_an_adjustment(path, lens):
    """Of eight lenses and two flights the worst ones: 1.3, 1.7, 1.7 standard deviations, by noise alone 7, 8, 5."""
    assert flown(path, 0.0, lens=lens, mode='mapping')[0].readout.doubt == ''


def test_velocities_that_a_filter_does_not_know_show_an_adjustment_nothing():
    """In every other frame; as information these hid it."""
    mapper, _ = flown(brisk, 0.016, lost=(3.0, 3.0), mode='mapping')
    assert 0.4 < np.mean(np.any(mapper.snapshot().rates != 0.0, axis=(1, 2))) < 0.6
    assert abs(mapper.readout.estimate.seconds - 0.016) < 3.0 * mapper.readout.estimate.std


def test_what_an_adjustment_takes_back_is_dropped():
    found = UndeclaredReadout(0.015)
    found.adopt(ReadoutEstimate(0.0147, 0.001))
    assert found.doubt.startswith('rows are read over 14.7 +- 1.0 ')
    found.adopt(ReadoutEstimate(0.0005, 0.001))
    assert (found.estimate.seconds, found.doubt) == (0.0005, '')


def test_another_map_needs_evidence_of_its_own():
    mapper, _ = flown(brisk, 0.016, seconds=0.5)
    assert mapper.readout.estimate.seconds > 0.0
    mapper.reset()
    assert mapper.readout.estimate == ReadoutEstimate(0.0, CONFIG.readout_time_std)
