"""Pixels across the sides of markers."""

import cv2
import numpy as np
import pytest

from thermal_fiducial.core.detection.corners.sides import sides_of
from thermal_fiducial.core.geometry.camera import Camera

CAMERA = Camera(640, 512, [[529.0, 0, 319.5], [0, 527.0, 255.5], [0, 0, 1]], 'plumb_bob', [-0.3, 0.1, 1e-4, -2e-4, 0.0])
CORNERS = np.array(
    [
        [[100.0, 80.0], [180.0, 90.0], [170.0, 160.0], [95.0, 150.0]],
        [[400.0, 300.0], [440.0, 310.0], [430.0, 350.0], [392.0, 338.0]],
    ]
)


@pytest.fixture
def image():
    noise = np.random.default_rng(1).normal(7000.0, 50.0, (512, 640)).astype(np.float32)
    return cv2.GaussianBlur(noise, (0, 0), 1.5)


def test_pixels_lie_across_the_sides(image):
    sides = sides_of(CAMERA.normalise(CORNERS), CAMERA, image.shape, cells=6, columns=6, blur_px=1.5)
    v, u = np.divmod(sides.pixel, 640)
    # Moved back along the normal by its distance, every pixel of the top side lies between the two upper corners.
    place = np.stack([u, v], axis=-1) - sides.distance[..., None] * sides.normal
    for marker, corners in enumerate(CAMERA.normalise(CORNERS)):
        side = corners[1] - corners[0]
        off = (CAMERA.normalise(place[:, :, 4 * marker]) - corners[0]) @ [-side[1], side[0]] / np.linalg.norm(side)
        # Without distortion sides are straight; a hundredth of a pixel is what the lens bends in five.
        assert np.abs(off).max() * CAMERA.focal_px < 0.02
    assert sides.inside is None
    assert np.all(sides.distance[-1] * sides.distance[0] < 0.0)


def test_columns_beyond_the_image_do_not_count(image):
    corners = CORNERS[:1] - [97.0, 60.0]
    sides = sides_of(CAMERA.normalise(corners), CAMERA, image.shape, cells=6, columns=6, blur_px=1.5)
    # The left side is cut off by the border of the image: its lower half lies outside, the top side does not.
    assert sides.inside is not None
    assert sides.fresh[:, 0].any()
    assert not sides.fresh[:, 2].all()
