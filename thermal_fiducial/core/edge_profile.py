"""The profile of a step edge as a microbolometer sees it.

Optics and pixels blur a step with a Gaussian. A bolometer answers with an exponential lag, so that in motion the step
is also smeared along the image motion, one-sided: the profile is a step convolved with a Gaussian and an exponential
("exponentially modified Gaussian"). The kernel is taken about its own mean: the edge's position is where the scene
was one time constant ago, whatever the speed, and what lag leaves is a pure time offset.
"""

from functools import lru_cache
import math

import numpy as np

from thermal_fiducial.core.types import Float32Array, FloatArray, IntArray

# The table, in units of the Gaussian's standard deviation: distances +-REACH, skews +-MAX_SKEW.
_REACH = 16.0
_STEPS = 40
_MAX_SKEW = 8.0
_SKEW_STEPS = 8
_SIZE = int(2 * _REACH * _STEPS) + 1


@lru_cache(maxsize=1)
def _table() -> Float32Array:
    """Profile and its derivative (skews, 2, distances)."""
    skews = np.linspace(-_MAX_SKEW, _MAX_SKEW, int(2 * _MAX_SKEW * _SKEW_STEPS) + 1)
    s = np.linspace(-_REACH, _REACH, _SIZE)
    rows = []
    for skew in skews:
        profile = _profile(s, skew) if skew >= 0 else 1.0 - _profile(-s, -skew)
        rows.append(np.stack([profile, np.gradient(profile, s)]))
    return np.stack(rows).astype(np.float32)


def _profile(s: FloatArray, skew: float) -> FloatArray:
    """Cumulative distribution of Z + skew * (E - 1), Z standard normal, E standard exponential."""
    u = s + skew
    if skew < 0.5 / _SKEW_STEPS:
        return _normal(s)
    exponent = np.minimum(0.5 / skew**2 - u / skew, 700.0)
    return np.asarray(_normal(u) - np.exp(exponent) * _normal(u - 1.0 / skew))


def _normal(x: FloatArray) -> FloatArray:
    return np.array([0.5 * math.erfc(-value / math.sqrt(2.0)) for value in x])


class EdgeProfiles:
    """Profiles of E edges at once.

    Parameters
    ----------
    blur_px : standard deviation of the Gaussian
    lag_px : (E,) mean of the exponential along the direction in which distances grow
    """

    def __init__(self, blur_px: float, lag_px: FloatArray) -> None:
        self._scale = _STEPS / blur_px
        skew = np.clip(lag_px / blur_px, -_MAX_SKEW, _MAX_SKEW - 1e-6)
        position = (skew + _MAX_SKEW) * _SKEW_STEPS
        row = position.astype(np.int64)
        fraction = (position - row).astype(np.float32)[:, None, None]
        table = _table()
        mixed = table[row] * (1.0 - fraction) + table[row + 1] * fraction
        self._profile = np.ascontiguousarray(mixed[:, 0]).reshape(-1)
        self._slope = np.ascontiguousarray(mixed[:, 1]).reshape(-1) * np.float32(1.0 / blur_px)
        self._start = (np.arange(len(lag_px)) * _SIZE + _REACH * _STEPS + 0.5).astype(np.float32)

    def index(self, distance_px: Float32Array) -> IntArray:
        """Place in the tables of distances (E, ...) outward of the edges."""
        limit = _REACH * _STEPS
        scaled = np.clip(distance_px * np.float32(self._scale), -limit, limit)
        scaled += self._start.reshape(-1, *([1] * (distance_px.ndim - 1)))
        return scaled.astype(np.int32)

    def value(self, index: IntArray) -> Float32Array:
        """Share of the outer level, 0 to 1."""
        return self._profile.take(index)

    def slope(self, index: IntArray) -> Float32Array:
        """Its derivative [1/px]."""
        return self._slope.take(index)
