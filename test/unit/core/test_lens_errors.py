"""Errors of the lens as joint draws: their covariance, and that they are the same wherever they are needed."""

from dataclasses import replace

import numpy as np
import pytest
from support.walls import CAMERA

from thermal_fiducial.core.error_model import covariance_by_draws, DRAWS, SystematicErrors
from thermal_fiducial.core.lens_errors import LensErrors

ERRORS = SystematicErrors(corner_px=0.2, focal_length_std=0.0)


def correlations(corners, length):
    """(n, n) of the errors of corners (n, 2), by the squared exponential that the process is declared to have."""
    squared = np.sum((corners[:, None] - corners) ** 2, axis=-1)
    return np.exp(-0.5 * squared / length**2)


@pytest.mark.parametrize(('width', 'height'), [(640, 512), (160, 120), (576, 576)])
def test_draws_have_the_covariance_of_the_error_model(width, height):
    camera = replace(CAMERA, width=width, height=height)
    corners = np.random.default_rng(0).uniform(0.0, [width, height], (40, 2))
    draws = LensErrors(corners, camera, ERRORS).drawn()
    expected = ERRORS.corner_px**2 * correlations(corners, 0.25 * width)
    modes = 2 * 6 * (2 + int(height / (0.25 * width)))
    # Between nodes one length apart the process is known to 1 to 2 %. Draws for more modes than there are draws are not
    # quite uncorrelated: four standard deviations, of directions of 64 out of that many dimensions.
    tolerance = 0.03 + 4.0 * np.sqrt(max(1.0 / DRAWS - 1.0 / modes, 0.0))
    for axis in (0, 1):
        assert np.abs(covariance_by_draws(draws[:, axis]) - expected).max() < tolerance * ERRORS.corner_px**2


@pytest.mark.parametrize(('width', 'height'), [(640, 512), (160, 120), (576, 576)])
def test_a_sum_of_errors_has_their_covariance(width, height):
    rng, camera = np.random.default_rng(1), replace(CAMERA, width=width, height=height)
    corners, gains = rng.uniform(0.0, [width, height], (40, 2)), rng.normal(size=(40, 6, 2))
    expected = ERRORS.corner_px**2 * np.einsum('iau,ij,jbu->ab', gains, correlations(corners, 0.25 * width), gains)
    found = LensErrors(corners, camera, ERRORS).covariance(gains)
    # Between nodes one length apart the process is known to 1 to 2 %.
    assert np.abs(found - expected).max() < 0.02 * expected.max()
    lens = LensErrors(corners, camera, SystematicErrors(aspect_left=np.linspace(-1.0, 1.0, DRAWS)))
    # The same sums of products, in another order.
    each, last = np.einsum('iau,iuk->iak', gains, lens.drawn()), np.arange(40) >= 15
    expected = [each[~last].sum(axis=0), each[last].sum(axis=0)]
    assert np.allclose(lens.drawn_sums(gains, np.array([0, 15])), expected, rtol=0.0, atol=1e-12 * np.abs(each).max())
    assert np.allclose(lens.drawn_sum(gains), np.sum(expected, axis=0), rtol=0.0, atol=1e-11 * np.abs(each).max())
    nothing = LensErrors(corners, camera, replace(ERRORS, corner_px=0.0))
    assert not nothing.covariance(gains).any()


def test_a_camera_has_one_lens():
    corners = np.random.default_rng(0).uniform(0.0, 500.0, (3, 4, 2))
    everywhere = LensErrors(corners, CAMERA, ERRORS).drawn()
    here = LensErrors(corners[1:2], CAMERA, ERRORS)
    # The same sums of products, in another order.
    assert np.allclose(here.drawn()[0], everywhere[1], rtol=0.0, atol=1e-12)
    other = LensErrors(corners, replace(CAMERA, K=CAMERA.K + np.diag([1.0, 1.0, 0.0])), ERRORS).drawn()
    correlation = np.vdot(other, everywhere) / (np.linalg.norm(other) * np.linalg.norm(everywhere))
    # Two lenses, 64 draws of at least four independent values each: four standard deviations.
    assert abs(correlation) < 4.0 / np.sqrt(4 * DRAWS)


def of_focal_lengths(along, across):
    """The camera with these focal lengths in x and y [px]."""
    return replace(CAMERA, K=np.array([[along, 0.0, 320.0], [0.0, across, 256.0], [0.0, 0.0, 1.0]]))


def test_half_of_what_the_focal_lengths_differ_by_is_an_error_of_either():
    """0.25 % of either, one too long where the other is too short."""
    corners = np.array([[420.0, 256.0], [320.0, 356.0], [320.0, 256.0]])
    of_aspect = replace(ERRORS, corner_px=0.0)
    lens = LensErrors(corners, of_focal_lengths(401.0, 399.0), of_aspect)
    expected = np.array([[0.25, 0.0], [0.0, -0.25], [0.0, 0.0]])
    draws = lens.drawn()
    signs = draws[0, 0] / 0.25
    np.testing.assert_allclose(draws, expected[..., None] * signs, rtol=0.0, atol=1e-12)
    # 64 draws, each of variance one over all of them.
    np.testing.assert_allclose(np.mean(signs**2), 1.0, rtol=1e-12)
    gains = np.random.default_rng(3).normal(size=(3, 6, 2))
    moved = np.einsum('iau,iu->a', gains, expected)
    np.testing.assert_allclose(lens.covariance(gains), np.outer(moved, moved), rtol=0.0, atol=1e-12)


@pytest.mark.parametrize('across', [400.0, 360.0])
def test_pixels_that_are_square_or_clearly_not_have_no_error_of_their_aspect_ratio(across):
    lens = LensErrors(np.full((1, 2), 100.0), of_focal_lengths(400.0, across), replace(ERRORS, corner_px=0.0))
    assert not lens.drawn().any()


def test_one_focal_length_is_wrong_for_all_corners():
    """By 1 %: away from the principal point, one draw for all of them."""
    corners = np.array([[420.0, 256.0], [320.0, 356.0], [220.0, 56.0]])
    errors = replace(ERRORS, corner_px=0.0, focal_length_std=0.01)
    lens, expected = LensErrors(corners, of_focal_lengths(400.0, 400.0), errors), 0.01 * (corners - [320.0, 256.0])
    draws = lens.drawn()
    np.testing.assert_allclose(draws, expected[..., None] * draws[0, 0], rtol=0.0, atol=1e-12)
    # 64 draws, for fewer errors of the camera: each of variance one over all of them.
    np.testing.assert_allclose(np.mean((draws[0, 0] / expected[0, 0]) ** 2), 1.0, rtol=1e-12)
    gains = np.random.default_rng(3).normal(size=(3, 6, 2))
    moved = np.einsum('iau,iu->a', gains, expected)
    np.testing.assert_allclose(lens.covariance(gains), np.outer(moved, moved), rtol=0.0, atol=1e-12)
