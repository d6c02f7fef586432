"""Identification of a marker by some of its cells."""

import numpy as np
import pytest

from thermal_fiducial.core.detection.patterns import Decoder
from thermal_fiducial.core.detection.visible_cells import VisibleCells
from thermal_fiducial.files.dictionary import load_dictionary

BITS = load_dictionary('DICT_4X4_50').bits
CELLS = VisibleCells(Decoder(BITS))
ID, CELL, MARGIN = 8, 20, 40
EVERY = np.ones(len(BITS), dtype=bool)
NUMBER = (BITS.shape[1] + 4) ** 2


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


def test_a_whole_view_names_its_marker():
    match = CELLS.likeness(picture(), places(), ID, EVERY)
    assert match.correlation == pytest.approx(1.0, abs=1e-6)  # single precision of the samples
    assert match.contrast == pytest.approx(100.0, rel=1e-5)
    assert match.runner_up == pytest.approx(match.perfect)
    assert match.runner_up < 0.9
    assert match.cells == NUMBER


def test_inverted_markers_correlate_negatively():
    match = CELLS.likeness(picture(contrast=-100.0), places(), ID, EVERY)
    assert match.correlation == pytest.approx(-1.0, abs=1e-6)
    assert match.contrast == pytest.approx(-100.0, rel=1e-5)


def test_what_is_out_of_view_does_not_count():
    image, px = cut(picture(), MARGIN + 2 * CELL)
    match = CELLS.likeness(image, px, ID, EVERY)
    # The ring's column and the first two of the marker are out of view, and a sample at the border does not count.
    assert match.cells < NUMBER * 6 / 8
    assert match.correlation == pytest.approx(1.0, abs=1e-6)
    assert match.distance < CELLS.likeness(picture(), places(), ID, EVERY).distance


def test_a_slope_of_the_scene_is_no_pattern():
    match = CELLS.likeness(picture(contrast=20.0, slope=0.5), places(), ID, EVERY)
    assert match.correlation > 0.999


def test_another_marker_is_more_alike_than_the_expected_one():
    match = CELLS.likeness(picture(marker_id=17), places(), ID, EVERY)
    assert match.runner_up == pytest.approx(1.0, abs=1e-6)
    assert match.correlation < 0.9
    only = EVERY.copy()
    only[17] = False
    assert CELLS.likeness(picture(marker_id=17), places(), ID, only).runner_up < 0.95


def test_too_few_cells_match_nothing():
    image, px = cut(picture(), MARGIN + 6 * CELL)
    match = CELLS.likeness(image, px, ID, EVERY)
    assert match.correlation == 0.0


def test_correlation_is_best_at_the_marker_s_place():
    off = np.array([[0.0, 0.0], [6.0, 0.0], [0.0, -6.0], [8.0, 8.0]])
    similarity = CELLS.match(picture(), places() + off[:, None], ID)
    assert similarity.argmax() == 0
    assert similarity[0] == pytest.approx(1.0, abs=1e-6)


def test_places_outside_the_lens_model_are_invisible():
    px = places()
    px[:9] = np.nan
    match = CELLS.likeness(picture(), px, ID, EVERY)
    assert match.cells == NUMBER - 1
    assert match.correlation == pytest.approx(1.0, abs=1e-6)
