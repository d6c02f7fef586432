"""The detector on rendered frames."""

import numpy as np
import pytest
from support.scenes import camera_of

from thermal_fiducial.config import ArucoDetectorConfig
from thermal_fiducial.core.detection import MarkerDetector
from thermal_fiducial.core.measurements import corners_px, MARKER_DTYPE
from thermal_fiducial.files.dictionary import load_dictionary
from thermal_fiducial.sim.camera import render_frames
from thermal_fiducial.sim.scenario import named


@pytest.fixture(scope='module')
def frames():
    return [frame for frame in render_frames('wall', seconds=20.0, seed=5, start=120, stop=124) if not frame.shutter]


@pytest.fixture
def detector():
    return MarkerDetector(ArucoDetectorConfig(), load_dictionary('DICT_4X4_50'))


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
