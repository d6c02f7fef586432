"""Six views of the middle third, lenses like published ones: errors elsewhere are what a calibration claims."""

import numpy as np
import pytest

from thermal_fiducial.calibration.lens_check import image_error, reaches_corners
from thermal_fiducial.calibration.lens_choice import choose_model
from thermal_fiducial.calibration.targets import Sighting
from thermal_fiducial.core.geometry import se3
from thermal_fiducial.core.geometry.camera import Camera

ROW, COLUMN = np.divmod(np.arange(48), 8)
POINTS = np.stack([0.05 * COLUMN, 0.05 * ROW, 0.0 * ROW], axis=1)
SIZE, SIGMA_PX = np.array([640, 512]), 0.05
#: Models, focal lengths over half the image's diagonal, and coefficients: a Tau 2 with 7.5 mm, a Boson 640 with 4.9 mm,
#: EuRoC's two cameras, and one with a field of 60 degrees.
PUBLISHED = (
    ('equidistant', 1.074, (-0.12517, -0.01585, 0.00552, 0.00188)),
    ('plumb_bob', 1.005, (-0.36751, 0.12044, -0.00052, 0.00043, 0.0)),
    ('plumb_bob', 1.027, (-0.28341, 0.07396, 0.00019, 0.00002, 0.0)),
    ('plumb_bob', 1.025, (-0.28368, 0.07451, -0.00010, -0.00004, 0.0)),
    ('plumb_bob', 1.837, (-0.23302, 0.21797, 0.00010, -0.00010, -0.09134)),
)


#: Largest magnification of angles over that in the middle: polynomials of two terms turn up where their views ended.
MAGNIFIED = 1.3


def turns_up(lens):
    """Whether angles are magnified far more in a corner of the image than in the middle."""
    rays = lens.rays(np.linspace(lens.principal_point, SIZE - 1.0, 50))
    magnified = 1.0 / np.arccos(np.clip(np.sum(rays[1:] * rays[:-1], axis=1), -1.0, 1.0))
    return magnified.max() > MAGNIFIED * magnified[0]


def lens_like(model, focal, coefficients, rng):
    """A camera that shows a part of such a lens's field, and whose coefficients are off by some per cent."""
    while True:
        K = np.eye(3)
        K[0, 0] = K[1, 1] = 0.5 * np.linalg.norm(SIZE) * focal * rng.uniform(1.0, 1.8)
        K[:2, 2] = 0.5 * (SIZE - 1.0) + rng.normal(0.0, 5.0, 2)
        lens = Camera(*SIZE.tolist(), K, model, rng.uniform(0.8, 1.1) * np.array(coefficients))
        if reaches_corners(lens) and not turns_up(lens):
            return lens


def middle_third(lens, rng, count=6):
    """Views of a board of 40 x 30 cm that stays in the middle third of the image."""
    views = []
    while len(views) < count:
        distance = 1.12 * lens.K[0, 0] * rng.uniform(1.0, 1.3) / SIZE[0]
        R = se3.so3_exp(rng.normal(0.0, 0.35, 3))
        pixels = lens.project(POINTS @ R.T + np.array([0.0, 0.0, distance]) - R @ POINTS.mean(axis=0))
        if np.all(np.abs(pixels - 0.5 * SIZE) < SIZE / 6.0 + 5.0):
            views.append(Sighting(POINTS, pixels + rng.normal(0.0, SIGMA_PX, pixels.shape)))
    return views


def errors_and_claims(lens, rng):
    """Errors and standard deviations (n,) [px] where no view reaches, after the rotation that fits best elsewhere."""
    views = middle_third(lens, rng)
    found = choose_model(views, *SIZE.tolist(), ['equidistant'])[0]
    claimed = image_error(found.camera, found.covariance, views)
    uv = np.stack(np.meshgrid(claimed.u, claimed.v), axis=-1).reshape(-1, 2)
    rays, true = found.camera.rays(uv), lens.rays(uv)
    covered = claimed.covered.ravel()
    U, _, Vt = np.linalg.svd(true[covered].T @ rays[covered])
    off = np.linalg.norm(lens.project(rays @ (U @ Vt).T) - uv, axis=1)
    return off[~covered], claimed.sigma_px.ravel()[~covered]


@pytest.mark.parametrize('seeds', [range(1, 2), pytest.param(range(8), marks=pytest.mark.nightly)], ids=len)
def test_claims_outside_the_views_are_the_errors_there(seeds):
    found = [
        errors_and_claims(lens_like(*published, rng := np.random.default_rng([seed, kind])), rng)
        for seed in seeds
        for kind, published in enumerate(PUBLISHED)
    ]
    off, sigma = (np.concatenate(values) for values in zip(*found, strict=True))
    # What is asked for. Before, each coefficient might move a corner by a tenth of its radius: 8, of 40 draws.
    assert 0.7 < np.sqrt(np.mean(sigma**2) / np.mean(off**2)) < 1.5
    assert np.mean(off > 3.0 * sigma) < 0.01
