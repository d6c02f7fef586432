"""A rig moved about in front of its markers, by hand or by a drone: sums of sines, roughly aimed at the markers."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from thermal_fiducial.core.types import FloatArray
from thermal_fiducial.sim.spline_trajectory import smooth_step, SplineTrajectory

_KNOTS_PER_SECOND = 20
#: Duration of the transitions between rest and motion [s].
_START = 1.5


@dataclass(frozen=True)
class Waving:
    """Motion about a position and a direction of view; each axis is a sum of sines with random phases.

    Parameters
    ----------
    centre : mean position [m]
    target : point in the middle of the view [m]; None: straight ahead along x, as over a floor
    speed : rms of each axis [m/s]
    turn : rms rate about each axis, beyond the rotation towards the target [rad/s]
    frequencies : slowest and fastest sine [Hz]
    rest : time at rest before and after [s]
    """

    centre: tuple[float, float, float]
    target: tuple[float, float, float] | None = None
    speed: float = 0.35
    turn: float = 0.45
    frequencies: tuple[float, float] = (0.25, 1.0)
    rest: float = 0.5

    def trajectory(self, seconds: float, seed: int) -> SplineTrajectory:
        """The flight of ``seed``.

        Raises
        ------
        InputError
            Less than a fraction of a second.
        """
        t = np.linspace(0.0, seconds, round(_KNOTS_PER_SECOND * seconds) + 1)
        rng = np.random.default_rng([seed, 10])
        begin, end = smooth_step(t, self.rest, _START), smooth_step(t, seconds - self.rest - _START, _START)
        envelope = (begin * (1.0 - end))[:, None]
        away = envelope * self._sines(t, rng, self.speed)
        positions = np.array(self.centre) + away
        turned = Rotation.from_rotvec(envelope * self._sines(t, rng, self.turn))
        return SplineTrajectory(t, positions, self._looking(positions) * turned)

    def _sines(self, t: FloatArray, rng: np.random.Generator, rate: float) -> FloatArray:
        """Sums of sines (N, 3) with an rms derivative of ``rate`` in each axis."""
        count = 5
        low, high = self.frequencies
        # One sine in each part of the band, so that no seed has slow ones only.
        edges = np.geomspace(low, high, count + 1)
        frequency = rng.uniform(edges[:-1, None], edges[1:, None], (count, 3))
        phase = rng.uniform(0.0, 2.0 * np.pi, (count, 3))
        omega = 2.0 * np.pi * frequency
        amplitude = rate * np.sqrt(2.0 / count) / omega
        return np.asarray(np.sum(amplitude * np.sin(omega * t[:, None, None] + phase), axis=1))

    def _looking(self, positions: FloatArray) -> Rotation:
        if self.target is None:
            return Rotation.identity(len(positions))
        forward = np.array(self.target) - positions
        forward /= np.linalg.norm(forward, axis=1, keepdims=True)
        left = np.cross([0.0, 0.0, 1.0], forward)
        left /= np.linalg.norm(left, axis=1, keepdims=True)
        return Rotation.from_matrix(np.stack([forward, left, np.cross(forward, left)], axis=-1))
