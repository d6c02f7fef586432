"""What is known of a marker's outline beforehand."""

import numpy as np

from thermal_fiducial.core import geometry
from thermal_fiducial.core.adjustment.squares import squareness
from thermal_fiducial.core.camera import Camera, ImagePoints
from thermal_fiducial.core.pose import marker_corners

CAMERA = Camera(640, 512, [[529.0, 0, 319.5], [0, 529.0, 255.5], [0, 0, 1]], 'plumb_bob', [-0.3, 0.1, 0, 0, 0])


def views(count, outline):
    """Corners of ``outline`` (4, 3) in poses like those of markers that can be read."""
    rng = np.random.default_rng(3)
    R = np.stack([geometry.so3_exp(tilt) for tilt in rng.uniform(-0.8, 0.8, (count, 3))]) @ np.diag([1.0, -1.0, -1.0])
    centre = rng.uniform([-0.5, -0.4, 1.0], [0.5, 0.4, 1.0], (count, 3)) * rng.uniform(1.0, 6.0, (count, 1))
    points = outline @ np.swapaxes(R, 1, 2) + centre[:, None]
    return ImagePoints.seen_at(points[..., :2] / points[..., 2:], CAMERA)


def test_views_of_squares_are_square_and_those_of_others_as_far_off_as_these():
    square = marker_corners(0.3)
    seen = views(50, square)
    np.testing.assert_allclose(squareness(seen.x, seen.inverse).value, 0.0, atol=1e-12)
    # Longer by 1 % from left to right: squares of the sides differ by 2 % of their mean. Sheared by 1 %: the cosine of
    # the angle; both to first order.
    longer, sheared = (views(50, square @ A.T) for A in (np.diag([1.01, 1.0, 1.0]), np.eye(3) + 0.01 * np.eye(3, k=1)))
    np.testing.assert_allclose(squareness(longer.x, longer.inverse).value, np.tile([0.0, 0.01], (50, 1)), atol=1e-4)
    off = np.abs(squareness(sheared.x, sheared.inverse).value)
    np.testing.assert_allclose(off, np.tile([0.01, 0.0], (50, 1)), atol=1e-4)


def test_derivative_by_the_corners_in_pixels():
    seen, step = views(20, marker_corners(0.3)), np.random.default_rng(4).normal(0.0, 1e-3, (20, 4, 2))
    known = squareness(seen.x, seen.inverse)
    later, earlier = (ImagePoints.at(seen.px + sign * step, CAMERA) for sign in (1.0, -1.0))
    difference = 0.5 * (squareness(later.x, later.inverse).value - squareness(earlier.x, earlier.inverse).value)
    # Of changes of about 1e-3, what the second derivative of the distortion leaves.
    np.testing.assert_allclose((known.derivative @ step.reshape(20, 8, 1))[..., 0], difference, rtol=1e-4, atol=1e-7)
