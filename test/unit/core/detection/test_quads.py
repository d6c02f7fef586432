"""Outlines of what is darker than its surroundings."""

import cv2
import numpy as np
import pytest

from thermal_fiducial.core.camera_frames import with_columns_corrected
from thermal_fiducial.core.detection.finding.quads import (
    dark_in_picture,
    DarkRegions,
    find_quads,
    halfway,
    halved,
    Segmentation,
    without_single_pixels,
)

SHAPE = 240, 320
FINE = Segmentation(smoothing_px=0.5, window_px=5, window_shrink=2, depth=0.2, floor=2.5, most=60.0)
NOTHING = np.zeros((0, 4, 2))
#: Clockwise from the top left.
QUAD = np.array([[80.0, 60.0], [140.0, 70.0], [130.0, 130.0], [70.0, 115.0]])


def noise(sigma, seed=0):
    return np.random.default_rng(seed).normal(0.0, sigma, SHAPE)


def drawn(contrast, sigma=1.0, quad=QUAD):
    """A dark quadrilateral on a wall that grows warmer to the right."""
    image = np.zeros(SHAPE, dtype=np.float32)
    cv2.fillConvexPoly(image, np.rint(quad).astype(np.int32), -contrast)
    return (7000.0 + 0.1 * np.arange(SHAPE[1]) + image + noise(sigma)).astype(np.float32)


def nearest_corner(quads, quad):
    """Distance [px] of the corners (4, 2) from those of the nearest of the quadrilaterals, at any first corner."""
    turned = [np.roll(quad, turn, axis=0) for turn in range(4)]
    return min(np.abs(found - each).max() for found in quads for each in turned)


def test_half_resolution_keeps_means_and_places():
    image = drawn(100.0)
    half = halved(image)
    assert half.shape == (SHAPE[0] // 2, SHAPE[1] // 2)
    np.testing.assert_allclose(half[3, 5], image[6:8, 10:12].mean(), rtol=1e-6)  # single precision
    # The middle of the first four pixels is the first pixel's.
    np.testing.assert_allclose(halfway(np.array([[0.5, 0.5], [10.5, 6.5]])), [[0.0, 0.0], [5.0, 3.0]])


@pytest.mark.parametrize('odd', [(1, 0), (0, 1), (1, 1)])
def test_at_half_the_resolution_of_odd_sizes_places_are_where_they_are(odd):
    """At the far border they were a pixel off, and one in ten faint markers was not found."""
    image = np.random.default_rng(0).normal(7000.0, 50.0, np.add((96, 128), odd)).astype(np.float32)
    np.testing.assert_array_equal(halved(image), halved(np.ascontiguousarray(image[:96, :128])))


@pytest.mark.parametrize('times_the_noise', [0.5, 2.5])
def test_offsets_of_columns_are_removed_and_the_scene_stays(times_the_noise):
    """Of offsets that are larger than the noise two thirds stayed."""
    offsets = np.random.default_rng(1).normal(0.0, times_the_noise, SHAPE[1])
    scene = drawn(100.0, sigma=0.0)
    seen = (scene + noise(1.0) + offsets).astype(np.float32)
    left = with_columns_corrected(seen, 1.0) - scene
    columns = left.mean(axis=0)
    # A ninth of the columns' own share stays, and what they have in common: 0.29 of the offsets when written.
    assert columns.std() < 0.4 * offsets.std()
    # The quadrilateral, a hundred times the noise, has moved no column by the noise.
    inside, outside = left[70:110, 90:120].mean(), left[150:, 90:120].mean()
    assert abs(inside - outside) < 1.0


@pytest.mark.parametrize(('contrast', 'clear'), [(200.0, True), (200.0, False), (8.0, False)])
def test_a_dark_region_is_outlined_at_any_contrast(contrast, clear):
    mask = DarkRegions(FINE).mask(drawn(contrast), 1.0, clear=clear)
    assert nearest_corner(find_quads(mask, 12.0, NOTHING), QUAD) < 4.0  # what alignment and refinement catch


def test_bright_regions_and_bare_noise_are_not_dark():
    regions = DarkRegions(FINE)
    bare = regions.mask(drawn(0.0), 1.0, clear=False)
    assert np.mean(bare > 0) < 0.1
    assert len(find_quads(bare, 12.0, NOTHING)) == 0
    bright = regions.mask(drawn(-200.0), 1.0, clear=False)
    assert np.mean(bright[80:100, 95:115] > 0) < 0.1


def test_images_of_another_size_may_follow():
    regions = DarkRegions(FINE)
    first = regions.mask(drawn(200.0), 1.0, clear=True).copy()
    smaller = regions.mask(np.ascontiguousarray(drawn(200.0)[:160, :200]), 1.0, clear=True)
    assert smaller.shape == (160, 200)
    np.testing.assert_array_equal(regions.mask(drawn(200.0), 1.0, clear=True), first)


def test_dark_cells_of_a_pixel_show_in_a_picture():
    picture = np.full(SHAPE, 120.0, dtype=np.float32)
    picture[50, 60] = 100.0
    mask = dark_in_picture(picture, 0.5)
    assert mask[50, 60] == 255
    assert np.count_nonzero(mask) == 1


def test_single_pixels_are_no_outlines_to_follow():
    mask = np.zeros(SHAPE, dtype=np.uint8)
    cv2.fillConvexPoly(mask, QUAD.astype(np.int32), 255)
    mask[20:22, 30] = 255
    kept = mask.copy()
    mask[10, 10] = mask[12, 11] = mask[0, 0] = 255
    np.testing.assert_array_equal(without_single_pixels(mask), kept)


def test_outlines_are_clockwise_and_large_enough():
    mask = np.zeros(SHAPE, dtype=np.uint8)
    for quad in (QUAD, QUAD[::-1] + np.array([120.0, 60.0])):
        cv2.fillConvexPoly(mask, quad.astype(np.int32), 255)
    cv2.rectangle(mask, (10, 10), (18, 18), 255, -1)
    quads = find_quads(mask, 12.0, NOTHING)
    assert len(quads) == 2
    to_next = np.roll(quads, -1, axis=1) - quads
    turn = np.roll(to_next, -1, axis=1)
    assert np.all(to_next[..., 0] * turn[..., 1] - to_next[..., 1] * turn[..., 0] > 0.0)


def test_holes_are_outlined_and_what_is_hidden_or_has_three_corners_is_not():
    mask = np.full(SHAPE, 255, dtype=np.uint8)
    cv2.fillConvexPoly(mask, QUAD.astype(np.int32), 0)
    cv2.fillConvexPoly(mask, np.array([[220, 60], [280, 70], [240, 120]]), 0)
    assert nearest_corner(find_quads(mask.copy(), 12.0, NOTHING), QUAD) < 2.0  # of pixels' centres
    mask = cv2.bitwise_not(mask)
    assert len(find_quads(mask.copy(), 12.0, NOTHING)) == 1
    around = QUAD.mean(axis=0) + 1.2 * (QUAD - QUAD.mean(axis=0))
    assert len(find_quads(mask, 12.0, around[None])) == 0


def test_outlines_may_be_taken_to_the_edges():
    """A square of 20 px in a ring of dark: its outline, through the centres of its own pixels or of the ring's."""
    mask = np.zeros(SHAPE, dtype=np.uint8)
    mask[30:50, 40:60] = 255
    edges = np.array([[39.5, 29.5], [59.5, 29.5], [59.5, 49.5], [39.5, 49.5]])
    for dark in (mask, cv2.bitwise_not(mask)):
        quads = find_quads(dark, 12.0, NOTHING, 0.5)
        # Corners of a hole's outline are cut off by a pixel.
        assert nearest_corner(quads, edges) < 1.0
    assert nearest_corner(find_quads(mask.copy(), 12.0, NOTHING, 0.5), edges) < 1e-9
    assert nearest_corner(find_quads(mask.copy(), 12.0, NOTHING), edges) == pytest.approx(0.5)
