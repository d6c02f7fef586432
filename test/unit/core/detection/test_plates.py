"""Plates of some thickness: where their outlines end, and corners of their faces in pictures of them."""

import cv2
import numpy as np
import pytest

from thermal_fiducial.config import ArucoDetectorConfig
from thermal_fiducial.core.detection.detector import MarkerDetector
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.geometry.reprojection import marker_corners, outlines_on_faces
from thermal_fiducial.core.geometry.se3 import apply, so3_exp, transform
from thermal_fiducial.core.measurements import corners_px
from thermal_fiducial.files.dictionary import load_dictionary

SIZE, THICKNESS = 0.3, 0.003
DICTIONARY = 'STENCIL_4X4_100'
CAMERA = Camera(96, 96, np.array([[420.0, 0.0, 47.5], [0.0, 420.0, 47.5], [0.0, 0.0, 1.0]]))
# Pictures are drawn so many times finer.
FINER = 8
PLACES = ((np.mgrid[0 : FINER * CAMERA.height, 0 : FINER * CAMERA.width] + 0.5) / FINER - 0.5).astype(np.float32)
# Of optics and pixel, as the detector's default; the mean over a pixel is of it.
BLUR_PX = np.sqrt(0.66**2 - 1.0 / 12.0)


def test_an_outline_is_where_rays_past_the_back_edges_cross_the_face():
    rng = np.random.default_rng(1)
    faces, cameras = marker_corners(np.full(200, SIZE)), rng.uniform([-4.0, -4.0, 0.2], 4.0, (200, 3))
    depth = np.array([0.0, 0.0, THICKNESS])
    back = faces - depth
    along = cameras[:, None, 2:] / (cameras[:, None, 2:] - back[..., 2:])
    crossed = cameras[:, None] + along * (back - cameras[:, None])
    farther = np.where(np.abs(crossed) > np.abs(faces), crossed, faces)
    # Where the ray comes from beyond the other side the face itself is the outline.
    farther = np.where(np.sign(crossed) == np.sign(faces), farther, faces)
    outlines = outlines_on_faces(faces, np.sign(faces[..., :2]), cameras, THICKNESS)
    # Rounding of metres.
    np.testing.assert_allclose(outlines, farther, atol=1e-12)
    seen_from_side = np.any(outlines != faces, axis=(1, 2))
    assert 0.5 < np.mean(seen_from_side) < 1.0


def drawn(T_camera_marker, bits, thickness, rng):
    """Counts of a plate before something warm, whose cut sides are as cold as its face."""
    n = len(bits) + 2

    def pixels(xy):
        """Of points on the face, and of those behind them on the back."""
        both = [np.column_stack((xy, np.full(len(xy), z))) for z in (0.0, -thickness)]
        return [CAMERA.project(apply(T_camera_marker, points)).astype(np.float32) for points in both]

    corners = np.concatenate(pixels(marker_corners(SIZE)[:, :2]))
    cold = inside(cv2.convexHull(corners)[:, 0])
    through = [np.zeros_like(cold), np.zeros_like(cold)]
    for row, column in zip(*np.nonzero(bits), strict=True):
        cell = np.array([[column, row], [column + 1, row], [column + 1, row + 1], [column, row + 1]]) + 1
        for hole, outline in zip(through, pixels(SIZE * (cell / n - 0.5) * [1.0, -1.0]), strict=True):
            hole |= inside(outline)
    warm = (~cold | (through[0] & through[1])).astype(np.float32)
    picture = warm.reshape(CAMERA.height, FINER, CAMERA.width, FINER).mean(axis=(1, 3))
    picture = cv2.GaussianBlur(picture, (0, 0), BLUR_PX)
    return np.rint(8000.0 + 300.0 * picture + rng.normal(0.0, 1.5, picture.shape)).astype(np.uint16)


def inside(polygon):
    """Which places of the fine picture lie inside a convex polygon (n, 2)."""
    y, x = PLACES
    ends = np.roll(polygon, -1, axis=0)
    turns = [
        (x1 - x0) * (y - y0) - (y1 - y0) * (x - x0) > 0.0 for (x0, y0), (x1, y1) in zip(polygon, ends, strict=True)
    ]
    return np.logical_and.reduce(turns) | np.logical_and.reduce([~turn for turn in turns])


def views(count, rng):
    """T_camera_marker of a marker of 30 to 40 px that is turned by 25 to 45 deg."""
    for _ in range(count):
        axis = rng.uniform(0.0, 2.0 * np.pi)
        tilt = rng.uniform(np.deg2rad(25.0), np.deg2rad(45.0))
        R = np.diag([1.0, -1.0, -1.0]) @ so3_exp(tilt * np.array([np.cos(axis), np.sin(axis), 0.0]))
        yield transform(R, [rng.uniform(-0.1, 0.1), rng.uniform(-0.1, 0.1), rng.uniform(3.2, 4.2)])


@pytest.mark.parametrize(
    ('thickness', 'declared', 'least_px', 'most_px'),
    [
        # Measured 0.021, 0.100 and 0.022 px; a half more, and a fifth less.
        (0.0, 0.0, 0.0, 0.03),
        (THICKNESS, 0.0, 0.08, 0.15),
        (THICKNESS, THICKNESS, 0.0, 0.03),
    ],
)
def test_corners_are_those_of_the_face(thickness, declared, least_px, most_px):
    rng, dictionary, errors = np.random.default_rng(2), load_dictionary(DICTIONARY), []
    config = ArucoDetectorConfig(dictionary=DICTIONARY, marker_size=SIZE, plate_thickness=declared, bolometer_lag=0.0)
    for T in views(8, rng):
        rows = MarkerDetector(config, dictionary).detect(1, drawn(T, dictionary.bits[7], thickness, rng), CAMERA)
        assert list(rows['id']) == [7]
        errors.append(corners_px(rows)[0] - CAMERA.project(apply(T, marker_corners(SIZE))))
    assert least_px <= np.sqrt(np.mean(np.square(errors))) < most_px
