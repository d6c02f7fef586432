"""Markers of the last frame looked for where the motion has carried them, without a map or odometry."""

import cv2
import numpy as np
import pytest

from thermal_fiducial.config import ArucoDetectorConfig
from thermal_fiducial.core.detection.detector import MarkerDetector
from thermal_fiducial.core.detection.finding.search import BlindSearch
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.measurements import corners_px
from thermal_fiducial.files.dictionary import load_dictionary

DICTIONARY = load_dictionary('DICT_4X4_50')
BITS = DICTIONARY.bits
CAMERA = Camera(640, 512, np.array([[600.0, 0, 319.5], [0, 600.0, 255.5], [0, 0, 1]]))
PERIOD_NS = 33_333_333
#: Pixels that the markers move to the right in a frame.
SPEED = 3


def frame(index, rng, shown=(4, 7)):
    """Two markers of 60 px in white plates, moving."""
    image = np.full((512, 640), 7000.0)
    for k, marker_id in enumerate(shown):
        u, v = 100 + SPEED * index, 80 + 200 * k
        image[v - 10 : v + 70, u - 10 : u + 70] = 7040.0
        image[v : v + 60, u : u + 60] = 7000.0 + 40.0 * np.kron(np.pad(BITS[marker_id], 1), np.ones((10, 10)))
    return np.rint(image + rng.normal(0.0, 2.0, image.shape)).astype(np.uint16)


def lagging_frame(index, rng, speed_px, tau, contrast=20.0):
    """Three markers of 36 px in white plates, faint as a rule, moving right [px/s], seen through a lag [s]."""
    image = np.full((512, 640), 7000.0)
    for k, marker_id in enumerate((4, 7, 9)):
        v, u = 60 + 150 * k, 60
        image[v - 6 : v + 42, u - 6 : u + 42] = 7000.0 + contrast
        image[v : v + 36, u : u + 36] = 7000.0 + contrast * np.kron(np.pad(BITS[marker_id], 1), np.ones((6, 6)))
    frequency = 2.0 * np.pi * np.fft.rfftfreq(640)
    optics = np.exp(-0.5 * (0.6 * frequency) ** 2)
    place = np.exp(-1j * frequency * speed_px * index * PERIOD_NS * 1e-9)
    image = np.fft.irfft(np.fft.rfft(image) * optics * place / (1.0 - 1j * frequency * speed_px * tau), n=640)
    return np.rint(image + rng.normal(0.0, 2.0, image.shape)).astype(np.uint16)


def test_fast_faint_markers_keep_their_shape():
    detector = MarkerDetector(ArucoDetectorConfig(bolometer_lag=0.010), DICTIONARY)
    rng, errors = np.random.default_rng(4), []
    for k in range(16):
        rows = detector.detect(k * PERIOD_NS, lagging_frame(k, rng, 450.0, 0.010), CAMERA)
        if k >= 3:
            assert rows['id'].tolist() == [4, 7, 9]
            corners = corners_px(rows)
            shape = corners - corners.mean(axis=1, keepdims=True)
            errors.append(shape - 18.0 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]))
    # Noise of a tenth of the contrast, doubled by deblurring, makes 0.2 px of 36 px sides; a tail of 4.5 px that passes
    # for a symmetric blur makes a pixel of each.
    assert np.sqrt(np.mean(np.square(errors))) < 0.35


def half_of_another(whole, rng):
    """Marker 30 of 30 px, or its right half alone, which is marker 17 seen from 60 degrees to the side."""
    image, left = np.full((512, 640), 7000.0), 0 if whole else 15
    image[90:140, 190 + left : 240] = 7400.0
    image[100:130, 200 + left : 230] = 7000.0 + 400.0 * np.kron(np.pad(BITS[30], 1), np.ones((5, 5)))[:, left:]
    return np.rint(cv2.GaussianBlur(image, (0, 0), 0.6) + rng.normal(0.0, 2.0, image.shape)).astype(np.uint16)


@pytest.mark.parametrize('seed', range(5))
def test_what_resembles_a_half_of_a_marker_is_followed_no_longer_than_until_the_whole_is_seen(seed):
    """As in a flight through motion blur, where 17 was followed for 1.5 s in the half of 30, which hid the whole."""
    detector, rng = MarkerDetector(ArucoDetectorConfig(), DICTIONARY), np.random.default_rng(seed)
    seen = [detector.detect(k * PERIOD_NS, half_of_another(k >= 4, rng), CAMERA)['id'].tolist() for k in range(8)]
    assert seen[1:4] == [[17]] * 3
    # A blind search is due every other frame.
    assert seen[6:] == [[30]] * 2


def test_the_second_frame_knows_the_motion_and_sharpens_by_it():
    detector = MarkerDetector(ArucoDetectorConfig(bolometer_lag=0.010), DICTIONARY)
    rng, speed = np.random.default_rng(4), 450.0
    for k in range(2):
        rows = detector.detect(k * PERIOD_NS, lagging_frame(k, rng, speed, 0.010, contrast=400.0), CAMERA)
    assert rows['id'].tolist() == [4, 7, 9]
    corners = corners_px(rows)
    left = 59.5 + speed * PERIOD_NS * 1e-9
    # Edges blurred by 4.5 px, taken for sharp ones, seem to lie less than that behind: corners would be 2.7 px ahead.
    # What the first frame's are off by, unknown, is a tenth of the way between the frames.
    assert np.abs(corners[:, [0, 3], 0] - left).max() < 0.6


def test_errors_by_unknown_motion_are_within_their_covariance():
    detector = MarkerDetector(ArucoDetectorConfig(bolometer_lag=0.010), DICTIONARY)
    rng, speed = np.random.default_rng(4), 450.0
    for k in range(4):
        rows = detector.detect(k * PERIOD_NS, lagging_frame(k, rng, speed, 0.010, contrast=400.0), CAMERA)
        corners = corners_px(rows)
        off = (corners[:, [0, 3], 0] - 59.5 - speed * k * PERIOD_NS * 1e-9).mean()
        # All are off alike, by no more than three standard deviations of one while nothing shows the motion.
        if k < 2:
            assert abs(off) < 3.0 * rows['sigma_px'].max()
    assert rows['sigma_px'].max() < 0.2


@pytest.fixture
def searches(monkeypatch):
    """How often a frame was searched blindly."""
    count = []
    search = BlindSearch.search
    monkeypatch.setattr(BlindSearch, 'search', lambda *args: count.append(1) or search(*args))
    return count


def test_seen_markers_are_followed(searches):
    detector = MarkerDetector(ArucoDetectorConfig(bolometer_lag=0.0), DICTIONARY)
    rng = np.random.default_rng(1)
    for k in range(11):
        rows = detector.detect(k * PERIOD_NS, frame(k, rng), CAMERA)
        assert rows['id'].tolist() == [4, 7]
        top_left = corners_px(rows)[:, 0]
        # Noise of a tenth of the contrast's half leaves some hundredths of a pixel; refined is refined.
        np.testing.assert_allclose(top_left, [[99.5 + SPEED * k, 79.5], [99.5 + SPEED * k, 279.5]], atol=0.2)
    # Two frames until the motion is known, then every second.
    assert len(searches) == 6


def test_a_marker_that_is_gone_is_not_followed(searches):
    detector = MarkerDetector(ArucoDetectorConfig(bolometer_lag=0.0), DICTIONARY)
    rng = np.random.default_rng(2)
    for k in range(4):
        detector.detect(k * PERIOD_NS, frame(k, rng), CAMERA)
    before = len(searches)
    rows = detector.detect(4 * PERIOD_NS, frame(4, rng, shown=(4, 9)), CAMERA)
    # What is missing where it should be starts a search, which finds what stands there instead.
    assert rows['id'].tolist() == [4, 9]
    assert len(searches) == before + 1


def test_nothing_is_followed_across_a_gap(searches):
    detector = MarkerDetector(ArucoDetectorConfig(bolometer_lag=0.0), DICTIONARY)
    rng = np.random.default_rng(3)
    for k in range(6):
        detector.detect(k * 10**9, frame(k, rng), CAMERA)
    assert len(searches) == 6
