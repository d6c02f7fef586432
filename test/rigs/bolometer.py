"""Counts of the frames: the lag of the pixels, smoke, blur, noise, patterns that grow, stuck pixels."""

from collections.abc import Iterator
import math

import cv2
import numpy as np

from rigs.motion import Path
from rigs.renderer import Renderer
from rigs.rig import Rig, SECONDS
from rigs.room import Room

#: The first frame [s]: the lag of the pixels looks back, and the path has a beginning.
FIRST = 0.1
#: Counts of a Tau 2's 14 bits.
FULL_SCALE = 16383
#: What is older than so many time constants has faded to a four-hundredth.
_MEMORY = 6.0
#: Motion between two of the instants that a frame is the mean of: at most this [px], but for the fastest.
_STEP_PX, _INSTANTS = 1.0, (2, 24)
#: What a frame of a shutter event leaves of the pattern.
_CORRECTED = 0.2
#: Smoke drifts by so many columns a second, is a little warmer than acrylic [K], and takes away this share at most.
_DRIFT, _SMOKE_KELVIN, _DENSEST = 60, 0.5, 0.93


class Bolometer:
    """The camera of a rig on its path through a room."""

    def __init__(self, rig: Rig, room: Room, path: Path) -> None:
        self._rig, self._path, self._sensor = rig, path, rig.sensor
        # The pixel's area blurs, too.
        self._renderer = Renderer(rig.lens, room, np.sqrt(rig.sensor.blur**2 - 1.0 / 12.0))
        self._rng = rig.rng('bolometer')
        self._shape = rig.lens.height, rig.lens.width
        self._pattern = np.zeros(self._shape)
        self._base = self._rng.uniform(3000.0, 9000.0)
        self._stuck = tuple(self._rng.integers(0, size, self._sensor.stuck) for size in self._shape)
        self._off = self._rng.normal(0.0, 60.0, self._sensor.stuck)
        width = round(_DRIFT * SECONDS) + rig.lens.width
        clouds = self._rng.normal(size=(12, width // 40)).astype(np.float32)
        self._clouds = cv2.resize(clouds, (width, rig.lens.height), interpolation=cv2.INTER_CUBIC)

    def frames(self) -> Iterator[tuple[float, np.ndarray]]:
        """Instant [s] and counts (H, W), uint16, of each frame."""
        period = 1.0 / self._sensor.rate
        kept = math.exp(-period / self._sensor.lag)
        state = self._seen(FIRST)
        for t in np.arange(FIRST, SECONDS - period, period).tolist():
            state = kept * state + (1.0 - kept) * self._mean(t, min(period, _MEMORY * self._sensor.lag))
            yield t, self._counts(t, state)

    def _mean(self, t: float, seconds: float) -> np.ndarray:
        """Mean [K] of the last ``seconds``, in which they fade exponentially."""
        lag = self._sensor.lag
        instants = int(np.clip(np.ceil(self._motion_px(t - seconds, t) / _STEP_PX), *_INSTANTS))
        step = seconds / instants
        weights = np.exp(-step / lag * np.arange(instants))
        # The centroid of what fades within a step, from its newer end.
        centroid = lag - step / np.expm1(step / lag)
        shares = (weights / weights.sum()).tolist()
        return sum(share * self._seen(t - k * step - centroid) for k, share in enumerate(shares))

    def _motion_px(self, begin: float, end: float) -> float:
        """How far things move in the image."""
        apart = np.linalg.inv(self._path.T_map_body(begin)) @ self._path.T_map_body(end)
        radians = np.arccos(np.clip((np.trace(apart[:3, :3]) - 1.0) / 2.0, -1.0, 1.0))
        return float(self._rig.lens.focal[0] * (radians + np.linalg.norm(apart[:3, 3]) / self._rig.near))

    def _seen(self, t: float) -> np.ndarray:
        """Temperatures (H, W) [K] that arrive at the lens through the smoke."""
        kelvin = self._renderer.kelvin(self._path.T_map_body(t) @ self._rig.T_body_camera)
        if self._rig.task.smoke == 0.0:
            return kelvin
        column = max(int(_DRIFT * t), 0)
        clouds = self._clouds[:, column : column + self._shape[1]]
        # It comes and goes.
        strength = self._rig.task.smoke * np.clip(np.sin(0.5 * t) + 0.6, 0.0, 1.0)
        dense = np.clip(strength * (1.0 + 0.3 * clouds), 0.0, _DENSEST)
        return kelvin * (1.0 - dense) + _SMOKE_KELVIN * dense

    def _counts(self, t: float, state: np.ndarray) -> np.ndarray:
        sensor, rng = self._sensor, self._rng
        if sensor.closes <= t < sensor.closes + sensor.closed:
            self._pattern *= _CORRECTED
        pixels, columns = sensor.pattern / np.sqrt(sensor.rate)
        self._pattern += rng.normal(0.0, pixels, self._shape) + rng.normal(0.0, columns, self._shape[1])
        kelvin = state + self._pattern + rng.normal(0.0, sensor.noise, self._shape)
        counts = self._base + kelvin / sensor.count
        np.add.at(counts, self._stuck, self._off)
        return np.clip(np.round(counts), 0, FULL_SCALE).astype(np.uint16)
