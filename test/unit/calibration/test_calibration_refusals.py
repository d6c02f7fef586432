"""Each refusal names what keeps the board from being found, in pictures that have just that."""

import re

import cv2
import numpy as np
import pytest
from support.heated_boards import Heat, picture

from thermal_fiducial.calibration.recognition import BoardNotFound
from thermal_fiducial.calibration.refusals import edge_blur
from thermal_fiducial.calibration.targets import Chessboard, CircleGrid
from thermal_fiducial.core.geometry.camera import Camera

GUESS = Camera(384, 288, np.array([[600.0, 0.0, 191.5], [0.0, 600.0, 143.5], [0.0, 0.0, 1.0]]))
DOTS = CircleGrid(15, 11, 1.0, 0.6, asymmetric=False)
SQUARES = Chessboard(12, 9, 1.0)
SIZE = {'width': 384, 'height': 288}


def reason(target, counts):
    with pytest.raises(BoardNotFound) as refused:
        target.find(counts, GUESS)
    return str(refused.value)


def seen(target, heat, seed=3, **view):
    radius = None if isinstance(target, Chessboard) else target.radius
    return picture(target.points[:, :2], heat, np.random.default_rng(seed), radius=radius, **{**SIZE, **view})[0]


@pytest.mark.parametrize('target', [DOTS, SQUARES])
@pytest.mark.parametrize(
    ('heat', 'view', 'words'),
    [
        (Heat(), {'outside': True}, 'partly out of view'),
        # Which of the two depends on the version of OpenCV, by whose pixels the picture is.
        (Heat(), {'fill': 0.15}, r'too far away or too oblique, points [0-9.]+ px apart|no board found: .*far away'),
        (Heat(defocus=6.0), {}, '(no board found: )?out of focus,? or moving'),
        (Heat(contrast=0.02), {}, 'no board found: out of view, too far away, or fainter than the noise'),
    ],
)
def test_the_cause_is_named(target, heat, view, words):
    text = reason(target, seen(target, heat, **view))
    assert re.match(words, text), text


@pytest.mark.parametrize(('target', 'contrast'), [(DOTS, 0.08), (SQUARES, 0.05)])
def test_faint_points_are_named(target, contrast):
    """Noise is 0.05 K; a chessboard shows more of its contrast than dots do."""
    assert 'faint' in reason(target, seen(target, Heat(contrast=contrast)))


def test_something_before_half_of_the_board_is_named():
    """A hot disc over a corner of the board: neither its edge nor the gaps between the dots make a larger grid."""
    points = DOTS.points[:, :2]
    counts, truth = picture(points, Heat(contrast=-4.0), np.random.default_rng(5), radius=0.3, **SIZE)
    middle = 0.7 * truth[0] + 0.3 * truth.mean(axis=0)
    reach = int(0.7 * np.linalg.norm(truth[0] - truth.mean(axis=0)))
    cv2.circle(counts, tuple(np.rint(middle).astype(int).tolist()), reach, 7300, -1)
    counts = cv2.GaussianBlur(counts, (0, 0), 0.7)
    assert reason(DOTS, counts).startswith('partly hidden, or another board: ')


def test_a_whole_grid_that_is_smaller_is_named_with_its_size():
    counts = seen(CircleGrid(13, 10, 1.0, 0.6, asymmetric=False), Heat(), fill=0.4)
    assert 'a whole grid of 13 x 10 points, which is smaller than the one described' in reason(DOTS, counts)


def test_gaps_between_wide_circles_are_not_taken_for_them():
    """A lamp's spot is stronger than the contrast of dots: two of them are lost, and the gaps make a whole grid."""
    target = CircleGrid(4, 11, 1.0, 0.8)
    points = target.points[:, :2]
    counts, truth = picture(points, Heat(contrast=4.0), np.random.default_rng(3), radius=0.4, **SIZE)
    spot = truth[20]
    v, u = np.mgrid[: counts.shape[0], : counts.shape[1]]
    lamp = 150.0 * np.exp(-0.5 * ((u - spot[0]) ** 2 + (v - spot[1]) ** 2) / 14.0**2)
    found = target.find(np.rint(counts + lamp).astype(np.uint16), GUESS)
    assert len(found.points) >= 40


@pytest.mark.parametrize('blur', [1.0, 3.0, 5.0])
def test_the_blur_of_edges_is_measured(blur):
    v, u = np.mgrid[:288, :384]
    step = (7000.0 + 100.0 * (u * 0.9 + v * 0.4 > 250.0)).astype(np.float32)
    noise = np.random.default_rng(1).normal(0.0, 1.0, step.shape).astype(np.float32)
    # Noise of 1 % of the step: a tenth at five pixels; and steps of whole pixels, 4 % at one.
    assert edge_blur(cv2.GaussianBlur(step, (0, 0), blur) + noise) == pytest.approx(blur, rel=0.15)
    assert edge_blur(7000.0 + noise) == 0.0


@pytest.mark.parametrize(('pitch', 'error'), [pytest.param(12.0, 0.02, marks=pytest.mark.nightly), (8.0, 0.04)])
def test_the_width_of_small_circles_is_measured(pitch, error):
    """Edges of small discs are bent: as straight ones they were measured 3 and 7 % too narrow."""
    radius, blur, fine = 0.3 * pitch, 0.8, 9
    rows, columns = np.divmod(np.arange(165), 15)
    truth = np.column_stack([40.3 + pitch * columns, 60.6 + pitch * rows])
    v, u = (np.mgrid[: 288 * fine, : 384 * fine] + 0.5) / fine - 0.5
    nearest = np.clip(np.rint((u - truth[0, 0]) / pitch), 0, 14), np.clip(np.rint((v - truth[0, 1]) / pitch), 0, 10)
    away = np.hypot(u - truth[0, 0] - pitch * nearest[0], v - truth[0, 1] - pitch * nearest[1])
    scene = cv2.GaussianBlur((away < radius).astype(np.float32), (0, 0), blur * fine)
    counts = 7000.0 + 100.0 * cv2.resize(scene, (384, 288), interpolation=cv2.INTER_AREA)
    counts += np.random.default_rng(2).normal(0.0, 1.25, counts.shape)
    picture_16bit = np.rint(counts).astype(np.uint16)
    # A board described 1.3 times as narrow is refused with that ratio.
    text = reason(CircleGrid(15, 11, 1.0, 0.6 / 1.3, asymmetric=False), picture_16bit)
    ratio = float(text.split('the circles are ')[1].split(' times')[0])
    assert ratio == pytest.approx(1.3, rel=error)
    assert len(DOTS.find(picture_16bit, GUESS).points) == 165
