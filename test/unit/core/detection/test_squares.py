"""What is known of a marker's outline beforehand."""

import numpy as np

from thermal_fiducial.core.detection.corners.squares import as_squares
from thermal_fiducial.core.geometry import se3
from thermal_fiducial.core.geometry.camera import Camera, ImagePoints
from thermal_fiducial.core.geometry.planar_pose import solve_marker_poses, squareness
from thermal_fiducial.core.geometry.reprojection import marker_corners

CAMERA = Camera(640, 512, [[529.0, 0, 319.5], [0, 529.0, 255.5], [0, 0, 1]], 'plumb_bob', [-0.3, 0.1, 0, 0, 0])


def views(count, outline):
    """Corners of ``outline`` (4, 3) in poses like those of markers that can be read."""
    rng = np.random.default_rng(3)
    R = np.stack([se3.so3_exp(tilt) for tilt in rng.uniform(-0.8, 0.8, (count, 3))]) @ np.diag([1.0, -1.0, -1.0])
    centre = rng.uniform([-0.5, -0.4, 1.0], [0.5, 0.4, 1.0], (count, 3)) * rng.uniform(1.0, 6.0, (count, 1))
    points = outline @ np.swapaxes(R, 1, 2) + centre[:, None]
    return ImagePoints.seen_at(points[..., :2] / points[..., 2:], CAMERA)


def test_views_of_squares_are_square_and_those_of_others_as_far_off_as_these():
    square = marker_corners(0.3)
    seen = views(50, square)
    np.testing.assert_allclose(squareness(seen.x, seen.inverse)[0][..., 0], 0.0, atol=1e-12)
    # Longer by 1 % from left to right: squares of the sides differ by 2 % of their mean. Sheared by 1 %: the cosine of
    # the angle; both to first order.
    longer, sheared = (views(50, square @ A.T) for A in (np.diag([1.01, 1.0, 1.0]), np.eye(3) + 0.01 * np.eye(3, k=1)))
    np.testing.assert_allclose(
        squareness(longer.x, longer.inverse)[0][..., 0], np.tile([0.0, 0.01], (50, 1)), atol=1e-4
    )
    off = np.abs(squareness(sheared.x, sheared.inverse)[0][..., 0])
    np.testing.assert_allclose(off, np.tile([0.01, 0.0], (50, 1)), atol=1e-4)


def test_derivative_by_the_corners_in_pixels():
    seen, step = views(20, marker_corners(0.3)), np.random.default_rng(4).normal(0.0, 1e-3, (20, 4, 2))
    _, derivative = squareness(seen.x, seen.inverse)
    later, earlier = (ImagePoints.at(seen.px + sign * step, CAMERA) for sign in (1.0, -1.0))
    difference = 0.5 * (squareness(later.x, later.inverse)[0] - squareness(earlier.x, earlier.inverse)[0])[..., 0]
    # Of changes of about 1e-3, what the second derivative of the distortion leaves.
    np.testing.assert_allclose((derivative @ step.reshape(20, 8, 1))[..., 0], difference, rtol=1e-4, atol=1e-7)


def test_corners_are_those_of_squares_with_consistent_covariance():
    truth, sigma = views(400, marker_corners(0.3)), 0.03
    noise = np.random.default_rng(5).normal(0.0, sigma, (400, 8, 1))
    known = as_squares(truth, noise, np.tile(sigma**2 * np.eye(8), (400, 1, 1)))
    nees = np.sum(known.moved * np.linalg.solve(known.covariance, known.moved), axis=(1, 2))
    # The six of a square, and up to two, as these are squares without error; four standard errors of the mean of 400.
    assert 6.0 - 4.0 * np.sqrt(12.0 / 400) < nees.mean() < 8.0 + 4.0 * np.sqrt(16.0 / 400)
    assert np.mean(known.moved**2) < 0.9 * sigma**2
    # Of 400 true squares about one is as far off by chance as an outline that is none.
    assert np.count_nonzero(known.doubt) <= 4


def test_small_outlines_that_begin_far_off_stay_where_they_are_seen():
    """Of sides of 6 px and more; begun a pixel off, the constraints bend between there and the truth."""
    truth, sigma = views(400, marker_corners(0.15)), 0.3
    rng = np.random.default_rng(6)
    begun = ImagePoints.at(truth.px + rng.uniform(-1.0, 1.0, (400, 4, 2)), CAMERA)
    off = (truth.px - begun.px).reshape(400, 8, 1)
    known = as_squares(begun, off + rng.normal(0.0, sigma, off.shape), np.tile(sigma**2 * np.eye(8), (400, 1, 1)))
    # 4.2 when written, of 3200 normal errors up to 3.5; 47 outlines ran away, by up to 93, where the linearised
    # constraints were taken for exact.
    assert np.abs(known.moved - off).max() < 6.0 * sigma


def test_noisy_views_of_small_squares_are_squares():
    """Of sides of 9 px and more in noise of 0.6 px: many tilts are within it, and where they vanish the views fold."""
    truth, sigma = views(400, marker_corners(0.1)), 0.6
    noise = np.random.default_rng(1).normal(0.0, sigma, (400, 8, 1))
    begun = truth.at_pixels(truth.px + noise.reshape(400, 4, 2))
    known = as_squares(begun, np.zeros((400, 8, 1)), np.tile(sigma**2 * np.eye(8), (400, 1, 1)))
    # One true square in 400 is as far off by chance; four standard deviations of their number. It was one in five.
    assert np.count_nonzero(known.doubt) <= 5
    # Per coordinate; 1 within four standard errors of the mean of 400 if all 8 were independent.
    error = (known.moved + noise).reshape(400, 4, 2)
    nees = np.einsum('nki,nkij,nkj->n', error, np.linalg.inv(known.corner_covariances), error) / 8.0
    assert nees.mean() < 1.0 + 4.0 * np.sqrt(2.0 / 8.0 / 400.0)


def test_the_square_constrains_corners_that_the_image_does_not():
    truth = views(50, marker_corners(0.3))
    faint, clear = (
        as_squares(truth, np.zeros((50, 8, 1)), np.tile(sigma**2 * np.eye(8), (50, 1, 1))).constrained
        for sigma in (3.0, 1e-4)
    )
    # Both of its conditions, or none.
    np.testing.assert_allclose(faint, 2.0, atol=0.1)
    np.testing.assert_allclose(clear, 0.0, atol=0.1)


def test_an_outline_that_is_no_square_is_reported():
    seen = views(50, marker_corners(0.3) * [1.1, 1.0, 1.0])
    known = as_squares(seen, np.zeros((50, 8, 1)), np.tile(0.01**2 * np.eye(8), (50, 1, 1)))
    assert np.count_nonzero(known.doubt) > 40


def test_a_square_of_the_other_tilt_is_left_for_the_true_one():
    centre, tilt = np.array([0.5, -0.3, 4.0]), np.array([0.4, 0.3, 0.2])
    T = se3.transform(se3.so3_exp(tilt) @ np.diag([1.0, -1.0, -1.0]), centre)
    true_px = CAMERA.project(se3.apply(T, marker_corners(0.3)))[None]
    unit = np.tile(np.eye(2), (1, 4, 1, 1))
    other = solve_marker_poses(true_px, 0.01**2 * unit, np.array([0.3]), CAMERA).T_camera_marker[0, 1]
    start = ImagePoints.at(CAMERA.project(se3.apply(other, marker_corners(0.3)))[None], CAMERA)
    off = (true_px - start.px).reshape(1, 8, 1)
    assert np.abs(off).max() > 0.1
    known = as_squares(start, off, 0.01**2 * np.eye(8)[None])
    # The corners are seen without noise, so hardly anything moves them off the true square.
    np.testing.assert_allclose(known.moved, off, atol=0.01)
    assert known.chi2[0] < 1.0
