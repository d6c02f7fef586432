"""How noisy the IMU is now: by its data sheet, under vibration, in motion, over gaps and at the end of its range."""

from collections import deque
import math

import numpy as np

from thermal_fiducial.config import ImuNoise
from thermal_fiducial.core.filter.imu_input import GAP_NS, LOST_FACTOR
from thermal_fiducial.core.types import FloatArray, SECOND_NS, TINY

#: Time constant [s] of the mean force; motion is what differs from it.
_SLOW = 0.2
#: Lags [s] of the structure function: the shortest, doubled in octaves; time over which it is averaged [s].
_SHORTEST_LAG, _MEMORY = 0.02, 2.0
_OCTAVES = np.arange(7)
_LAGS = _SHORTEST_LAG * 2.0**_OCTAVES
#: Largest exponents of the structure function: of the measured one, as motion may become nonlinear in a gap, and of the
#: least motion that is assumed.
_SMOOTHEST = np.repeat((1.5, 2.0), 2)
#: Added before logarithms are taken [(rad/s)^2, (m/s^2)^2].
_NO_MOTION = 1e-12
#: Least structure function that is assumed: an IMU at rest may begin to move in a gap.
_LEAST_MOTION = (2.0 * (_LAGS / 0.2) ** 3 / (1.0 + (_LAGS / 0.2) ** 2))[:, None] * np.array((0.1, 0.3)) ** 2
#: Correlation time [s] of errors by nonlinearity, bandwidth and internal lever arms: that of the motion.
_MOTION_TIME = 1.0
#: Standard deviation of what a saturated sample may miss: a spin beyond the range [rad/s], a hit [m/s^2].
_SATURATED = 5.0, 150.0
#: Gaps [s] interrupt the spectrum; their interpolation error is added.
_GAP = GAP_NS / SECOND_NS
#: Time [s] in which poses show a bias: 20 a second, white to a millimetre, show an acceleration to 6 mm/s^2. Faster
#: flicker moves position by less than they show.
_BIAS_SHOWS = 1.0
#: Number of bands, and their lowest and highest frequency [Hz]: above the motion, below the IMU's own low-pass filter.
#: The quietest band is the floor of the spectrum: rotor tones leave at least one band nearly untouched.
_BANDS, _LOWEST, _HIGHEST = 4, 12.5, 50.0
#: Length of a window [s], number of windows that overlap at any time, windows in the mean.
_WINDOW, _OVERLAPPING, _MEAN_OF = 0.32, 4, 20


def bias_walks(noise: ImuNoise) -> tuple[float, float]:
    """Random walks of the biases of gyroscope and accelerometer [rad/s^2/sqrt(Hz), m/s^3/sqrt(Hz)].

    Bias instability is flicker noise, whose spectral density is B^2 / (2 pi f) (IEEE Std 952-1997, annex B). That of a
    random walk is K^2 / (2 pi f)^2, with K = B / sqrt(T) the larger one at frequencies below 1 / (2 pi T).
    """
    root = math.sqrt(_BIAS_SHOWS)
    return (
        math.hypot(noise.gyroscope_random_walk, noise.gyroscope_instability / root),
        math.hypot(noise.accelerometer_random_walk, noise.accelerometer_instability / root),
    )


class ImuNoiseMonitor:
    """Present noise densities of the IMU.

    The sum of the variances of: the data sheet's noise, or the floor of the vibration's spectrum if larger; errors in
    proportion to the motion; interpolation over a step; saturated samples.
    """

    def __init__(self, noise: ImuNoise) -> None:
        self._noise = noise
        self._floor = NoiseFloor()
        self._motion = StructureFunction()
        self._mean_force: list[float] = []
        # Of gyroscope and accelerometer, as single numbers: small arrays take ten times as long.
        self._sheet = noise.gyroscope_noise_density, noise.accelerometer_noise_density
        #: densities of the white noise alone, as of the newest sample [rad/s/sqrt(Hz), m/s^2/sqrt(Hz)]
        self.white = self._sheet
        self._nonlinearity = noise.gyroscope_nonlinearity, noise.accelerometer_nonlinearity
        self._ranges = noise.gyroscope_range, noise.accelerometer_range
        self._saturated = [0.0, 0.0]

    @property
    def vibration(self) -> tuple[float, float]:
        """Densities of the floor of the vibration's spectrum [rad/s/sqrt(Hz), m/s^2/sqrt(Hz)]."""
        return self._floor.densities

    def densities(self, imu: FloatArray, seconds: float) -> FloatArray:
        """(6,) densities for the step of ``seconds`` that ends with sample ``imu`` (6,)."""
        self._floor.add(imu, seconds)
        self._motion.add(imu, seconds)
        between = (0.0, 0.0) if self._floor.covers(seconds) else self._motion.interpolation_noise(seconds)
        values = imu.tolist()
        rates, forces = values[:3], values[3:]
        motions = math.hypot(*rates), self._motion_of(forces, seconds)
        (rate_sheet, force_sheet), (rate_floor, force_floor) = self._sheet, self._floor.densities
        factor = self._noise.vibration
        self.white = max(rate_sheet, factor * rate_floor), max(force_sheet, factor * force_floor)
        squares = []
        for triad, (readings, motion) in enumerate(zip((rates, forces), motions, strict=True)):
            moving = (self._nonlinearity[triad] * motion) ** 2 * _MOTION_TIME
            beyond = max(map(abs, readings)) >= self._ranges[triad]
            lost = _SATURATED[triad] ** 2 * seconds if beyond else 0.0
            squares.append(self.white[triad] ** 2 + moving + between[triad] + max(lost, self._saturated[triad]))
            self._saturated[triad] = lost
        rate, force = map(math.sqrt, squares)
        return np.array((rate, rate, rate, force, force, force))

    def _motion_of(self, forces: list[float], seconds: float) -> float:
        """Magnitude of the force (3,) less its slow mean, which is gravity."""
        self._mean_force = self._mean_force or forces
        share = min(seconds / _SLOW, 1.0)
        self._mean_force = [mean + share * (now - mean) for mean, now in zip(self._mean_force, forces, strict=True)]
        return math.dist(forces, self._mean_force)


class StructureFunction:
    """Structure functions of rate and force, and the interpolation error over long steps that follows from them.

    D(tau) is the mean square of the difference of samples tau apart (A. Kolmogorov's structure function; S. Panchev,
    "Random Functions and Turbulence", 1971). Where it grows as tau^a, the mean over a step of T seconds differs from
    that of the samples at its ends by a variance of D(T) (1 / (a + 2) - 1 / 4): a quarter of D(T) for vibration, a
    twelfth for Brownian motion, zero for motion linear in time. Motion is smoother at shorter times, so the exponent
    between T and 2 T gives an upper bound.
    """

    def __init__(self) -> None:
        self._time = 0.0
        #: samples that the next one is compared with, (K,) [s] and (K, 6)
        self._times, self._samples = np.zeros(0), np.zeros((0, 6))
        self._weights = np.zeros(len(_LAGS))
        self._measured = np.zeros((len(_LAGS), 2))

    def add(self, imu: FloatArray, seconds: float) -> None:
        """Add a sample (6,) that follows the last one after ``seconds``."""
        self._time += seconds
        if len(self._times) and self._time - self._times[-1] < _SHORTEST_LAG:
            return
        first = int(self._times.searchsorted(self._time - _LAGS[-1]))
        times, samples = self._times[first:], self._samples[first:]
        if len(times):
            self._compare(imu, times, samples)
        self._times = np.concatenate((times, (self._time,)))
        self._samples = np.concatenate((samples, imu[None]))

    def _compare(self, imu: FloatArray, times: FloatArray, samples: FloatArray) -> None:
        """Count the differences of a sample from earlier ones (K, 6) at ``times`` (K,)."""
        squares = ((samples - imu) ** 2).reshape(-1, 2, 3).sum(axis=2) / 3.0
        of_lag = np.rint(np.log2((self._time - times) / _SHORTEST_LAG)) == _OCTAVES[:, None]
        counts = of_lag.sum(axis=1)
        # A plain mean at first, later an exponential one with time constant _MEMORY.
        new = np.minimum(counts, 1) * min(self._time - times[-1], _MEMORY)
        self._weights = np.minimum(self._weights + new, _MEMORY)
        gain = new / np.maximum(self._weights, _SHORTEST_LAG)
        mean = (of_lag @ squares) / np.maximum(counts, 1)[:, None]
        self._measured = self._measured + gain[:, None] * (mean - self._measured)

    def interpolation_noise(self, seconds: float) -> tuple[float, float]:
        """Squared noise densities of rate and force for the interpolation error of a step of ``seconds``."""
        place = math.log2(seconds / _SHORTEST_LAG)
        lower = min(max(int(place), 0), len(_LAGS) - 2)
        into = min(max(place - lower, 0.0), 1.0)
        log_D = np.log2(np.hstack((self._measured, _LEAST_MOTION))[lower : lower + 3] + _NO_MOTION)
        slopes = np.clip(log_D[1:] - log_D[:-1], 0.0, _SMOOTHEST)
        at_step = 2.0 ** (log_D[1] + slopes[0] * (place - lower - 1))
        # From one step to two of them.
        exponent = slopes[0] + into * (slopes[-1] - slopes[0])
        # Errors of consecutive steps share a sample: for pure vibration their variances add up twice as fast.
        shared = 1.0 + np.maximum(1.0 - exponent, 0.0)
        noise = at_step * (1.0 / (exponent + 2.0) - 0.25) * shared * seconds
        rate, force = np.maximum(noise[:2], noise[2:]).tolist()
        return rate, force


class NoiseFloor:
    """Density of the vibration's white noise, without motion and tones: the quietest band of a Welch spectrum.

    Spectra are taken of second differences, so that the motion does not leak into them.
    """

    def __init__(self) -> None:
        self._samples: list[FloatArray] = []
        #: of each of them the time since the one before [s]
        self._seconds: list[float] = []
        #: (_BANDS, 2) squared densities of rate and force of the latest windows
        self._powers: deque[FloatArray] = deque(maxlen=_MEAN_OF)
        #: gyroscope and accelerometer [rad/s/sqrt(Hz), m/s^2/sqrt(Hz)]; 0 until the first window is full
        self.densities = (0.0, 0.0)
        #: longest step [s] of samples that are as even as a spectrum takes them for
        self._longest_even = 0.0

    def covers(self, seconds: float) -> bool:
        """Whether the floor has been measured, and covers what lies in a step of ``seconds``."""
        return seconds <= self._longest_even and any(self.densities)

    def add(self, imu: FloatArray, seconds: float) -> None:
        """Add a sample (6,) that follows the last one after ``seconds``; one behind a gap begins a new window."""
        if seconds > _GAP:
            self._samples.clear()
            self._seconds.clear()
        self._samples.append(imu)
        self._seconds.append(seconds)
        if len(self._samples) > 2 and sum(self._seconds[2:]) >= _WINDOW:
            self._measure()
            old = len(self._samples) // _OVERLAPPING
            del self._samples[:old], self._seconds[:old]

    def _measure(self) -> None:
        """Take the spectrum of a full window into the mean, and the noise densities from its quietest band."""
        samples = np.array(self._samples)
        differences = samples[:-2] - 2.0 * samples[1:-1] + samples[2:]
        count = len(differences)
        seconds = sum(self._seconds[2:]) / count
        self._longest_even = min(LOST_FACTOR * seconds, _GAP)
        frequencies, window = np.fft.rfftfreq(count, seconds), np.hanning(count + 1)[:-1, None]
        spectrum = np.abs(np.fft.rfft(differences * window, axis=0)) ** 2
        # Power of second differences to squared density of the samples.
        gain = 4.0 * np.sin(np.pi * frequencies * seconds) ** 2
        scale = seconds / (np.maximum(gain, TINY) ** 2 * (window**2).sum())
        power = (scale[:, None] * spectrum).reshape(-1, 2, 3).mean(axis=2)
        edges = np.linspace(_LOWEST, max(min(_HIGHEST, 0.5 / seconds), _LOWEST), _BANDS + 1)
        inside = (frequencies >= edges[:-1, None]) & (frequencies < edges[1:, None])
        counts = inside.sum(axis=1, keepdims=True)
        # Slow samples have fewer bands.
        self._powers.append(np.where(counts > 0, inside @ power / np.maximum(counts, 1), np.inf))
        rate, force = np.sqrt(np.mean(self._powers, axis=0).min(axis=0)).tolist()
        self.densities = (rate, force) if math.isfinite(rate) else (0.0, 0.0)
