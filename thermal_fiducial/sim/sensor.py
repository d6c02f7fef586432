"""A Tau 2's electronics: noise, fixed pattern, bad pixels, shutter, drift, 14 bits.

Its values: NETD below 50 mK (FLIR), fixed-pattern noise that grows to about 0.1 K within minutes of a correction by the
shutter, large-scale non-uniformity up to 0.6 K, shutter events of less than half a second.
"""

from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np

from thermal_fiducial.core.types import Counts, Float32Array
from thermal_fiducial.errors import InputError

FULL_SCALE = 16383
FFC_BEHAVIOURS = ('frozen', 'dropped', 'shutter')
_SHADING_GRID = 4
_GROWTH_TIME = 180.0


@dataclass(frozen=True)
class Sensor:
    """The focal plane and its read-out.

    Parameters
    ----------
    lag : thermal time constant of the bolometers [s]
    readout : from the sampling of the first row to that of the last [s]; the stamp is that of the middle row
    psf_sigma_px : standard deviation of the point spread of the optics [px]; with the pixel's area, over which they
        integrate, edges are blurred by sqrt(psf_sigma_px^2 + 1/12)
    netd : temporal noise [K]
    counts_per_kelvin, offset_counts : scale, and counts at ambient temperature
    drift_counts, drift_period : of the drift of the offset with the housing's temperature [counts], [s]
    pixel_pattern, pixel_growth : fixed-pattern noise just after a shutter event, and its growth in three minutes [K]
    column_pattern, column_growth : the same for whole columns [K]
    shading : low-order non-uniformity [K]
    bad_pixel_share : share of bad pixels: half of them dead, half stuck at random counts
    ffc_period, ffc_first, ffc_duration : period, first start and duration of shutter events [s]; period 0: none
    ffc_behaviour : output of the driver in them: ``frozen`` repeats the last frame with new stamps, ``dropped`` sends
        nothing, ``shutter`` sends the view of the closed shutter
    shutter_excess : temperature of the shutter above ambient [K]
    frame_rate : [Hz]
    full_scale : counts of saturated pixels; below 256 the pictures have 8 bits. Brighter objects grow at their
        edges, by the width over which the blur exceeds half of the scale
    """

    lag: float = 0.010
    readout: float = 0.0
    psf_sigma_px: float = 0.6
    netd: float = 0.05
    counts_per_kelvin: float = 30.0
    offset_counts: float = 3600.0
    drift_counts: float = 60.0
    drift_period: float = 90.0
    pixel_pattern: float = 0.02
    pixel_growth: float = 0.10
    column_pattern: float = 0.025
    column_growth: float = 0.05
    shading: float = 0.4
    bad_pixel_share: float = 0.0005
    ffc_period: float = 12.0
    ffc_first: float = 7.0
    ffc_duration: float = 0.4
    ffc_behaviour: str = 'frozen'
    shutter_excess: float = 4.0
    frame_rate: float = 30.0
    full_scale: int = FULL_SCALE

    def __post_init__(self) -> None:
        if self.ffc_behaviour not in FFC_BEHAVIOURS:
            raise InputError(f'driver behaviour {self.ffc_behaviour!r} is not one of {", ".join(FFC_BEHAVIOURS)}')

    def without_noise(self) -> 'Sensor':
        """The sensor without noise, drift, fixed pattern, bad pixels and shutter events."""
        return replace(
            self,
            netd=0.0,
            drift_counts=0.0,
            pixel_pattern=0.0,
            pixel_growth=0.0,
            column_pattern=0.0,
            column_growth=0.0,
            shading=0.0,
            bad_pixel_share=0.0,
            ffc_period=0.0,
        )

    def ffc_index(self, t: float) -> int:
        """Number of shutter events that have begun by ``t`` [s]."""
        if self.ffc_period <= 0:
            return 0
        return max(0, int(np.floor((t - self.ffc_first) / self.ffc_period)) + 1)

    def ffc_start(self, index: int) -> float:
        """Start of shutter event ``index`` (from 1) [s]; index 0 is a correction long before the flight."""
        return self.ffc_first + (index - 1) * self.ffc_period if index > 0 else -60.0

    def in_ffc(self, t: float) -> bool:
        """Whether the shutter is closed at ``t`` [s]."""
        index = self.ffc_index(t)
        return index > 0 and t - self.ffc_start(index) < self.ffc_duration

    def counts(self, temperature: Float32Array, t: float, frame: int, seed: int) -> Counts:
        """14-bit counts (height, width) of the temperatures [K] of the bolometers at ``t`` [s]."""
        rng = np.random.default_rng([seed, 4, frame])
        kelvin = temperature + self._pattern(t, temperature.shape, seed)
        if self.netd > 0:
            kelvin += rng.standard_normal(kelvin.shape, dtype=np.float32) * np.float32(self.netd)
        offset = self.offset_counts + self.drift_counts * float(np.sin(2 * np.pi * t / self.drift_period))
        levels = np.rint(kelvin * np.float32(self.counts_per_kelvin) + np.float32(offset))
        counts: Counts = np.clip(levels, 0, self.full_scale).astype(np.uint16)
        where, stuck = _bad_pixels(kelvin.shape, self.bad_pixel_share, seed, self.full_scale)
        counts.reshape(-1)[where] = stuck
        return counts

    def _pattern(self, t: float, shape: tuple[int, int], seed: int) -> Float32Array:
        index = self.ffc_index(t)
        growth = np.float32((max(0.0, t - self.ffc_start(index)) / _GROWTH_TIME) ** 0.8)
        after, growing = _patterns(self, shape, seed, index)
        return np.asarray(after + growth * growing, dtype=np.float32)


@lru_cache(maxsize=2)
def _patterns(sensor: Sensor, shape: tuple[int, int], seed: int, index: int) -> tuple[Float32Array, Float32Array]:
    """Fixed pattern (height, width) [K] just after shutter event ``index``, and its growth in three minutes."""
    rng = np.random.default_rng([seed, 5, index])

    def pattern(pixel: float, column: float) -> Float32Array:
        whole = rng.standard_normal(shape, dtype=np.float32) * np.float32(pixel)
        return whole + rng.standard_normal(shape[1], dtype=np.float32) * np.float32(column)

    coarse = rng.standard_normal((_SHADING_GRID, _SHADING_GRID), dtype=np.float32) * np.float32(sensor.shading / 2)
    shading = cv2.resize(coarse, (shape[1], shape[0]), interpolation=cv2.INTER_CUBIC)
    after = shading + pattern(sensor.pixel_pattern, sensor.column_pattern)
    return after, pattern(sensor.pixel_growth, sensor.column_growth)


@lru_cache(maxsize=2)
def _bad_pixels(shape: tuple[int, int], share: float, seed: int, full_scale: int) -> tuple[np.ndarray, np.ndarray]:
    """Flat indices of bad pixels and their constant counts: 0 or full scale (dead), or any (stuck)."""
    rng = np.random.default_rng([seed, 6])
    count = round(share * shape[0] * shape[1])
    where = rng.choice(shape[0] * shape[1], count, replace=False)
    stuck = np.where(rng.random(count) < 0.5, rng.choice([0, full_scale], count), rng.integers(0, full_scale, count))
    return where, stuck.astype(np.uint16)


IDEAL = Sensor().without_noise()
