"""Samples of the IMU on a path."""

from collections.abc import Iterator

import numpy as np
from scipy.linalg import block_diag

from rigs.motion import Path, ROTORS, smooth
from rigs.rig import Rig, SECONDS

GRAVITY = np.array([0.0, 0.0, 9.80665])


def readings(path: Path, times: np.ndarray) -> np.ndarray:
    """Angular velocity and specific force (N, 6) of a perfect IMU."""
    force = path.rotations(times).inv().apply(path.acceleration(times) + GRAVITY)
    return np.hstack((path.rates(times), force))


def samples(rig: Rig, path: Path) -> Iterator[tuple[float, np.ndarray]]:
    """Stamp [s] and reading (6,) of each sample that arrives, in order."""
    imu, rng = rig.imu, rig.rng('imu')
    times = np.arange(0.0, SECONDS, 1.0 / imu.rate)
    draws = rng.normal(size=(2, len(times), 6))
    bias = imu.bias + np.cumsum(draws[0] * imu.walk / np.sqrt(imu.rate), axis=0)
    white = draws[1] * imu.density * np.sqrt(imu.rate)
    spinning = smooth(times - ROTORS)[:, None] if rig.task.style == 'take-off' else 1.0
    shaken = imu.shaking * np.repeat([imu.turning, 1.0], 3) * spinning
    vibration = shaken * np.sin(2.0 * np.pi * (imu.turns * np.arange(len(times))[:, None] + rng.random(6)))
    scale = np.eye(6) + block_diag(*imu.scale)
    values = readings(path, times) @ scale.T + bias + white + vibration
    # Never so late that the next one is before it.
    stamps = times + np.minimum(np.abs(rng.normal(0.0, imu.jitter, len(times))), 0.5 / imu.rate)
    arrived = rng.random(len(times)) >= imu.loss
    return zip(stamps[arrived].tolist(), values[arrived], strict=True)
