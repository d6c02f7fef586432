"""The fit of poses to whitened images of known points."""

import numpy as np
import pytest

from thermal_fiducial.core.geometry.rigid_fit import costs, evaluate, Images, minimise
from thermal_fiducial.core.geometry.se3 import apply, difference, retract, so3_exp, transform

#: Robust limit of the errors, in standard deviations: with the noise below some points are beyond it.
INLIER = 1.5


def bodies(rng, count, sigma):
    """Points (1, K, 3) of a body, true poses (count, 4, 4) in front of the camera, images with noise ``sigma``."""
    points = rng.uniform(-0.3, 0.3, (1, 6, 3))
    T = np.stack([transform(so3_exp(0.3 * rng.normal(size=3)), [0.1, -0.2, 2.0]) for _ in range(count)])
    p = apply(T, points)
    x = p[..., :2] / p[..., 2:] + sigma * rng.normal(size=(count, 6, 2))
    W = np.broadcast_to(np.eye(2) / max(sigma, 1e-3), (count, 6, 2, 2))
    return points, T, Images(W, (W @ x[..., None])[..., 0])


@pytest.mark.parametrize('inlier', [np.inf, INLIER])
def test_gradient_and_costs_are_those_of_the_robust_error(inlier):
    points, T, images = bodies(np.random.default_rng(1), 3, 1e-3)
    T = retract(T, np.full((3, 6), 0.002))
    cost, gradient, information = evaluate(T, points, images, inlier)
    np.testing.assert_allclose(costs(T, points, images, inlier), cost, rtol=1e-12)
    h = 1e-6
    steps = h * np.eye(6)
    numeric = [
        (costs(retract(T, step), points, images, inlier) - costs(retract(T, -step), points, images, inlier)) / (2.0 * h)
        for step in np.broadcast_to(steps[:, None], (6, 3, 6))
    ]
    # Half the gradient; central differences of a cost of 100 with steps of 1e-6 are good to 1e-5 of it.
    np.testing.assert_allclose(2.0 * gradient, np.transpose(numeric), rtol=1e-5, atol=1e-3)
    assert np.all(np.linalg.eigvalsh(information) > 0.0)


def test_exact_images_give_the_exact_poses_from_afar():
    points, T, images = bodies(np.random.default_rng(2), 4, 0.0)
    start = retract(T, np.full((4, 6), 0.2))
    found, cost, _ = minimise(start, lambda at: evaluate(at, points, images))
    # Steps end where the cost, in units of (a thousandth)^2, changes by less than a hundredth.
    assert np.abs(difference(found, T)).max() < 1e-5
    assert cost.max() < 1e-2


def test_a_start_that_is_not_finite_costs_without_bound_and_leaves_the_others_alone():
    points, T, images = bodies(np.random.default_rng(3), 2, 1e-3)
    alone, _, _ = minimise(T.copy(), lambda at: evaluate(at, points, images))
    start = T.copy()
    start[1] = np.nan
    found, cost, _ = minimise(start, lambda at: evaluate(at, points, images))
    np.testing.assert_array_equal(found[0], alone[0])
    assert np.isfinite(cost[0])
    assert cost[1] == np.inf


def test_a_body_behind_the_camera_has_no_finite_cost():
    points, T, images = bodies(np.random.default_rng(4), 1, 1e-3)
    T[:, 2, 3] *= -1.0
    assert evaluate(T, points, images)[0] == costs(T, points, images, np.inf) == np.inf
