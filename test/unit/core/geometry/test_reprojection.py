"""Re-projection and its derivatives; bounds of correlated errors."""

import numpy as np
import pytest

from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.geometry.reprojection import linearise, whitening
from thermal_fiducial.core.geometry.se3 import retract, so3_exp, transform

CAMERAS = [
    Camera(640, 512, np.array([[440.0, 0.0, 320.0], [0.0, 442.0, 250.0], [0.0, 0.0, 1.0]]), model, D)
    for model, D in (
        ('plumb_bob', np.array([-0.3, 0.1, 1e-3, -2e-3, 0.01])),
        ('equidistant', np.array([-0.02, 0.016, -0.01, 0.002])),
    )
]


def some_views(rng, n=5):
    T_map_camera = transform(so3_exp(0.2 * rng.normal(size=(n, 3))), 0.3 * rng.normal(size=(n, 3)))
    away = transform(so3_exp(np.array([np.pi, 0.0, 0.0]) + 0.4 * rng.normal(size=(n, 3))), [0.0, 0.0, 2.0])
    return T_map_camera, T_map_camera @ away, rng.uniform(0.1, 0.4, n)


@pytest.mark.parametrize('camera', CAMERAS, ids=lambda camera: camera.model)
def test_derivatives_are_those_of_the_pixels(camera):
    rng = np.random.default_rng(0)
    T_map_camera, T_map_marker, sizes = some_views(rng)
    _, J_camera, J_marker = linearise(camera, T_map_camera, T_map_marker, sizes)
    h = 1e-6
    for axis in range(6):
        d = np.zeros(6)
        d[axis] = h
        for which, J in ((0, J_camera), (1, J_marker)):
            plus, minus = (
                linearise(
                    camera,
                    retract(T_map_camera, sign * d) if which == 0 else T_map_camera,
                    retract(T_map_marker, sign * d) if which == 1 else T_map_marker,
                    sizes,
                )[0]
                for sign in (1.0, -1.0)
            )
            numeric = ((plus - minus) / (2 * h)).reshape(-1, 8)
            # Central differences of step 1e-6 of values of hundreds: round-off 1e-4 px per unit, curvature below it.
            np.testing.assert_allclose(J[..., axis], numeric, rtol=1e-5, atol=2e-3)


def test_whitening_makes_the_covariance_a_unit():
    rng = np.random.default_rng(2)
    A = rng.normal(size=(7, 4, 2, 2))
    C = A @ np.swapaxes(A, -1, -2) + 0.1 * np.eye(2)
    W = whitening(C)
    np.testing.assert_allclose(W @ C @ np.swapaxes(W, -1, -2), np.broadcast_to(np.eye(2), C.shape), atol=1e-12)
