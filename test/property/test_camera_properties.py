"""What holds for every lens that a thermal camera may have."""

from hypothesis import assume, given
from hypothesis import strategies as st
import numpy as np

from thermal_fiducial.core.geometry.camera import Camera, MODELS

focals = st.floats(400.0, 1200.0)  # 7.5 to 20 mm lenses of a 17 um array
pixels = st.tuples(st.floats(0.0, 639.0), st.floats(0.0, 511.0)).map(np.array)
distances = st.floats(0.2, 50.0)


def coefficients(*limits):
    return st.tuples(*(st.floats(-limit, limit) for limit in limits)).map(list)


LENSES = {
    'plumb_bob': coefficients(0.3, 0.1, 2e-3, 2e-3, 0.02),
    'rational_polynomial': coefficients(0.3, 0.05, 2e-3, 2e-3, 0.01, 0.3, 0.05, 0.01),
    'equidistant': coefficients(0.15, 0.03, 0.01, 0.003),
}


@st.composite
def cameras(draw):
    model = draw(st.sampled_from(sorted(MODELS)))
    fx = draw(focals)
    K = [
        [fx, 0, draw(st.floats(300, 340))],
        [0, fx * draw(st.floats(0.99, 1.01)), draw(st.floats(236, 276))],
        [0, 0, 1],
    ]
    return Camera(640, 512, K, model, draw(LENSES[model]))


def invertible(camera):
    """Whether the lens shows its whole image once: some coefficients are no lens."""
    border = np.array([[0.0, 0], [639, 0], [0, 511], [639, 511], [320, 0], [0, 256], [639, 256], [320, 511]])
    rays = camera.rays(border)
    return bool(np.all(np.isfinite(rays)) and np.allclose(camera.project(rays), border, atol=1e-6))


#: In the corners of its image normalised coordinates are infinite.
FOLDED = Camera(
    640, 512, np.array([[400.0, 0, 300], [0, 400, 250], [0, 0, 1]]), 'equidistant', [-0.140625, -0.015625, 0, 0]
)


def test_a_pixel_that_the_lens_does_not_show_has_no_ray_and_gives_no_warning():
    assert not invertible(FOLDED)
    assert np.isnan(FOLDED.rays([0.0, 0.0])).any()


@given(cameras(), pixels, distances)
def test_every_pixel_has_its_ray(camera, uv, distance):
    assume(invertible(camera))
    assert np.allclose(camera.project(distance * camera.rays(uv)), uv, atol=1e-8)


@given(cameras(), pixels, distances)
def test_distance_does_not_matter(camera, uv, distance):
    assume(invertible(camera))
    ray = camera.rays(uv)
    assert np.allclose(camera.project(ray), camera.project(distance * ray), atol=1e-9)


@given(cameras(), pixels, distances)
def test_the_derivative_along_the_ray_is_zero(camera, uv, distance):
    assume(invertible(camera))
    point = distance * camera.rays(uv)
    J = camera.project_jacobian(point)[1]
    assert np.allclose(J @ point, 0.0, atol=1e-7)


@given(cameras(), pixels, distances)
def test_the_derivative_is_the_difference_quotient(camera, uv, distance):
    assume(invertible(camera))
    point, h = distance * camera.rays(uv), 1e-6 * distance
    J = camera.project_jacobian(point)[1]
    numeric = [(camera.project(point + h * e) - camera.project(point - h * e)) / (2 * h) for e in np.eye(3)]
    assert np.allclose(J, np.stack(numeric, axis=1), rtol=1e-5, atol=1e-5 / distance)
