"""Removal of the bolometers' lag."""

from functools import cache
import math

import cv2
import numpy as np
import pytest
from support import approach
from support.detector_scores import odometry_before

from thermal_fiducial.config import ArucoDetectorConfig
from thermal_fiducial.core.detection.corners.blurred_patterns import PatternView
from thermal_fiducial.core.detection.corners.corner_errors import OF_LAG_FORM, of_motion_blur, unknown_motion
from thermal_fiducial.core.detection.corners.gray_scale import UNKNOWN_SCALE
from thermal_fiducial.core.detection.corners.pattern_fit import fit_patterns, nearness
from thermal_fiducial.core.detection.corners.side_fit import too_blurred_for_sides
from thermal_fiducial.core.detection.patterns import Decoder
from thermal_fiducial.core.detection.prediction.frame import (
    counts_of,
    Frame,
    lag_tail_maps,
    MotionBlur,
    Places,
    REMAINING,
    Saturation,
    SPREAD,
)
from thermal_fiducial.core.detection.prediction.twist import Twist
from thermal_fiducial.core.geometry.camera import Camera, ImagePoints
from thermal_fiducial.core.measurements import corners_px
from thermal_fiducial.files.dictionary import load_dictionary
from thermal_fiducial.sim.scenario import with_contrast
from thermal_fiducial.sim.thermal_camera import render_frames


def freed(image, maps):
    """The whole image without the lag tails of one marker."""
    pixel = np.arange(image.size).reshape(1, 1, 1, -1)
    return counts_of(pixel, image, maps).reshape(image.shape)


@pytest.mark.parametrize('steps', [None, 4, 8])
def test_deblurred_corners_do_not_depend_on_the_form_of_the_lag(steps):
    """A square seen through lag that is continuous, or integrated in steps of a frame of 1/30 s."""
    tau, frame, velocity = 0.010, 1 / 30, np.array([300.0, -120.0])
    duration = 2e-4 if steps is None else frame / steps
    ages = np.arange(0.0, 8.0 * tau, duration)
    weights = np.exp(-ages / tau) / np.exp(-ages / tau).sum()
    pixel = np.arange(100.0)
    low, high = 30.2, 64.7
    seen = np.zeros((100, 100))
    for age, weight in zip(ages, weights, strict=True):
        # at a time before the stamp the square was farther back along its way
        column, row = (
            np.clip(np.minimum(pixel + 0.5, high - v * age) - np.maximum(pixel - 0.5, low - v * age), 0.0, 1.0)
            for v in velocity
        )
        seen += weight * np.outer(row, column)
    image = cv2.GaussianBlur(seen.astype(np.float32), (0, 0), 0.6)
    corners = np.array([[low, low], [high, low], [high, high], [low, high]])
    blurred = np.broadcast_to(-tau * velocity, (1, 4, 2))
    # All points are displaced alike.
    sharp = freed(image, lag_tail_maps(corners[None], blurred))
    v, u = np.mgrid[:100, :100]
    centre = np.array([(sharp * u).sum(), (sharp * v).sum()]) / sharp.sum()
    mean_age = float(weights @ ages)
    # What was taken out is known, so what is left is the response's own mean delay. Lanczos interpolation is exact for
    # what optics leave of edges, not for means: 0.0138 px times 0.9 at a quarter of a pixel.
    expected = corners.mean(axis=0) - velocity * (mean_age - (1.0 - REMAINING) * tau)
    np.testing.assert_allclose(centre, expected, atol=0.014)
    wide = np.sqrt((sharp * (u - centre[0]) ** 2).sum() / sharp.sum())
    before = np.sqrt((image * (u - (image * u).sum() / image.sum()) ** 2).sum() / image.sum())
    assert wide < before


@pytest.mark.parametrize('lag_blur', [0.3, 0.7, 2.1])
def test_deblurred_edges_are_those_of_a_response_that_forgets(lag_blur):
    """Across a vertical side the image is the one of a bolometer that remembers no longer than the lag tail's age."""
    ages = np.arange(0.0, 10.0, 0.002)
    weights = np.exp(-ages)

    def seen(kept):
        profile = sum(
            w * np.clip(np.minimum(np.arange(100.0) + 0.5, 64.7 - lag_blur * a) - (np.arange(100.0) - 0.5), 0.0, 1.0)
            for w, a in zip(weights[kept] / weights[kept].sum(), ages[kept], strict=True)
        )
        return cv2.GaussianBlur(np.tile(profile, (60, 1)).astype(np.float32), (0, 0), 0.6)

    corners = np.array([[[44.7, 20.0], [64.7, 20.0], [64.7, 40.0], [44.7, 40.0]]])
    blurred = np.broadcast_to([-lag_blur, 0.0], (1, 4, 2))
    image, maps = seen(ages < 10.0), lag_tail_maps(corners, blurred)
    sharp, young = freed(image, maps)[30], seen(ages < 0.75)[30]
    slope = np.gradient(young)
    side = slice(59, 70)
    displaced = slope[side] @ (sharp - young)[side] / (slope[side] @ slope[side])
    # Linear interpolation displaces it by 0.019, 0.044 and 0.028 px, Lanczos's by at most 0.0144 px.
    assert abs(displaced) < 0.015


def test_each_marker_is_freed_of_its_own_lag_tails():
    rng = np.random.default_rng(4)
    image, pixel = rng.normal(size=(60, 70)).astype(np.float32), rng.integers(0, 60 * 70, (7, 1, 6, 1))
    maps = lag_tail_maps(np.concatenate([SQUARE, SQUARE]), np.array([0.0, 2.5])[:, None, None] * np.ones((2, 4, 2)))
    columns = counts_of(pixel, image, maps)
    np.testing.assert_allclose(columns[:, :, :3], image.ravel()[pixel[:, :, :3]], atol=1e-5)
    np.testing.assert_allclose(columns[:, :, 3:], freed(image, maps[1:]).ravel()[pixel[:, :, 3:]], atol=1e-4)


SQUARE = 60.0 * np.array([[[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]])


def test_lag_displaces_by_the_mean_of_the_response_in_an_acceleration():
    """A camera that moves along x ever faster: what is s old lies s w - s^2 a / 2 behind."""
    tau, speed, acceleration = 0.010, 0.5, 4.0
    camera = Camera(640, 512, np.array([[500.0, 0.0, 320.0], [0.0, 500.0, 256.0], [0.0, 0.0, 1.0]]))
    places = Places.of(ImagePoints.seen_at(np.zeros((1, 4, 2)), camera), np.ones((1, 4)))
    along = np.eye(6)[0]
    twist = Twist(speed * along, np.eye(6), acceleration * along)
    ages = tau * (np.arange(30_000) + 0.5) / 1e3
    behind = np.average(ages * speed - 0.5 * ages**2 * acceleration, weights=np.exp(-ages / tau))
    # 1e-6 px is what the sum leaves, 0.2 px what the acceleration does.
    np.testing.assert_allclose(places.lag_blur(twist, tau)[..., 0], 500.0 * behind, atol=1e-5)


def wrong_lag(lag_blur_px):
    """What is wrong with the lag, of a twist that is known."""
    return of_motion_blur(np.ones((1, 4, 2, 6)), np.eye(6), lag_blur_px, displayed=False)


def test_a_wrong_lag_leaves_the_common_shift_out():
    common = np.broadcast_to([3.0, 0.0], (1, 4, 2))
    turning = common + 0.2 * np.array([[[0, -1], [1, 0], [0, 1], [-1, 0]]])
    np.testing.assert_array_equal(wrong_lag(0.0 * common), 0.0)
    shape = wrong_lag(turning) - wrong_lag(common)
    # The lag constant may be off by a third, which turns the marker by so much.
    np.testing.assert_allclose(np.trace(shape, axis1=-2, axis2=-1), (0.35 * 0.2) ** 2, rtol=1e-6)
    # Of another response edges are off by a seventieth of the way, along it and across.
    np.testing.assert_allclose(wrong_lag(common)[0, 0], (0.014 * 3.0) ** 2 * np.eye(2), rtol=1e-6)


def test_blur_that_a_wrong_twist_leaves_on_displays_changes_the_shape():
    """All corners are displaced by 2 px for 1 rad/s, which is known to 0.3 rad/s."""
    by_twist = np.tile(2.0 * np.eye(2, 6, k=3), (1, 4, 1, 1))
    still, unsure = np.zeros((1, 4, 2)), np.diag([0.0, 0.0, 0.0, 0.3, 0.0, 0.0]) ** 2
    claimed = of_motion_blur(by_twist, unsure, still, displayed=True)[0, 0]
    np.testing.assert_allclose(claimed, (0.15 * 2.0 * 0.3) ** 2 * np.eye(2), rtol=1e-6)


def test_an_unknown_motion_is_limited_by_sharp_edges_and_by_cells_that_can_be_read():
    displacement = np.tile(0.01 * 500.0 * np.eye(2, 6, k=3), (4, 4, 1, 1))
    cell = np.array([10.0, 10.0, 30.0, 10.0])
    covariances = unknown_motion(displacement, 1.5**2 * np.eye(6), np.array([0.015, 0.05, 0.1, 0.1]), cell)
    deviation = np.sqrt(covariances[..., 0, 0])
    # Of a faint marker, whose residuals show nothing, as much as the motion does, or 0.4 cells.
    np.testing.assert_allclose(deviation, np.broadcast_to([[0.3], [1.0], [7.5], [4.0]], (4, 4)), rtol=1e-6)
    np.testing.assert_allclose(unknown_motion(0.0 * displacement, np.eye(6), np.zeros(4), cell), 0.0)


def test_cells_are_read_without_their_lag_tails():
    """Cells of 8 px, which lag displaces by 12 px in the mean."""
    bits, corner = load_dictionary('DICT_4X4_50').bits, np.array([60.0, 60.0])
    marker = np.kron(np.pad(np.pad(bits[21], 1), 1, constant_values=1), np.ones((8, 8))).astype(np.float32)
    velocity, ages = np.array([10.0, -6.0]), np.arange(0.0, 8.0, 0.02)
    image = np.zeros((200, 200), dtype=np.float32)
    for age in ages:
        u, v = corner - 8.0 - velocity * age
        shown = cv2.warpAffine(marker, np.array([[1.0, 0.0, u], [0.0, 1.0, v]]), image.shape)
        image += np.exp(-age) / np.exp(-ages).sum() * shown
    quad = (corner - 0.5 + 48.0 * np.array([[0, 0], [1, 0], [1, 1], [0, 1]]))[None]
    maps = lag_tail_maps(quad, np.broadcast_to(-velocity, (1, 4, 2)))
    # What is left of the lag without its tail still displaces the corners.
    quad = quad - REMAINING * velocity
    tails = quad @ maps[:, :, :2].swapaxes(1, 2) + maps[:, None, :, 2]
    decoder = Decoder(bits)
    lagging, sharp = decoder.read(image, quad), decoder.read(image, quad, lag_tails=tails)
    assert sharp.ids[0] == 21
    # 0.994 and 0.86 of the contrast when written; as the lag shows it 0.941 and 0.40.
    assert sharp.correlation[0] > 0.99
    assert sharp.contrast[0] > 2.0 * lagging.contrast[0]


def test_lag_of_a_marker_that_grows_is_removed_though_its_centre_stays():
    """Approached, its sides move apart by up to a pixel in the lag's time."""
    scene, rng = with_contrast(approach.scenario(), 8.0), np.random.default_rng(1)
    camera, detector = approach.camera_of(scene), approach.detector_of(scene, with_map=True)
    motion_at = scene.trajectory(8.0, 21)
    for frame in render_frames(scene, 8.0, 21, start=104, stop=112):
        rows = detector.detect(frame.stamp_ns, frame.counts, camera, odometry_before(frame, motion_at, rng))
        error = corners_px(rows)[0] - frame.corners_px[7]
        # At most 0.044 px; 0.13 px where what the mean of the corners moves by decides.
        assert np.sqrt(np.mean((error - error.mean(axis=0)) ** 2)) < 0.06


@pytest.mark.parametrize('lag_blur', [pytest.param((10.0, 0.0), marks=pytest.mark.nightly), (-8.0, 5.0)])
def test_corners_are_right_where_motion_blur_is_longer_than_cells(lag_blur):
    """A marker with cells of 5 px, which lag displaces by 10 px in the mean."""
    decoder, image, corners = lagging(5, lag_blur)
    lag = np.broadcast_to(lag_blur, corners.shape)
    there = corners + REMAINING * lag
    motion = MotionBlur(lag_tail_maps(there, lag), REMAINING * lag, (1.0 - REMAINING) * lag, SPREAD * lag[:, 0], lag)
    assert too_blurred_for_sides(there, decoder.cells, BLUR_PX, motion).all()
    view = PatternView(1000.0 * image, motion.to_tails, motion.spread)
    fit = fit_patterns(view, there + 0.5, MARKER, decoder, BLUR_PX)
    # When written 0.11 and 0.10 px, as motion blur has ends and is fitted as a Gaussian: no more than what is claimed.
    assert np.sqrt(np.mean(np.square(fit.corners_px - there))) < OF_LAG_FORM * np.hypot(*lag_blur)


@pytest.mark.parametrize(('bent', 'allowed'), [(0.5, 0.02), (1.0, 0.01), (2.0, 0.04)])
@pytest.mark.parametrize(
    ('cell', 'lag_blur'), [(7, (1.7, 0.0)), pytest.param(12, (-2.5, 2.0), marks=pytest.mark.nightly)]
)
def test_a_marker_in_motion_shows_the_gray_scale_of_a_display(cell, lag_blur, bent, allowed):
    """Bolometers lag, and then their counts are bent."""
    decoder, image, corners = lagging(cell, lag_blur, beyond=1.0)
    view = PatternView(np.rint(200.0 * np.clip(image, 0.0, 1.0) ** bent).astype(np.float32))
    view, scale = view._replace(lag=np.broadcast_to(lag_blur, corners.shape)), UNKNOWN_SCALE
    for _ in range(3):
        scale = scale.estimated_by(view, corners + lag_blur, MARKER, decoder, BLUR_PX)
    levels = np.arange(20, 181)
    true = (levels / 200.0) ** (1.0 / bent)
    zero_and_unit = np.polyfit(scale.counts[levels], true, 1)
    # When written at most 0.014, 0.005 and 0.030 of the contrast; a linear scale is off by 0.106, 0 and 0.068.
    assert np.abs(np.polyval(zero_and_unit, scale.counts[levels]) - true).max() < allowed


@pytest.mark.parametrize(('settled', 'change', 'differs'), [(0, 0.01, 0), (0, 0.03, 1), (1, 0.03, 0), (1, 0.07, 1)])
def test_a_gray_scale_that_has_settled_is_as_good_as_what_few_markers_show(settled, change, differs):
    """Changes of 0.03 from frame to frame are those of an estimate by one or two markers; zero and unit are free."""
    levels = np.arange(256.0)
    before = UNKNOWN_SCALE._replace(settled=bool(settled))
    bent = levels + change * 255.0 * math.sqrt(2.0) * np.cos(4.0 * math.pi * levels / 255.0)
    now = UNKNOWN_SCALE._replace(counts=7.0 + 3.0 * bent)
    assert now.differs(before) == bool(differs)


@pytest.mark.parametrize(
    ('cell', 'lag_blur', 'white', 'allowed'),
    [(7, (1.7, 0.0), 0.75, 0.04), (7, (3.0, 0.0), 0.5, 0.04), (9, (4.0, 2.0), 0.75, 0.13)],
)
def test_what_a_display_saturates_is_no_count(cell, lag_blur, white, allowed):
    """A warm marker comes into view before the gray scale has followed: white are all counts above a share of it."""
    decoder, image, corners = lagging(cell, lag_blur, beyond=0.3)
    noise = np.random.default_rng(0).normal(0.0, 0.7, image.shape)
    gray = np.clip(np.rint(20.0 + 235.0 * image / white + noise), 0, 255).astype(np.uint8)
    frame = Frame.of(
        0, gray, Camera(*gray.shape[::-1], np.eye(3)), None, ArucoDetectorConfig(), 0.66, keep_columns=True
    )
    lag = np.broadcast_to(lag_blur, corners.shape)
    there, to_tails, spread = (
        corners + REMAINING * lag,
        lag_tail_maps(corners + REMAINING * lag, lag),
        SPREAD * lag[:, 0],
    )
    view = PatternView(frame.image, to_tails, spread, displayed=True, saturation=frame.saturation)
    near = int(nearness(there, decoder.cells, np.hypot(BLUR_PX, np.hypot(*spread.T)))[0])
    fit = fit_patterns(view, there + 0.5, MARKER, decoder, BLUR_PX, near)
    # When written 0.024, 0.018 and 0.106 px; where gray levels of what is saturated count, 0.125, 0.330 and 0.235 px.
    assert np.sqrt(np.mean(np.square(fit.corners_px - there))) < allowed


@pytest.mark.parametrize(
    ('now', 'then', 'later', 'known'),
    [(0, 0, 0, 1), (1, 0, 0, 1), (0, 1, 0, 0), (1, 1, 0, 0), (1, 1, 1, 1), (-1, -1, 0, 0), (1, -1, 0, 1)],
)
def test_a_saturated_pixel_without_its_lag_tail(now, then, later, known):
    """Pixels at a place, where their lag tails are, and as far on the other side."""
    saturation = Saturation(np.array([[then, now, later]], dtype=np.float32), 0.0, 255.0)
    places, tails = np.array([[[1.0]], [[0.0]]], dtype=np.float32), np.zeros((2, 1, 1), dtype=np.float32)
    assert saturation.known(places, tails).item() == bool(known)


BLUR_PX, MARKER = np.hypot(0.6, 12**-0.5), np.array([13])


@cache
def lagging(cell, lag_blur, beyond=0.0):
    """A decoder, a white image with a marker in cells of so many pixels in a lag of ``lag_blur`` [px], its corners.

    ``beyond`` : value of what is farther than a cell from the marker
    """
    fine, decoder = 8, Decoder(load_dictionary('DICT_4X4_50').bits)
    place = 16 + math.ceil(7.0 * max(map(abs, lag_blur)))
    pattern = decoder.patterns(MARKER, np.zeros_like(MARKER))[0]
    pattern = np.kron(np.pad(pattern, 1, constant_values=1), np.ones((cell * fine, cell * fine)))
    scene = np.pad(pattern.astype(np.float32), place * fine, constant_values=beyond)
    # The response at some ages, evenly spread in what they weigh.
    ages = -np.log(1.0 - (np.arange(400) + 0.5) / 400)
    seen = np.zeros_like(scene)
    for age in ages:
        cv2.accumulate(moved(scene, fine * np.array(lag_blur) * age), seen)
    sharp = seen / len(ages)
    size = scene.shape[0] // fine
    image = cv2.resize(cv2.GaussianBlur(sharp, (0, 0), 0.6 * fine), (size, size), interpolation=cv2.INTER_AREA)
    first, last = place + cell - 0.5, place + 7 * cell - 0.5
    return decoder, image, np.array([[[first, first], [last, first], [last, last], [first, last]]])


def moved(image, displacement):
    """``image`` displaced by whole and parts of pixels."""
    u, v = displacement
    return cv2.warpAffine(image, np.array([[1.0, 0.0, u], [0.0, 1.0, v]]), image.shape)
