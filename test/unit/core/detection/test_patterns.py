"""What is read of a quadrilateral."""

import cv2
import numpy as np
import pytest

from thermal_fiducial.core.detection.patterns import Decoder
from thermal_fiducial.files.dictionary import load_dictionary

#: Its marker 17 is a window of two by two cells, in the middle of the upper half.
DICTIONARY = load_dictionary('DICT_4X4_50')
CELL_PX = 12
QUAD = np.array([[[20.0, 20.0], [92.0, 20.0], [92.0, 92.0], [20.0, 92.0]]]) - 0.5


def window(off, blur_px):
    """Counts of marker 17 whose window is ``off`` by (u, v) [cells]."""
    # Tenths of a pixel, for edges between pixels.
    fine = np.ones((1120, 1120), np.float32)
    fine[200:920, 200:920] = 0.0
    left, top = np.rint(10 * CELL_PX * np.array([2.0, 1.0]) + 10 * CELL_PX * np.asarray(off)).astype(int) + 200
    fine[top : top + 20 * CELL_PX, left : left + 20 * CELL_PX] = 1.0
    image = cv2.resize(fine, (112, 112), interpolation=cv2.INTER_AREA)
    return 7000.0 + 100.0 * cv2.GaussianBlur(image, (0, 0), blur_px)


@pytest.mark.parametrize('blur_px', [0.3, 1.0, 2.0])
@pytest.mark.parametrize('off', [(0.0, 0.0), (0.1, 0.0), (0.0, -0.2), (-0.25, 0.1), (0.25, 0.25)])
@pytest.mark.parametrize('contrast', [1.0, -0.2])
def test_edges_off_the_grid_are_measured_whatever_the_blur(off, blur_px, contrast):
    image = (contrast * window(off, blur_px)).astype(np.float32)
    measured = Decoder(DICTIONARY.bits).off_grid(image, QUAD, np.array([17]))
    # Half of the window's edges run along each axis. Samples are a tenth of a cell apart: up to a pixel of blur they
    # are 0.02 off; by 2 px, where a profile has not ended at the middle of its cells and is flatter, 0.037.
    np.testing.assert_allclose(measured, np.hypot(*off) / np.sqrt(2.0), atol=0.04)


def test_a_bad_pixel_moves_the_edges_little():
    """It counts for no more than an edge at the farthest place."""
    image = window((0.0, 0.0), 1.0).astype(np.float32)
    image[38, 45] = 20000.0
    # One or two of eight edges.
    assert Decoder(DICTIONARY.bits).off_grid(image, QUAD, np.array([17]))[0] <= 0.5 * np.sqrt(2.0 / 8.0)
