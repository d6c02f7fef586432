"""Blind search and decoding: what is found, and above all what is not."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from thermal_fiducial.config import ArucoDetectorConfig
from thermal_fiducial.core.camera_frames import pixel_noise
from thermal_fiducial.core.detection.confirmation import confirmed
from thermal_fiducial.core.detection.corners.gray_scale import UNKNOWN_SCALE
from thermal_fiducial.core.detection.corners.refining import refine
from thermal_fiducial.core.detection.detector import MarkerDetector
from thermal_fiducial.core.detection.finding.finder import near_prediction
from thermal_fiducial.core.detection.finding.search import BlindSearch, overlapped, SearchScales
from thermal_fiducial.core.detection.patterns import Decoder, Dictionary, Reading, sampled, shrunk
from thermal_fiducial.core.detection.prediction.frame import Frame, Places
from thermal_fiducial.core.detection.prediction.known_markers import ExpectedMarkers, FoundMarkers
from thermal_fiducial.core.detection.prediction.tracking import MotionTrack
from thermal_fiducial.core.detection.prediction.twist import UNKNOWN_TWIST
from thermal_fiducial.core.geometry.camera import Camera, ImagePoints
from thermal_fiducial.files.dictionary import load_dictionary

BITS = load_dictionary('DICT_4X4_50').bits
DECODER = Decoder(BITS)
SEARCH = BlindSearch(DECODER)
EVERY = np.ones(len(BITS), dtype=bool)


def scene(marker_id, contrast, noise, seed=0, slope=0.0):
    """A marker of 72 px at (200, 150) in a white plate on a grey wall, upright."""
    rng = np.random.default_rng(seed)
    image = np.full((512, 640), 7000.0 + 0.5 * contrast, dtype=np.float32)
    image[138:234, 188:284] = 7000.0 + contrast
    image[150:222, 200:272] = 7000.0 + contrast * np.kron(np.pad(BITS[marker_id], 1), np.ones((12, 12)))
    image += slope * np.arange(640, dtype=np.float32)
    return (image + rng.normal(0, noise, image.shape)).astype(np.float32)


CORNERS = np.array([[199.5, 149.5], [271.5, 149.5], [271.5, 221.5], [199.5, 221.5]])


def frame_of(image):
    height, width = image.shape
    camera = Camera(width, height, [[500.0, 0, width / 2], [0, 500.0, height / 2], [0, 0, 1]])
    return Frame(0, image, pixel_noise(image), camera, None, 0.0, 0.0, ArucoDetectorConfig().blur_px, image)


def search(image, config=None, allowed=EVERY, scales=SearchScales.ALL):
    return SEARCH.search(frame_of(image), allowed, config or ArucoDetectorConfig(), FoundMarkers.none(), scales)


def test_more_outlines_than_opencv_interpolates_at_once():
    """As a picture of a fine grid has: 2^15 rows are too many for it."""
    image = scene(13, 100.0, 1.0)
    places = np.random.default_rng(0).uniform(0.0, 500.0, (2, 40_000, 3)).astype(np.float32)
    found = sampled(image, places)
    parts = [sampled(image, part) for part in np.split(places, 8, axis=1)]
    np.testing.assert_array_equal(found, np.concatenate(parts))


@pytest.mark.parametrize('turn', range(4))
@pytest.mark.parametrize('sign', [1.0, -1.0])
def test_decoder_names_id_turn_and_polarity(turn, sign):
    image = scene(13, sign * 100.0, 1.0, slope=0.5)
    quad = np.roll(CORNERS, -turn, axis=0)[None]
    reading = DECODER.read(image, quad, EVERY)
    assert reading.ids[0] == 13
    np.testing.assert_allclose(np.roll(quad[0], reading.turns[0], axis=0), CORNERS)
    assert sign * reading.correlation[0] > 0.99
    assert reading.contrast[0] == pytest.approx(sign * 100.0, rel=0.05)
    assert reading.bit_errors[0] == 0


def test_plate_shrinks_to_its_marker():
    plate = np.array([[[187.5, 137.5], [283.5, 137.5], [283.5, 233.5], [187.5, 233.5]]])
    np.testing.assert_allclose(shrunk(plate, DECODER.cells, 1.0)[0], CORNERS, atol=1e-9)


@pytest.mark.parametrize('contrast', [400.0, 20.0, 6.0, -20.0])
def test_finds_the_marker_at_any_contrast(contrast):
    found = search(scene(21, contrast, 2.0))
    assert found.ids.tolist() == [21]
    assert np.abs(found.corners_px[0] - CORNERS).max() < 4.0  # a third of a cell, which the refinement catches


def in_plate(marker_id, contrast, surroundings):
    """A marker of 28 px in a plate of 40 px at (95, 135), before ``surroundings``, with noise of 1."""
    rng = np.random.default_rng(marker_id)
    image = 7000.0 + surroundings.astype(np.float32)
    image[95:135, 135:175] = 7000.0 + contrast
    bits = np.pad(BITS[marker_id], 1).astype(np.float32)
    image[101:129, 141:169] = 7000.0 + contrast * cv2.resize(bits, (28, 28), interpolation=cv2.INTER_AREA)
    return (cv2.GaussianBlur(image, (0, 0), 0.7) + rng.normal(0.0, 1.0, image.shape)).astype(np.float32)


def found_of_thirty(contrast, surroundings, scales=SearchScales.ALL):
    return sum(search(in_plate(k, contrast, surroundings), scales=scales).ids.tolist() == [k] for k in range(30))


def touching_flame(warmth):
    flame = np.zeros((256, 320))
    flame[90:140, 175:200] = warmth
    return flame


# When written: 29, 25, 25, 30 of 30; without a bound on what counts for the contrast 22, 1, none, none.
@pytest.mark.parametrize(('warmth', 'gap_px'), [(5.0, 0), (20.0, 4), (40.0, 4), (40.0, 15)])
def test_something_hot_in_view_does_not_hide_a_marker(warmth, gap_px):
    flame = np.zeros((256, 320))
    flame[90:140, 175 + gap_px : 200 + gap_px] = 40.0 * warmth
    assert found_of_thirty(40.0, flame) >= 18


def test_the_edge_of_a_cold_sky_does_not_hide_a_marker():
    sky = np.zeros((256, 320))
    sky[:91] = -2000.0
    # 29 when written, none without the bound.
    assert found_of_thirty(8.0, sky) >= 24


# When written: 30, 30, 26; unclipped 2, none, 7.
@pytest.mark.parametrize(('contrast', 'warmth'), [(40.0, 20.0), (8.0, 100.0), (160.0, 20.0)])
def test_a_flame_that_touches_a_plate_does_not_hide_it_where_counts_are_clipped(contrast, warmth):
    assert found_of_thirty(contrast, touching_flame(contrast * warmth), SearchScales.ALL | SearchScales.CLIPPED) >= 22


# When written: 30, 30, 29; unclipped 2, 8, 20.
@pytest.mark.parametrize('contrast', [8.0, 20.0, 40.0])
def test_the_edge_of_a_warm_panel_does_not_hide_a_plate_beside_it_where_counts_are_clipped(contrast):
    panel = np.zeros((256, 320))
    panel[:, :131] = 1000.0
    assert found_of_thirty(contrast, panel, SearchScales.ALL | SearchScales.CLIPPED) >= 27


@pytest.mark.parametrize(('chosen', 'found'), [((), [[3], []]), ((3, 1023), [[3], []])])
def test_a_marker_that_looks_the_same_upside_down_is_not_found(chosen, found):
    """As its pose is one of two: a window in a panel, which is 1023, the only such marker of OpenCV's dictionaries."""
    dictionary, ids = load_dictionary('DICT_ARUCO_ORIGINAL'), []
    for marker_id in (3, 1023):
        image = np.full((256, 320), 7200.0)
        image[101:164, 141:204] = 7000.0 + 200.0 * np.kron(np.pad(dictionary.bits[marker_id], 1), np.ones((9, 9)))
        image = np.rint(cv2.GaussianBlur(image, (0, 0), 0.7)).astype(np.uint16)
        detector = MarkerDetector(ArucoDetectorConfig(whitelist=chosen), dictionary)
        ids.append(detector.detect(1, image, frame_of(image.astype(np.float32)).camera)['id'].tolist())
    assert ids == found


def test_counts_are_clipped_in_turn_until_a_marker_is_found():
    detector = MarkerDetector(ArucoDetectorConfig(), Dictionary(BITS, 1))
    image = np.rint(in_plate(3, 40.0, touching_flame(800.0))).astype(np.uint16)
    camera = frame_of(image).camera
    ids = [detector.detect(frame * 33_333_333, image, camera)['id'].tolist() for frame in range(1, 5)]
    assert ids == [[], [3], [3], [3]]


def test_faint_markers_brighter_than_all_round_are_found():
    """Twice the noise of a pixel; their white is the wall's, so that no plate shows."""
    found = []
    for seed in range(5):
        rng = np.random.default_rng(seed)
        image = np.full((512, 640), 7000.0)
        image[150:222, 200:272] += 2.0 * (1.0 - np.kron(np.pad(BITS[21], 1), np.ones((12, 12))))
        found += search((image + rng.normal(0.0, 1.0, image.shape)).astype(np.float32)).ids.tolist()
    # All when written, none when only what is darker than its surroundings is followed.
    assert found.count(21) >= 4


@pytest.mark.parametrize(('side', 'half_cells'), [(16, 2), (14, 3), (14, 4), (13, 2)])
@pytest.mark.parametrize('contrast', [2000.0, 100.0])
def test_bright_markers_far_away_are_found(contrast, side, half_cells):
    """Plates on a cold wall, whose white and that of bits swamps the border of less than three pixels between."""
    rng = np.random.default_rng(4)
    shown = rng.choice(len(BITS), 12, replace=False)
    fine = np.zeros((10 * 512, 10 * 640), dtype=np.float32)
    first = 1003 * np.stack(np.divmod(np.arange(12), 4), axis=-1) + 1000
    for marker_id, (v, u) in zip(shown.tolist(), first.tolist(), strict=True):
        plate = np.pad(np.kron(np.pad(BITS[marker_id], 1), np.ones((2, 2))), half_cells, constant_values=1.0)
        width = 10 * side * len(plate) // 12
        fine[v : v + width, u : u + width] = cv2.resize(plate, (width, width), interpolation=cv2.INTER_NEAREST)
    image = cv2.GaussianBlur(cv2.resize(fine, (640, 512), interpolation=cv2.INTER_AREA), (0, 0), 0.6)
    found = search((7000.0 + contrast * image + rng.normal(0.0, 1.25, image.shape)).astype(np.float32))
    # By four seeds 11 or 12 of 12; of 13 px 5 to 9 when the search smooths by a pixel and outlines end at the centres
    # of pixels. At most 2 when only the outlines themselves are read, and 1 to 7 with more than one cell around when
    # all plates are taken to end one cell outside.
    assert len(set(found.ids.tolist()) & set(shown.tolist())) >= 11


@pytest.mark.parametrize('sign', [1.0, -1.0])
def test_one_marker_at_a_place(sign):
    """A marker without much of a surround, the edge of its plate, bits in it, an inaccurate outline, another marker."""
    correlation = sign * np.array([0.96, -0.89, -0.88, 0.79, -0.9])
    reading = Reading(
        np.array([19, 10, 17, 32, 4]),
        np.zeros(5, dtype=np.int64),
        correlation,
        np.full(5, 0.6),
        100.0 * correlation,
        np.zeros(5, dtype=np.int64),
        np.array([0.5, 1.2, 0.9, 0.6, 1.0]),
    )
    factor = np.array([1.0, 1.5, 0.6, 1.1, 1.0])[:, None, None]
    quads = CORNERS.mean(axis=0) + factor * (CORNERS - CORNERS.mean(axis=0))
    quads[4] += 200.0
    everything = np.ones(5, dtype=bool)
    assert overlapped(reading, quads, everything, everything).tolist() == [False, True, True, True, False]
    # A marker that is only readable keeps the edge of its plate out, what cannot be read is no evidence.
    edge_and_other = np.array([False, True, False, False, True])
    assert overlapped(reading, quads, edge_and_other, everything).tolist() == [False, True, False, False, False]
    assert not overlapped(reading, quads, edge_and_other, edge_and_other).any()


def test_what_is_seen_already_is_not_searched_for():
    image = scene(21, 100.0, 2.0)
    image[300:396, 400:496] = scene(8, 100.0, 2.0)[138:234, 188:284]
    frame, one = frame_of(image), np.ones(1, dtype=bool)
    places = Places.of(ImagePoints.at(CORNERS[None], frame.camera), np.ones((1, 4)))
    seen = FoundMarkers(np.array([21]), places, np.ones(1), one, one)
    found = SEARCH.search(frame, EVERY, ArucoDetectorConfig(), seen)
    assert found.ids.tolist() == [8]


@pytest.mark.parametrize('scales', [SearchScales.FINE, SearchScales.FAINT])
@pytest.mark.parametrize('sign', [1.0, -1.0])
def test_either_resolution_shows_a_clear_marker(scales, sign):
    image = scene(21, 50.0 * sign, 2.0)
    found = SEARCH.search(frame_of(image), EVERY, ArucoDetectorConfig(), FoundMarkers.none(), scales)
    assert found.ids.tolist() == [21]


def test_rules():
    image = scene(21, 100.0, 2.0)
    image[300:396, 400:496] = image[138:234, 188:284]
    assert search(image).ids.tolist() == []
    assert search(image, ArucoDetectorConfig(duplicates='best')).ids.tolist() == [21]
    alone = scene(21, 100.0, 2.0)
    assert search(alone, allowed=np.arange(50) != 21).ids.tolist() == []
    # Outlines are accurate to a tenth; the marker has 72 px.
    assert search(alone, ArucoDetectorConfig(min_side_px=90.0)).ids.tolist() == []
    assert search(alone, ArucoDetectorConfig(min_contrast=100.0)).ids.tolist() == []


def test_a_marker_at_the_border_may_be_cut_off():
    """Half a cell beyond the image, or with a corner in its outermost pixels, is too near; clear of them is not."""
    image = scene(21, 100.0, 2.0)
    for left, ids in ((206, []), (199, []), (194, [21])):
        cropped = np.ascontiguousarray(image[:, left:])
        assert search(cropped).ids.tolist() == ids


def test_columns_of_fixed_pattern_do_not_hide_a_faint_marker():
    rng = np.random.default_rng(2)
    columns = rng.normal(0.0, 2.0, 640).astype(np.float32)
    found = search(scene(21, 6.0, 2.0) + columns)
    assert found.ids.tolist() == [21]
    assert np.abs(found.corners_px[0] - CORNERS).max() < 4.0


def test_no_markers_in_noise():
    rng = np.random.default_rng(4)
    for frame in range(12):
        noise = rng.normal(0, (1.0, 3.0, 30.0)[frame % 3], (512, 640))
        assert search((7000 + noise).astype(np.float32)).ids.tolist() == []


#: Largest error of an outline from which sides are found [px]: four passes of two blurs of 0.66 px each.
FOUND_FROM_PX = 5.0


def large_scene(marker_id, cell, sign):
    """A marker with cells so wide [px] before a warm plate, its top left corner at (79.5, 59.5), and its corners."""
    grid = np.pad(np.pad(BITS[marker_id], 1), 1, constant_values=1)
    image = np.full((512, 640), -0.5 * sign * 300.0)
    side = 8 * cell
    image[60 - cell : 60 - cell + side, 80 - cell : 80 - cell + side] = (
        sign * 300.0 * np.kron(grid - 0.5, np.ones((cell, cell)))
    )
    image = cv2.GaussianBlur(image, (0, 0), 0.6) + np.random.default_rng(0).normal(7000.0, 1.5, image.shape)
    corners = np.array([79.5, 59.5]) + 6 * cell * np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    return image.astype(np.float32), corners


@pytest.mark.parametrize('sign', [1.0, -1.0])
@pytest.mark.parametrize('cell', [40, 48])
def test_large_markers_are_found_where_their_sides_are(cell, sign):
    """Cells are read in their middles: an outline that was off by a third of a cell read as well as the right one."""
    for marker_id in (0, 7, 17, 49):
        image, corners = large_scene(marker_id, cell, sign)
        found = search(image)
        at = found.ids.tolist().index(marker_id)
        # 1.7 px at most when written; up to 13 px before.
        assert np.abs(found.corners_px[at] - corners).max() < FOUND_FROM_PX


def near(image, marker_id, corners):
    """A marker that is found near a prediction (4, 2) [px]; None if it is not."""
    frame = replace(frame_of(image), twist=UNKNOWN_TWIST)
    expected = ExpectedMarkers(
        np.array([marker_id]), frame.camera.normalise(corners)[None], np.ones((1, 4)), np.zeros(1)
    )
    return near_prediction(frame, expected, DECODER, ArucoDetectorConfig())


@pytest.mark.parametrize('off', [(0.8, 0.3), (-0.5, -0.9), (-0.9, -0.9)])
@pytest.mark.parametrize('cell', [11, 20, 32])
def test_large_markers_off_their_predictions_are_found_where_their_sides_are(cell, off):
    """After seconds without markers a prediction is a centimetre and half a degree off: a cell of a near marker."""
    for marker_id in (0, 7, 17, 49):
        image, corners = large_scene(marker_id, cell, 1.0)
        found = near(image, marker_id, corners + cell * np.array(off))
        assert found.ids.tolist() == [marker_id]
        # 1.2 px at most when written; up to 13 px before.
        assert np.abs(found.places.points.px[0] - corners).max() < FOUND_FROM_PX


@pytest.mark.parametrize('corner', [0, 2])
@pytest.mark.parametrize('radius', [0.8, 1.3])
@pytest.mark.parametrize('cell', [20, 32])
def test_what_covers_a_corner_of_a_large_marker_does_not_draw_it_there(cell, radius, corner):
    """A flame or a hand: the shape of an outline is predicted well, only its place is not."""
    for marker_id in (0, 7, 17, 49):
        image, corners = large_scene(marker_id, cell, 1.0)
        u, v = np.meshgrid(np.arange(640), np.arange(512))
        image[np.hypot(u - corners[corner, 0], v - corners[corner, 1]) < radius * cell] = 7600.0
        found = near(image, marker_id, corners + 0.1 * cell * np.array([1.0, -1.0]))
        assert found.ids.tolist() == [marker_id]
        # 1.8 px at most when written; up to 20 px before.
        assert np.abs(found.places.points.px[0] - corners).max() < FOUND_FROM_PX


@pytest.mark.parametrize('sign', [1.0, -1.0])
@pytest.mark.parametrize(('off', 'count'), [(0.02, 1), (0.3, 0)])
def test_an_expected_marker_has_sides_where_it_is_claimed(off, count, sign):
    """Its cells read as well 14 px off; the fit found no sides there, and claimed the 3 px of its prior."""
    image, corners = large_scene(7, 48, sign)
    frame, yes = frame_of(image), np.ones(1, dtype=bool)
    places = Places.of(ImagePoints.at(corners[None] + 48 * off, frame.camera), np.ones((1, 4)))
    found = FoundMarkers(np.array([7]), places, np.array([200.0]), yes, ~yes)
    config, track = ArucoDetectorConfig(), MotionTrack(np.eye(4), 0.0)
    refined, _ = refine(frame, found, track, UNKNOWN_SCALE, DECODER)
    assert len(confirmed(frame, found, refined, DECODER, config).ids) == count
