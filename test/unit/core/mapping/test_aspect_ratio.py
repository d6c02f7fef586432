"""An adjustment finds what the focal lengths of square pixels differ by, and poses are without it."""

from dataclasses import replace

import numpy as np
import pytest
from support.walls import CAMERA, flight, see, SIZE, stamp, wall

from thermal_fiducial.config import MarkerMapperConfig
from thermal_fiducial.core.error_model import DRAWS
from thermal_fiducial.core.mapping.map_data import MapMarker, MarkerMap
from thermal_fiducial.core.mapping.mapper import MarkerMapper
from thermal_fiducial.core.measurements import corners_px

#: Half of what the calibrated focal lengths differ by: a published calibration has this.
WRONG = 0.0015
CALIBRATED = replace(CAMERA, K=CAMERA.K + WRONG * CAMERA.K[0, 0] * np.diag([1.0, -1.0, 0.0]))


def mapped(seconds, sigma):
    """The mapper after a flight of its true poses before a wall, whose pixels are square and calibrated otherwise."""
    rng = np.random.default_rng(4)
    poses = wall(rng)
    m = MarkerMapper(MarkerMapperConfig(), MarkerMap({0: MapMarker(0, SIZE, True, poses[0])}))
    for k in range(0, int(30 * seconds), 5):
        m.process(stamp(k), see(flight(k / 30), poses, sigma, rng), CALIBRATED)
        if m.refinement_due(stamp(k)):
            m.refine()
    return m, poses


def corrected_by(m, poses):
    """Largest distance [px] of corrected corners from where a camera as calibrated would see them."""
    T, exact = flight(3.0), np.random.default_rng(0)
    frame = m.locate(stamp(10_000), see(T, poses, 1e-4, exact), CALIBRATED)
    expected = corners_px(see(T, poses, 1e-4, exact, camera=CALIBRATED))
    return np.abs(frame.observed.corners - expected).max()


def test_the_error_of_the_aspect_ratio_is_found_within_its_claim():
    m, poses = mapped(20.0, 0.05)
    found = m.refine().aspect
    assert found.camera.matches(CALIBRATED)
    assert found.left.shape == (DRAWS,)
    left = np.sqrt(np.mean(found.left**2))
    # Half of it is left at most, and three sigma of that. Corners are off as much as the calibration, the other way.
    assert left < 0.5
    assert abs(found.share + 1.0) < 3.0 * left
    off_px = corrected_by(m, poses)
    # What is left of corners that are off by 0.15 % of their distance from the principal point.
    assert off_px < 3.0 * left * WRONG * CAMERA.width / 2.0


@pytest.mark.parametrize('share', [0.0, 0.02])
def test_pixels_that_are_square_or_clearly_not_are_left_alone(share):
    camera = replace(CAMERA, K=CAMERA.K + share * CAMERA.K[0, 0] * np.diag([1.0, 0.0, 0.0]))
    rng = np.random.default_rng(4)
    poses = wall(rng, 4)
    m = MarkerMapper(MarkerMapperConfig(), MarkerMap({0: MapMarker(0, SIZE, True, poses[0])}))
    for k in range(0, 300, 10):
        m.process(stamp(k), see(flight(k / 30), poses, 0.05, rng, camera=camera), camera)
    assert m.refine().aspect.share == 0.0
