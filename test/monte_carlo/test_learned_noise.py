"""Noise that no parameter tells: rotors shake the IMU, stamps of the camera jitter, and the filter stays honest."""

from dataclasses import replace

import numpy as np
import pytest
from support.flights import config, Flight, Motion, rms, run, START_NS, timeline

from thermal_fiducial.config import ImuNoise
from thermal_fiducial.core.filter.learned_noise import Aliasing
from thermal_fiducial.core.filter.pose_ekf import PoseEkf
from thermal_fiducial.core.geometry.se3 import so3_log

pytestmark = pytest.mark.slow
SEEDS = (51, 52)
#: Broad shaking, five and ten times the data sheet.
SHAKEN = ImuNoise(gyroscope_noise_density=1e-3, accelerometer_noise_density=2e-2)
GOOD_POSES = {'rotation_std': (0.003, 0.003, 0.001), 'translation_std': (0.0003, 0.0003, 0.003)}
#: Tones [Hz] of four rotors; of three, and one that 200 Hz sampling turns into one of 2.5 Hz.
ROTORS, ALIASED = (74.0, 79.0, 83.0, 90.0), (74.0, 79.0, 83.0, 202.5)
JITTER = 0.0015
#: Samples in about a thirtieth of a second.
FRAME = 7
SETTLED = 5.0


def flown(seed, noise, tones, amplitudes, jitter):
    """Filter, position errors (N, 3), and squared errors of poses (N,) in sigma per degree of freedom, once settled."""
    rng = np.random.default_rng(seed)
    data = Flight(seed, 12.0, Motion.random(rng, speed=1.2, turn=0.8), imu_noise=noise, **GOOD_POSES)
    axes = rng.normal(size=(len(tones), 6)) * np.repeat(amplitudes, 3)
    shaking = np.sin(2.0 * np.pi * np.outer(data.t, tones) + rng.uniform(0.0, 6.28, len(tones))) @ axes
    samples = [
        replace(sample, angular_velocity=row[:3], linear_acceleration=row[3:])
        for sample, row in zip(data.samples(), data.imu + shaking, strict=True)
    ]
    late = jitter * rng.normal(size=len(data.poses))
    poses = [replace(pose, stamp_ns=pose.stamp_ns + round(s * 1e9)) for pose, s in zip(data.poses, late, strict=True)]
    ekf = PoseEkf(config())
    states, _ = run(ekf, timeline(samples, poses, 0.03))
    states = [state for state in states if state.stamp_ns > START_NS + SETTLED * 1e9]
    truth = data.motion.pose(np.array([(state.stamp_ns - START_NS) * 1e-9 for state in states]))
    position = np.array([state.T_map_body[:3, 3] for state in states]) - truth[:, :3, 3]
    turned = [so3_log(state.T_map_body[:3, :3] @ T[:3, :3].T) for state, T in zip(states, truth, strict=True)]
    error = np.concatenate((position, turned), axis=1)
    P = np.array([state.pose_covariance for state in states])
    return ekf, position, np.einsum('ni,nij,nj->n', error, np.linalg.inv(P), error) / 6.0


def over_seeds(noise, tones, amplitudes, jitter=0.0):
    """Mean share of vibration and stamp jitter that were learned, jitter of the position, and mean error in sigma."""
    runs = [flown(seed, noise, tones, amplitudes, jitter) for seed in SEEDS]
    numbers = [ekf.diagnostics() for ekf, _, _ in runs]
    shares, jitters = ([entry[name] for entry in numbers] for name in ('vibration share', 'stamp jitter'))
    steps = rms(
        np.concatenate([np.linalg.norm(position[FRAME:] - position[:-FRAME], axis=1) for _, position, _ in runs])
    )
    return np.mean(shares), np.mean(jitters), steps, np.mean([squared.mean() for _, _, squared in runs])


def test_rotors_and_jittering_stamps_are_learned(monkeypatch):
    share, jitter, steps, squared = over_seeds(SHAKEN, ROTORS, (0.02, 0.6), JITTER)
    assert share < 0.1
    # A jitter among errors of 3 mm is found to a third; poses are told to be twice as bad as they are.
    assert jitter == pytest.approx(JITTER, rel=0.3)
    assert 0.3 < squared < 1.0
    monkeypatch.setattr(Aliasing, 'after', lambda self, *_: self)
    assert steps < 0.8 * over_seeds(SHAKEN, ROTORS, (0.02, 0.6), JITTER)[2]


def test_vibration_that_aliases_into_the_motion_is_allowed_for(monkeypatch):
    """No spectrum tells it from motion. Taken for quiet, the errors would be three times as large as claimed."""
    share, _, _, squared = over_seeds(ImuNoise(), ALIASED, (0.015, 0.5))
    assert share > 0.5
    assert squared < 2.0
    monkeypatch.setattr(Aliasing, 'after', lambda self, *_: replace(self, share=0.0))
    assert over_seeds(ImuNoise(), ALIASED, (0.015, 0.5))[3] > 3.0 * squared
