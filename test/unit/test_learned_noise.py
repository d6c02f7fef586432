"""What innovations show of the stamps' jitter and of vibration that aliases."""

import numpy as np
import pytest

from thermal_fiducial.core.filter.learned_noise import Aliasing, INTERRUPTED_NS, LEAST_JITTER, StampJitter

FRAME_NS = 33_000_000


def watched(jitter, true_std, poses=900, twist_scale=1.0, wild=0.0, seed=1):
    """``jitter`` after innovations of poses known to 1 mm and 1 mrad, whose stamps scatter by ``true_std``."""
    rng = np.random.default_rng(seed)
    for _ in range(poses):
        twist = twist_scale * rng.normal(size=6)
        innovation = 1e-3 * rng.normal(size=6) + true_std * rng.normal() * twist
        if rng.uniform() < wild:
            innovation = 0.05 * rng.normal(size=6)
        S = 1e-6 * np.eye(6) + jitter.variance * np.outer(twist, twist)
        jitter = jitter.after(twist, np.linalg.solve(S, twist), innovation)
    return jitter


@pytest.mark.parametrize('true_std', [0.0003, 0.0015, 0.004])
def test_jitter_of_stamps_is_found(true_std):
    # 20 %: a mean over 300 poses of squares, whose standard deviation is 8 % of the variance and more of a small one
    assert np.sqrt(watched(StampJitter.of(0.0005), true_std).variance) == pytest.approx(true_std, rel=0.2)


def test_wild_poses_do_not_pass_for_jitter():
    # 5 % of outliers at the limit of 9 would add 0.45 of the total variance, 1 mm of 1.8
    assert np.sqrt(watched(StampJitter.of(0.0005), 0.0015, wild=0.05).variance) < 0.0022


def test_a_robot_at_rest_shows_no_jitter_and_unlearns_none():
    known = watched(StampJitter.of(0.0005), 0.0015)
    assert watched(known, 0.0, twist_scale=0.0).variance == known.variance


def test_jitter_keeps_within_its_range():
    assert np.sqrt(watched(StampJitter.of(0.001), 0.0).variance) < 3.0 * LEAST_JITTER
    exact = StampJitter.of(0.0)
    assert watched(exact, 0.0015) is exact


def shaken(aliasing, innovations, step=1.0, scale=2.0, gap_ns=FRAME_NS):
    """``aliasing`` after normalised innovations (N, 6)."""
    for count, innovation in enumerate(innovations, start=1):
        aliasing = aliasing.after(aliasing.time_ns + gap_ns * min(count, 1), innovation, innovation, step, scale)
    return aliasing


def tone(frequency, amplitude, poses=400):
    """White innovations of half the expected size, and a tone [Hz] in them."""
    noise = 0.5 * np.random.default_rng(2).normal(size=(poses, 6))
    return noise + amplitude * np.sin(2.0 * np.pi * frequency * np.arange(poses) * FRAME_NS * 1e-9)[:, None]


def test_white_innovations_speak_against_aliased_vibration():
    assert shaken(Aliasing(), tone(0.0, 0.0)).share == 0.0


@pytest.mark.parametrize('frequency', [1.0, 3.0, 6.0, 9.0])
def test_innovations_that_follow_each_other_speak_for_it(frequency):
    assert shaken(Aliasing(share=0.0), tone(frequency, 1.0)).share == 1.0


def test_wild_poses_do_not_speak_for_it():
    innovations = tone(0.0, 0.0)
    innovations[::20] = 100.0 * np.random.default_rng(3).normal(size=(20, 6))
    # the random walk of products at the limit, one pose in twenty
    assert shaken(Aliasing(share=0.0), innovations).share < 0.2


def test_where_the_noise_is_in_no_doubt_nothing_is_learned():
    assert shaken(Aliasing(), tone(0.0, 0.0), step=0.0).share == 1.0


def test_poses_after_a_gap_follow_nothing():
    before = shaken(Aliasing(), tone(3.0, 1.0, poses=20))
    after = shaken(before, tone(3.0, 1.0, poses=5), gap_ns=INTERRUPTED_NS + 1)
    assert after.share == before.share
    np.testing.assert_array_equal(after.correlations, before.correlations)
