"""Whether the markers of a place are darker than what is behind them or brighter: all alike, as all are as warm.

What looks like a marker of the other kind is the inside of one: white cells round a hole, where the border of the image
cuts off the border that would show.
"""

from dataclasses import dataclass

import numpy as np

from thermal_fiducial.core.types import BoolArray, FloatArray

# A frame's markers are remembered for about so many frames, and make sure of the kind when so many more are of it.
_FRAMES, _SURE = 30, 6.0


@dataclass(frozen=True, slots=True)
class Polarity:
    """The kind of the markers that were seen last: how many more were dark than bright, the older the less."""

    balance: float = 0.0

    def after(self, contrast: FloatArray) -> 'Polarity':
        """With the markers (N,) of one more frame, by white minus black."""
        return Polarity(self.balance + float(np.sign(contrast).sum()) - self.balance / _FRAMES)

    def kinds(self, rule: str) -> tuple[float, ...]:
        """Which kinds there may be by the parameter ``polarity``: 1 for markers darker than what is behind, -1."""
        return tuple(kind for kind in (1.0, -1.0) if self.possible(np.array([kind]), rule)[0])

    def possible(self, contrast: FloatArray, rule: str) -> BoolArray:
        """Which markers (N,) may be some, by the parameter ``polarity``."""
        if rule == 'any' or (rule == 'alike' and abs(self.balance) < _SURE):
            return np.ones(len(contrast), dtype=bool)
        kind = self.balance if rule == 'alike' else 1.0 if rule == 'dark' else -1.0
        return np.asarray(contrast * kind > 0.0)
