"""Pixels that do not follow the scene: which are found, when, and what is put in their place."""

import cv2
import numpy as np
import pytest

from thermal_fiducial.core.imaging.bad_pixels import BadPixelFiller, BadPixelFinder
from thermal_fiducial.errors import InputError

SHAPE = HEIGHT, WIDTH = 64, 80
NOISE = 2.0


def scene(index, at=None):
    """Frame ``index`` of a noisy gradient that a warm spot of 9 px crosses; ``at``: counts by (column, row)."""
    rng = np.random.default_rng(index)
    picture = np.zeros(SHAPE)
    cv2.circle(picture, (20 + 2 * index, 30), 9, 300.0, -1)
    counts = 7000.0 + np.arange(WIDTH) + cv2.GaussianBlur(picture, (0, 0), 1.0) + rng.normal(0.0, NOISE, SHAPE)
    for (column, row), value in (at or {}).items():
        counts[row, column] = value
    return np.rint(counts).astype(np.uint16)


def pixels_after(finder, frames):
    """Column and row of the bad pixels after some frames, as by the last answer."""
    answers = [answer for answer in (finder.add(frame) for frame in frames) if answer is not None]
    return [tuple(pixel) for pixel in answers[-1].tolist()]


def test_hot_and_dead_pixels_are_found_within_the_first_frames():
    at = {(10, 50): 7400.0, (60, 12): 0.0}
    frames = [scene(index, at) for index in range(BadPixelFinder.ENOUGH // BadPixelFinder.VOTE + 1)]
    assert pixels_after(BadPixelFinder(SHAPE), frames) == [(60, 12), (10, 50)]


def test_a_sound_array_has_none():
    assert pixels_after(BadPixelFinder(SHAPE), [scene(index) for index in range(20)]) == []


def test_later_frames_are_looked_at_now_and_then():
    finder = BadPixelFinder(SHAPE, interval=5)
    looked_at = [index for index in range(1, 21) if finder.add(scene(index)) is not None]
    first = range(1, BadPixelFinder.ENOUGH // BadPixelFinder.VOTE + 2)
    assert looked_at == [*first, *range(5, 21, 5)]


def test_a_pixel_that_recovers_is_bad_for_a_while_only():
    finder = BadPixelFinder(SHAPE, interval=1)
    bad = [scene(index, {(10, 50): 7400.0}) for index in range(5)]
    assert pixels_after(finder, bad) == [(10, 50)]
    assert pixels_after(finder, [scene(5)]) == [(10, 50)]
    # Five votes fade one by one.
    assert pixels_after(finder, [scene(index) for index in range(6, 6 + 5 * BadPixelFinder.VOTE)]) == []


def test_a_pixel_that_keeps_a_plausible_value_is_bad_once_the_scene_around_it_has_moved():
    stuck = {(30, 30): 7200.0}
    still = [scene(0, stuck)] * 20
    assert pixels_after(BadPixelFinder(SHAPE, interval=1), still) == []
    moving = [scene(index, stuck) for index in range(32)]
    assert pixels_after(BadPixelFinder(SHAPE, interval=1), moving) == [(30, 30)]


def test_an_edge_that_passes_a_bad_pixel_keeps_its_place():
    counts = np.full((16, 16), 1000, dtype=np.uint16)
    # Five of its neighbours lie on its side of an edge between two rows.
    counts[8:] = 3000
    counts[8, 5] = 65535
    BadPixelFiller(np.array([[5, 8]]), counts.shape).fill(counts)
    assert counts[8, 5] == 3000


def test_half_a_count_is_rounded_up():
    counts = np.full((16, 16), 1000, dtype=np.uint16)
    counts[:, 5:] = 1001
    # Four of its neighbours have either count.
    counts[7, 5], counts[8, 5] = 1000, 0
    BadPixelFiller(np.array([[5, 8]]), counts.shape).fill(counts)
    assert counts[8, 5] == 1001


def test_filling_leaves_all_other_pixels():
    counts = scene(3)
    before, bad = counts.copy(), np.array([[0, 0], [40, 40], [WIDTH - 1, HEIGHT - 1]])
    counts[bad[:, 1], bad[:, 0]] = 0
    BadPixelFiller(bad, SHAPE).fill(counts)
    changed = np.argwhere(counts != before)[:, ::-1].tolist()
    assert all(pixel in bad.tolist() for pixel in changed)
    # From neighbours: of a gradient of 1 a column, with noise.
    assert np.abs(counts[bad[:, 1], bad[:, 0]].astype(int) - before[bad[:, 1], bad[:, 0]]).max() <= 5 * NOISE


def test_clusters_and_corners_take_the_nearest_sound_pixel():
    counts = np.full((16, 16), 1000, dtype=np.uint16)
    bad = np.array([[column, row] for column in range(5) for row in range(5)])
    counts[:5, :5] = 0
    BadPixelFiller(bad, counts.shape).fill(counts)
    assert np.all(counts == 1000)


def test_no_pixels_leave_a_frame_as_it_is():
    counts = scene(1)
    before = counts.copy()
    BadPixelFiller(np.zeros((0, 2), dtype=np.int64), SHAPE).fill(counts)
    np.testing.assert_array_equal(counts, before)


@pytest.mark.parametrize(
    ('pixels', 'words'),
    [
        ([[WIDTH, 0]], f'bad pixel {WIDTH} 0 lies outside the {WIDTH}x{HEIGHT} frame'),
        ([[3, -1]], f'bad pixel 3 -1 lies outside the {WIDTH}x{HEIGHT} frame'),
        ([[column, row] for column in range(40) for row in range(16)], '640 bad pixels are more than a tenth'),
    ],
)
def test_impossible_lists_are_refused(pixels, words):
    with pytest.raises(InputError, match=words):
        BadPixelFiller(np.array(pixels), SHAPE)
