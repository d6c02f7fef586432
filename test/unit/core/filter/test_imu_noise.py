"""How noisy the IMU is taken to be: data sheet, rotors, motion, gaps and the ends of its range."""

from dataclasses import replace

import numpy as np
import pytest
from support.flights import perfect

from thermal_fiducial.config import ImuNoise
from thermal_fiducial.core.filter.imu_noise import ImuNoiseMonitor

SHEET = ImuNoise()
#: Nothing that motion adds.
LINEAR = replace(SHEET, gyroscope_nonlinearity=0.0, accelerometer_nonlinearity=0.0)
#: White noise of a shaken IMU [rad/s/sqrt(Hz), m/s^2/sqrt(Hz)].
FLOOR = np.repeat((1.0e-3, 2.0e-2), 3)
GRAVITY = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 9.8])


def last(monitor, samples, seconds=0.005):
    """Densities of gyroscope and accelerometer after ``samples``."""
    return [monitor.densities(imu, seconds) for imu in samples][-1][[0, 3]]


def white(count, rate, densities=FLOOR, seed=3):
    return GRAVITY + np.random.default_rng(seed).normal(size=(count, 6)) * densities * np.sqrt(rate)


def test_white_noise_of_the_data_sheet_leaves_the_densities_alone():
    sheet = np.repeat((SHEET.gyroscope_noise_density, SHEET.accelerometer_noise_density), 3)
    # the floor's maximum with the data sheet's is a little above it
    assert last(ImuNoiseMonitor(LINEAR), white(400, 200.0, sheet)) == pytest.approx((1.7e-4, 2.0e-3), rel=0.1)


@pytest.mark.parametrize('rate', [100.0, 200.0, 400.0])
def test_the_floor_of_the_noise_is_found_under_motion_and_between_tones(rate):
    t = np.arange(round(6.0 * rate)) / rate
    swings = np.sin(2.0 * np.pi * np.outer(t, [0.4, 0.9, 2.1, 0.7, 1.3, 2.5])) * np.repeat((1.5, 4.0), 3)
    rotors = np.sin(2.0 * np.pi * np.outer(t, [78.0, 85.0, 91.0, 81.0, 77.0, 88.0])) * np.repeat((0.03, 1.0), 3)
    noise = last(ImuNoiseMonitor(LINEAR), swings + rotors + white(len(t), rate), 1.0 / rate)
    # The quietest of four bands, each of some 60 independent values: 10 % below the truth; tones leak little; and what
    # 10 ms between samples hide of swings of 4 m/s^2 at 2.5 Hz adds some per cent
    assert noise == pytest.approx((1.0e-3, 2.0e-2), rel=0.3)


@pytest.mark.parametrize('rates', [(50.0, 200.0), (200.0, 50.0), (400.0, 100.0), (200.0, 45.0)])
def test_the_floor_is_found_after_a_change_of_the_rate(rates):
    """An autopilot is asked for another rate once it streams."""
    monitor = ImuNoiseMonitor(LINEAR)
    for seed, rate in enumerate(rates):
        noise = last(monitor, white(round(6.0 * rate), rate, seed=seed), 1.0 / rate)
    # As above, less what is not there; at 50 Hz a band has a third of the values.
    assert noise == pytest.approx((1.0e-3, 2.0e-2), rel=0.3)


def test_motion_makes_errors_in_proportion():
    t = np.arange(800) / 200.0
    swings = GRAVITY + np.outer(np.sin(2.0 * np.pi * t), [2.0, 0.0, 0.0, 3.0, 0.0, 0.0])
    monitor = ImuNoiseMonitor(replace(perfect(SHEET), gyroscope_nonlinearity=0.01, accelerometer_nonlinearity=0.01))
    densities = np.array([monitor.densities(imu, 0.005) for imu in swings])[400:]
    # rms over a period: 1 % of 2 / sqrt(2) rad/s; of the force, what its running mean over 0.2 s leaves: 78 %
    rms = np.sqrt(np.mean(densities[:, [0, 3]] ** 2, axis=0))
    assert rms[0] == pytest.approx(0.01 * np.sqrt(2.0), rel=0.03)
    assert rms[1] == pytest.approx(0.01 * 0.78 * 3.0 / np.sqrt(2.0), rel=0.05)


def hidden(motion, stamps, gap):
    """Squared densities (2,) claimed for a gap after samples of ``motion``, and true ones: mean squares over many."""
    monitor = ImuNoiseMonitor(replace(perfect(SHEET), gyroscope_nonlinearity=0.0, accelerometer_nonlinearity=0.0))
    last(monitor, GRAVITY + motion(stamps[:1]))
    for seconds, imu in zip(np.diff(stamps), motion(stamps)[1:], strict=True):
        monitor.densities(GRAVITY + imu, seconds)
    claimed = monitor.densities(GRAVITY + motion(stamps[-1:] + gap)[0], gap)[[0, 3]] ** 2
    begins = np.linspace(stamps[0], stamps[-1] - gap, 500)
    between = motion((begins[:, None] + np.linspace(0.0, gap, 101)).ravel()).reshape(-1, 101, 6)
    errors = 0.5 * (between[:, 0] + between[:, -1]) - between.mean(axis=1)
    return claimed, (errors**2).reshape(-1, 2, 3).mean(axis=(0, 2)) * gap


def swinging(t):
    """Motion of a flight: turns of 1.5 rad/s, thrust of 4 m/s^2, up to 2.5 Hz."""
    frequencies = np.array([[1.0, 1.3, 0.7, 1.1, 0.8, 1.2], [2.3, 1.9, 2.5, 2.1, 2.4, 2.0]])
    return np.sin(2.0 * np.pi * t[:, None, None] * frequencies).sum(axis=1) * np.repeat((1.0, 2.8), 3)


def bursts(rng, seconds=8.0):
    """Stamps as of a recorded drone whose sensor's samples are lost but for some: a few in a row, then none."""
    begins = np.cumsum(rng.uniform(0.02, 0.1, round(seconds / 0.06)))
    return np.unique((begins[:, None] + np.arange(4) * 125e-6).ravel())


@pytest.mark.parametrize('gap', [0.1, 0.2, 0.5])
@pytest.mark.parametrize('even', [True, False])
def test_what_a_gap_hides_follows_from_the_motion_around_it(gap, even):
    stamps = np.arange(1600) / 200.0 if even else bursts(np.random.default_rng(5))
    claimed, true = hidden(swinging, stamps, gap)
    # An upper bound: with lags an octave apart it may be a third too small, and it is the wider the closer the gap is
    # to the period of the motion: 8 times at 0.2 s.
    assert np.all(claimed > true / 1.5)
    assert np.all(claimed < 10.0 * true)


def test_a_gap_hides_the_jumps_that_are_seen_behind_gaps_alone():
    # As of a recorded drone: each burst of samples shows one and the same motion, behind the gap it is another.
    sigma = np.repeat((0.2, 0.5), 3)
    monitor = ImuNoiseMonitor(LINEAR)
    for motion in np.random.default_rng(7).normal(size=(60, 6)) * sigma:
        behind_gap = monitor.densities(GRAVITY + motion, 0.067)[[0, 3]] ** 2
        for _ in range(9):
            monitor.densities(GRAVITY + motion * 1.01, 0.005)
    # A jump of variance 2 sigma^2 at an unknown instant: the mean over the gap is off by a twelfth of that.
    true = 2.0 * sigma[[0, 3]] ** 2 / 12.0 * 0.067
    # Wide by at most 10, as above: it may be anything else than a jump.
    assert np.all(behind_gap > true / 1.5)
    assert np.all(behind_gap < 10.0 * true)


def test_what_was_linear_in_time_need_not_stay_so_in_a_gap():
    slopes = np.repeat((0.3, 1.0), 3)
    claimed, _ = hidden(lambda t: t[:, None] * slopes, np.arange(600) / 200.0, 0.5)
    # The change over the gap is 0.15 rad/s and 0.5 m/s^2: at least a tenth of it may have come early or late.
    assert np.all(np.sqrt(claimed / 0.5) > 0.1 * 0.5 * slopes[[0, 3]])


@pytest.mark.parametrize('gap', [0.5, 0.8])
def test_a_long_gap_is_judged_by_lags_as_long(gap):
    # A period of two seconds: up to half a second it looks like a parabola.
    claimed, true = hidden(lambda t: np.sin(np.pi * t)[:, None] * np.ones(6), np.arange(1600) / 200.0, gap)
    # as for the faster motion above
    assert np.all(claimed > true / 1.5)
    assert np.all(claimed < 10.0 * true)


def test_a_drone_that_is_still_may_turn_in_a_long_gap():
    claimed, _ = hidden(lambda t: np.zeros((len(t), 6)), np.arange(400) / 200.0, 0.77)
    # A rendered flight turned by 13 deg in such a gap, of which nothing was to be seen before or after: 0.3 rad/s at
    # three sigma.
    assert 3.0 * np.sqrt(claimed[0] / 0.77) > 0.2


def test_a_gap_of_a_drone_at_rest_hides_little():
    claimed, _ = hidden(lambda t: np.zeros((len(t), 6)), np.arange(400) / 200.0, 0.033)
    # no more than the noise of the data sheet, which is in it
    assert np.all(np.sqrt(claimed) < 1.5 * np.array((1.7e-4, 2.0e-3)))


def test_vibration_between_bursts_of_samples_is_noise():
    rng = np.random.default_rng(6)
    stamps = bursts(rng)
    sigma = np.repeat((0.1, 0.5), 3)
    monitor = ImuNoiseMonitor(LINEAR)
    shaken = np.repeat(rng.normal(size=(len(stamps) // 4, 6)), 4, axis=0) * sigma
    steps = np.diff(stamps)
    densities = np.array([monitor.densities(GRAVITY + v, s) for s, v in zip(steps, shaken[1:], strict=True)])
    # What the ends of the steps show by chance adds up to noise as of white samples: variance times time between.
    expected = sigma[[0, 3]] ** 2 * np.sum(steps**2)
    claimed = np.sum(densities[:, [0, 3]] ** 2 * steps[:, None], axis=0)
    # 130 bursts, of which those of the first second know little yet
    np.testing.assert_allclose(claimed, expected, rtol=0.35)


def test_saturation_raises_the_noise():
    assert ImuNoiseMonitor(SHEET).densities(np.array([0, 0, 0, 0, 0, 157.0]), 0.005)[3] > 1.0
    assert ImuNoiseMonitor(SHEET).densities(np.array([35.0, 0, 0, 0, 0, 9.8]), 0.005)[0] > 0.03


def test_a_gap_is_no_noise_of_the_samples_around_it():
    monitor = ImuNoiseMonitor(LINEAR)
    last(monitor, white(400, 200.0))
    before = np.array(monitor.vibration)
    monitor.densities(np.full(6, 30.0), 0.2)
    last(monitor, 30.0 + white(100, 200.0, seed=4))
    # two more windows of twelve in the mean
    np.testing.assert_allclose(monitor.vibration, before, rtol=0.1)


def test_a_slow_imu_has_no_room_for_a_floor():
    assert np.isfinite(last(ImuNoiseMonitor(SHEET), white(200, 25.0), 0.04)).all()
