"""Bridged markers with all that holds them, in front of the simulated camera: the detector reads the bits."""

import numpy as np
import pytest
import shapely
from support.boards import render

from thermal_fiducial.config import ArucoDetectorConfig
from thermal_fiducial.core.detection.detector import MarkerDetector
from thermal_fiducial.core.geometry import se3
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.measurements import corners_px
from thermal_fiducial.fabrication.bridges import find_bridges
from thermal_fiducial.fabrication.plate import marker_drawing, pattern_origin, PlateOptions
from thermal_fiducial.fabrication.verification import sheet_of
from thermal_fiducial.files.dictionary import load_dictionary
from thermal_fiducial.sim.scenario import LENSES

LENS = LENSES['13mm']
CAMERA = Camera(LENS.width, LENS.height, LENS.matrix, LENS.model, np.array(LENS.distortion))
SIZE_MM, BORDER_MM = 300.0, 50.0
CORNERS = 0.5e-3 * SIZE_MM * np.array([[-1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, -1.0, 0.0]])


def raster(drawing, origin):
    """Cells of two millimetres, True where the warm surface shows, their lines on the edges of the black square."""
    border = BORDER_MM + 2.0 * np.ceil(0.5 * origin) - origin
    count = round(0.5 * (drawing.width + 2.0 * border))
    x = 2.0 * (np.arange(count) + 0.5) - border
    u, v = np.meshgrid(x, x[::-1])
    acrylic = shapely.contains_xy(sheet_of(drawing), u, v)
    for hole in drawing.holes:
        acrylic &= np.hypot(u - hole.x, v - hole.y) > hole.radius
    return ~acrylic, 2e-3 * count


@pytest.mark.parametrize('mount', ['ears', 'frame'])
@pytest.mark.parametrize('name', ['DICT_6X6_50', 'DICT_APRILTAG_36h11'])
def test_bits_of_bridged_markers_are_read(name, mount):
    dictionary = load_dictionary(name)
    bits = dictionary.bits
    detector = MarkerDetector(ArucoDetectorConfig(dictionary=name), dictionary)
    options = PlateOptions(size=SIZE_MM, mount=mount)
    # Side of 100 px, tilted 15 degrees about two axes.
    R = np.diag([1.0, -1.0, -1.0]) @ se3.so3_exp([0.26, -0.26, 0.1])
    T = se3.transform(R, [0.01, -0.02, LENS.focal[0] * 1e-3 * SIZE_MM / 100.0])
    truth = LENS.project(se3.apply(T, CORNERS))
    marker_id = max(range(30), key=lambda index: len(find_bridges(bits[index]).patches))
    drawing = marker_drawing(bits[marker_id], str(marker_id), options)
    levels, side = raster(drawing, float(pattern_origin(options, bits.shape[1] + 2)[0]))
    rows = detector.detect(0, render(LENS, T, levels, side, side, 8.0, 1), CAMERA)
    assert rows['id'].tolist() == [marker_id]
    # Kerf, rounded corners and necks may shift an edge by some hundredths of a pixel; measured: 0.02 px.
    assert np.abs(corners_px(rows)[0] - truth).max() < 0.1
