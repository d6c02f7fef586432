"""Identification of a marker by some of its cells."""

import numpy as np
import pytest

from thermal_fiducial.core.detection.partial.visible_cells import VisibleCells
from thermal_fiducial.core.detection.patterns import Decoder
from thermal_fiducial.files.dictionary import load_dictionary

BITS = load_dictionary('DICT_4X4_50').bits
CELLS = VisibleCells(Decoder(BITS))
ID, CELL, MARGIN = 8, 20, 40


def picture(contrast=100.0, slope=0.0, noise=0.0, marker_id=ID):
    """The marker with cells of 20 px, white around it; its top left corner lies at (39.5, 39.5)."""
    cells = np.pad(np.pad(BITS[marker_id].astype(float), 1), 2, constant_values=1.0)
    image = 7000.0 + contrast * np.kron(cells, np.ones((CELL, CELL)))
    image += slope * np.arange(image.shape[1])
    return (image + np.random.default_rng(0).normal(0.0, noise, image.shape)).astype(np.float32)


def places(left=0.0, top=0.0):
    """Pixels of the samples where the marker stands so far to the left and above of where it is."""
    side = CELL * (BITS.shape[1] + 2)
    return MARGIN - 0.5 + side * CELLS.places - np.array([left, top])


def cut(image, columns):
    """The image without its first columns, and the pixels of the samples in it."""
    return np.ascontiguousarray(image[:, columns:]), places(left=columns)


def match(image, px, marker_id=ID):
    return CELLS.correlation(image, px[None], marker_id)[0]


def test_a_whole_view_shows_its_marker():
    assert match(picture(), places()) == pytest.approx(1.0, abs=1e-6)  # single precision of the samples


def test_inverted_markers_correlate_negatively():
    assert match(picture(contrast=-100.0), places()) == pytest.approx(-1.0, abs=1e-6)


def test_what_is_out_of_view_does_not_count():
    # The ring's column and the first two of the marker are out of view, and a sample at the border does not count.
    image, px = cut(picture(), MARGIN + 2 * CELL)
    image[:, 0] = 0.0
    assert match(image, px) == pytest.approx(1.0, abs=1e-6)


def test_a_slope_of_the_scene_is_no_pattern():
    assert match(picture(contrast=20.0, slope=0.5), places()) > 0.999


def test_another_marker_is_more_alike_than_the_expected_one():
    assert match(picture(marker_id=17), places(), 17) == pytest.approx(1.0, abs=1e-6)
    assert match(picture(marker_id=17), places()) < 0.9


def test_too_few_cells_match_nothing():
    assert match(*cut(picture(), MARGIN + 6 * CELL)) == 0.0


def test_correlation_is_best_at_the_marker_s_place():
    off = np.array([[0.0, 0.0], [6.0, 0.0], [0.0, -6.0], [8.0, 8.0]])
    similarity = CELLS.correlation(picture(), places() + off[:, None], ID)
    assert similarity.argmax() == 0
    assert similarity[0] == pytest.approx(1.0, abs=1e-6)


def test_places_outside_the_lens_model_are_invisible():
    px = places()
    px[:9] = np.nan
    assert match(picture(), px) == pytest.approx(1.0, abs=1e-6)
