"""An IMU on the simulated body: exact rates and specific force, errors of its axes, noise, errors of its stamps."""

from dataclasses import dataclass
from itertools import accumulate

import numpy as np

from thermal_fiducial.core.types import FloatArray, IntArray, SECOND_NS
from thermal_fiducial.sim.spline_trajectory import GRAVITY, MotionPath


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

    def delivered(self, delivery: 'Delivery', times: FloatArray, start_ns: int) -> 'ImuRecord':
        """What of samples taken at ``times`` (N,) [s] after ``start_ns`` arrives, with the stamps that it gets."""
        kept, stamps = delivery.stamps(times)
        return ImuRecord(
            start_ns + stamps,
            self.angular_velocity[kept],
            self.linear_acceleration[kept],
            self.gyroscope_bias[kept],
            self.accelerometer_bias[kept],
        )


@dataclass(frozen=True)
class SimulatedNoise:
    """Continuous densities, under Kalibr's names: [rad/s/sqrt(Hz)], [m/s^2/sqrt(Hz)], walks per second more."""

    gyroscope_noise_density: float = 1.7e-4
    accelerometer_noise_density: float = 2.0e-3
    gyroscope_random_walk: float = 2.0e-5
    accelerometer_random_walk: float = 3.0e-4


@dataclass(frozen=True)
class Delivery:
    """A driver that reads several samples at once, and stamps them when it reads them.

    Parameters
    ----------
    period : time from one reading to the next [s]; the stamps of samples read together are ``spacing`` apart [s]
    gaps : start and length [s] of gaps without samples, repeated after ``every`` [s]
    steps_back : times at which one stamp is a millisecond too early [s]
    """

    period: float = 0.033
    spacing: float = 0.00013
    gaps: tuple[tuple[float, float], ...] = ()
    every: float = 10.0
    steps_back: tuple[float, ...] = ()

    def stamps(self, times: FloatArray) -> tuple[IntArray, IntArray]:
        """Of samples taken at ``times`` (N,) [s], the indices (M,) of those that arrive, and their stamps (M,) [ns]."""
        within = times[:, None] % self.every
        lost = np.any(
            [(within[:, 0] >= begin) & (within[:, 0] < begin + length) for begin, length in self.gaps], axis=0
        )
        kept = np.flatnonzero(~np.broadcast_to(lost, times.shape))
        burst = np.ceil(times[kept] / self.period).astype(np.int64)
        first = np.searchsorted(burst, burst)
        seconds = burst * self.period + (np.arange(len(kept)) - first) * self.spacing
        stamps = np.round(seconds * SECOND_NS).astype(np.int64)
        for moment in self.steps_back:
            place = int(np.searchsorted(stamps, moment * SECOND_NS))
            if 0 < place < len(stamps):
                stamps[place] = stamps[place - 1] - 1_000_000
        return kept, stamps


@dataclass(frozen=True)
class ImuModel:
    """Errors of the IMU.

    Parameters
    ----------
    noise : densities and random walks (Kalibr's)
    rate : [Hz]
    gyroscope_bias_sigma, accelerometer_bias_sigma : of the biases at switch-on [rad/s], [m/s^2]
    gyroscope_rattle, accelerometer_rattle : broadband noise of a sample by vibration, beyond the data sheet's
        [rad/s], [m/s^2]
    stamp_jitter : standard deviation of the errors of the stamps, which stay in order [s]
    gyroscope_axes, accelerometer_axes : standard deviation of each entry of the matrices of scale and misalignment
    g_sensitivity : standard deviation of each entry of the matrix from specific force to rate [rad/s per m/s^2]
    gyroscope_instability, accelerometer_instability : standard deviation of a first-order Gauss-Markov process added
        to the biases [rad/s], [m/s^2]
    instability_time : its time constant [s]
    delivery : the driver; None: samples have stamps of their own
    """

    noise: SimulatedNoise = SimulatedNoise()
    rate: float = 200.0
    gyroscope_bias_sigma: float = 0.003
    accelerometer_bias_sigma: float = 0.04
    gyroscope_rattle: float = 0.0
    accelerometer_rattle: float = 0.0
    stamp_jitter: float = 0.0
    gyroscope_axes: float = 0.0
    accelerometer_axes: float = 0.0
    g_sensitivity: float = 0.0
    gyroscope_instability: float = 0.0
    accelerometer_instability: float = 0.0
    instability_time: float = 2.0
    delivery: Delivery | None = None

    def sample(self, trajectory: MotionPath, times: FloatArray, stamps_ns: IntArray, seed: int) -> ImuRecord:
        """Measurements of the IMU at ``times`` (N,) [s] of a flight, with true stamps ``stamps_ns`` (N,).

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

        gyroscope_wander, accelerometer_wander = self._instabilities(len(times), seed)
        gyroscope_bias = gyroscope_wander + bias(self.gyroscope_bias_sigma, noise.gyroscope_random_walk)
        accelerometer_bias = accelerometer_wander + bias(self.accelerometer_bias_sigma, noise.accelerometer_random_walk)
        true_rates, force = self._seen_by_its_axes(motion.angular_velocity_body, force, seed)
        rates = true_rates + gyroscope_bias + white(noise.gyroscope_noise_density)
        forces = force + accelerometer_bias + white(noise.accelerometer_noise_density)
        shaken = np.random.default_rng([seed, 8])
        rates += shaken.normal(0.0, self.gyroscope_rattle, rates.shape)
        forces += shaken.normal(0.0, self.accelerometer_rattle, forces.shape)
        jitter = np.clip(shaken.normal(0.0, self.stamp_jitter, len(times)), -0.4 / self.rate, 0.4 / self.rate)
        stamps = stamps_ns + np.round(jitter * SECOND_NS).astype(np.int64)
        record = ImuRecord(stamps, rates, forces, gyroscope_bias, accelerometer_bias)
        return record if self.delivery is None else record.delivered(self.delivery, times, int(stamps_ns[0]))

    def _seen_by_its_axes(self, rates: FloatArray, forces: FloatArray, seed: int) -> tuple[FloatArray, FloatArray]:
        """Rates and forces (N, 3) with errors of scale, misalignment and g-sensitivity."""
        rng = np.random.default_rng([seed, 12])
        deviations = self.gyroscope_axes, self.accelerometer_axes, self.g_sensitivity
        gyroscope, accelerometer, sensitivity = (rng.normal(0.0, deviation, (3, 3)) for deviation in deviations)
        return rates + rates @ gyroscope.T + forces @ sensitivity.T, forces + forces @ accelerometer.T

    def _instabilities(self, count: int, seed: int) -> tuple[FloatArray, FloatArray]:
        """Gauss-Markov processes (count, 3) of gyroscope and accelerometer."""
        rng = np.random.default_rng([seed, 13])
        kept = np.exp(-1.0 / (self.rate * self.instability_time))
        driven = rng.normal(size=(count, 6))
        driven[1:] *= np.sqrt(1.0 - kept**2)
        # Not by scipy.signal, whose import takes longer than all else that a rendering process loads.
        wander = np.array(list(accumulate(driven, lambda last, new: kept * last + new)))
        return self.gyroscope_instability * wander[:, :3], self.accelerometer_instability * wander[:, 3:]
