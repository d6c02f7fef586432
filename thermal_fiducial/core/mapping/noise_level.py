"""How noisy corners really are, beside what their covariances promise."""

from collections import deque

import numpy as np

from thermal_fiducial.core.measurements import columns, CORNER_COVARIANCE_FIELDS, Markers

#: Markers that the estimate remembers.
MEMORY = 300
# Median of chi square of two degrees of freedom.
_MEDIAN = 1.386


class NoiseLevel:
    """Ratio of the corners' variance to the declared one, from what single-marker poses leave unexplained.

    Decisions between rival poses rest on the noise. A detector may promise too much (photos, motion, a lens that the
    calibration doesn't quite fit); four corners of a square over-determine its pose by two, which tells. The median
    over many markers is blind to misdetections.
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
