"""How noisy corners really are, beside what their covariances promise."""

from collections import deque
import math

import numpy as np

from thermal_fiducial.core.error_model import INCONSISTENT_PX, SystematicErrors
from thermal_fiducial.core.measurements import columns, CORNER_COVARIANCE_FIELDS, Markers
from thermal_fiducial.core.types import FloatArray, IntArray

#: Markers that the estimate remembers.
MEMORY = 300
#: Frames that the error to begin with is worth, and the weight that each new frame leaves to those before: 300 frames.
BIAS_PRIOR, BIAS_MEMORY = 30.0, 1.0 - 1.0 / 300.0
#: A pose takes up nearly all of the error of fewer markers.
FEWEST_MARKERS = 3
# Frames farther apart than this see the corners elsewhere in the image [ns].
_SUCCESSIVE_NS = 150_000_000
# Median of chi square of two degrees of freedom.
_MEDIAN = 1.386


class NoiseLevel:
    """Ratio of the corners' variance to the declared one, from what single-marker poses leave unexplained.

    Decisions between alternative poses rest on the noise. A detector may promise too much (photos, motion, a lens that
    the calibration doesn't quite fit); four corners of a square over-determine its pose by two, which shows it. The
    median over many markers is blind to misdetections.
    """

    def __init__(self) -> None:
        self._ratios: deque[float] = deque(maxlen=MEMORY)
        #: at least 1
        self.factor = 1.0

    def add(self, markers: Markers) -> None:
        """Take in the re-projection errors of the single-marker poses of one frame."""
        if not len(markers):
            return
        variances = columns(markers, CORNER_COVARIANCE_FIELDS).reshape(-1, 4, 3)[..., [0, 2]].mean(axis=(1, 2))
        chi2 = 4.0 * markers['rms_px'].astype(np.float64) ** 2 / variances
        self._ratios.extend(chi2[np.isfinite(chi2)].tolist())
        if self._ratios:
            self.factor = max(1.0, float(np.median(self._ratios)) / _MEDIAN)


class CornerBias:
    """Systematic error of the corners (lens, detector), from residuals that are still there in the next frame.

    White noise of two frames is independent: the mean product of a corner's residuals in successive frames is the
    variance of what lasts, as far as the pose does not take it up.
    """

    def __init__(self, model: SystematicErrors) -> None:
        self._weight = BIAS_PRIOR
        self._sum = BIAS_PRIOR * model.corner_px**2
        self._last: tuple[int, IntArray, FloatArray] | None = None

    @property
    def px(self) -> float:
        """Standard deviation [px]."""
        return math.sqrt(max(self._sum / self._weight, 0.0))

    def add(self, stamp_ns: int, ids: IntArray, residuals: FloatArray, visible: float) -> None:
        """Take in residuals (N, 4, 2) [px] of one frame, of which ``visible`` is what a pose leaves of the error."""
        last, self._last = self._last, (stamp_ns, ids, residuals)
        if last is None or not 0 < stamp_ns - last[0] < _SUCCESSIVE_NS or len(ids) < FEWEST_MARKERS:
            return
        _, now, before = np.intersect1d(ids, last[1], return_indices=True)
        if len(now) < FEWEST_MARKERS:
            return
        # Moved markers last as well: none counts for more than what makes it inconsistent.
        products = np.mean(residuals[now] * last[2][before], axis=(1, 2))
        product = float(np.mean(np.clip(products, -(INCONSISTENT_PX**2), INCONSISTENT_PX**2)))
        self._weight = BIAS_MEMORY * self._weight + visible
        self._sum = BIAS_MEMORY * self._sum + product
