"""Drawings of a calibration are legible."""

from itertools import pairwise

from matplotlib.figure import Figure
import numpy as np
import pytest

from thermal_fiducial.calibration.board_shape import BoardShape
from thermal_fiducial.calibration.lens_check import ImageError
from thermal_fiducial.calibration.plots import drawings

U, V = np.meshgrid(np.linspace(0.0, 639.0, 17), np.linspace(0.0, 511.0, 13))
SIGMA = 0.01 + 1e-3 * np.hypot(U - 320.0, V - 256.0)
FLAT = np.stack([*np.meshgrid(0.03 * np.arange(8.0), 0.03 * np.arange(6.0)), np.zeros((6, 8))], axis=-1).reshape(-1, 3)
BENT = BoardShape(FLAT, FLAT + 1e-3 * np.sin(20.0 * FLAT[:, [1, 0, 0]]))
ERROR = ImageError(U[0], V[:, 0], SIGMA, SIGMA < 0.2, 0.5)


def test_numbers_of_an_axis_do_not_run_into_each_other(monkeypatch):
    figures, save = [], Figure.savefig

    def kept(figure, *arguments, **options):
        figures.append(figure)
        save(figure, *arguments, **options)

    monkeypatch.setattr(Figure, 'savefig', kept)
    rng = np.random.default_rng(0)
    pixels = rng.uniform((0.0, 0.0), (640.0, 512.0), (400, 2))
    # Residuals between -0.09 and 0.11 px had nine numbers of three digits below a drawing of 4 inches.
    residuals = np.array([0.11, 0.1]) * rng.uniform(-0.8, 1.0, (400, 2))
    drawings((640, 512), pixels, [residuals[:200], residuals[200:]], ['a.png', 'b.png'], ERROR, BENT)
    assert len(figures) == 6
    for figure in figures:
        labels = [label for label in figure.axes[0].get_xticklabels() if label.get_text()]
        boxes = sorted((label.get_window_extent() for label in labels), key=lambda box: box.x0)
        # Three pixels at 100 dots per inch: a gap that the eye sees between two numbers.
        assert all(right.x0 - left.x1 >= 3.0 for left, right in pairwise(boxes)), figure.axes[0].get_title()


@pytest.mark.filterwarnings('error')
def test_few_points_and_odd_names_are_drawn():
    # No cell has the points of a mean; matplotlib reads what is between dollar signs as a formula, and this is none.
    pixels = np.random.default_rng(0).uniform((0.0, 0.0), (640.0, 512.0), (9, 2))
    assert 'a$_$.png' in drawings((640, 512), pixels, [np.full((9, 2), 0.1)], ['a$_$.png'], ERROR, BENT)
