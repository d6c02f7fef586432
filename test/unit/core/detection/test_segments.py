"""Displacements of sides by their pixels, and corners that fit them."""

from dataclasses import dataclass

import numpy as np
import pytest
from support.close_views import BITS, BLUR_WITH_PIXEL, CAMERAS, draw, plate, pose

from thermal_fiducial.core.detection.corners.segments import adjust, measure, median_of, robust_fit, UNMEASURED
from thermal_fiducial.core.detection.corners.sides import blur_of, free_distance, model, sides_of
from thermal_fiducial.core.detection.prediction.frame import counts_of
from thermal_fiducial.core.geometry import se3
from thermal_fiducial.core.geometry.reprojection import marker_corners

MODEL, ID, CONTRAST, NOISE = 'plumb_bob', 7, 200.0, 8.0
CAMERA = CAMERAS[MODEL]
CELLS, REACH = BITS.shape[2] + 2, 1.5
T = pose(90, 0.05, -0.05, (0.3, -0.25, 0.4))
IMAGE = 7000.0 + CONTRAST * draw(MODEL, plate(ID), T, samples=8)
CORNERS = CAMERA.project(se3.apply(T, marker_corners(0.3)))


@dataclass
class Measured:
    """Sides of the marker from corners that are off, and what their pixels say of them."""

    off: tuple[float, float] = (0.0, 0.0)
    noise: float = 0.0
    #: (u, v) of a pixel that is 5000 counts off
    outlier: tuple[int, int] | None = None
    contrast: float = 1.0

    def __post_init__(self):
        image = 7000.0 + self.contrast * (IMAGE - 7000.0)
        image = image + np.random.default_rng(3).normal(0.0, self.noise, IMAGE.shape)
        if self.outlier is not None:
            image[self.outlier[1], self.outlier[0]] += 5000.0
        x = CAMERA.normalise(CORNERS[None] + np.array(self.off))
        self.sides = sides_of(x, CAMERA, IMAGE.shape, CELLS, 6, BLUR_WITH_PIXEL)
        blur = blur_of(self.sides, BLUR_WITH_PIXEL, np.zeros((1, 2)))
        counts = counts_of(self.sides.pixel, image.astype(np.float32))
        free = free_distance(self.sides, blur.across)
        self.segments = measure(counts, model(self.sides, blur, free, free), np.full_like(free, REACH))


@pytest.mark.parametrize('off', [(0.0, 0.0), (0.4, -0.3), (-0.6, 0.5)])
def test_segments_measure_how_far_their_sides_are_off(off):
    measured = Measured(off)
    expected = -(measured.sides.normal @ off).reshape(1, -1)
    used = measured.segments.variance < UNMEASURED
    assert used.mean() > 0.9
    error = (measured.segments.shift - expected)[used]
    # When written 0.02 px without an offset, of segments at the corners, and 0.05 with one, of the linearisation.
    assert np.sqrt(np.mean(error**2)) < (0.08 if any(off) else 0.03)
    # Level and slope of the contrast are free: some per cent.
    np.testing.assert_allclose(measured.segments.contrast[used], CONTRAST, rtol=0.15)


def test_variances_are_those_of_the_noise():
    clean, noisy = Measured(), Measured(noise=NOISE)
    used = (clean.segments.variance < UNMEASURED) & (noisy.segments.variance < UNMEASURED)
    z = ((noisy.segments.shift - clean.segments.shift) / np.sqrt(noisy.segments.variance))[used]
    # Twenty-odd segments: the mean square is 1 within 0.3 at one sigma; the variance is a marker's typical one.
    assert 0.3 < np.mean(z * z) < 2.0
    assert np.sqrt(np.median(noisy.segments.noise)) == pytest.approx(NOISE, rel=0.25)


def test_a_contrast_of_the_other_sign_is_measured_alike():
    dark, bright = Measured((0.3, 0.2)), Measured((0.3, 0.2), contrast=-1.0)
    np.testing.assert_allclose(bright.segments.shift, dark.segments.shift, atol=1e-3)  # single precision
    np.testing.assert_allclose(bright.segments.contrast, -dark.segments.contrast, rtol=1e-3)


def test_no_segment_moves_beyond_its_reach():
    assert np.abs(Measured((5.0, 4.0)).segments.shift).max() <= REACH


def test_an_outlying_pixel_costs_its_segment_little():
    clean = Measured(noise=NOISE)
    # On the top side, a pixel of its third part.
    row, column = divmod(int(clean.sides.pixel[clean.sides.pixel.shape[0] // 2, 3, 0, 2]), IMAGE.shape[1])
    spoilt = Measured(noise=NOISE, outlier=(column, row))
    sigma = np.sqrt(clean.segments.variance)
    assert np.all(np.abs(spoilt.segments.shift - clean.segments.shift) < 3.0 * sigma)


def test_corners_follow_their_segments():
    off = np.array([0.5, -0.4])
    measured = Measured(tuple(off), noise=NOISE)
    moved, covariance = adjust(measured.sides, measured.segments)
    back = moved.reshape(4, 2) + off
    # Four sigma of eight coordinates, and the linearisation's share of the step.
    assert np.all(np.abs(back).reshape(-1) < 4.0 * np.sqrt(covariance[0].diagonal()) + 0.05)
    assert np.all(np.linalg.eigvalsh(covariance[0]) > 0.0)


def test_without_segments_the_prior_remains():
    measured = Measured()
    nothing = measured.segments._replace(variance=np.full_like(measured.segments.variance, UNMEASURED))
    moved, covariance = adjust(measured.sides, nothing)
    # Each of the 24 segments still weighs a millionth.
    assert np.abs(moved).max() < 1e-3
    assert np.sqrt(covariance[0].diagonal()) == pytest.approx(np.full(8, 3.0), rel=1e-2)


def test_medians_leave_out_what_is_not_good():
    values = np.array([[5.0, 1.0, 3.0, 9.0], [1.0, 2.0, 3.0, 4.0], [7.0, 7.0, 7.0, 7.0]])
    good = np.array([[True, True, True, False], [True, True, True, True], [False, False, False, False]])
    # The lower one of two in the middle, and 0 of none.
    np.testing.assert_array_equal(median_of(values, good), [[3.0], [2.0], [0.0]])


def test_a_robust_fit_is_least_squares_without_the_outliers():
    rng = np.random.default_rng(5)
    A, true = rng.normal(0.0, 3.0, (20, 30, 4)), rng.normal(0.0, 1.0, (20, 4))
    noise = rng.normal(0.0, 1.0, (20, 30))
    shift = (A @ true[..., None])[..., 0] + noise
    shift[:, :3] += 60.0
    fit = robust_fit(A, shift, np.ones(shift.shape, dtype=bool), 1e-9 * np.eye(4))
    assert not fit.kept[:, :3].any()
    assert fit.kept[:, 3:].mean() > 0.9
    error = fit.moved[..., 0] - true
    # NEES per degree of freedom, of 80: 1 within 0.16 at one sigma; three outliers of thirty still pull a little.
    nees = np.mean(np.einsum('ni,nij,nj->n', error, np.linalg.inv(fit.covariance), error)) / 4.0
    assert 0.5 < nees < 1.6


def test_scatter_beyond_the_claim_is_trusted_less():
    rng = np.random.default_rng(6)
    A = rng.normal(0.0, 3.0, (50, 30, 4))
    used, prior = np.ones((50, 30), dtype=bool), 1e-9 * np.eye(4)
    without = np.linalg.inv(A.swapaxes(1, 2) @ A)
    claimed, worse = (
        np.trace(without, axis1=1, axis2=2) / np.trace(fit.covariance, axis1=1, axis2=2)
        for fit in (robust_fit(A, sigma * rng.normal(0.0, 1.0, (50, 30)), used, prior) for sigma in (1.0, 3.0))
    )
    assert 0.85 < claimed.mean() < 1.2
    assert worse.mean() < 0.5
