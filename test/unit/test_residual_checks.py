"""Correlation time and second poses, from residuals made to order."""

import numpy as np
import pytest

from thermal_fiducial.core.mapping.residual_checks import correlation_time, two_places


@pytest.mark.parametrize('memory', [0.0, 0.5, 0.9])
def test_the_correlation_time_is_that_of_the_errors(memory):
    """Of a first-order process: (1 + a) / (1 - a)."""
    rng = np.random.default_rng(0)
    views, markers = 4000, 4
    noise = rng.normal(size=(views, markers, 8))
    errors = np.zeros_like(noise)
    for k in range(1, views):
        errors[k] = memory * errors[k - 1] + np.sqrt(1.0 - memory**2) * noise[k]
    marker = np.tile(np.arange(markers), views)
    # 16,000 views of 8: a few percent, and the sum ends a little early.
    assert correlation_time(errors.reshape(-1, 8), marker) == pytest.approx((1 + memory) / (1 - memory), rel=0.1)


def test_few_views_of_white_noise_count_in_full():
    rng = np.random.default_rng(1)
    times = [correlation_time(rng.normal(size=(60, 8)), np.arange(60) % 5) for _ in range(200)]
    # By chance 2.5 % seem correlated.
    assert np.mean(np.array(times) > 1.0) < 0.06
    assert correlation_time(np.zeros((0, 8)), np.zeros(0, dtype=int)) == 1.0
    assert correlation_time(np.zeros((3, 8)), np.zeros(3, dtype=int)) == 1.0


def test_outliers_that_agree_are_a_second_pose_and_others_are_not():
    rng = np.random.default_rng(2)
    views = 60
    J = 100.0 * rng.normal(size=(views, 8, 6))
    outlying = np.arange(views) % 4 == 0
    noise = rng.normal(size=(views, 8))
    moved = noise + np.where(outlying[:, None], J @ np.array([0.05, 0.0, 0.02, 0.0, 0.1, 0.0]), 0.0)
    scattered = np.where(outlying[:, None], 20.0 * noise, noise)
    assert two_places(moved, J, outlying)
    assert not two_places(scattered, J, outlying)
    # A few frames, or a few in a hundred, are no evidence.
    few = np.arange(views) < 9
    assert not two_places(np.where(few[:, None], J @ np.full(6, 0.05), noise), J, few)
