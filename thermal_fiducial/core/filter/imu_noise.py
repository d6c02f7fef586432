"""How noisy the IMU is now: by its data sheet, under vibration, in gaps and at the end of its range."""

from dataclasses import dataclass
import math

import numpy as np

from thermal_fiducial.config import ImuNoise
from thermal_fiducial.core.types import FloatArray

#: A step longer than this [s] is a gap: what happened in it isn't known from the samples at its ends.
GAP = 0.03
#: Standard deviation of rate [rad/s] and specific force [m/s^2] in a gap; of a saturated sample, hit or fault.
UNKNOWN_RATE, UNKNOWN_FORCE, SATURATED_FORCE = 0.5, 3.0, 150.0
#: How much less the force's shaking counts than the rate's: the position, its second integral, hardly feels tones above
#: the bandwidth of the filter; the attitude, a first integral, feels more.
FORCE_SHARE = 0.5
#: Time constant of the running vibration level [s].
VIBRATION_TIME = 0.3
#: The floor of the spectrum is sought in so many bands between these frequencies [Hz]: above the motion, below what
#: an IMU's own low-pass filter takes away. The tones of rotors leave at least one of them nearly alone.
BANDS, LOWEST, HIGHEST = 4, 12.5, 50.0
#: Length of a window [s], windows that overlap, and windows in the running mean.
WINDOW, OVERLAPPING, MEAN_OF = 0.32, 4, 12


@dataclass(frozen=True, slots=True)
class NoiseRange:
    """Densities of gyroscope and accelerometer if all vibration stays tones, and if all of it is white noise.

    In rad/s/sqrt(Hz) and m/s^2/sqrt(Hz).
    """

    quiet: tuple[float, float] = (0.0, 0.0)
    shaken: tuple[float, float] = (0.0, 0.0)

    def at(self, share: float) -> tuple[float, float]:
        """Densities where ``share`` of the vibration's variance is white noise."""
        (rate, force), (shaken_rate, shaken_force) = self.quiet, self.shaken
        return (
            math.sqrt(rate * rate + share * (shaken_rate * shaken_rate - rate * rate)),
            math.sqrt(force * force + share * (shaken_force * shaken_force - force * force)),
        )

    @property
    def doubt(self) -> float:
        """How far apart the two are for the gyroscope: share of its largest variance, 0 to 1."""
        quiet, shaken = self.quiet[0], self.shaken[0]
        return 1.0 - (quiet / shaken) ** 2 if shaken > 0.0 else 0.0


class NoiseMonitor:
    """Noise densities that hold now: those of the data sheet, more under vibration, saturation and in gaps.

    Rotors shake an IMU by far more than its noise. Most of that are tones, which integrate to nothing; what counts are
    the floor between them, and tones that alias to the frequencies of the motion. The second difference of samples
    shows all vibration, as the motion itself hardly has any.
    """

    def __init__(self, noise: ImuNoise) -> None:
        self._noise = noise
        self._recent: list[FloatArray] = []
        self._variance = np.zeros(2)
        self._floor = NoiseFloor()
        self._beyond = (False, False)

    @property
    def vibration(self) -> tuple[float, float]:
        """Running sample-to-sample standard deviations [rad/s, m/s^2], rms over the axes."""
        rate, force = self._variance.tolist()
        return math.sqrt(rate), math.sqrt(force)

    def densities(self, imu: FloatArray, seconds: float) -> NoiseRange:
        """Densities for the step of ``seconds`` that ends with sample ``imu`` (6,)."""
        self._watch(imu, seconds)
        noise, (floor_rate, floor_force), (rate, force) = self._noise, self._floor.densities, self.vibration
        lost_rate, lost_force = self._lost(imu.tolist(), seconds)
        quiet_rate = max(noise.gyroscope_noise_density, noise.vibration * floor_rate, lost_rate)
        quiet_force = max(noise.accelerometer_noise_density, noise.vibration * floor_force, lost_force)
        share = noise.vibration * math.sqrt(min(seconds, GAP))
        shaken = max(quiet_rate, share * rate), max(quiet_force, FORCE_SHARE * share * force)
        return NoiseRange((quiet_rate, quiet_force), shaken)

    def _lost(self, imu: list[float], seconds: float) -> tuple[float, float]:
        """Least densities of a step that a gap or saturation hides."""
        rate_lost, force_lost = self._saturated(imu)
        gap, unknown = seconds > GAP, math.sqrt(seconds)
        rate = UNKNOWN_RATE * unknown if gap or rate_lost else 0.0
        force = SATURATED_FORCE if force_lost else UNKNOWN_FORCE if gap else 0.0
        return rate, force * unknown

    def _saturated(self, imu: list[float]) -> tuple[bool, bool]:
        """Whether rate and force are beyond their ranges at either end of the step."""
        before = self._beyond
        self._beyond = (
            max(map(abs, imu[:3])) >= self._noise.gyroscope_range,
            max(map(abs, imu[3:])) >= self._noise.accelerometer_range,
        )
        return before[0] or self._beyond[0], before[1] or self._beyond[1]

    def _watch(self, imu: FloatArray, seconds: float) -> None:
        if seconds > GAP:
            self._recent.clear()
            self._floor.interrupt()
        self._recent.append(imu)
        if len(self._recent) < 3:
            return
        first, second, third = self._recent
        difference = first - 2.0 * second + third
        self._floor.add(difference, seconds)
        # White noise of variance s^2 has second differences of variance 6 s^2.
        variance = (difference * difference).reshape(2, 3).sum(axis=1) / 18.0
        self._variance += min(seconds / VIBRATION_TIME, 1.0) * (variance - self._variance)
        del self._recent[0]


class NoiseFloor:
    """Density of the white noise above the motion and between tones: that of the quietest band (Welch's method).

    Spectra are those of second differences, so that the motion doesn't leak into them.
    """

    def __init__(self) -> None:
        self._differences: list[FloatArray] = []
        self._seconds = 0.0
        self._window = self._bands = np.zeros((0, 1))
        self._power = np.zeros((1, 2))
        self._windows = 0
        #: of gyroscope and accelerometer [rad/s/sqrt(Hz), m/s^2/sqrt(Hz)]; 0 until the first window is full
        self.densities = (0.0, 0.0)

    def interrupt(self) -> None:
        """Begin a new window: the next difference doesn't follow the last one."""
        self._differences.clear()
        self._seconds = 0.0

    def add(self, difference: FloatArray, seconds: float) -> None:
        """Take the second difference (6,) of samples ``seconds`` apart."""
        self._differences.append(difference)
        if not len(self._window):
            self._seconds += seconds
            if self._seconds >= WINDOW:
                self._prepare()
        if 0 < len(self._window) <= len(self._differences):
            self._measure()
            del self._differences[: max(len(self._window) // OVERLAPPING, 1)]

    def _prepare(self) -> None:
        """Window and bands for the rate that the samples turn out to have."""
        count = len(self._differences)
        seconds = self._seconds / count
        frequencies = np.fft.rfftfreq(count, seconds)
        edges = np.linspace(LOWEST, min(HIGHEST, 0.5 / seconds), BANDS + 1)
        inside = (frequencies >= edges[:-1, None]) & (frequencies < edges[1:, None])
        inside = inside[inside.any(axis=1)]
        self._window = np.hanning(count + 1)[:-1, None]
        # Power of second differences to squared density of the samples.
        gain = 4.0 * np.sin(np.pi * frequencies * seconds) ** 2
        scale = seconds / (np.maximum(gain, 1e-9) ** 2 * (self._window**2).sum())
        self._bands = inside / inside.sum(axis=1, keepdims=True) * scale

    def _measure(self) -> None:
        spectrum = np.abs(np.fft.rfft(np.array(self._differences) * self._window, axis=0)) ** 2
        power = (self._bands @ spectrum).reshape(-1, 2, 3).mean(axis=2)
        self._windows = min(self._windows + 1, MEAN_OF)
        self._power = self._power + (power - self._power) / self._windows
        if len(power):
            rate, force = np.sqrt(self._power.min(axis=0)).tolist()
            self.densities = rate, force
