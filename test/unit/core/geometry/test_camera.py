"""Camera models against OpenCV, and their inverses."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from thermal_fiducial.core.geometry.camera import Camera, ImagePoints, MODELS
from thermal_fiducial.errors import InputError

K = np.array([[441.2, 0.0, 322.1], [0.0, 439.8, 251.3], [0.0, 0.0, 1.0]])
CAMERAS = {
    'pinhole': Camera(640, 512, K),
    'plumb_bob': Camera(640, 512, K, 'plumb_bob', [-0.29, 0.11, 1e-3, -5e-4, -0.02]),
    'rational_polynomial': Camera(640, 512, K, 'rational_polynomial', [0.3, 0.05, 1e-3, -5e-4, 0.01, 0.6, 0.12, 0.02]),
    'equidistant': Camera(640, 512, K, 'equidistant', [-0.125, -0.0158, 0.0055, 0.0019]),
}
every_model = pytest.mark.parametrize('name', CAMERAS)


def view_points(camera, count=400, seed=0):
    """Points all over the image, 0.5 to 10 m away."""
    rng = np.random.default_rng(seed)
    uv = rng.uniform([0, 0], [camera.width - 1, camera.height - 1], (count, 2))
    return camera.rays(uv) * rng.uniform(0.5, 10.0, (count, 1)), uv


def opencv(camera, points):
    zero = np.zeros(3)
    if camera.model == 'equidistant':
        return cv2.fisheye.projectPoints(points[:, None], zero, zero, camera.K, camera.D)[0][:, 0]
    return cv2.projectPoints(points, zero, zero, camera.K, camera.D)[0][:, 0]


@every_model
def test_projection_is_opencv_s(name):
    points, _ = view_points(CAMERAS[name])
    assert np.allclose(CAMERAS[name].project(points), opencv(CAMERAS[name], points), atol=1e-9)


@every_model
def test_a_ray_projects_onto_its_pixel(name):
    points, uv = view_points(CAMERAS[name])
    # Newton's iteration stops at rounding: 1e-14 of a focal length, a little more at the border.
    assert np.allclose(CAMERAS[name].project(points), uv, atol=1e-9)
    assert np.allclose(np.linalg.norm(CAMERAS[name].rays(uv), axis=1), 1.0)


@every_model
def test_normalise_inverts_distort(name):
    _, uv = view_points(CAMERAS[name], seed=1)
    assert np.allclose(CAMERAS[name].distort(CAMERAS[name].normalise(uv)), uv, atol=1e-9)


@every_model
def test_projection_jacobian_is_the_difference_quotient(name):
    camera, h = CAMERAS[name], 1e-6
    points, _ = view_points(camera, 60, seed=2)
    points = np.vstack([points, [[0.0, 0.0, 2.0], [1e-8, 0.0, 1.0]]])
    uv, J = camera.project_jacobian(points)
    assert np.allclose(uv, camera.project(points))
    for k in range(3):
        d = h * np.eye(3)[k]
        numeric = (camera.project(points + d) - camera.project(points - d)) / (2 * h)
        # Points from 0.5 m: third derivatives up to 1e4 px/m^3 times h^2, and 1e-13 px / h of rounding.
        assert np.allclose(J[..., k], numeric, rtol=1e-7, atol=2e-6)


@every_model
def test_distortion_jacobian_is_the_difference_quotient(name):
    camera, h = CAMERAS[name], 1e-6
    x = np.vstack([np.random.default_rng(3).uniform(-0.6, 0.6, (50, 2)), [[0.0, 0.0], [1e-9, 0.0]]])
    distorted, J = camera.distort_linearised(x)
    np.testing.assert_allclose(distorted, camera.distort(x), rtol=1e-12)
    for k in range(2):
        d = h * np.eye(2)[k]
        assert np.allclose(J[..., k], (camera.distort(x + d) - camera.distort(x - d)) / (2 * h), rtol=1e-7, atol=1e-6)


@every_model
def test_derivatives_by_the_coefficients_are_difference_quotients(name):
    camera, h = CAMERAS[name], 1e-6
    x = camera.normalise(view_points(camera, 60, seed=4)[1])
    uv, J = camera.distort_by_coefficients(x)
    assert np.array_equal(uv, camera.distort(x))
    assert J.shape == (60, 2, len(camera.D))
    for column, step in enumerate(h * np.eye(len(camera.D))):
        ahead, behind = (replace(camera, D=camera.D + sign * step).distort(x) for sign in (1.0, -1.0))
        # Rounding of pixels by 1e-13, and second order.
        assert np.allclose(J[:, :, column], (ahead - behind) / (2.0 * h), rtol=1e-6, atol=1e-6)


@every_model
def test_what_lies_behind_is_not_seen(name):
    points = np.array([[0.1, 0.1, -1.0], [0.0, 0.0, 0.0], [0.1, 0.2, 1.0]])
    assert np.isnan(CAMERAS[name].project(points)).all(axis=1).tolist() == [True, True, False]


@pytest.mark.parametrize('model', ['plumb_bob', 'rational_polynomial', 'equidistant'])
def test_the_fold_is_where_the_distorted_radius_falls(model):
    rng, r = np.random.default_rng(3), np.linspace(0.0, 6.0, 2401)
    folds = 0
    for _ in range(30):
        D = rng.normal(0.0, 0.2, len(MODELS[model]))
        if model != 'equidistant':
            D[2:4] = 0.0
        lens = Camera(640, 512, K, model, D)
        falling = np.flatnonzero(np.diff(lens.distort(np.stack([r, 0.0 * r], axis=-1))[:, 0]) <= 0.0)
        visible = np.isfinite(lens.project(np.stack([r, 0.0 * r, np.ones_like(r)], axis=-1))).all(axis=-1)
        folds += len(falling) > 0
        # To a step or two of the grid.
        assert abs(np.count_nonzero(visible) - (falling[0] if len(falling) else len(r))) <= 2
    assert folds > 5


@pytest.mark.parametrize('model', ['plumb_bob', 'rational_polynomial', 'equidistant'])
@pytest.mark.parametrize('size', [5e-324, 1e-313, 1e-160, 1e160, 1e300])
def test_coefficients_of_any_size_do_not_break_a_projection(model, size):
    D = np.full(len(MODELS[model]), size)
    with np.errstate(all='ignore'):
        assert Camera(640, 512, K, model, D).project([0.0, 0.0, 1.0]).shape == (2,)


def test_points_beyond_the_fold_are_not_seen():
    """A strong barrel polynomial folds back: a point far outside would land in the image."""
    camera = Camera(640, 512, K, 'plumb_bob', [-0.3, 0.0, 0.0, 0.0, 0.0])
    fold = 1.0 / np.sqrt(0.9)
    outside, inside = np.array([1.7 * fold, 0.0, 1.0]), np.array([0.97 * fold, 0.0, 1.0])
    assert camera.contains(opencv(camera, outside[None])[0])
    assert np.isnan(camera.project(outside)).all()
    assert np.isfinite(camera.project(inside)).all()


def test_a_wide_fisheye_is_inverted_to_its_border():
    camera = Camera(640, 512, np.array([[240.0, 0, 320], [0, 240.0, 256], [0, 0, 1]]), 'equidistant', [0.0] * 4)
    uv = np.array([[0.0, 256.0], [639.0, 256.0], [320.0, 0.0], [20.0, 100.0]])
    assert np.allclose(camera.distort(camera.normalise(uv)), uv, atol=1e-8)


@pytest.mark.parametrize('D', [[0.0], [0.05], [-0.05], [0.1, -0.02, 0.005, -0.001], [-0.02, 0.01, -0.01, 0.002]])
def test_a_fisheye_is_inverted_to_half_a_degree_from_the_hemisphere(D):
    """OpenCV's inverse is off by a third at 85 degrees where the first coefficient is 0.05."""
    angle = np.radians(np.linspace(0.0, 89.5, 180))[:, None]
    camera = Camera(640, 512, np.array([[200.0, 0, 320], [0, 200.0, 256], [0, 0, 1]]), 'equidistant', D)
    x = np.tan(angle) * [0.6, 0.8]
    # Digits of the radius are lost as the cosine of the angle falls to 0.009, twice in the derivative.
    assert np.allclose(camera.normalise(camera.distort(x)), x, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    ('model', 'D', 'radius'),
    [
        # The hemisphere ends 157 px from the centre, 85 degrees are at 148 px.
        ('equidistant', [0.0], 100.0 * np.radians(85.0)),
        # x (1 - 0.3 x^2) folds back at x = 1.054. Steps of the angle are a fifth of those in the middle at x = 1:
        # (1 + x^2) (1 - 0.9 x^2) = 0.2.
        ('plumb_bob', [-0.3], 100.0 * 1.0 * (1.0 - 0.3)),
    ],
)
def test_pixels_beyond_what_the_lens_can_show(model, D, radius):
    camera = Camera(640, 512, np.array([[100.0, 0, 320], [0, 100.0, 256], [0, 0, 1]]), model, D)
    uv = camera.principal_point + np.array(
        [[0.0, radius - 0.1], [radius + 0.1, 0.0], [-0.6 * radius, 0.8 * radius + 0.1]]
    )
    assert camera.shows(uv).tolist() == [True, False, False]
    assert camera.shows(uv[0])


def test_a_lens_that_nearly_folds_back_shows_nothing_from_there_on():
    """Its slope falls to 0.006 at a radius of 1.65 and rises again: beyond, pixels say nothing of directions."""
    camera = Camera(640, 512, np.array([[392.0, 0, 320], [0, 392.0, 256], [0, 0, 1]]), 'plumb_bob', [-0.243, 0.0268])
    radii = np.linspace(0.0, 1.7, 1701)
    px = camera.distort(radii[:, None] * [1.0, 0.0])
    last = radii[camera.shows(px)][-1]
    step = (camera.distort([[last + 1e-4, 0.0]]) - camera.distort([[last, 0.0]]))[0, 0] / 1e-4
    # Steps of the angle, in the image, over those in the middle; the angle is found to half a degree.
    assert abs(step * (1.0 + last**2) / 392.0 - 0.2) < 0.02
    assert not camera.shows([639.0, 0.0])


@every_model
def test_a_lens_shows_all_of_its_image(name):
    assert CAMERAS[name].shows([[0.0, 0.0], [639.0, 0.0], [639.0, 511.0], [1e6, 0.0]]).all()


@every_model
def test_points_move_in_both_coordinates(name):
    camera = CAMERAS[name]
    px = np.array([[100.0, 80.0], [180.0, 90.0], [170.0, 160.0], [95.0, 150.0]])
    there = ImagePoints.at(px, camera).at_pixels(px + 2.0)
    # Over three pixels a lens bends by a hundredth; twice that allows for its border.
    np.testing.assert_allclose(camera.distort(there.x), there.px, atol=0.02)


def test_single_points_and_batches():
    camera = CAMERAS['equidistant']
    points, uv = view_points(camera, 12)
    assert np.allclose(camera.project(points.reshape(3, 4, 3)), uv.reshape(3, 4, 2))
    assert np.allclose(camera.project(points[0]), uv[0])
    assert camera.project_jacobian(points.reshape(3, 4, 3))[1].shape == (3, 4, 2, 3)


def test_contains_and_its_margin():
    camera = CAMERAS['pinhole']
    uv = np.array([[0.0, 0.0], [639.0, 511.0], [639.1, 10.0], [-0.1, 10.0], [5.0, 5.0], [np.nan, 3.0]])
    assert camera.contains(uv).tolist() == [True, True, False, False, True, False]
    assert camera.contains(uv, 5.0).tolist() == [False, False, False, False, True, False]


def test_matches_is_equality_of_all():
    camera = CAMERAS['plumb_bob']
    assert camera.matches(Camera(640, 512, K.copy(), 'plumb_bob', camera.D.tolist()))
    assert camera.matches(Camera(640, 512, K.ravel(), 'plumb_bob', camera.D))
    for other in (Camera(640, 480, K, 'plumb_bob', camera.D), Camera(640, 512, K), CAMERAS['equidistant']):
        assert not camera.matches(other)


def test_short_coefficients_are_filled_up():
    assert Camera(640, 512, K, 'plumb_bob', [-0.3, 0.1, 0.0, 0.0]).D.tolist() == [-0.3, 0.1, 0.0, 0.0, 0.0]
    assert Camera(640, 512, K, 'plumb_bob', [0.0] * 14).D.tolist() == [0.0] * 5
    assert Camera(640, 512, K).focal_px == pytest.approx(np.sqrt(441.2 * 439.8))


@pytest.mark.parametrize(
    ('arguments', 'words'),
    [
        ((640, 512, K, 'tangent'), "'tangent' is not one of"),
        ((640, 512, K, 'equidistant', [0.1] * 5), 'takes 4 coefficients, not 5'),
        ((640, 512, [745.0, 745.0, 319.5, 255.5]), r'shape \(4,\), not \(3, 3\)'),
        ((640, 512, K.T), 'not of the form'),
        ((640, 512, np.zeros((3, 3))), 'not calibrated'),
        ((640, 512, np.full((3, 3), np.nan)), 'not calibrated'),
        ((640, 512, K, 'plumb_bob', [np.inf, 0, 0, 0, 0]), 'not calibrated'),
        ((0, 512, K), 'image size 0x512'),
        ((640.5, 512, K), 'image size 640.5x512'),
        (('640', 512, K), 'image size 640x512'),
        ((640, 512, [[745.0, 0.0], [319.5]]), 'camera matrix that is not of real numbers'),
        ((640, 512, np.full((3, 3), 'a')), 'camera matrix that is not of real numbers'),
        ((640, 512, K, 'plumb_bob', ['-0.3 0.1']), 'distortion that is not of real numbers'),
        ((640, 512, K, 'plumb_bob', [1j]), 'distortion that is not of real numbers'),
    ],
)
def test_what_is_no_calibration_is_refused(arguments, words):
    with pytest.raises(InputError, match=words):
        Camera(*arguments)
