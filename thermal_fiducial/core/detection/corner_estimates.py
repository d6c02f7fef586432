"""Corners of markers that were found: refined, confirmed, and as they are published."""

from dataclasses import dataclass, replace

import numpy as np

from thermal_fiducial.config import ArucoDetectorConfig
from thermal_fiducial.core.detection.confirmation import confirmed
from thermal_fiducial.core.detection.corners.edges import edges_behind
from thermal_fiducial.core.detection.corners.refinement import RefinedCorners
from thermal_fiducial.core.detection.decoding import Decoder
from thermal_fiducial.core.detection.displayed import DisplayedSides
from thermal_fiducial.core.detection.finding import Findings
from thermal_fiducial.core.detection.following import Followed
from thermal_fiducial.core.detection.found import Found, places_of
from thermal_fiducial.core.detection.frame import Frame, Places
from thermal_fiducial.core.detection.ids import among
from thermal_fiducial.core.detection.known_markers import ExpectedMarkers
from thermal_fiducial.core.detection.local_corners import local_corners
from thermal_fiducial.core.detection.refining import RefinedMarkers, Refiner, sides_px
from thermal_fiducial.core.detection.small_markers import with_corners_by_pattern
from thermal_fiducial.core.detection.tracking import MotionTrack
from thermal_fiducial.core.detection.twist import Twist
from thermal_fiducial.core.geometry.camera import ImagePoints
from thermal_fiducial.core.types import BoolArray, FloatArray, Gray, IntArray

# Nearer to the border of the image than this a marker may be cut off [px].
_BORDER_PX = 1.0
# A marker that was read off its corners by less than this need not be read again [cells].
_READ_THERE = 0.1
# Standard deviation of motion blur below which a marker looks as if it stood still [cells].
_STANDING = 0.1


@dataclass(frozen=True, slots=True)
class MarkerEstimates:
    """N markers of a frame at its stamp."""

    #: (N,)
    ids: IntArray
    #: as they are published
    corners: RefinedCorners
    at: ImagePoints
    #: (N, 4, 2) normalised, as the next frame's motion is measured from
    x: FloatArray
    #: corrected by the corners
    twist: Twist | None


class CornerEstimator:
    """Corners of the markers of a dictionary.

    Parameters
    ----------
    decoder, bits : of the dictionary, (M, n, n)
    """

    def __init__(self, decoder: Decoder, bits: Gray) -> None:
        self._decoder = decoder
        self._refiner = Refiner(edges_behind(bits))
        self._displayed = DisplayedSides(bits)

    def estimate(
        self,
        frame: Frame,
        findings: Findings,
        in_map: ExpectedMarkers | None,
        sizes: FloatArray,
        track: MotionTrack,
        config: ArucoDetectorConfig,
    ) -> MarkerEstimates:
        """Those of the ``findings`` that their refined corners confirm, of markers of ``sizes`` (N,) [m]."""
        found, followed = findings.found, findings.followed
        if len(found.ids) == 0:
            return _none(frame.twist)
        near, places = _places(frame, found, followed, in_map, sizes)
        refined = self._refiner.refine(frame, found, places, near | frame.displayed, track, config)
        keep = self._confirmed(frame, found, refined, followed, config)
        if frame.displayed and not keep.all():
            refined, small = with_corners_by_pattern(frame, found, refined, ~keep, self._decoder, config)
            keep = keep | small
        ids, refined = found.ids[keep], refined.only(keep)
        if config.refinement == 'subpix':
            corners = local_corners(frame.image, refined.corners, self._decoder.cells)
        elif frame.displayed:
            corners = self._displayed.corrected(frame, ids, refined, config.blur_px)
        else:
            return MarkerEstimates(ids, refined.corners, refined.places.at, refined.places.at.x, refined.twist)
        at = ImagePoints.at(corners.corners_px, frame.camera)
        return MarkerEstimates(ids, corners, at, refined.places.at.x, refined.twist)

    def _confirmed(
        self, frame: Frame, found: Found, refined: RefinedMarkers, followed: Followed, config: ArucoDetectorConfig
    ) -> BoolArray:
        """Which markers look like themselves at their refined corners: how the motion is known does not matter."""
        view, observed = refined.view, refined.observed
        there = found.corners_px + view.shift
        off = np.abs(observed.corners_px - there).max(axis=(1, 2))
        read = off < _READ_THERE / self._decoder.cells * sides_px(found.corners_px)
        keep = read & among(found.ids, followed.ids[followed.certain])
        others = np.flatnonzero(~keep)
        if len(others):
            image = view.image(observed.corners_px, others)
            expected = replace(found, corners_px=there).only(others)
            observed = observed.only(others)
            blur = np.sqrt(np.sum(view.spread[others] ** 2, axis=1))
            standing = frame.displayed & (blur < _STANDING * sides_px(expected.corners_px) / self._decoder.cells)
            keep[others] = confirmed(image, expected, observed, self._decoder, config, standing_picture=standing)
        return np.asarray(keep & frame.camera.contains(refined.observed.corners_px, _BORDER_PX).all(axis=1))


def _places(
    frame: Frame, found: Found, followed: Followed, in_map: ExpectedMarkers | None, sizes: FloatArray
) -> tuple[BoolArray, Places]:
    """Which markers (N,) are where they were followed to, and where all are."""
    near = among(found.ids, followed.ids)
    if len(followed.ids) == len(found.ids) and near.all():
        return near, followed.places
    known = [] if in_map is None else [(in_map.ids, in_map.depth)]
    return near, places_of(frame, found, sizes, *known, (followed.ids, followed.places.depth))


def _none(twist: Twist | None) -> MarkerEstimates:
    """No markers."""
    x, square = np.zeros((0, 4, 2)), np.zeros((0, 4, 2, 2))
    corners = RefinedCorners(x, square, np.zeros(0), np.zeros(0), np.zeros(0))
    return MarkerEstimates(np.zeros(0, dtype=np.int64), corners, ImagePoints(x, x, square, square), x, twist)
