"""Rows that are read one after the other."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from thermal_fiducial.config import ArucoDetectorConfig
from thermal_fiducial.core.detection.corners.gray_scale import UNKNOWN_SCALE
from thermal_fiducial.core.detection.corners.refining import refine
from thermal_fiducial.core.detection.patterns import Decoder
from thermal_fiducial.core.detection.prediction.frame import (
    delays,
    Frame,
    motion_blur,
    Places,
    rolling_displacement,
)
from thermal_fiducial.core.detection.prediction.known_markers import FoundMarkers
from thermal_fiducial.core.detection.prediction.tracking import MotionTrack
from thermal_fiducial.core.detection.prediction.twist import Twist
from thermal_fiducial.core.geometry import se3
from thermal_fiducial.core.geometry.camera import Camera, ImagePoints
from thermal_fiducial.files.dictionary import load_dictionary

CAMERA = Camera(640, 512, [[440.0, 0, 319.5], [0, 440.0, 255.5], [0, 0, 1]], 'plumb_bob', [-0.3, 0.1, 0, 0, 0])
TWIST = Twist(np.array([0.8, -1.5, 0.6, -1.8, 1.5, 0.8]), np.eye(6), np.array([3.0, 0.0, 2.0, 6.0, -4.0, 5.0]))
IMAGE = np.zeros((512, 640), dtype=np.float32)
FRAME = Frame(0, IMAGE, 1.0, CAMERA, TWIST, 0.0, 0.025, 0.66, IMAGE)


def points():
    """Corners (N, 4, 3) of squares all over the view."""
    centres = np.random.default_rng(3).uniform([-1.2, -0.9, 2.0], [1.2, 0.9, 4.0], (12, 3))
    return centres[:, None] + 0.15 * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])


def seen_after(corners, seconds):
    """Pixels of corners (..., 3) when the camera has moved with TWIST for ``seconds`` (...), exactly."""
    result = np.empty((*corners.shape[:-1], 2))
    for index in np.ndindex(seconds.shape):
        T, steps = np.eye(4), 40
        dt = seconds[index] / steps
        for k in range(steps):
            twist = TWIST.value + (k + 0.5) * dt * TWIST.acceleration
            T = T @ se3.transform(se3.so3_exp(twist[3:] * dt), twist[:3] * dt)
        p = se3.apply(se3.inverse(T), corners[index][None])[0]
        result[index] = CAMERA.distort(p[:2] / p[2])
    return result


def places_of(corners):
    return Places.of(ImagePoints.seen_at(corners[..., :2] / corners[..., 2:], CAMERA), corners[..., 2])


def rows_read(corners):
    """Pixels (..., 2) that show corners when their own rows are read."""
    seconds = np.zeros(corners.shape[:-1])
    for _ in range(8):
        seconds = delays(seen_after(corners, seconds)[..., 1], FRAME)
    return seen_after(corners, seconds)


def test_corners_are_found_where_their_rows_show_them():
    corners = points()
    places, seen = places_of(corners), rows_read(corners)
    off = seen - places.points.px
    assert np.abs(off).max() > 5.0
    # 0.003 px is what the third order leaves, 0.06 px would be what the bent ways do.
    np.testing.assert_allclose(rolling_displacement(places, TWIST, FRAME, seen[..., 1]), off, atol=0.01)
    # Where they are looked for: 0.17 px is what the rows do by which they have moved until then.
    np.testing.assert_allclose(rolling_displacement(places, TWIST, FRAME), off, atol=0.2)


def test_nothing_moves_when_all_rows_are_read_at_once():
    places, at_once = places_of(points()), replace(FRAME, readout=0.0)
    for result in (
        rolling_displacement(places, TWIST, at_once),
        rolling_displacement(places, None, FRAME),
        rolling_displacement(places, TWIST, at_once, places.points.px[..., 1]),
        rolling_displacement(places, None, FRAME, places.points.px[..., 1]),
    ):
        np.testing.assert_array_equal(result, np.zeros_like(places.points.px))


@pytest.mark.parametrize('lag', [0.0005, 0.010])
def test_rows_that_are_read_later_are_displaced_and_no_more_blurred(lag):
    """By a little lag, of which nothing is removed, and by much, whose tails are."""
    places = places_of(points())
    motion = motion_blur(replace(FRAME, lag=lag), places, TWIST)
    assert (motion.to_tails is None) == (lag < 0.001)
    np.testing.assert_allclose(motion.lag, places.lag_blur(TWIST, lag), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize('readout', [0.025, -0.025])
def test_corners_of_rows_that_are_read_early_claim_what_the_twist_is_uncertain_by(readout):
    """A marker near the top of the image, at rest, by a twist that is known to 0.1 rad/s."""
    decoder = Decoder(load_dictionary('DICT_4X4_50').bits)
    image = np.full((512, 640), 7000.0)
    cells = np.pad(decoder.patterns(np.array([7]), np.array([0]))[0], 1, constant_values=1.0)
    image[28:124, 268:364] += 200.0 * np.kron(cells, np.ones((12, 12)))
    image = cv2.GaussianBlur(image, (0, 0), 0.6) + np.random.default_rng(0).normal(0.0, 1.0, image.shape)
    corners = np.array([279.5, 39.5]) + 72.0 * np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    camera, one = Camera(640, 512, [[440.0, 0, 319.5], [0, 440.0, 255.5], [0, 0, 1]]), np.ones(1, dtype=bool)
    still = Twist(np.zeros(6), np.diag([0.0, 0.0, 0.0, 0.1, 0.1, 0.0]) ** 2)
    frame = Frame(0, image.astype(np.float32), 1.0, camera, still, 0.0, readout, ArucoDetectorConfig().blur_px, image)
    found = FoundMarkers(
        np.array([7]),
        Places.of(ImagePoints.at(corners[None], camera), np.ones((1, 4))),
        np.array([200.0]),
        one,
        one,
    )
    track = MotionTrack(np.eye(4), 0.0)
    refined, _ = refine(frame, found, track, UNKNOWN_SCALE, decoder)
    std = np.sqrt(refined.corners.covariances[0].diagonal(axis1=1, axis2=2))
    x, y = camera.normalise(corners).T
    # Of turns about both axes of the image.
    moved = 44.0 * np.sqrt([(x * y) ** 2 + (1.0 + x * x) ** 2, (x * y) ** 2 + (1.0 + y * y) ** 2])
    # The noise of pixels adds 0.2 per cent.
    np.testing.assert_allclose(std, (moved * np.abs(delays(corners[:, 1], frame))).T, rtol=0.01)
