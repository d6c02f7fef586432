"""Points of a board that are fitted many at a time: each as if it were alone, along the slopes of its pattern."""

import numpy as np
import pytest
from support.heated_boards import Heat, picture

from thermal_fiducial.calibration.appearance import Disc, SquaresMeet
from thermal_fiducial.calibration.subpixel import refine

COLUMNS, ROWS = 7, 5
NODES = np.stack(np.meshgrid(np.arange(COLUMNS), np.arange(ROWS)), axis=-1).reshape(-1, 2).astype(np.float64)
APPEARANCES = pytest.mark.parametrize(('appearance', 'radius'), [(SquaresMeet(), None), (Disc(0.3), 0.3)])


@APPEARANCES
def test_points_do_not_depend_on_those_fitted_with_them(appearance, radius):
    rng = np.random.default_rng(3)
    counts, truth = picture(NODES, Heat(), rng, radius=radius, width=320, height=256)
    image, start = counts.astype(np.float32), truth + rng.normal(0.0, 0.5, truth.shape)
    together = refine(image, NODES, start, NODES, appearance).pixels
    # Measured 0.008 px, which is the frame's noise.
    assert np.sqrt(np.mean(np.sum((together - truth) ** 2, axis=1))) < 0.012
    order = rng.permutation(len(NODES))
    otherwise = refine(image, NODES[order], start[order], NODES, appearance).pixels
    # Sums are formed in another order: measured 1e-12 px.
    assert np.allclose(otherwise, together[order], atol=1e-9)


@APPEARANCES
@pytest.mark.parametrize('width', [0.02, -0.05])
def test_slopes_are_those_of_the_pattern(appearance, radius, width):
    nodes = NODES[[8, 9]]
    looks = appearance.at(nodes, NODES)
    free = 4
    places = np.random.default_rng(4).uniform(-0.45, 0.45, (2, 60, 2))
    blur = np.array([[0.1, 0.15], [0.3, 0.2]])
    widths = np.full(2, width) if radius is None else np.full(2, radius)
    _, slopes = looks.shape(places, blur, widths, free)
    h = 1e-5
    for number in range(free):
        ends = []
        for side in (h, -h):
            aside = places + side * np.eye(4)[number, :2]
            ends.append(looks.shape(aside, blur * np.exp(side * (number == 2)), widths + side * (number == 3), free)[0])
        # Central differences of step h are good to h squared, here times third derivatives of up to 1e4.
        assert np.allclose(slopes[number], (ends[0] - ends[1]) / (2 * h), atol=1e-5)
