"""Markers away from their predictions, as far as the predicted camera is uncertain."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.scenes import motion_prior

from thermal_fiducial.config import ArucoDetectorConfig
from thermal_fiducial.core.detection.detector import MarkerDetector
from thermal_fiducial.core.detection.finding.drifted import drifted_markers, halvings, MarkerTemplate, NOT_THERE
from thermal_fiducial.core.detection.finding.quads import halved
from thermal_fiducial.core.detection.patterns import Decoder
from thermal_fiducial.core.geometry import se3
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.geometry.reprojection import sides_px
from thermal_fiducial.core.measurements import Odometry
from thermal_fiducial.files.dictionary import load_dictionary
from thermal_fiducial.sim.scenario import named, with_contrast
from thermal_fiducial.sim.thermal_camera import render_frames

SCENARIO = named('wall')
LENS = SCENARIO.lens
CAMERA = Camera(LENS.width, LENS.height, LENS.matrix, LENS.model, LENS.distortion)
MAP = {marker.id: (marker.T_map_marker, marker.size) for marker in SCENARIO.markers}
CONFIG = ArucoDetectorConfig(
    camera_position=SCENARIO.camera_position,
    camera_orientation=tuple(Rotation.from_quat(SCENARIO.camera_orientation).as_quat()),
)
TAGS = load_dictionary('DICT_APRILTAG_36h11')
DECODER = Decoder(TAGS.bits, TAGS.correctable)
#: Of a camera at 3 m with a focal length of 400 px: centres move with it to the side, and turn with it.
FLOW = np.array([[-133.0, 0.0, 0.0, 0.0, -400.0, 0.0], [0.0, -133.0, 0.0, 400.0, 0.0, 0.0]])
BOTH = 1.0, -1.0
#: Odds that say nothing: of a hundred squares of random bits one has five times as much.
UNDECIDED = 1.0


def square(centre, side):
    half = 0.5 * side
    return np.array(centre) + np.array([[-half, -half], [half, -half], [half, half], [-half, half]])


def drawn(markers, noise=0.0, shape=(240, 320), sign=1.0, seed=0):
    """An image of ID to corners (4, 2), black and white 1 apart, blurred by 0.7 px, on plates that are a cell wider."""
    finer = 4
    image = np.zeros((shape[0] * finer, shape[1] * finer), dtype=np.float32)
    for marker_id, corners in markers.items():
        pattern = np.pad(DECODER.patterns(np.array([marker_id]), np.array([0]))[0], 1, constant_values=1.0)
        cells = np.kron(pattern, np.ones((8, 8))).astype(np.float32)
        edge = 8.0 * np.array([[1, 1], [9, 1], [9, 9], [1, 9]], dtype=np.float32) - 0.5
        to = cv2.getPerspectiveTransform(edge, (finer * (corners + 0.5) - 0.5).astype(np.float32))
        size = image.shape[::-1]
        there = cv2.warpPerspective(np.ones_like(cells), to, size)
        image = np.where(there > 0.5, cv2.warpPerspective(cells, to, size), image)
    image = cv2.resize(cv2.GaussianBlur(image, (0, 0), 0.7 * finer), shape[::-1], interpolation=cv2.INTER_AREA)
    rng = np.random.default_rng(seed)
    return (sign * image + rng.normal(0.0, noise, shape)).astype(np.float32)


def template_of(image, marker_id, corners, reach, polarities=BOTH):
    images = [image]
    for _ in range(halvings(sides_px(corners[None])[0] / DECODER.cells)):
        images.append(halved(images[-1]))
    return MarkerTemplate(images, marker_id, corners, np.full(2, reach), polarities, DECODER)


@pytest.mark.parametrize('sign', BOTH)
@pytest.mark.parametrize('side', [12.0, 30.0, 90.0])
def test_a_template_is_found_where_the_marker_is(side, sign):
    there = square((160.3, 118.8), side)
    image = drawn({7: there}, noise=0.05, sign=sign)
    match = template_of(image, 7, there + np.array([21.0, -13.0]), 40.0).best(np.zeros(2), np.full(2, 40.0))
    # Half of a cell is near enough; as drawn it is a tenth.
    np.testing.assert_allclose(match.shift_px, (-21.0, 13.0), atol=0.2 * side / DECODER.cells)
    # Odds of a hundred to one. Cells of 1.5 px that are blurred by half of that have 5, wider ones 50 and more.
    assert match.gain > np.log(100.0)


def test_of_another_polarity_or_outside_the_image_there_is_no_match():
    there = square((160.0, 120.0), 30.0)
    image = drawn({7: there}, noise=0.05)
    other = template_of(image, 7, there + 9.0, 40.0, polarities=(-1.0,)).best(np.zeros(2), np.full(2, 40.0))
    assert other.gain < UNDECIDED
    outside = template_of(image, 7, square((-60.0, 120.0), 30.0), 20.0)
    assert outside.best(np.zeros(2), np.full(2, 20.0)) is NOT_THERE


def test_a_plain_square_is_no_evidence_of_a_marker():
    there = square((160.0, 120.0), 30.0)
    image = drawn({}, noise=0.05)
    cv2.fillConvexPoly(image, np.rint(there).astype(np.int32), 1.0)
    match = template_of(image, 7, there, 20.0, polarities=(1.0,)).best(np.zeros(2), np.full(2, 20.0))
    assert match.gain < UNDECIDED


def places(markers, image, covariance, shift):
    """Which of the markers are found, and the largest error of their centres [px], predicted so far off."""
    ids = np.array(list(markers))
    corners = np.stack(list(markers.values()))
    flow = np.repeat(FLOW[None], len(ids), axis=0)
    found, moved = drifted_markers(image, ids, corners + shift, flow, covariance, 80.0, (1.0,), DECODER)
    off = np.linalg.norm((moved - corners).mean(axis=1), axis=1)
    return ids[found].tolist(), off[found].max(initial=0.0)


def test_faint_markers_confirm_each_other():
    """At this noise no single one is certain among as many places, of five together there is no doubt."""
    grid = {3: (60, 60), 8: (140, 90), 21: (220, 60), 30: (100, 160), 41: (200, 170)}
    markers = {key: square(centre, 13.0) for key, centre in grid.items()}
    uncertain, alone, together = np.diag([0.1**2] * 3 + [0.02**2] * 3), [], []
    for seed in range(6):
        image = drawn(markers, noise=0.35, seed=seed)
        found, off = places(markers, image, uncertain, (17.0, -9.0))
        together.append(len(found))
        # Half a cell, from which a marker is found at its prediction.
        assert off < 0.5 * 13.0 / 8.0 + 0.5
        alone += [len(places({key: corners}, image, uncertain, (17.0, -9.0))[0]) for key, corners in markers.items()]
    # As drawn 30 of 30 and none; at a noise of a half 15 of 30.
    assert sum(together) >= 24
    assert sum(alone) <= 3


def test_nothing_is_found_in_noise_or_among_other_markers():
    others = {50 + k: square((40.0 + 60.0 * (k % 4), 50.0 + 60.0 * (k // 4)), 20.0) for k in range(12)}
    markers = {k: square((50.0 + 55.0 * (k % 4), 60.0 + 60.0 * (k // 4)), 20.0) for k in range(8)}
    uncertain = np.diag([0.1**2] * 3 + [0.02**2] * 3)
    for seed in range(8):
        assert places(markers, drawn({}, noise=0.2, seed=seed), uncertain, (0.0, 0.0))[0] == []
        assert places(markers, drawn(others, noise=0.05, seed=seed), uncertain, (seed, -seed))[0] == []


def test_a_certain_prediction_is_not_searched_around():
    there = {7: square((160.0, 120.0), 30.0)}
    image = drawn(there, noise=0.02)
    certain = np.diag([0.002**2] * 3 + [0.0005**2] * 3)
    assert places(there, image, certain, (15.0, 0.0)) == ([], 0.0)


def odometry(frame, shift, std_m):
    T = frame.T_map_camera @ se3.inverse(SCENARIO.T_body_camera)
    T = se3.transform(T[:3, :3], T[:3, 3] + shift)
    covariance = np.diag([std_m**2] * 3 + [(0.2 * std_m) ** 2] * 3)
    return Odometry(frame.stamp_ns, T, np.zeros(3), np.zeros(3), covariance, 1e-2 * np.eye(6))


def test_a_filter_that_has_drifted_finds_faint_markers_again():
    """At the contrast of a pixel's noise, and 13 cm, 30 px, away from where they are predicted."""
    sensor = replace(
        SCENARIO.sensor, pixel_growth=0.0, column_growth=0.0, column_pattern=0.01, bad_pixel_share=0.0, ffc_period=0.0
    )
    scenario = replace(with_contrast(SCENARIO, 0.05), sensor=sensor)
    scenario = replace(scenario, acrylic=replace(scenario.acrylic, steady=0.0))
    drifted, surer, expected = [], [], 0
    for frame in render_frames(scenario, seconds=20.0, seed=3, start=120, stop=124):
        expected += len(frame.corners_px)
        for std_m in (0.07, 0.002):
            detector = MarkerDetector(CONFIG, load_dictionary('DICT_4X4_50'))
            detector.set_map(MAP)
            prior = motion_prior(odometry(frame, (0.02, 0.11, -0.06), std_m))
            found = len(detector.detect(frame.stamp_ns, frame.counts, CAMERA, prior))
            (drifted if std_m > 0.01 else surer).append(found)
    # As drawn 22 and 9 of 32: the blind search finds a quarter.
    assert sum(drifted) >= 0.6 * expected
    assert sum(surer) < 0.4 * expected
