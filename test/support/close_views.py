"""Markers so near that the image cuts them off, drawn from their geometry alone: nothing of the detector is used."""

from functools import lru_cache

import cv2
import numpy as np

from support.lens_planes import on_plane, rays
from thermal_fiducial.core.geometry import se3
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.files.dictionary import load_dictionary

K = [[265.0, 0, 158.5], [0, 264.0, 129.5], [0, 0, 1]]
CAMERAS = {
    'plumb_bob': Camera(320, 256, K, 'plumb_bob', [-0.15, 0.03, 1e-4, -2e-4, 0.0]),
    'rational_polynomial': Camera(320, 256, K, 'rational_polynomial', [0.3, 0.05, 1e-4, -2e-4, 0.01, 0.6, 0.1, 0.02]),
    'equidistant': Camera(320, 256, K, 'equidistant', [-0.02, -0.006, 0.0055, -0.0019]),
}
DICTIONARY = load_dictionary('DICT_4X4_50')
BITS = DICTIONARY.bits
BLUR = 0.6
#: Optics, and the pixel's own square over which the drawing averages.
BLUR_WITH_PIXEL = float(np.hypot(BLUR, np.sqrt(1 / 12)))
#: Rows that are drawn at a time.
STRIP = 32


def pose(size_px, u, v, tilt, size=0.3):
    """T_camera_marker of a marker that looks so large, its middle in the direction (u, v) of normalised coordinates."""
    R = se3.so3_exp(tilt) @ np.diag([1.0, -1.0, -1.0])
    return se3.transform(R, np.array([u, v, 1.0]) * size * 265.0 / size_px)


@lru_cache(maxsize=1)
def strips(model, samples):
    """Rays of all samples of the camera of a model, in strips of rows: solved once for all views by one lens."""
    camera = CAMERAS[model]
    u, v = ((np.arange(pixels * samples) + 0.5) / samples - 0.5 for pixels in (camera.width, camera.height))
    return [rays(camera, u, rows) for rows in np.split(v, range(STRIP * samples, len(v), STRIP * samples))]


def draw(model, grid, T, size=0.3, samples=4, blur=BLUR, thickness=0.0):
    """White's share (height, width) of a plate at T_camera_marker, seen by the camera of a model of the lens.

    ``grid`` has the cells of the plate, a white ring about it.

    White is what is seen through the holes of both its face and its back, ``thickness`` behind it.
    """
    camera = CAMERAS[model]
    image = np.empty((camera.height, camera.width), dtype=np.float32)
    # Strips of rows stay in the cache of the processor.
    for first, (a, b) in zip(range(0, camera.height, STRIP), strips(model, samples), strict=True):
        seen = cells_at(grid, size, *on_plane(T, a, b))
        if thickness:
            back = T @ se3.transform(np.eye(3), [0.0, 0.0, -thickness])
            seen = np.minimum(seen, cells_at(grid, size, *on_plane(back, a, b)))
        shares = seen.reshape(-1, samples, camera.width, samples)
        image[first : first + STRIP] = shares.mean(axis=(1, 3))
    return cv2.GaussianBlur(image, (0, 0), blur) if blur > 0.0 else image


def cells_at(grid, size, x, y):
    """Values of the cells at points of the marker's plane."""
    cells = len(grid) - 2
    column = np.clip(np.floor((x / size + 0.5) * cells) + 1, 0, cells + 1).astype(int)
    row = np.clip(np.floor((0.5 - y / size) * cells) + 1, 0, cells + 1).astype(int)
    return grid[row, column]


def plate(marker_id):
    """Cells of a marker with its white ring."""
    return np.pad(np.pad(BITS[marker_id].astype(float), 1), 1, constant_values=1.0)
