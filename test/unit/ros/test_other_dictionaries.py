"""Whether the detector notices that the markers in view are of another dictionary than the parameter says."""

from dataclasses import replace

import numpy as np
import pytest
from support import small_pictures
from support.messages import info

from thermal_fiducial.config import ArucoDetectorConfig
from thermal_fiducial.core.detection.detector import MarkerDetector
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.types import SECOND_NS
from thermal_fiducial.files.dictionary import load_dictionary
from thermal_fiducial.nodes.aruco_detector import ArucoDetector
from thermal_fiducial.ros.base.node import WARN
from thermal_fiducial.ros.camera_nodes.other_dictionaries import OtherDictionaries
from thermal_fiducial.ros.messages import convert

WIDTH, HEIGHT, FOCAL_PX = small_pictures.WIDTH, small_pictures.HEIGHT, small_pictures.FOCAL_PX
CAMERA = Camera(WIDTH, HEIGHT, [[FOCAL_PX, 0, WIDTH / 2], [0, FOCAL_PX, HEIGHT / 2], [0, 0, 1]])
#: One at each other dictionary, and two more.
LOOKS = 12


def counts(dictionary, ids, seed=0):
    """Counts of a wall with markers, two noise levels of a picture to a kelvin."""
    bits = load_dictionary(dictionary).bits[ids]
    picture, corners = small_pictures.with_markers(np.random.default_rng(seed), bits, 40.0, 20.0)
    return (7000 + 2 * picture.astype(np.uint16)), corners


def after_looks(own, image):
    """The doubt after a flight with the same picture every half second."""
    config = ArucoDetectorConfig(dictionary=own)
    seen = len(MarkerDetector(config, load_dictionary(own)).detect(0, image, CAMERA)) > 0
    watch = OtherDictionaries(config)
    for k in range(2 * LOOKS):
        watch.look(k * SECOND_NS // 2, image, CAMERA, any_seen=seen)
    return watch.doubt


@pytest.mark.parametrize(
    ('hung', 'own', 'words'),
    [
        ('STENCIL_4X4_100', 'DICT_4X4_50', 'of STENCIL_4X4_100'),
        ('DICT_4X4_50', 'STENCIL_4X4_100', 'of DICT_4X4_250'),
        ('DICT_APRILTAG_36h11', 'DICT_4X4_50', 'of DICT_APRILTAG_36h11'),
        ('STENCIL_5X5_100', 'STENCIL_4X4_100', 'of STENCIL_5X5_100'),
    ],
)
def test_plates_of_another_dictionary_are_named_with_both_dictionaries(hung, own, words):
    image, _ = counts(hung, np.arange(12))
    doubt = after_looks(own, image)
    assert doubt.startswith(f'dictionary is {own}, but the markers in view are ')
    assert words in doubt
    assert doubt.endswith('set the parameter dictionary')


def test_limits_that_change_in_flight_count_here_too():
    image, _ = counts('STENCIL_4X4_100', np.arange(12))
    config = ArucoDetectorConfig()
    watch = OtherDictionaries(config)
    # Markers of 40 px are too small for it, whatever they are of.
    watch.configure(replace(config, min_side_px=80.0))
    for k in range(2 * LOOKS):
        watch.look(k * SECOND_NS // 2, image, CAMERA, any_seen=False)
    assert watch.doubt == ''


def test_dictionaries_with_the_same_markers_are_all_named():
    image, _ = counts('STENCIL_4X4_80_SIGNED', np.arange(12))
    doubt = after_looks('DICT_4X4_50', image)
    assert 'STENCIL_4X4_100 or ' in doubt
    assert '0, 1, 2, 3, 4 and 7 more of STENCIL_4X4_80_SIGNED' in doubt


@pytest.mark.parametrize('own', ['DICT_4X4_50', 'STENCIL_4X4_100', 'DICT_APRILTAG_36h11'])
def test_markers_of_the_own_dictionary_are_no_doubt(own):
    image, _ = counts(own, np.arange(12))
    assert after_looks(own, image) == ''


def test_a_wrong_name_for_a_plate_is_no_marker_of_ours():
    """The four stencils that are one wrong bit from a marker of the nodes' default: read with a wrong ID."""
    stencils, ours = (load_dictionary(name).bits for name in ('STENCIL_4X4_100', 'DICT_4X4_50'))
    turned = np.concatenate([np.rot90(ours, turn, axes=(1, 2)) for turn in range(4)]).reshape(-1, 16)
    distance = (stencils.reshape(-1, 1, 16) != turned).sum(axis=-1).min(axis=1)
    image, _ = counts('STENCIL_4X4_100', np.tile(np.flatnonzero(distance == 1), 3))
    config = ArucoDetectorConfig(duplicates='best')
    rows = MarkerDetector(config, load_dictionary('DICT_4X4_50')).detect(0, image, CAMERA)
    assert len(rows) > 0
    watch = OtherDictionaries(config)
    for k in range(LOOKS):
        watch.look(k * SECOND_NS, image, CAMERA, any_seen=True)
    assert 'of STENCIL_4X4_100' in watch.doubt


def test_one_foreign_marker_beside_ours_is_no_doubt():
    """A landing pad of another system, say."""
    ours, _ = counts('DICT_4X4_50', np.arange(12))
    theirs, corners = counts('DICT_APRILTAG_36h11', np.arange(12))
    low, high = np.floor(corners[0].min(axis=0)).astype(int) - 12, np.ceil(corners[0].max(axis=0)).astype(int) + 12
    place = slice(max(low[1], 0), high[1]), slice(max(low[0], 0), high[0])
    ours[place] = theirs[place]
    assert after_looks('DICT_4X4_50', ours) == ''


@pytest.mark.ros
def test_the_detector_warns_on_console_and_in_the_diagnostics(graph):
    node = graph.add(ArucoDetector)
    graph.send('thermal/camera_info', info(CAMERA))
    image, _ = counts('STENCIL_4X4_100', np.arange(12))
    for k in range(3):
        assert node.headline() == ''
        graph.send('thermal/image', convert.image(image, convert.header((k + 1) * SECOND_NS, 'camera')))
    level, reason, _ = graph.diagnose(node)
    assert level == WARN
    assert reason == f'0 markers; {node.headline()}'
    assert node.headline().startswith('dictionary is DICT_4X4_50, but the markers in view are 0, 1, 2, 3, 4 and 7 more')


@pytest.mark.ros
def test_nothing_is_looked_for_once_the_filter_runs(graph):
    """A look takes as long as one or two frames, and would delay the next one."""
    node = graph.add(ArucoDetector)
    graph.send('thermal/camera_info', info(CAMERA))
    graph.send('camera_clock', convert.clock_reference(SECOND_NS, 0.0))
    image, _ = counts('STENCIL_4X4_100', np.arange(12))
    for k in range(4):
        graph.send('thermal/image', convert.image(image, convert.header((k + 1) * SECOND_NS, 'camera')))
    assert node.headline() == ''
