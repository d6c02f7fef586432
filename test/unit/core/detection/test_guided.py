"""Guided detection: known markers where the filter says they are, and nothing where they are not."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.scenes import motion_prior

from thermal_fiducial.config import ArucoDetectorConfig
from thermal_fiducial.core.detection.detector import MarkerDetector
from thermal_fiducial.core.detection.prediction.known_markers import KnownMarkers
from thermal_fiducial.core.geometry import se3
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.measurements import corners_px, Odometry
from thermal_fiducial.files.dictionary import load_dictionary
from thermal_fiducial.sim.scenario import named, with_contrast
from thermal_fiducial.sim.thermal_camera import render_frames

SCENARIO = named('wall')
LENS = SCENARIO.lens
CAMERA = Camera(LENS.width, LENS.height, LENS.matrix, LENS.model, LENS.distortion)
NONE = np.zeros(0, dtype=np.int64)
MAP = {marker.id: (marker.T_map_marker, marker.size) for marker in SCENARIO.markers}
CONFIG = ArucoDetectorConfig(
    camera_position=SCENARIO.camera_position,
    camera_orientation=tuple(Rotation.from_quat(SCENARIO.camera_orientation).as_quat()),
)


def frames(contrast, count=4):
    sensor = replace(
        SCENARIO.sensor, pixel_growth=0.0, column_growth=0.0, column_pattern=0.01, bad_pixel_share=0.0, ffc_period=0.0
    )
    scenario = replace(with_contrast(SCENARIO, contrast), sensor=sensor)
    scenario = replace(scenario, acrylic=replace(scenario.acrylic, steady=0.0))
    return list(render_frames(scenario, seconds=20.0, seed=3, start=120, stop=120 + count))


def odometry(frame, shift=(0.003, -0.002, 0.002)):
    T = frame.T_map_camera @ se3.inverse(SCENARIO.T_body_camera)
    T = se3.transform(T[:3, :3], T[:3, 3] + shift)
    return Odometry(frame.stamp_ns, T, np.zeros(3), np.zeros(3), 1e-6 * np.eye(6), 1e-2 * np.eye(6))


def detector(**changes):
    found = MarkerDetector(replace(CONFIG, **changes), load_dictionary('DICT_4X4_50'))
    found.set_map(MAP)
    return found


def test_expected_markers_are_those_in_view():
    frame = frames(8.0, 1)[0]
    expected = KnownMarkers(MAP, np.ones(50)).expected(se3.inverse(frame.T_map_camera), CAMERA, 12.0, NONE)
    assert set(frame.corners_px) >= set(expected.ids.tolist())
    for marker_id, corners in zip(expected.ids.tolist(), CAMERA.distort(expected.x), strict=True):
        np.testing.assert_allclose(corners, frame.corners_px[marker_id], atol=1e-6)
    assert np.all(expected.depth > 1.0)
    others = KnownMarkers(MAP, np.ones(50)).expected(se3.inverse(frame.T_map_camera), CAMERA, 12.0, expected.ids[1:])
    np.testing.assert_array_equal(others.x, expected.x[:1])
    assert len(KnownMarkers({}, np.ones(50)).expected(np.eye(4), CAMERA, 12.0, NONE).ids) == 0


def test_finds_markers_of_the_noise_s_own_contrast():
    guided, blind, expected = detector(), detector(guided=False), 0
    seen = {guided: 0, blind: 0}
    for frame in frames(0.05):
        expected += len(frame.corners_px)
        for each in seen:
            rows = each.detect(frame.stamp_ns, frame.counts, CAMERA, motion_prior(odometry(frame)))
            truth = np.array([frame.corners_px[marker_id] for marker_id in rows['id'].tolist()]).reshape(-1, 4, 2)
            error = np.linalg.norm((corners_px(rows) - truth).mean(axis=1), axis=-1)
            # A third of a cell: at this contrast a corner is good to a pixel or two, a marker's centre is better.
            assert error.max(initial=0.0) < 4.0
            seen[each] += len(rows)
    assert seen[guided] >= 0.9 * expected
    assert seen[blind] < 0.5 * expected


def shape_error(each, shown, counts):
    """Rms of the corners' errors [px] without what each marker's four have in common."""
    rows = each.detect(shown.stamp_ns, counts, CAMERA, motion_prior(odometry(shown)))
    truth = np.stack([shown.corners_px[marker_id] for marker_id in rows['id'].tolist()])
    error = corners_px(rows) - truth
    return np.sqrt(np.mean((error - error.mean(axis=1, keepdims=True)) ** 2))


def test_columns_of_fixed_pattern_hardly_pull_the_sides():
    shown = frames(0.5, 1)[0]
    columns = np.random.default_rng(7).normal(0.0, 1.0, shown.counts.shape[1])
    pulled = np.rint(shown.counts + columns).astype(np.uint16)
    clean = shape_error(detector(), shown, shown.counts)
    # Left in the image these columns make errors half to three quarters larger; taken out, by up to an eighth.
    assert shape_error(detector(), shown, pulled) < 1.25 * clean


@pytest.mark.parametrize('noise', [1.5, 20.0])
def test_never_invents_a_marker(noise):
    rng, guided = np.random.default_rng(0), detector()
    frame = frames(8.0, 1)[0]
    for index in range(10):
        counts = np.rint(7000 + rng.normal(0, noise, frame.counts.shape)).astype(np.uint16)
        hint = replace(odometry(frame), stamp_ns=frame.stamp_ns + index)
        assert len(guided.detect(frame.stamp_ns + index, counts, CAMERA, motion_prior(hint))) == 0


def test_wrong_prediction_leaves_the_blind_search_to_find_all():
    frame = frames(8.0, 1)[0]
    rows = detector().detect(frame.stamp_ns, frame.counts, CAMERA, motion_prior(odometry(frame, shift=(0.0, 0.4, 0.2))))
    assert rows['id'].tolist() == sorted(frame.corners_px)


def test_a_filter_that_diverges_blinds_no_detector():
    """As with an IMU in degrees a second: none was found in six of eight frames, and the pose ran away unseen."""
    turning = {'angular_velocity_body': np.array([0.0, 15.0, 0.0]), 'twist_covariance': 1e-4 * np.eye(6)}
    each = detector()
    for frame in frames(8.0, 8):
        hint = motion_prior(replace(odometry(frame), **turning))
        rows = each.detect(frame.stamp_ns, frame.counts, CAMERA, hint)
        assert rows['id'].tolist() == sorted(frame.corners_px)
        truth = np.array([frame.corners_px[marker_id] for marker_id in rows['id'].tolist()])
        # Of 512 coordinates one is beyond four standard deviations in thirty draws.
        assert np.all(np.abs(corners_px(rows) - truth).max(axis=(1, 2)) < 4.0 * rows['sigma_px'])


@pytest.mark.parametrize('rate', [8.6, 30.0, pytest.param(60.0, marks=pytest.mark.nightly)])
def test_a_marker_that_is_not_mapped_is_found_as_soon_at_any_frame_rate(rate):
    """It comes into view while the mapped ones are where odometry has them: within the period and a frame more."""
    (frame,) = frames(8.0, 1)
    found, new = detector(), max(frame.corners_px)
    found.set_map({key: place for key, place in MAP.items() if key != new})
    hidden, corners = frame.counts.copy(), np.rint(frame.corners_px[new]).astype(int)
    (left, top), (right, bottom) = corners.min(axis=0) - 12, corners.max(axis=0) + 12
    hidden[top:bottom, left:right] = np.median(hidden[top:bottom, left:right])
    stamps = frame.stamp_ns + np.rint(1e9 / rate * np.arange(int(2.6 * rate))).astype(int)
    appears, seen = int(1.3 * rate), []
    for k, stamp_ns in enumerate(stamps.tolist()):
        counts = hidden if k < appears else frame.counts
        prior = motion_prior(odometry(replace(frame, stamp_ns=stamp_ns), shift=(0.0, 0.0, 0.0)))
        seen.append(new in found.detect(stamp_ns, counts, CAMERA, prior)['id'])
    # Searches alternate between two resolutions, of which one shows it at once.
    assert seen.index(True) - appears <= rate * 2.0 * CONFIG.blind_period + 1.0
    assert all(seen[seen.index(True) :])


def test_branch_follows_the_map():
    frame = frames(8.0, 1)[0]
    rows = detector().detect(frame.stamp_ns, frame.counts, CAMERA, motion_prior(odometry(frame)))
    for row in rows:
        R = se3.rotation_from_quaternion([row['qx'], row['qy'], row['qz'], row['qw']])
        expected = frame.T_map_camera[:3, :3].T @ MAP[int(row['id'])][0][:3, :3]
        assert np.linalg.norm(se3.so3_log(R @ expected.T)) < np.radians(6.0)
