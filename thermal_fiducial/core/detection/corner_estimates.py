"""Published corners of markers: confirmed, and on pictures for a display corrected by the width of the border.

A gain control for displays is a nonlinear function of the counts. The middle between the gray levels of black and white
is then not the middle of the blurred step between them: all dark regions grow, or all shrink. The sides of a marker and
the inner edges of its border move in opposite directions, so the width of the border measures the displacement.
"""

from dataclasses import replace

import cv2
import numpy as np

from thermal_fiducial.config import ArucoDetectorConfig
from thermal_fiducial.core.detection.confirmation import BORDER_PX, confirmed, with_corners_by_pattern
from thermal_fiducial.core.detection.corner_errors import (
    OF_BENT_BLUR_PX,
    OF_BENT_SCALE_PX,
    OF_BORDER_PX,
    OF_BORDERS_TOGETHER,
    OF_LOCAL_PX,
)
from thermal_fiducial.core.detection.corners.segments import HOPELESS, measure, REACHED, Segments
from thermal_fiducial.core.detection.corners.sides import blurs, edges_behind_border, model, sides_of
from thermal_fiducial.core.detection.frame import counts_of, Frame
from thermal_fiducial.core.detection.known_markers import FoundMarkers
from thermal_fiducial.core.detection.patterns import Decoder
from thermal_fiducial.core.detection.refining import RefinedCorners, RefinedMarkers, sides_px
from thermal_fiducial.core.geometry import se3
from thermal_fiducial.core.geometry.camera import ImagePoints
from thermal_fiducial.core.types import BoolArray, Float32Array, FloatArray, Gray

# Half the window of ``cornerSubPix``: in cells, and at most in pixels.
_WINDOW_IN_CELLS, _LARGEST_WINDOW = 0.3, 5
_STOP = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 0.001)
# Largest step of ``cornerSubPix`` that is accepted [cells].
_LOST_CELLS = 0.4
# Factor on the covariances of four corners with a common error: taken as independent, their mean has a quarter of it.
_CORNERS = 4.0
# Columns of pixels in a segment of a border, and the blur for which they are long enough [px].
_COLUMNS, _WIDEST_PX = 6, 2.0
# Largest distance of the refined corners from where the marker was decoded for it not to be decoded again [cells].
_READ_THERE = 0.1
# Standard deviation of motion blur below which a marker counts as at rest [cells].
_STANDING = 0.1


def local_corners(image: Float32Array, refined: RefinedCorners, cells: int) -> RefinedCorners:
    """Corners (N, 4, 2) by ``cv2.cornerSubPix``; those that move too far keep their refined place.

    These lie a few tenths of a pixel inside the intersections of the sides, because blur rounds corners.
    """
    corners = refined.corners_px.copy()
    for index, start in enumerate(refined.corners_px):
        cell = np.linalg.norm(start[2] - start[0]) / (np.sqrt(2.0) * cells)
        window = int(np.clip(round(_WINDOW_IN_CELLS * cell), 1, _LARGEST_WINDOW))
        points = start.astype(np.float32).reshape(-1, 1, 2)
        found = cv2.cornerSubPix(image, points, (window, window), (-1, -1), _STOP).reshape(4, 2).astype(np.float64)
        near = np.abs(found - start).max(axis=1) < max(1.0, _LOST_CELLS * cell)
        corners[index, near] = found[near]
    return replace(refined, corners_px=corners, covariances=refined.covariances + OF_LOCAL_PX**2 * np.eye(2))


class DisplayedSides:
    """Corrects corners for the displacement of sides in pictures for a display; markers with ``bits`` (M, n, n)."""

    def __init__(self, bits: Gray) -> None:
        self._behind, self._white = edges_behind_border(bits)
        self._bits = bits.shape[1]

    def corrected(self, frame: Frame, refined: RefinedMarkers, blur_px: float) -> RefinedCorners:
        """Corrected corners of N markers at the stamp; covariances with the remaining error of the correction."""
        if len(refined.ids) == 0:
            return refined.corners
        segments = self._across_border(frame, refined, blur_px)
        known = segments.variance < HOPELESS
        weight = np.where(known, 1.0 / (OF_BORDERS_TOGETHER * (segments.variance + OF_BORDER_PX**2)), 0.0)
        # Sides displaced outward by 1 scale the pattern, so that the inner edges appear displaced inward by ``gain``.
        gain = 2.0 - 2.0 / (self._bits + 2.0)
        information = gain * gain * weight.sum(axis=1)
        variance = 1.0 / (information + OF_BENT_SCALE_PX**-2)
        displacement = variance * gain * np.sum(weight * segments.shift, axis=1)
        outward = _outward(refined.corners.corners_px)
        corners = refined.corners.corners_px - displacement[:, None, None] * outward
        unknown = _CORNERS * variance[:, None, None, None] * outward[..., :, None] * outward[..., None, :]
        unknown = unknown + OF_BENT_BLUR_PX**2 * np.eye(2)
        return replace(refined.corners, corners_px=corners, covariances=refined.corners.covariances + unknown)

    def _across_border(self, frame: Frame, refined: RefinedMarkers, blur_px: float) -> Segments:
        """Inward displacements of the inner edges of the borders, where the cells behind are white."""
        seen = ImagePoints.at(refined.observed.corners_px, frame.camera)
        inset = 1.0 / (self._bits + 2.0)
        a, b = inset + (1.0 - 2.0 * inset) * np.array([[0.0, 1.0, 1.0, 0.0], [0.0, 0.0, 1.0, 1.0]])
        inner = np.moveaxis(se3.seen_between(seen.x, se3.bilinear(a, b)), 0, -1)
        sides = sides_of(inner, frame.camera, frame.image.shape, self._bits, _COLUMNS, _WIDEST_PX)
        blur = blurs(sides.normal[:, self._bits // 2], blur_px, refined.blur.spread)
        value, slope, weight = model(sides, self._behind[refined.ids], blur)
        weight *= self._white[refined.ids].reshape(-1, self._bits)
        counts = counts_of(sides.pixel, frame.image, refined.blur.to_tails)
        return measure(counts, (value, slope, weight), REACHED * blur[0])


def _outward(corners: FloatArray) -> FloatArray:
    """Displacement (N, 4, 2) of the corners (N, 4, 2) of quadrilaterals whose sides all move outward by 1."""
    side = np.roll(corners, -1, axis=1) - corners
    side = side / np.linalg.norm(side, axis=-1, keepdims=True)
    normal = np.stack([side[..., 1], -side[..., 0]], axis=-1)
    before = np.roll(normal, 1, axis=1)
    return np.asarray((normal + before) / (1.0 + np.sum(normal * before, axis=-1, keepdims=True)))


class CornerEstimator:
    """Corners of the markers of a dictionary.

    Parameters
    ----------
    decoder, bits : of the dictionary, (M, n, n)
    """

    def __init__(self, decoder: Decoder, bits: Gray) -> None:
        self._decoder = decoder
        self._displayed = DisplayedSides(bits)

    def published(
        self, frame: Frame, found: FoundMarkers, markers: RefinedMarkers, config: ArucoDetectorConfig
    ) -> RefinedMarkers:
        """The markers ``found`` that are confirmed at their refined corners, with the corners to publish."""
        if len(found.ids) == 0:
            return markers
        keep = self._confirmed(frame, found, markers, config)
        if frame.displayed and not keep.all():
            markers, small = with_corners_by_pattern(frame, found, markers, ~keep, self._decoder, config)
            keep = keep | small
        markers = markers if keep.all() else markers.only(keep)
        if config.refinement == 'subpix':
            return replace(markers, corners=local_corners(frame.image, markers.corners, self._decoder.cells))
        if frame.displayed:
            return replace(markers, corners=self._displayed.corrected(frame, markers, config.blur_px))
        return markers

    def _confirmed(
        self, frame: Frame, found: FoundMarkers, markers: RefinedMarkers, config: ArucoDetectorConfig
    ) -> BoolArray:
        """Which markers show their pattern at the refined corners."""
        blur, observed, cells = markers.blur, markers.observed, self._decoder.cells
        there = found.places.at.px + blur.shift
        off = np.abs(observed.corners_px - there).max(axis=(1, 2))
        read = off < _READ_THERE / cells * sides_px(found.places.at.px)
        keep = read & found.certain
        others = np.flatnonzero(~keep)
        if len(others):
            there, to_tails = there[others], None if blur.to_tails is None else blur.to_tails[others]
            standing = np.sqrt(np.sum(blur.spread[others] ** 2, axis=1)) < _STANDING * sides_px(there) / cells
            keep[others] = confirmed(
                frame.image, to_tails, found.only(others), there, observed.only(others), self._decoder, config,
                standing_picture=frame.displayed & standing,
            )  # fmt: skip
        return np.asarray(keep & frame.camera.contains(observed.corners_px, BORDER_PX).all(axis=1))
