import numpy as np
import pytest

from thermal_fiducial.core.detection.corners.sides import sides_of
from thermal_fiducial.core.geometry import se3
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.geometry.planar_pose import marker_corners

CAMERA = Camera(640, 512, [[765.0, 0, 319.5], [0, 765.0, 255.5], [0, 0, 1]], 'plumb_bob', [-0.2, 0.05, 0, 0, 0])


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
