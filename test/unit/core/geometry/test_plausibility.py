"""What counts as a plausible covariance and camera, and what is refused and in which words."""

import numpy as np
import pytest

from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.geometry.plausibility import (
    checked_covariance,
    doubt_of_resolution,
    require_image,
    require_usable,
)
from thermal_fiducial.errors import InputError

K = np.array([[530.0, 0.0, 319.5], [0.0, 530.0, 255.5], [0.0, 0.0, 1.0]])


def with_entry(matrix, place, value):
    changed = np.array(matrix, dtype=float)
    changed[place] = value
    return changed


def test_a_covariance_is_returned_as_it_is():
    root = np.random.default_rng(0).normal(size=(3, 6, 6))
    covariances = root @ np.swapaxes(root, 1, 2)
    assert checked_covariance(covariances, 'a pose') is covariances


def test_rounding_passes_and_what_is_more_is_made_symmetric():
    P = np.array([[1.0, 0.1], [0.1, 2.0]])
    # A billionth of an entry is rounding.
    rounded = with_entry(P, (1, 0), 0.1 * (1.0 + 1e-10))
    assert checked_covariance(rounded, 'a pose') is rounded
    slanted = with_entry(P, (1, 0), 0.2)
    # To a few units in the last place.
    np.testing.assert_allclose(checked_covariance(slanted, 'a pose'), [[1.0, 0.15], [0.15, 2.0]], rtol=1e-15)


@pytest.mark.parametrize(
    ('covariance', 'words'),
    [
        (with_entry(np.eye(6), (2, 3), np.nan), 'a pose that is not finite'),
        (with_entry(np.eye(6), (0, 0), np.inf), 'a pose that is not finite'),
        (with_entry(np.eye(6), (4, 4), 0.0), 'a pose with a variance of 0'),
        (with_entry(np.eye(6), (4, 4), -1.0), 'a pose with a variance of -1'),
        (with_entry(np.eye(6), (1, 1), 1e9), r'a pose with a variance of 1e\+09'),
        (np.full((2, 2), 1.0), 'a pose that is not positive definite'),
        (np.array([[1.0, 2.0], [2.0, 1.0]]), 'a pose that is not positive definite'),
        # The square of such an entry is beyond what a float holds.
        (np.array([[1.0, 1e200], [1e200, 1.0]]), 'a pose that is not positive definite'),
    ],
)
def test_a_covariance_that_cannot_be_is_refused(covariance, words):
    with pytest.raises(InputError, match=words):
        checked_covariance(covariance, 'a pose')


def test_units_of_any_size_may_stand_beside_each_other():
    checked_covariance(np.diag([1e-19, 1e7]), 'a pose')


def test_a_partial_covariance_may_have_no_variance_but_no_negative_one():
    single = np.outer([1.0, 2.0, 0.0], [1.0, 2.0, 0.0])
    assert checked_covariance(single, 'a map error', partial=True) is single
    checked_covariance(np.zeros((6, 6)), 'a map error', partial=True)
    with pytest.raises(InputError, match='a map error with a variance of -'):
        checked_covariance(np.diag([1.0, -1e-3]), 'a map error', partial=True)
    with pytest.raises(InputError, match='a map error that is not positive definite'):
        checked_covariance(np.array([[1.0, 1.1], [1.1, 1.0]]), 'a map error', partial=True)


def test_a_camera_of_a_real_lens_is_returned():
    camera = Camera(640, 512, K, D=[-0.3, 0.1, 0.0, 0.0, 0.0])
    assert require_usable(camera) is camera


@pytest.mark.parametrize(
    ('size', 'place', 'value', 'words'),
    [
        ((4, 512), (0, 0), 530.0, 'an image of 4x512 pixels'),
        ((640, 20000), (0, 0), 530.0, 'an image of 640x20000 pixels'),
        ((640, 512), (1, 0), 1.0, 'not of the form'),
        ((640, 512), (2, 2), 2.0, 'not of the form'),
        ((640, 512), (0, 1), 600.0, 'not of the form'),
        ((640, 512), (0, 0), 1.0, 'fx 1 '),
        ((640, 512), (1, 1), 1e6, r'fy 1e\+06 '),
        ((640, 512), (0, 2), -700.0, 'cx -700 '),
        ((640, 512), (1, 2), 1100.0, 'cy 1100 '),
    ],
)
def test_a_camera_that_no_lens_makes_is_refused(size, place, value, words):
    with pytest.raises(InputError, match=words):
        require_usable(Camera(*size, with_entry(K, place, value)))


def test_a_calibration_of_half_or_twice_the_resolution_is_doubted():
    assert doubt_of_resolution(Camera(640, 512, K)) == ''
    for factor in (0.5, 2.0):
        scaled = K * np.array([[factor], [factor], [1.0]])
        assert 'of another resolution?' in doubt_of_resolution(Camera(640, 512, scaled))


def test_a_distortion_that_folds_the_image_is_refused():
    with pytest.raises(InputError, match='that no lens has'):
        require_usable(Camera(640, 512, K, D=[-5.0, 0.0, 0.0, 0.0, 0.0]))


@pytest.mark.parametrize(
    ('image', 'words'),
    [
        ([[0, 1]], 'list is no image'),
        (None, 'NoneType is no image'),
        (np.zeros((4, 5)), r'frame of float64 with shape \(4, 5\)'),
        (np.zeros((4, 5, 3), np.uint16), r'shape \(4, 5, 3\)'),
        # As some libraries read TIFF and PNG: no marker was found in it, without a word.
        (np.zeros((4, 5), '>u2'), 'frame of >u2'),
    ],
)
def test_what_is_no_image_is_refused(image, words):
    with pytest.raises(InputError, match=words):
        require_image(image)
