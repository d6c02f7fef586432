"""A board of our own stencils: found through the package's own detector, in part or whole."""

from dataclasses import replace

import numpy as np
import pytest
from support.boards import plate_pose, random_view, render

from thermal_fiducial.calibration.intrinsics import calibrate
from thermal_fiducial.calibration.targets import MarkerBoard
from thermal_fiducial.config import ArucoDetectorConfig
from thermal_fiducial.core.detection.detector import MarkerDetector
from thermal_fiducial.core.geometry import se3
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.mapping.map_data import MapMarker, MarkerMap
from thermal_fiducial.core.measurements import MARKER_DTYPE, places_of
from thermal_fiducial.errors import InputError
from thermal_fiducial.fabrication.boards import marker_grid
from thermal_fiducial.files.dictionary import load_dictionary
from thermal_fiducial.sim.scenario import LENSES

NAME, COLUMNS, ROWS, SIZE = 'STENCIL_4X4_100', 4, 3, 0.06
CELL = SIZE / 6
# Between two markers as much warm background as half a marker.
GAP_CELLS = 3


def board():
    """Map of the board and the cells of its plate."""
    bits = load_dictionary(NAME).bits
    centres = marker_grid(COLUMNS, ROWS, SIZE, GAP_CELLS * CELL)
    markers = {
        index: MapMarker(index, SIZE, True, se3.transform(np.eye(3), [*centre, 0.0]))
        for index, centre in enumerate(centres.tolist())
    }
    pitch = 6 + GAP_CELLS
    levels = np.ones((pitch * ROWS + GAP_CELLS, pitch * COLUMNS + GAP_CELLS), dtype=bool)
    for index in markers:
        row, column = (GAP_CELLS + pitch * step for step in divmod(index, COLUMNS))
        levels[row : row + 6, column : column + 6] = np.pad(bits[index] > 0, 1)
    return MarkerMap(markers, dictionary=NAME), levels


def test_marker_board_calibrates():
    marker_map, levels = board()
    lens = LENSES['13mm']
    detector = MarkerDetector(ArucoDetectorConfig(dictionary=NAME), load_dictionary(NAME))
    detector.set_map(*places_of(marker_map.rows()))
    target = MarkerBoard(marker_map, detector)
    camera = Camera(640, 512, lens.matrix, lens.model, np.array(lens.distortion))
    rows, columns = levels.shape
    u, v = 0.5 * CELL * columns, 0.5 * CELL * rows
    outline = np.array([[-u, -v, 0.0], [u, -v, 0.0], [u, v, 0.0], [-u, v, 0.0]])
    flip = np.diag([1.0, -1.0, -1.0, 1.0])
    rng = np.random.default_rng(4)
    sightings = []
    for seed in range(12):
        T = random_view(lens, outline, rng, fill=0.9, tilt=0.25)
        counts = render(lens, plate_pose(T, np.zeros(2)), levels, columns * CELL, rows * CELL, 8.0, seed)
        sighting = target.find(counts, camera)
        if sighting is None:
            continue
        truth = lens.project(se3.apply(T @ flip, sighting.points))
        # A few hundredths of a pixel at 8 K; corners of small, oblique markers are the worst.
        assert np.median(np.linalg.norm(sighting.pixels - truth, axis=1)) < 0.06
        sightings.append(sighting)
    assert len(sightings) >= 10
    assert np.mean([len(sighting.points) for sighting in sightings]) > 0.7 * 4 * COLUMNS * ROWS
    found = calibrate(sightings, 640, 512, 'plumb_bob')
    # Twelve views in place of forty.
    assert abs(found.camera.K[0, 0] / lens.focal[0] - 1.0) < 2e-3
    assert np.all(np.abs(found.camera.K[:2, 2] - lens.centre) < 1.5)


def test_markers_in_quarantine_are_left_alone():
    marker_map, _ = board()
    marker_map.markers[1] = replace(marker_map.markers[1], trusted=False)
    rows = np.zeros(3, MARKER_DTYPE)
    rows['id'] = 0, 1, 2

    class Seen:
        def detect(self, stamp_ns, counts, camera):
            return rows

    camera = Camera(640, 512, LENSES['13mm'].matrix)
    assert len(MarkerBoard(marker_map, Seen()).find(np.zeros((512, 640), np.uint16), camera).points) == 8


def test_a_board_of_one_marker_is_refused_before_any_view():
    marker_map, _ = board()
    alone = MarkerMap({0: marker_map.markers[0]}, dictionary=NAME)
    detector = MarkerDetector(ArucoDetectorConfig(dictionary=NAME), load_dictionary(NAME))
    with pytest.raises(InputError, match='a board of 1 marker: calibration needs two or more'):
        MarkerBoard(alone, detector)
