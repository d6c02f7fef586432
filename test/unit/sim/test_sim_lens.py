import cv2
import numpy as np
import pytest

from thermal_fiducial.errors import InputError
from thermal_fiducial.sim.lens import Lens
from thermal_fiducial.sim.scenario import LENSES


def opencv_projection(lens, points):
    """The same by OpenCV: points (N, 3) in the camera frame to pixels (N, 2)."""
    zero = np.zeros(3)
    if lens.model == 'equidistant':
        pixels, _ = cv2.fisheye.projectPoints(points[:, None], zero, zero, lens.matrix, np.array(lens.distortion))
    else:
        pixels, _ = cv2.projectPoints(points, zero, zero, lens.matrix, np.array(lens.distortion))
    return pixels[:, 0]


@pytest.mark.parametrize('name', LENSES)
def test_projects_as_opencv_does(name):
    lens = LENSES[name]
    v, u = np.mgrid[0:512:37, 0:640:41].astype(float)
    pixels = np.stack([u.ravel(), v.ravel()], axis=-1)
    points = np.concatenate([lens.slopes(pixels), np.ones((len(pixels), 1))], axis=1) * 2.5
    # Both are double precision: 1e-9 px leaves four digits for rounding.
    np.testing.assert_allclose(lens.project(points), pixels, atol=1e-9)
    np.testing.assert_allclose(opencv_projection(lens, points), pixels, atol=1e-9)


@pytest.mark.parametrize('name', LENSES)
def test_jacobian_is_the_derivative_of_the_rays(name):
    lens = LENSES[name]
    pixels = np.array([[10.0, 20.0], [320.0, 256.0], [600.0, 480.0]])
    step = 1e-3
    numeric = [(lens.slopes(pixels + step * d) - lens.slopes(pixels - step * d)) / (2 * step) for d in np.eye(2)]
    # Central differences of a function of size 1 at 1e-3 px: their error is below 1e-9.
    np.testing.assert_allclose(lens.slopes_jacobian(lens.slopes(pixels)), np.stack(numeric, axis=-1), atol=1e-9)


def test_impossible_lenses_are_refused():
    with pytest.raises(InputError, match='one of'):
        Lens((400.0, 400.0), (320.0, 256.0), 'brown')
    with pytest.raises(InputError, match='takes 4'):
        Lens((400.0, 400.0), (320.0, 256.0), 'equidistant', (0.0,))
