"""Pixels across the sides of markers."""

import cv2
import numpy as np
import pytest

from thermal_fiducial.core.detection.corners.sides import sides_of
from thermal_fiducial.core.geometry import se3
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.geometry.reprojection import marker_corners

CAMERA = Camera(640, 512, [[765.0, 0, 319.5], [0, 765.0, 255.5], [0, 0, 1]], 'plumb_bob', [-0.2, 0.05, 0, 0, 0])

BENT = Camera(640, 512, [[529.0, 0, 319.5], [0, 527.0, 255.5], [0, 0, 1]], 'plumb_bob', [-0.3, 0.1, 1e-4, -2e-4, 0.0])
TWO_MARKERS = np.array(
    [
        [[100.0, 80.0], [180.0, 90.0], [170.0, 160.0], [95.0, 150.0]],
        [[400.0, 300.0], [440.0, 310.0], [430.0, 350.0], [392.0, 338.0]],
    ]
)


@pytest.mark.parametrize('tilt_deg', [0.0, 40.0, 60.0, 75.0])
def test_distances_grow_inward_however_the_square_is_turned_and_tilted(tilt_deg):
    tilt = np.deg2rad(tilt_deg)
    for turn, axis in np.deg2rad(
        np.stack(np.meshgrid(np.arange(0, 360, 15), np.arange(0, 180, 15)), -1).reshape(-1, 2)
    ):
        R = se3.so3_exp([tilt * np.cos(axis), tilt * np.sin(axis), 0.0]) @ se3.so3_exp([np.pi, 0.0, 0.0])
        T = se3.transform(R @ se3.so3_exp([0.0, 0.0, turn]), [0.2, -0.1, 3.0])
        points = se3.apply(T, marker_corners(0.3))
        x = (points[:, :2] / points[:, 2:])[None]
        sides = sides_of(x, CAMERA, (512, 640), 6, 6, 1.0)
        corners = CAMERA.distort(x)[0]
        middles = 0.5 * (corners[[0, 3, 0, 1]] + corners[[1, 2, 3, 2]])
        inward = np.sum(sides.normal[:, 3] * (corners.mean(axis=0) - middles), axis=1)
        # Half the width of the square across each side, to the fraction of a pixel that distortion bends it by.
        np.testing.assert_allclose(inward, 0.5 * sides.across[:, 0], atol=0.5)
        distance = sides.distance[:, 0, :, 3]
        assert np.all(np.abs(distance).argmin(axis=0) == 4)
        assert np.all(np.diff(distance, axis=0) * np.sign(np.diff(distance[:2], axis=0)) > 0.0)


@pytest.fixture
def image():
    noise = np.random.default_rng(1).normal(7000.0, 50.0, (512, 640)).astype(np.float32)
    return cv2.GaussianBlur(noise, (0, 0), 1.5)


def test_pixels_lie_across_the_sides(image):
    sides = sides_of(BENT.normalise(TWO_MARKERS), BENT, image.shape, cells=6, columns=6, blur_px=1.5)
    v, u = np.divmod(sides.pixel, 640)
    # Moved back along the normal by its distance, every pixel of the top side lies between the two upper corners.
    place = np.stack([u, v], axis=-1) - sides.distance[..., None] * sides.normal
    for marker, corners in enumerate(BENT.normalise(TWO_MARKERS)):
        side = corners[1] - corners[0]
        off = (BENT.normalise(place[:, :, 4 * marker]) - corners[0]) @ [-side[1], side[0]] / np.linalg.norm(side)
        # Without distortion sides are straight; a hundredth of a pixel is what the lens bends in five.
        assert np.abs(off).max() * BENT.focal_px < 0.02
    assert sides.inside is None
    assert np.all(sides.distance[-1] * sides.distance[0] < 0.0)


def test_columns_beyond_the_image_do_not_count(image):
    corners = TWO_MARKERS[:1] - [97.0, 60.0]
    sides = sides_of(BENT.normalise(corners), BENT, image.shape, cells=6, columns=6, blur_px=1.5)
    # The left side is cut off by the border of the image: its lower half lies outside, the top side does not.
    assert sides.inside is not None
    assert sides.fresh[:, 0].any()
    assert not sides.fresh[:, 2].all()
