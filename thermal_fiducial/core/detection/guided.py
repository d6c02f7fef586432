"""Markers where they must be: those of the last frame carried on, and those of the map where the odometry expects them.

A marker is accepted by its own evidence alone: its pattern, in its expected place and attitude, must correlate with
the image clearly, and better than the pattern of any other marker or any other turn of its own.
"""

from dataclasses import dataclass

import numpy as np

from thermal_fiducial.config import ArucoDetectorConfig
from thermal_fiducial.core.detection.found import Found
from thermal_fiducial.core.detection.frame import expected_displacement, Frame, Places
from thermal_fiducial.core.detection.known_markers import ExpectedMarkers
from thermal_fiducial.core.detection.lag import lag_tail_maps, markers_deblurred, REMAINING
from thermal_fiducial.core.detection.patterns import Decoder, Reading
from thermal_fiducial.core.detection.refining import BLUR_THAT_MATTERS_PX
from thermal_fiducial.core.detection.tracking import TrackedMarkers
from thermal_fiducial.core.detection.twist import Twist
from thermal_fiducial.core.geometry.camera import ImagePoints
from thermal_fiducial.core.types import BoolArray, Float32Array, FloatArray, IntArray

# Correlation with its pattern of a marker that is still where motion has carried it, seen through the lag.
_STILL_SIMILAR = 0.7
# Places round the prediction that are tried, in shares of a cell.
_NEAR = np.stack(np.meshgrid([-0.5, 0.0, 0.5], [-0.5, 0.0, 0.5]), axis=-1).reshape(-1, 2)


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
        likeness = decoder.likeness(frame.image, shown)
        similarity = likeness.correlation * np.sign(self.cnr)
        alike = (likeness.best == 4 * self.ids) & (similarity > _STILL_SIMILAR)
        alike &= frame.camera.contains(shown).all(axis=1)
        certain = similarity >= config.guided_min_correlation
        certain &= similarity - likeness.runner_up >= config.guided_min_margin
        return Followed(self.ids, self.places, self.cnr, certain).only(alike)


def near_prediction(
    frame: Frame,
    twist: Twist,
    expected: ExpectedMarkers,
    decoder: Decoder,
    config: ArucoDetectorConfig,
) -> Found:
    """Those of the ``expected`` markers that the frame shows near where they are expected."""
    places = Places.of(ImagePoints.at(expected.corners_px, frame.camera), expected.depth)
    shift, rolling = places.lag_blur(twist, frame.lag), expected_displacement(places, twist, frame)
    ids, corners = expected.ids, expected.corners_px + rolling
    blurred = np.abs(shift).max(axis=(1, 2)) > BLUR_THAT_MATTERS_PX
    scene = frame.image
    if blurred.any():
        scene = markers_deblurred(frame.image, corners[blurred], lag_tail_maps(corners[blurred], shift[blurred]))
    left = np.where(blurred[:, None, None], REMAINING * shift, shift)
    shown = _shifted(scene, ids, corners + left, decoder)
    reading = decoder.read(scene, shown)
    good = _confirmed(reading, ids, frame.noise, config)
    corners = (shown - left - rolling)[good]
    return Found(ids[good], corners, reading.contrast[good] / frame.noise, np.ones(len(corners), dtype=bool))


def _shifted(image: Float32Array, ids: IntArray, corners: FloatArray, decoder: Decoder) -> FloatArray:
    """Corners (N, 4, 2) moved to where their patterns correlate best, between the places by the centre of gravity."""
    cell = np.linalg.norm(corners[:, 2] - corners[:, 0], axis=-1) / (np.sqrt(2.0) * decoder.cells)
    step = cell[:, None, None] * _NEAR
    tried = (corners[:, None] + step[:, :, None]).reshape(-1, 4, 2)
    similarity = np.abs(decoder.match(image, tried, np.repeat(ids, len(_NEAR)))).reshape(len(ids), -1)
    weight = np.maximum(similarity - 0.8 * similarity.max(axis=1, keepdims=True), 0.0)
    shift = np.einsum('np,npk->nk', weight, step) / np.maximum(weight.sum(axis=1, keepdims=True), 1e-9)
    return np.asarray(corners + shift[:, None])


def _confirmed(reading: Reading, ids: IntArray, noise: float, config: ArucoDetectorConfig) -> BoolArray:
    similarity = np.abs(reading.correlation)
    return np.asarray(
        (reading.ids == ids)
        & (reading.turns == 0)
        & (similarity >= config.guided_min_correlation)
        & (similarity - reading.runner_up >= config.guided_min_margin)
        & (np.abs(reading.contrast) >= config.guided_min_contrast * noise)
    )
