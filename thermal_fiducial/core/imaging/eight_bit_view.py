"""Counts as an 8-bit picture for people, and for tools that are limited to 8 bits."""

import cv2
import numpy as np

from thermal_fiducial.config import Tau2CameraConfig
from thermal_fiducial.core.types import Counts, FloatArray, Gray


class EightBitView:
    """Counts as an 8-bit picture whose scale follows the scene slowly.

    The scale runs between two percentiles of a sub-sample, smoothed over frames, and in a frame moves by no more than a
    small share of its span: an object that enters or leaves hardly changes the rest of the picture. The scale jumps
    only when the whole scene is outside it.
    """

    STEP = 8

    def __init__(self, config: Tau2CameraConfig) -> None:
        self.config = config
        self._range: FloatArray | None = None

    def __call__(self, counts: Counts) -> Gray:
        """Picture (height, width) uint8 of ``counts`` (height, width)."""
        low, high = self._follow(counts)
        span = max(high - low, self.config.view_minimum_span)
        # Counts below the scale saturate in the unsigned difference, counts above it in the conversion.
        start = max(0.0, 0.5 * (low + high - span))
        above = cv2.subtract(counts, np.array([start]))
        return np.asarray(cv2.convertScaleAbs(above, alpha=255.0 / span), dtype=np.uint8)

    def _follow(self, counts: Counts) -> tuple[float, float]:
        """Lower and upper end of the scale [counts], moved towards the percentiles of this frame."""
        sample = counts[:: self.STEP, :: self.STEP].ravel()
        share = self.config.view_tail_percent / 100.0
        ranks = (int(share * (sample.size - 1)), int((1.0 - share) * (sample.size - 1)))
        part = np.partition(sample, ranks)
        now = np.array([part[ranks[0]], part[ranks[1]]], np.float64)
        if self._range is None or now[0] > self._range[1] or now[1] < self._range[0]:
            self._range = now
        else:
            # Relative to the span, else an object a hundred times hotter than the markers would darken them at once.
            most = max(float(self._range[1] - self._range[0]), self.config.view_minimum_span)
            self._range = self._range + self.config.view_smoothing * np.clip(now - self._range, -most, most)
        return float(self._range[0]), float(self._range[1])
