"""How noisy the IMU is taken to be: data sheet, rotors, gaps and ends of its range."""

import numpy as np
import pytest

from thermal_fiducial.config import ImuNoise
from thermal_fiducial.core.filter.imu_noise import GAP, NoiseMonitor, NoiseRange

SHEET = ImuNoise()
#: White noise of a shaken IMU [rad/s/sqrt(Hz), m/s^2/sqrt(Hz)].
FLOOR = np.repeat((1.0e-3, 2.0e-2), 3)


def last(monitor, samples, seconds=0.005):
    """Range after ``samples``."""
    return [monitor.densities(imu, seconds) for imu in samples][-1]


def white(count, rate, densities=FLOOR, seed=3):
    return np.random.default_rng(seed).normal(size=(count, 6)) * densities * np.sqrt(rate)


def test_white_noise_of_the_data_sheet_leaves_the_densities_alone():
    sheet = np.repeat((SHEET.gyroscope_noise_density, SHEET.accelerometer_noise_density), 3)
    monitor = NoiseMonitor(SHEET)
    noise = last(monitor, white(400, 200.0, sheet))
    assert noise.quiet == pytest.approx((1.7e-4, 2.0e-3), rel=0.1)
    assert noise.shaken == pytest.approx((1.7e-4, 2.0e-3), rel=0.2)
    # 20 % is five standard deviations of a variance over 60 samples x 3 axes, correlated over three
    assert monitor.vibration == pytest.approx(np.sqrt(200.0) * sheet[[0, 3]], rel=0.2)


@pytest.mark.parametrize('rate', [100.0, 200.0, 400.0])
def test_the_floor_of_the_noise_is_found_under_motion_and_between_tones(rate):
    t = np.arange(round(6.0 * rate)) / rate
    swings = np.sin(2.0 * np.pi * np.outer(t, [0.4, 0.9, 2.1, 0.7, 1.3, 2.5])) * np.repeat((1.5, 4.0), 3)
    rotors = np.sin(2.0 * np.pi * np.outer(t, [78.0, 85.0, 91.0, 81.0, 77.0, 88.0])) * np.repeat((0.03, 1.0), 3)
    noise = last(NoiseMonitor(SHEET), swings + rotors + white(len(t), rate), 1.0 / rate)
    # The quietest of four bands, each of some 60 independent values: 10 % below the truth; tones leak little
    assert noise.quiet == pytest.approx((1.0e-3, 2.0e-2), rel=0.25)
    # Tones of 0.03 rad/s have 1.1 to 4.5 times the variance of that white noise, at 400 Hz their differences have less
    assert noise.shaken[0] > 1.1 * noise.quiet[0]
    assert noise.doubt > 0.2


def test_noise_of_all_vibration_is_that_of_its_samples():
    noise = last(NoiseMonitor(SHEET), np.random.default_rng(3).normal(size=(400, 6)))
    # 1 rad/s and 1 m/s^2 rms at 200 Hz, all of it white but half of the force's counts by samples; 20 % as above
    assert noise.shaken == pytest.approx((np.sqrt(0.005), np.sqrt(0.005)), rel=0.2)
    assert last(NoiseMonitor(ImuNoise(vibration=0.0)), np.ones((400, 6))) == NoiseRange((1.7e-4, 2e-3), (1.7e-4, 2e-3))


def test_the_share_of_vibration_lies_between_quiet_and_shaken():
    noise = NoiseRange((3.0, 0.3), (5.0, 0.5))
    assert noise.at(0.0) == pytest.approx(noise.quiet)
    assert noise.at(1.0) == pytest.approx(noise.shaken)
    assert noise.at(0.5)[0] == pytest.approx(np.sqrt(17.0))
    assert noise.doubt == pytest.approx(1.0 - 9.0 / 25.0)
    assert NoiseRange().doubt == 0.0


def test_gaps_and_saturation_raise_the_noise():
    for share in (0.0, 1.0):
        assert NoiseMonitor(SHEET).densities(np.zeros(6), GAP + 0.01).at(share)[1] > 0.5
        assert NoiseMonitor(SHEET).densities(np.array([0, 0, 0, 0, 0, 157.0]), 0.005).at(share)[1] > 1.0
        assert NoiseMonitor(SHEET).densities(np.array([35.0, 0, 0, 0, 0, 9.8]), 0.005).at(share)[0] > 0.03


def test_a_gap_is_no_noise_of_the_samples_around_it():
    monitor = NoiseMonitor(SHEET)
    before = last(monitor, white(400, 200.0))
    monitor.densities(np.full(6, 30.0), 0.2)
    after = last(monitor, 30.0 + white(100, 200.0, seed=4))
    # two more windows of twelve in the mean
    assert after.quiet == pytest.approx(before.quiet, rel=0.1)


def test_a_slow_imu_has_no_room_for_a_floor():
    noise = last(NoiseMonitor(SHEET), white(200, 25.0), 0.04)
    assert np.isfinite(noise.shaken).all()
