"""The promise of how long the pose may be used, against the filter's own covariance while it coasts."""

from dataclasses import replace

import numpy as np
import pytest
from support.flights import config, Flight, MATCHED_IMU, Motion, run, timeline

from thermal_fiducial.config import ImuNoise
from thermal_fiducial.core.filter.ekf import PoseEkf
from thermal_fiducial.core.filter.propagation import HORIZON, hovered, random_walks, usable_seconds
from thermal_fiducial.core.filter.state import POSITION

IMU = config().imu
WALKS = random_walks(config())
DENSITIES = np.repeat((IMU.gyroscope_noise_density, IMU.accelerometer_noise_density), 3)


@pytest.fixture(scope='module')
def hover():
    """A filter at rest whose markers vanish after 4 s, there and 4 s later."""
    data = Flight(seed=2, seconds=8.0, motion=Motion.still())
    samples, ekf = data.samples(), PoseEkf(config())
    last = samples[800]
    run(ekf, timeline([s for s in samples if s.stamp_ns <= last.stamp_ns], data.poses[:114]))
    then = ekf.estimate
    run(ekf, samples[801:])
    return then, ekf.estimate, (samples[-1].stamp_ns - last.stamp_ns) * 1e-9


def test_the_variance_is_that_of_the_propagated_covariance(hover):
    then, now, seconds = hover
    # 3 per mille of six seeds when this was written; 15 where walks count from the ends of the steps.
    assert hovered(then, DENSITIES, WALKS, seconds).std(POSITION) == pytest.approx(now.std(POSITION), rel=0.005)


def test_usable_until_the_variance_is_too_large(hover):
    then, now, seconds = hover
    # the grid of 0.05 s and the half per cent above
    assert usable_seconds(then, DENSITIES, WALKS, now.std(POSITION)) == pytest.approx(seconds, abs=0.15)
    assert usable_seconds(then, DENSITIES, WALKS, 0.0) == 0.0
    assert usable_seconds(then, DENSITIES, WALKS, 1e6) == HORIZON


def test_the_promise_counts_the_noise_that_the_imu_has():
    """Thirty times that of the data sheet, as under rotors."""
    noise = ImuNoise(gyroscope_noise_density=30.0 * DENSITIES[0], accelerometer_noise_density=30.0 * DENSITIES[3])
    several_markers = {'rotation_std': (0.003, 0.003, 0.001), 'translation_std': (0.0003, 0.0003, 0.003)}
    data = Flight(seed=4, seconds=9.0, motion=Motion.still(), imu_noise=noise, **several_markers)
    samples, ekf = data.samples(), PoseEkf(config(lost_position_std=0.3, imu=replace(MATCHED_IMU, vibration=1.0)))
    run(ekf, timeline(samples[:1000], data.poses[:140]))
    promised, by_data_sheet = ekf.usable_for, usable_seconds(ekf.estimate, DENSITIES, WALKS, 0.3)
    lost = next(seconds for seconds, sample in enumerate(samples[1000:]) if ekf.add_imu(sample) and ekf.lost) / 200.0
    # what vibration there is varies from sample to sample
    assert promised == pytest.approx(lost, rel=0.05)
    assert by_data_sheet > 1.1 * lost
