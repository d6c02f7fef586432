"""What the buffer of IMU samples shows of the time between them."""

from dataclasses import replace

import numpy as np
import pytest
from support.estimates import any_estimate

from thermal_fiducial.core.filter.imu_buffer import ImuBuffer
from thermal_fiducial.core.filter.propagation import propagated
from thermal_fiducial.core.filter.state import SIZE

#: Uneven, as real drivers are.
STAMPS_NS = [0, 5_000_000, 9_000_000, 15_000_000, 20_000_000]
DENSITIES = np.arange(5.0)[:, None] * np.ones(6)
WHITE = (2e-3, 3e-2)


def line(time_ns):
    """Sample of a motion that is linear in time."""
    return np.arange(6.0) + time_ns * 1e-7 * np.array([1.0, -2.0, 3.0, -1.0, 0.5, 2.0])


@pytest.fixture
def buffer():
    buffer = ImuBuffer()
    for stamp_ns, densities in zip(STAMPS_NS, DENSITIES, strict=True):
        buffer.append(stamp_ns, line(stamp_ns), densities)
    return buffer


@pytest.mark.parametrize('time_ns', [0, 2_000_000, 9_000_000, 19_999_999])
def test_between_samples_the_motion_is_linear(buffer, time_ns):
    np.testing.assert_allclose(buffer.at(time_ns), line(time_ns), rtol=1e-12)


@pytest.mark.parametrize(
    ('begin_ns', 'end_ns', 'lengths_ms', 'last_densities'),
    [
        (0, 20_000_000, [5, 4, 6, 5], 4.0),
        (5_000_000, 9_000_000, [4], 2.0),
        (6_000_000, 8_000_000, [2], 2.0),
        (3_000_000, 12_000_000, [2, 4, 3], 3.0),
    ],
)
def test_steps_begin_and_end_where_they_are_asked_to(buffer, begin_ns, end_ns, lengths_ms, last_densities):
    steps = buffer.steps(begin_ns, end_ns)
    np.testing.assert_allclose(1e3 * steps.seconds, lengths_ms, rtol=1e-12)
    middles_ns = begin_ns + 1e9 * (np.cumsum(steps.seconds) - 0.5 * steps.seconds)
    np.testing.assert_allclose(steps.imu, [line(middle) for middle in middles_ns], rtol=1e-9)
    assert steps.densities[-1, 0] == last_densities


def test_a_stretch_does_not_change_the_samples(buffer):
    before = buffer.window(STAMPS_NS[-1], 1.0)
    buffer.steps(3_000_000, 12_000_000)
    np.testing.assert_array_equal(buffer.window(STAMPS_NS[-1], 1.0), before)


def test_a_window_ends_at_its_instant(buffer):
    window = buffer.window(12_000_000, 0.008)
    np.testing.assert_allclose(window, [line(5_000_000), line(9_000_000), line(12_000_000)], rtol=1e-12)


def test_it_grows_and_forgets():
    buffer = ImuBuffer()
    for index in range(5000):
        buffer.append(index, line(index), np.ones(6))
        if index % 100 == 0:
            buffer.forget_before(index - 1500)
    # the one before 3400, as an instant between the two may be asked for
    assert buffer.oldest_ns == 3399
    assert len(buffer) == 5000 - 3399
    np.testing.assert_allclose(buffer.window(4999, 1.0)[[0, -1]], [line(3399), line(4999)], rtol=1e-12)


def test_a_gap_is_filled_with_short_steps_of_its_own_noise(buffer):
    begin_ns, end_ns = STAMPS_NS[-1], STAMPS_NS[-1] + 100_000_000
    buffer.append(end_ns, line(end_ns), 9.0 * np.ones(6))
    steps = buffer.steps(begin_ns, end_ns)
    # four of 25 ms: more than 30 ms would be one of its parts with three
    np.testing.assert_allclose(steps.seconds, 0.025)
    np.testing.assert_allclose(steps.densities, 9.0)
    np.testing.assert_allclose(steps.imu, [line(begin_ns + (2 * k + 1) * 12_500_000) for k in range(4)], rtol=1e-12)


def test_one_pose_behind_a_gap_does_not_make_the_velocity_known():
    # The hidden acceleration may have come early or late in the gap.
    gap = ImuBuffer()
    gap.append(0, np.zeros(6), np.ones(6))
    gap.append(500_000_000, np.zeros(6), np.ones(6))
    known = replace(any_estimate(), stamp_ns=0, covariance=np.zeros((SIZE, SIZE)))
    noise = propagated(known, gap.steps(0, 500_000_000), 500_000_000, np.zeros(SIZE)).covariance
    velocity, position = noise[5, 5], noise[8, 8]
    left = 1.0 - noise[5, 8] ** 2 / (velocity * position)
    # of white noise a quarter of the variance is left, of steps of 29 ms the less by the square of their share
    assert left == pytest.approx(0.25, abs=0.005)


def test_the_motion_at_a_pose_has_the_white_noise_of_its_samples():
    """Of a gyroscope and an accelerometer that are nothing but noise, by its spread over many instants."""
    rng, step_ns, accepted_ns = np.random.default_rng(2), 5_000_000, 40_000_000
    noisy = ImuBuffer()
    noisy.white = WHITE
    samples = rng.normal(size=(20_000, 6)) * np.repeat(WHITE, 3) / np.sqrt(1e-9 * step_ns)
    for index, sample in enumerate(samples):
        # what poses claim beside it says nothing of the noise
        noisy.append(index * step_ns, sample, np.ones(6))
    at = [noisy.motion(ns, ns - accepted_ns) for ns in range(1_000_000_000, 99_000_000_000, 100_000_000)]
    spread = np.var([motion.imu[:3] for motion in at])
    # 3 x 980 independent rates: 2.6 % of standard deviation, three of them
    assert at[0].white[0] == pytest.approx(spread, rel=0.08)
    np.testing.assert_allclose(at[0].white[3:], WHITE[1] ** 2 * 1e-9 * accepted_ns)
