"""Sides of markers in what is meant for a display, whose gain control has bent the scale of counts.

The middle between the grey levels of black and white is then not that of the step between them: all that is dark looks
larger, or all smaller. A marker's sides go out where the inner edges of its border go in, so that the width of the
border says by how much.
"""

from dataclasses import replace

import numpy as np

from thermal_fiducial.core.detection.corners.edges import blurs, edges_behind_border, model
from thermal_fiducial.core.detection.corners.refinement import RefinedCorners
from thermal_fiducial.core.detection.corners.segments import counts_across, HOPELESS, measure, REACHED, Segments
from thermal_fiducial.core.detection.corners.sides import sides_of
from thermal_fiducial.core.detection.frame import Frame
from thermal_fiducial.core.detection.refining import RefinedMarkers
from thermal_fiducial.core.geometry import se3
from thermal_fiducial.core.geometry.camera import ImagePoints
from thermal_fiducial.core.types import FloatArray, Gray, IntArray

#: Displacement of sides by a bent scale [px]: if the middle of black and white lies anywhere from a fifth to four
#: fifths of the step as it was, that of a step blurred by 0.66 px is off by up to 0.55, evenly spread.
DISPLACED = 0.3
# Deviation of a segment that no noise explains [px], and how much larger the variance of their mean is than if segments
# erred by themselves: of rendered frames after the Tau 2's plateau equalisation, errors of the displacement found are
# 3 to 4 of the sigmas that independent segments would have, of markers of 14 to 60 px seen at up to 70 degrees.
_FLOOR, _TOGETHER = 0.05, 12.0
# Deviation of a corner from what a bent scale does to steps, whose motion blur it bends too [px].
_DEVIATION = 0.1
# Four corners that err together, each with a covariance of its own, claim what they have in common four times too well.
_CORNERS = 4.0
_COLUMNS, _HALF = 6, 6


class DisplayedSides:
    """Takes the displacement of sides out of the corners of markers with ``bits`` (M, n, n)."""

    def __init__(self, bits: Gray) -> None:
        self._behind, self._white = edges_behind_border(bits)
        self._bits = bits.shape[1]

    def corrected(self, frame: Frame, ids: IntArray, refined: RefinedMarkers, blur_px: float) -> RefinedCorners:
        """Corners of N markers ``ids`` at the stamp, with what stays unknown of the displacement."""
        if len(ids) == 0:
            return refined.corners
        segments = self._across_border(frame, ids, refined, blur_px)
        known = segments.variance < HOPELESS
        weight = np.where(known, 1.0 / (_TOGETHER * (segments.variance + _FLOOR**2)), 0.0)
        # Where sides are out by one, the inner edges are in by one, of a border that is drawn too large with them.
        gain = 2.0 - 2.0 / (self._bits + 2.0)
        information = gain * gain * weight.sum(axis=1)
        variance = 1.0 / (information + DISPLACED**-2)
        displacement = variance * gain * np.sum(weight * segments.shift, axis=1)
        outward = _outward(refined.corners.corners_px)
        corners = refined.corners.corners_px - displacement[:, None, None] * outward
        unknown = _CORNERS * variance[:, None, None, None] * outward[..., :, None] * outward[..., None, :]
        unknown = unknown + _DEVIATION**2 * np.eye(2)
        return replace(refined.corners, corners_px=corners, covariances=refined.corners.covariances + unknown)

    def _across_border(self, frame: Frame, ids: IntArray, refined: RefinedMarkers, blur_px: float) -> Segments:
        """Displacements of the inner edges of the borders, inward, where white lies behind them."""
        seen = ImagePoints.at(refined.observed.corners_px, frame.camera)
        inset = 1.0 / (self._bits + 2.0)
        a, b = inset + (1.0 - 2.0 * inset) * np.array([[0.0, 1.0, 1.0, 0.0], [0.0, 0.0, 1.0, 1.0]])
        inner = np.moveaxis(se3.in_quadrilaterals(seen.x, a, b), 0, -1)
        sides = sides_of(inner, frame.camera, frame.image.shape, self._bits, _COLUMNS, _HALF)
        blur = blurs(sides.normal[self._bits // 2], blur_px, refined.view.spread)
        value, slope, weight = model(sides, self._behind[ids], blur)
        weight *= self._white[ids].reshape(-1, self._bits).T
        counts = counts_across(frame.image, sides, refined.view.lag_tail)
        return measure(counts, (value, slope, weight), REACHED * blur[0])


def _outward(corners: FloatArray) -> FloatArray:
    """How corners (N, 4, 2) of quadrilaterals move when all sides move outward by one (N, 4, 2)."""
    side = np.roll(corners, -1, axis=1) - corners
    side = side / np.linalg.norm(side, axis=-1, keepdims=True)
    normal = np.stack([side[..., 1], -side[..., 0]], axis=-1)
    before = np.roll(normal, 1, axis=1)
    return np.asarray((normal + before) / (1.0 + np.sum(normal * before, axis=-1, keepdims=True)))
