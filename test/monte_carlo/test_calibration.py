"""Forty views of a heated board through a Tau 2's noise, both lens models: what a calibration must reach."""

from contextlib import suppress

import numpy as np
import pytest
from support.boards import chessboard_levels, plate_pose, random_view, render

from thermal_fiducial.calibration.intrinsics import calibrate
from thermal_fiducial.calibration.recognition import BoardNotFound
from thermal_fiducial.calibration.targets import Chessboard
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.sim.scenario import LENSES

SQUARE = 0.05
BOARD = Chessboard(8, 6, SQUARE)
GUESS = Camera(640, 512, np.array([[600.0, 0.0, 319.5], [0.0, 600.0, 255.5], [0.0, 0.0, 1.0]]))


@pytest.mark.nightly
@pytest.mark.parametrize('name', ['13mm', '7.5mm'])
def test_forty_views_at_eight_kelvin(name):
    lens = LENSES[name]
    rng = np.random.default_rng(21)
    sightings = []
    for seed in range(40):
        plate = plate_pose(random_view(lens, BOARD.points, rng), np.array([3.5, 2.5]) * SQUARE)
        counts = render(lens, plate, chessboard_levels(8, 6), 11 * SQUARE, 9 * SQUARE, 8.0, seed)
        with suppress(BoardNotFound):
            sightings.append(BOARD.find(counts, GUESS))
    assert len(sightings) >= 36
    found = calibrate(sightings, 640, 512, lens.model)
    K = found.camera.K
    assert [K[0, 0], K[1, 1]] == pytest.approx(lens.focal, rel=5e-4)
    assert K[:2, 2] == pytest.approx(lens.centre, abs=0.3)
    assert found.rms_px < 0.03
    error = np.array([K[0, 0], K[1, 1], *K[:2, 2]]) - [*lens.focal, *lens.centre]
    # Chi-square of four degrees of freedom, 99.9 %, doubled: dropped views and the residuals of the corner finder are
    # not quite white noise.
    assert error @ np.linalg.solve(found.covariance[:4, :4], error) < 37.0
