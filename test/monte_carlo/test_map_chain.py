"""A chain of markers, of which two are in view at a time: the errors along it are what the map claims.

Two markers show neither the lens's error nor the markers' shapes, so that the declared sizes of these are claimed, and
add up along the chain. With noise alone, as if lens and markers were perfect, claims are 7 to 10 times the errors.
"""

import numpy as np
import pytest
from support.walls import CAMERA, hung, look, see, SIZE, stamp

from thermal_fiducial.config import MarkerMapperConfig
from thermal_fiducial.core.error_model import CORNER_LENGTH, SystematicErrors
from thermal_fiducial.core.geometry.se3 import difference
from thermal_fiducial.core.mapping.map_data import MapMarker, MarkerMap
from thermal_fiducial.core.mapping.mapper import MarkerMapper
from thermal_fiducial.core.measurements import CORNER_FIELDS, corners_px

ERRORS, MARKERS, SECONDS, SIGMA = SystematicErrors(), 7, 40, 0.1
#: Places at which the error of the lens is drawn [px].
GRID = np.stack(np.meshgrid(np.linspace(0, 640, 17), np.linspace(0, 512, 14)), axis=-1).reshape(-1, 2)


def lens(rng):
    """A smooth error of the lens (n, 2) [px] at the places of the grid, and by the focal length."""
    squared = np.sum((GRID[:, None] - GRID) ** 2, axis=-1) / (CORNER_LENGTH * CAMERA.width) ** 2
    smooth = np.linalg.cholesky(np.exp(-0.5 * squared) + 1e-7 * np.eye(len(GRID))) @ rng.normal(size=GRID.shape)
    return ERRORS.corner_px * smooth + ERRORS.focal_length_std * rng.normal() * (GRID - CAMERA.principal_point)


def nees_along_a_chain(seed):
    """NEES a degree of freedom of each marker but the first, a metre apart, with errors drawn as they are declared."""
    rng = np.random.default_rng(seed)
    poses = {i: hung(rng, [rng.uniform(-0.1, 0.1), i, 1.0], 0.0, 0.15) for i in range(MARKERS)}
    off, shapes = lens(rng), ERRORS.marker_shape * SIGMA * rng.normal(size=(MARKERS, 4, 2))
    size = SIZE * (1.0 + ERRORS.marker_size_std * rng.normal())
    m = MarkerMapper(MarkerMapperConfig(), MarkerMap({0: MapMarker(0, SIZE, True, poses[0])}))
    for k in range(0, 30 * SECONDS, 3):
        y = (MARKERS - 1) * k / (30 * SECONDS)
        position = [-1.75 + 0.25 * np.sin(k / 23), y + 0.3 * np.sin(k / 15), 1.0 + 0.4 * np.sin(k / 19)]
        rows = see(look(position, [0.0, y, 1.0 + 0.1 * np.sin(k / 11)]), poses, SIGMA, rng, size=size)
        corners = corners_px(rows)
        nearest = np.argmin(np.sum((corners[..., None, :] - GRID) ** 2, axis=-1), axis=-1)
        moved = (corners + off[nearest] + shapes[rows['id']]).reshape(-1, 8)
        for name, column in zip(CORNER_FIELDS, moved.T, strict=True):
            rows[name] = column
        m.process(stamp(k), rows, CAMERA)
        if m.refinement_due(stamp(k)):
            m.refine()
    m.refine()
    errors = [difference(m.map.markers[i].T_map_marker, poses[i]) for i in range(1, MARKERS)]
    return [e @ np.linalg.solve(m.map.markers[i].covariance, e) / 6.0 for i, e in enumerate(errors, 1)]


@pytest.mark.slow
@pytest.mark.parametrize('flights', [2, pytest.param(8, marks=pytest.mark.nightly)])
def test_claims_along_a_chain_are_its_errors(flights):
    nees = np.mean([nees_along_a_chain(seed) for seed in range(flights)], axis=0)
    # The mean of eight flights is 0.65 to 0.83 a marker; single flights scatter by 0.5 about it. Three sigma; and above
    # what claims of twice the errors would have.
    assert np.all(nees < 0.8 + 3.0 * 0.5 / np.sqrt(flights))
    assert np.mean(nees) > 0.25
