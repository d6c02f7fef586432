"""Drawings of a calibration are legible."""

from itertools import pairwise

from matplotlib.figure import Figure
import numpy as np

from thermal_fiducial.calibration.lens_check import ImageError
from thermal_fiducial.calibration.plots import drawings


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
    u, v = np.meshgrid(np.linspace(0.0, 639.0, 17), np.linspace(0.0, 511.0, 13))
    sigma = 0.01 + 1e-3 * np.hypot(u - 320.0, v - 256.0)
    error = ImageError(u[0], v[:, 0], sigma, sigma < 0.2, 0.5)
    drawings((640, 512), pixels, [residuals[:200], residuals[200:]], ['a.png', 'b.png'], error)
    assert len(figures) == 5
    for figure in figures:
        labels = [label for label in figure.axes[0].get_xticklabels() if label.get_text()]
        boxes = sorted((label.get_window_extent() for label in labels), key=lambda box: box.x0)
        # Three pixels at 100 dots per inch: a gap that the eye sees between two numbers.
        assert all(right.x0 - left.x1 >= 3.0 for left, right in pairwise(boxes)), figure.axes[0].get_title()
