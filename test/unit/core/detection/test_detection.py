"""The detector on rendered frames."""

from types import SimpleNamespace

import numpy as np
import pytest
from support.scenes import camera_of

from thermal_fiducial.config import ArucoDetectorConfig
from thermal_fiducial.core.detection.confirmation import DisplayedSides
from thermal_fiducial.core.detection.detector import MarkerDetector
from thermal_fiducial.core.measurements import corner_covariances, corners_px, MARKER_DTYPE
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.dictionary import load_dictionary
from thermal_fiducial.sim.scenario import named
from thermal_fiducial.sim.thermal_camera import render_frames


@pytest.fixture(scope='module')
def frames():
    return [frame for frame in render_frames('wall', seconds=20.0, seed=5, start=120, stop=124) if not frame.shutter]


def new_detector():
    return MarkerDetector(ArucoDetectorConfig(), load_dictionary('DICT_4X4_50'))


@pytest.fixture
def detector():
    return new_detector()


def test_finds_every_marker(frames, detector):
    camera = camera_of(named('wall'))
    for frame in frames:
        rows = detector.detect(frame.stamp_ns, frame.counts, camera)
        assert rows.dtype == MARKER_DTYPE
        assert rows['id'].tolist() == sorted(frame.corners_px)
        truth = np.stack([frame.corners_px[marker_id] for marker_id in rows['id'].tolist()])
        assert np.abs(corners_px(rows) - truth).max() < 1.5


def test_no_markers_give_no_rows(detector):
    rng = np.random.default_rng(0)
    camera = camera_of(named('wall'))
    noise = np.rint(7000 + rng.normal(0, 2, (camera.height, camera.width))).astype(np.uint16)
    rows = detector.detect(0, noise, camera)
    assert rows.dtype == MARKER_DTYPE
    assert len(rows) == 0


def test_a_calibration_of_another_image_size_is_named(detector):
    camera = camera_of(named('wall'))
    with pytest.raises(InputError, match='image of 320x256, camera_info of 640x512 pixels'):
        detector.detect(0, np.zeros((256, 320), np.uint16), camera)


def displayed(counts, bent):
    """What a gain control makes of counts that bends its scale."""
    low, high = np.percentile(counts, [0.1, 99.9])
    return np.rint(255.0 * np.clip((counts - low) / (high - low), 0.0, 1.0) ** bent).astype(np.uint16)


def last_rows(frames, process):
    """Of the last frame, when the motion is known by those before."""
    detector, camera = new_detector(), camera_of(named('wall'))
    return [detector.detect(frame.stamp_ns, process(frame.counts), camera) for frame in frames][-1]


@pytest.mark.parametrize('bent', [0.5, 2.0])
def test_what_a_display_displaces_the_border_shows(frames, bent):
    rows = last_rows(frames, lambda counts: displayed(counts, bent))
    truth = np.stack([frames[-1].corners_px[marker_id] for marker_id in rows['id'].tolist()])
    error = corners_px(rows) - truth
    # A bent scale moves the middle of black and white, and with it all sides alike: by -0.34 px and +0.54 px as long as
    # nothing takes that out, by 0.001 and -0.012 px then.
    outward = np.sum(error * np.sign(truth - truth.mean(axis=1, keepdims=True)), axis=-1).mean()
    assert abs(outward) < 0.04
    nees = np.einsum('nki,nkij,nkj->nk', error, np.linalg.inv(corner_covariances(rows)), error).mean()
    # 2 of a consistent corner; a real camera's scale is bent from place to place, not by one curve.
    assert nees < 2.0


def test_without_markers_a_display_displaces_nothing():
    untouched = SimpleNamespace(ids=np.zeros(0, dtype=np.int64), corners='untouched')
    bits = load_dictionary('DICT_4X4_50').bits
    assert DisplayedSides(bits).corrected(None, untouched, 0.66) == 'untouched'


def test_raw_counts_are_claimed_better_than_a_display(frames):
    raw = last_rows(frames, lambda counts: counts)
    bent = last_rows(frames, lambda counts: displayed(counts, 2.0))
    # Measured: 0.016 and 0.13 px.
    assert np.median(raw['sigma_px']) < 0.05 < 0.1 < np.median(bent['sigma_px'])
