"""Second poses, from residuals made to order."""

import numpy as np

from thermal_fiducial.core.mapping.bundle_adjustment import two_places


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


def test_views_from_behind_show_no_second_pose():
    """They have no residuals, and so no direction."""
    residuals, J = np.zeros((20, 8)), np.zeros((20, 8, 6))
    assert not two_places(residuals, J, np.ones(20, dtype=bool))
