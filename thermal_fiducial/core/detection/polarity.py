"""Whether the markers of a place are darker than what is behind them or brighter: all alike, as all are as warm.

What looks like a marker of the other kind is the inside of one: white cells round a hole, where the rim of the image
cuts off the border that would tell.
"""

import numpy as np

from thermal_fiducial.core.types import BoolArray, FloatArray

# A frame's markers are remembered for about so many frames, and make sure of the kind when so many more are of it.
_MEMORY, _SURE = 30, 6.0


class Polarity:
    """Remembers the kind of the markers that were seen last."""

    def __init__(self) -> None:
        self._balance = 0.0

    def learn(self, contrast: FloatArray) -> None:
        """Take in the markers (N,) of a frame, by white minus black."""
        self._balance += float(np.sign(contrast).sum()) - self._balance / _MEMORY

    def kinds(self, rule: str) -> tuple[float, ...]:
        """Which kinds there may be by the parameter ``polarity``: 1 for markers darker than what is behind, -1."""
        return tuple(kind for kind in (1.0, -1.0) if self.possible(np.array([kind]), rule)[0])

    def possible(self, contrast: FloatArray, rule: str) -> BoolArray:
        """Which markers (N,) may be some, by the parameter ``polarity``."""
        if rule == 'any' or (rule == 'alike' and abs(self._balance) < _SURE):
            return np.ones(len(contrast), dtype=bool)
        kind = self._balance if rule == 'alike' else 1.0 if rule == 'dark' else -1.0
        return np.asarray(contrast * kind > 0.0)
