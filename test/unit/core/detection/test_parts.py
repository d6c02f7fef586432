"""Parts of known markers that look like others: the right half of marker 30 is marker 17, seen from 60 degrees."""

import numpy as np
import pytest
from support.close_views import BITS, BLUR_WITH_PIXEL, CAMERAS, DICTIONARY, draw, plate, pose
from support.scenes import motion_prior

from thermal_fiducial.config import ArucoDetectorConfig
from thermal_fiducial.core.detection.detector import MarkerDetector
from thermal_fiducial.core.detection.finding.parts import shown_by_known
from thermal_fiducial.core.detection.patterns import Decoder
from thermal_fiducial.core.detection.prediction.frame import Places
from thermal_fiducial.core.detection.prediction.known_markers import FoundMarkers, KnownMarkers
from thermal_fiducial.core.geometry import se3
from thermal_fiducial.core.geometry.camera import ImagePoints
from thermal_fiducial.core.measurements import Odometry

SIZE, CAMERA, DECODER = 0.3, CAMERAS['plumb_bob'], Decoder(BITS)
#: A known marker 30 of 110 px, a little tilted.
VIEW = pose(110, 0.05, -0.02, (0.1, -0.05, 0.2))
CONFIG = ArucoDetectorConfig(blur_px=BLUR_WITH_PIXEL, bolometer_lag=0.0)


def seen(marker_id, columns, rows):
    """A marker found upside down in a rectangle of the known one, between these shares of its sides."""
    left, right = (SIZE * (share - 0.5) for share in columns)
    top, bottom = (SIZE * (0.5 - share) for share in rows)
    corners = np.array([[right, bottom, 0.0], [left, bottom, 0.0], [left, top, 0.0], [right, top, 0.0]])
    points = ImagePoints.at(CAMERA.project(se3.apply(VIEW, corners))[None], CAMERA)
    no = np.zeros(1, dtype=bool)
    return FoundMarkers(np.array([marker_id]), Places.of(points, np.ones((1, 4))), np.full(1, 50.0), no, no)


def is_shown(found, known=30, *, mapped=()):
    """Whether a known marker at ``VIEW`` shows what was found."""
    markers = {known: (VIEW, SIZE)} | {key: (pose(80, 0.4, 0.0, (0.0, 0.0, 0.0)), SIZE) for key in mapped}
    return bool(shown_by_known(found, KnownMarkers(markers, np.full(len(BITS), SIZE)), np.eye(4), CAMERA, DECODER)[0])


@pytest.mark.parametrize('off', [-0.04, 0.0, 0.04])
def test_a_half_that_looks_like_another_marker_is_no_marker(off):
    assert is_shown(seen(17, (0.5 + off, 1.0), (off, 1.0)))


def test_what_a_known_marker_does_not_show_is_a_marker():
    """A small one in its middle, one over it, one of another pattern, one beside it, and one that the map has."""
    assert not is_shown(seen(17, (0.35, 0.65), (0.35, 0.65)))
    assert not is_shown(seen(17, (0.0, 1.0), (0.0, 1.0)))
    assert not is_shown(seen(8, (0.5, 1.0), (0.0, 1.0)))
    assert not is_shown(seen(17, (1.1, 1.6), (0.0, 1.0)))
    assert not is_shown(seen(17, (0.5, 1.0), (0.0, 1.0)), mapped=[17])
    assert not is_shown(seen(17, (0.5, 1.0), (0.0, 1.0)), known=8)


def test_a_known_marker_behind_the_camera_or_turned_away_shows_nothing():
    for T in (VIEW @ np.diag([-1.0, 1.0, -1.0, 1.0]), np.diag([1.0, -1.0, -1.0, 1.0]) @ VIEW):
        known = KnownMarkers({30: (T, SIZE)}, np.full(len(BITS), SIZE))
        assert not shown_by_known(seen(17, (0.5, 1.0), (0.0, 1.0)), known, np.eye(4), CAMERA, DECODER)[0]


@pytest.mark.parametrize('known', [False, True])
def test_at_the_border_of_the_image_a_half_is_no_marker_if_the_whole_is_known(known):
    rng, T = np.random.default_rng(0), pose(160, -0.58, 0.0, (0.0, 0.0, 0.0))
    white = draw('plumb_bob', plate(30), T)
    image = np.rint(7000.0 + 400.0 * white + rng.normal(0.0, 2.0, white.shape)).astype(np.uint16)
    detector, still, T_map_body = (
        MarkerDetector(CONFIG, DICTIONARY),
        np.zeros(3),
        se3.inverse(se3.camera_in_body(CONFIG)),
    )
    # The map has another marker where that is the only one, as odometry is of use with a map alone.
    detector.set_map({30: (T, SIZE)} if known else {8: (T, SIZE)})
    prior = motion_prior(Odometry(0, T_map_body, still, still, 1e-6 * np.eye(6), 1e-6 * np.eye(6)))
    assert (17 in detector.detect(0, image, CAMERA, prior)['id']) is not known
