"""Markers of the last frame followed into this one."""

from dataclasses import dataclass

import numpy as np

from thermal_fiducial.config import ArucoDetectorConfig
from thermal_fiducial.core.detection.decoding import Decoder
from thermal_fiducial.core.detection.found import Found
from thermal_fiducial.core.detection.frame import Frame, Places
from thermal_fiducial.core.detection.readout import expected_displacement
from thermal_fiducial.core.detection.tracking import TrackedMarkers
from thermal_fiducial.core.detection.twist import Twist
from thermal_fiducial.core.geometry.camera import ImagePoints
from thermal_fiducial.core.types import BoolArray, FloatArray, IntArray

# Correlation with its pattern of a marker that is still where motion has carried it, seen through the lag.
_STILL_SIMILAR = 0.7


@dataclass(frozen=True, slots=True)
class Followed:
    """N markers where the motion since the last frame has carried them.

    Parameters
    ----------
    ids : (N,)
    places : at the stamp
    cnr : (N,) contrast-to-noise ratio of a pixel
    certain : (N,) whether the frame shows them there beyond doubt
    """

    ids: IntArray
    places: Places
    cnr: FloatArray
    certain: BoolArray

    @staticmethod
    def none() -> 'Followed':
        """No markers."""
        x, J = np.zeros((0, 4, 2)), np.zeros((0, 4, 2, 2))
        places = Places(ImagePoints(x, x, J, J), np.zeros((0, 4)), np.zeros((0, 4, 2, 6)))
        return Followed(np.zeros(0, dtype=np.int64), places, np.zeros(0), np.zeros(0, dtype=bool))

    @staticmethod
    def of(last: TrackedMarkers, frame: Frame) -> 'Followed':
        """Those of the last frame, carried on; nothing is known yet of whether they are seen."""
        places = Places.of(ImagePoints.seen_at(last.x, frame.camera), last.depth)
        return Followed(last.ids, places, last.cnr, np.zeros(len(last.ids), dtype=bool))

    def only(self, keep: BoolArray) -> 'Followed':
        """Those of the markers ``keep`` (N,)."""
        if keep.all():
            return self
        return Followed(self.ids[keep], self.places.only(keep), self.cnr[keep], self.certain[keep])

    def found(self) -> Found:
        """As a search would have found them."""
        return Found(self.ids, self.places.at.px, self.cnr, np.ones(len(self.ids), dtype=bool))

    def seen(self, frame: Frame, twist: Twist, decoder: Decoder, config: ArucoDetectorConfig) -> 'Followed':
        """Those that the frame shows: they look like themselves more than like any other marker."""
        if len(self.ids) == 0:
            return self
        shown = self.places.at.px + self.places.lag_blur(twist, frame.lag)
        shown += expected_displacement(self.places, twist, frame)
        likeness = decoder.likeness(frame.samples, shown)
        similarity = likeness.correlation * np.sign(self.cnr)
        alike = (likeness.best == 4 * self.ids) & (similarity > _STILL_SIMILAR)
        alike &= frame.camera.contains(shown).all(axis=1)
        certain = similarity >= config.guided_min_correlation
        certain &= similarity - likeness.runner_up >= config.guided_min_margin
        return Followed(self.ids, self.places, self.cnr, certain).only(alike)
