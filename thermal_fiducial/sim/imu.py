"""An IMU on the simulated body: exact rates and specific force, white noise, wandering biases."""

from dataclasses import dataclass

import numpy as np

from thermal_fiducial.core.types import FloatArray, IntArray
from thermal_fiducial.sim.trajectory import GRAVITY, Path


@dataclass(frozen=True)
class ImuRecord:
    """Samples of one flight, leading dimension (N,)."""

    stamps_ns: IntArray
    #: [rad/s], body
    angular_velocity: FloatArray
    #: specific force [m/s^2], body
    linear_acceleration: FloatArray
    #: the true biases
    gyroscope_bias: FloatArray
    accelerometer_bias: FloatArray


@dataclass(frozen=True)
class ImuNoise:
    """Continuous densities, under Kalibr's names: [rad/s/sqrt(Hz)], [m/s^2/sqrt(Hz)], walks per second more."""

    gyroscope_noise_density: float = 1.7e-4
    accelerometer_noise_density: float = 2.0e-3
    gyroscope_random_walk: float = 2.0e-5
    accelerometer_random_walk: float = 3.0e-4


@dataclass(frozen=True)
class ImuModel:
    """Noise of the IMU.

    Parameters
    ----------
    noise : densities and random walks (Kalibr's)
    rate : [Hz]
    gyroscope_bias_sigma, accelerometer_bias_sigma : of the biases at switch-on [rad/s], [m/s^2]
    gyroscope_rattle, accelerometer_rattle : broadband noise of a sample by vibration, which no data sheet counts
        [rad/s], [m/s^2]
    stamp_jitter : standard deviation of the stamps about the sampling; they stay in order [s]
    """

    noise: ImuNoise = ImuNoise()
    rate: float = 200.0
    gyroscope_bias_sigma: float = 0.003
    accelerometer_bias_sigma: float = 0.04
    gyroscope_rattle: float = 0.0
    accelerometer_rattle: float = 0.0
    stamp_jitter: float = 0.0

    def sample(self, trajectory: Path, times: FloatArray, stamps_ns: IntArray, seed: int) -> ImuRecord:
        """What the IMU answers at ``times`` (N,) [s] of a flight, true stamps ``stamps_ns`` (N,).

        A discrete sample of white noise of density n at rate f has deviation n sqrt(f), a bias of random walk
        w moves by w / sqrt(f) a sample (Kalibr's IMU noise model).
        """
        rng = np.random.default_rng([seed, 2])
        motion, noise, root = trajectory(times), self.noise, np.sqrt(self.rate)
        gravity_up = np.array([0.0, 0.0, GRAVITY])
        force = motion.rotation.inv().apply(motion.acceleration + gravity_up)

        def bias(start: float, walk: float) -> FloatArray:
            steps = rng.normal(0.0, walk / root, (len(times), 3))
            return np.asarray(rng.normal(0.0, start, 3) + np.cumsum(steps, axis=0))

        def white(density: float) -> FloatArray:
            return rng.normal(0.0, density * root, (len(times), 3))

        gyroscope_bias = bias(self.gyroscope_bias_sigma, noise.gyroscope_random_walk)
        accelerometer_bias = bias(self.accelerometer_bias_sigma, noise.accelerometer_random_walk)
        rates = motion.angular_velocity_body + gyroscope_bias + white(noise.gyroscope_noise_density)
        forces = force + accelerometer_bias + white(noise.accelerometer_noise_density)
        shaken = np.random.default_rng([seed, 8])
        rates += shaken.normal(0.0, self.gyroscope_rattle, rates.shape)
        forces += shaken.normal(0.0, self.accelerometer_rattle, forces.shape)
        jitter = np.clip(shaken.normal(0.0, self.stamp_jitter, len(times)), -0.4 / self.rate, 0.4 / self.rate)
        stamps = stamps_ns + np.round(jitter * 1e9).astype(np.int64)
        return ImuRecord(stamps, rates, forces, gyroscope_bias, accelerometer_bias)
