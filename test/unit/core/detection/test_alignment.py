"""Rough outlines pulled onto the pattern."""

import cv2
import numpy as np
import pytest

from thermal_fiducial.core.detection.corners.pattern_fit import aligned
from thermal_fiducial.core.detection.patterns import Decoder
from thermal_fiducial.files.dictionary import load_dictionary

BITS = load_dictionary('DICT_4X4_50').bits
DECODER = Decoder(BITS)
CELL = 6
CORNERS = np.array([[39.5, 29.5], [75.5, 29.5], [75.5, 65.5], [39.5, 65.5]])


def picture(marker_id, contrast, noise, bend=0.0, seed=0):
    """A marker with cells of 6 px and a white margin before a background that rises and bends."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[:96, :128]
    image = 100.0 + bend * (((u - 57.0) / 30.0) ** 2 - (v - 40.0) / 30.0)
    image[24:72, 34:82] += contrast
    image[30:66, 40:76] -= contrast * (1.0 - np.kron(np.pad(BITS[marker_id], 1), np.ones((CELL, CELL))))
    return (image + rng.normal(0.0, noise, image.shape)).astype(np.float32)


@pytest.mark.parametrize('turn', range(4))
@pytest.mark.parametrize('contrast', [4.0, -4.0])
def test_a_corner_off_by_most_of_a_cell_comes_back(turn, contrast):
    image = picture(13, contrast, noise=1.0, bend=8.0)
    rough = CORNERS + np.array([[-4.0, 3.0], [1.0, -1.5], [1.5, 1.0], [-1.0, 1.5]])
    seen = np.roll(rough, -turn, axis=0)[None]
    found = np.roll(aligned(image, seen, np.array([13]), np.array([turn]), DECODER)[0], turn, axis=0)
    # A third of a cell, from where the refinement finds the sides; 0.9 px when written.
    assert np.abs(found - CORNERS).max() < CELL / 3.0


def test_what_else_is_in_the_image_does_not_matter():
    rough = (CORNERS + 1.5)[None]
    image = picture(13, 40.0, noise=1.0)
    larger = cv2.copyMakeBorder(image, 60, 50, 70, 80, cv2.BORDER_REPLICATE)
    here, there = (
        aligned(view, quads, np.array([13]), np.zeros(1, dtype=np.int64), DECODER)
        for view, quads in ((image, rough), (larger, rough + np.array([70.0, 60.0])))
    )
    # single precision of counts about another mean
    np.testing.assert_allclose(there - np.array([70.0, 60.0]), here, atol=1e-3)


def test_what_shows_nothing_stays_finite():
    quads = np.stack([CORNERS, CORNERS + 500.0, np.tile(CORNERS[:1], (4, 1))])
    flat = np.full((96, 128), 7.0, dtype=np.float32)
    assert np.isfinite(aligned(flat, quads, np.array([1, 2, 3]), np.zeros(3, dtype=np.int64), DECODER)).all()
