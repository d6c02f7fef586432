"""Systematic error of the corners, learned from what poses leave of them."""

import math

import numpy as np

from thermal_fiducial.core.error_model import INCONSISTENT_PX, SystematicErrors
from thermal_fiducial.core.types import FloatArray, IntArray

#: Frames that the error to begin with is worth, and the weight that each new frame leaves to those before: 300 frames.
BIAS_PRIOR, BIAS_MEMORY = 30.0, 1.0 - 1.0 / 300.0
#: A pose takes up nearly all of the error of fewer markers.
FEWEST_MARKERS = 3
# Frames farther apart than this see the corners elsewhere in the image [ns].
_SUCCESSIVE_NS = 150_000_000


class CornerBias:
    """Systematic error of the corners (lens, detector), from residuals that are still there in the next frame.

    White noise of two frames is independent: the mean product of a corner's residuals in successive frames is the
    variance of what lasts, as far as the pose does not take it up.
    """

    def __init__(self) -> None:
        #: standard deviation [px]
        self.px = SystematicErrors().corner_px
        self._weight = BIAS_PRIOR
        self._sum = BIAS_PRIOR * self.px**2
        self._last: tuple[int, IntArray, FloatArray] | None = None

    def add(self, stamp_ns: int, ids: IntArray, residuals: FloatArray, visible: float) -> None:
        """Take in residuals (N, 4, 2) [px] of one frame, of which ``visible`` is what a pose leaves of the error."""
        last, self._last = self._last, (stamp_ns, ids, residuals)
        if last is None or not 0 < stamp_ns - last[0] < _SUCCESSIVE_NS or len(ids) < FEWEST_MARKERS:
            return
        before, residuals_before = last[1], last[2]
        if not np.array_equal(ids, before):
            _, now, then = np.intersect1d(ids, before, return_indices=True)
            residuals, residuals_before = residuals[now], residuals_before[then]
        if len(residuals) < FEWEST_MARKERS:
            return
        # Moved markers last as well: none counts for more than what makes it inconsistent.
        products = np.mean(residuals * residuals_before, axis=(1, 2))
        product = float(np.mean(np.clip(products, -(INCONSISTENT_PX**2), INCONSISTENT_PX**2)))
        self._weight = BIAS_MEMORY * self._weight + visible
        self._sum = BIAS_MEMORY * self._sum + product
        self.px = math.sqrt(max(self._sum / self._weight, 0.0))
