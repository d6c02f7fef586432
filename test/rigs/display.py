"""From counts to what a driver hands over: raw counts, or 8 bits of a gain control; the shutter freezes either."""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from rigs.rig import Rig

Frames = Iterator[tuple[float, np.ndarray]]
#: Defaults of a Tau 2: share of the pixels that a count is worth at most, gray levels a count, weight of a new frame.
PLATEAU, MOST_GRAY, DAMPED = 0.00076, 12.0, 0.2
#: Linear: share of the pixels beyond either end [%], weight of a new frame, least range [counts].
CLIPPED, FOLLOWED, LEAST = 0.5, 0.1, 60.0


class Linear:
    """A linear scale between two percentiles, which follow the scene slowly."""

    def __init__(self) -> None:
        self._ends: Any = None

    def __call__(self, counts: np.ndarray) -> np.ndarray:
        """Gray levels (H, W), uint8."""
        ends = np.percentile(counts[::4, ::4], [CLIPPED, 100.0 - CLIPPED])
        self._ends = ends if self._ends is None else self._ends + FOLLOWED * (ends - self._ends)
        low, high = self._ends
        return np.clip(np.round((counts - low) / max(high - low, LEAST) * 255.0), 0, 255).astype(np.uint8)


class Plateau:
    """Histogram equalisation in which a count is worth no more than a plateau."""

    def __init__(self) -> None:
        self._shares: Any = None

    def __call__(self, counts: np.ndarray) -> np.ndarray:
        """Gray levels (H, W), uint8."""
        histogram = np.bincount(counts.ravel(), minlength=1 << 14)
        below = np.cumsum(np.minimum(histogram, PLATEAU * counts.size))
        shares = below / below[-1]
        self._shares = shares if self._shares is None else self._shares + DAMPED * (shares - self._shares)
        # So few counts that each would have more gray levels than it may do not fill the range.
        levels = min(255.0, MOST_GRAY * np.count_nonzero(histogram))
        return np.round(127.5 + levels * (self._shares[counts] - 0.5)).astype(np.uint8)


CONVERSIONS: dict[str, Callable[[], Callable[[np.ndarray], np.ndarray]]] = {
    'raw': lambda: lambda counts: counts,
    'linear': Linear,
    'plateau': Plateau,
}


def shown(rig: Rig, frames: Frames) -> Frames:
    """The frames as the driver hands them over."""
    convert = CONVERSIONS[rig.task.display]()
    closes = rig.sensor.closes
    image = None
    for t, counts in frames:
        converted = convert(counts)
        if image is None or not closes <= t < closes + rig.sensor.closed:
            image = converted
        yield t, image
