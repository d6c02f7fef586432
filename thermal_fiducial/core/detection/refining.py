"""Corners refined in frames that motion and the bolometers' lag blur.

The motion blur of each marker follows from the camera's twist. Where it matters it is taken out round the marker, as
far as that holds whatever the response is like; the edges are fitted with the blur that remains, and what lag has
displaced them by is taken out of the corners. These correct the twist: where that changes the blur much, it is done
once more.
"""

from dataclasses import dataclass, replace

import numpy as np

from thermal_fiducial.config import ArucoDetectorConfig
from thermal_fiducial.core.detection.corner_errors import unknown_motion, wrong_lag
from thermal_fiducial.core.detection.corners.refinement import refine_corners, RefinedCorners
from thermal_fiducial.core.detection.frame import (
    delays,
    Frame,
    lag_tail,
    lag_tail_maps,
    markers_deblurred,
    Places,
    REMAINING,
    rolling_displacement,
    SPREAD,
)
from thermal_fiducial.core.detection.known_markers import FoundMarkers
from thermal_fiducial.core.detection.tracking import MotionTrack
from thermal_fiducial.core.detection.twist import Twist, unknown_twist
from thermal_fiducial.core.types import BoolArray, Float32Array, FloatArray, IntArray

# Blur by lag below which the shape of an edge doesn't change [px].
_BLUR_THAT_MATTERS_PX = 0.4
#: Contrast over noise below which a marker is faint; a clearer one shows at full and at half the resolution.
CLEAR_CNR = 20.0
# Columns of pixels used of a cell, all of a faint marker's; and blur [px] up to which the lag tail stays in the frame,
# where the model takes it for a symmetric one: among faint markers that costs less than the noise of taking it out.
_OF_CLEAR, _OF_FAINT = (6, 0.2), (12, 1.0)
_ROUNDS = 2
_NEXT, _EYE = np.array([1, 2, 3, 0]), np.eye(2)


@dataclass(frozen=True, slots=True)
class DeblurredView:
    """A frame in which the motion blur of N markers is short."""

    image: Float32Array
    #: (N, 2, 3) affine maps of pixels to their lag tails, which are to be taken out; None: there is hardly any blur
    to_tails: FloatArray | None
    #: (N, 4, 2) where the corners appear in the view, off their places at the stamp [px]
    shift: FloatArray
    #: (N, 4, 2) how much of the motion blur's shift is taken out
    removed: FloatArray
    #: (N, 2) standard deviation of what is left of the motion blur, along it
    spread: FloatArray

    def only(self, keep: BoolArray) -> 'DeblurredView':
        """That of the markers ``keep`` (N,)."""
        to_tails = None if self.to_tails is None else self.to_tails[keep]
        return DeblurredView(self.image, to_tails, self.shift[keep], self.removed[keep], self.spread[keep])

    def round_markers(self, corners_px: FloatArray, which: IntArray) -> Float32Array:
        """The image freed of lag tails round those of the markers ``which``, with corners (N, 4, 2)."""
        if self.to_tails is None:
            return self.image
        return markers_deblurred(self.image, corners_px[which], self.to_tails[which])


@dataclass(frozen=True, slots=True)
class RefinedMarkers:
    """Refined corners of N markers."""

    #: (N,)
    ids: IntArray
    #: as the view shows them
    view: DeblurredView
    observed: RefinedCorners
    #: at the stamp, with what is unknown of the motion
    corners: RefinedCorners
    #: by these, or by what the thermal frame would have shown, from which the next frame's motion is measured
    places: Places
    #: corrected by the corners
    twist: Twist | None

    @staticmethod
    def none(frame: Frame) -> 'RefinedMarkers':
        """No markers."""
        found, corners = FoundMarkers.none(), RefinedCorners.none()
        view = _view(frame, found.places, None, 0.0)
        return RefinedMarkers(found.ids, view, corners, corners, found.places, frame.twist)

    def only(self, keep: BoolArray) -> 'RefinedMarkers':
        """That of the markers ``keep`` (N,)."""
        if keep.all():
            return self
        observed, corners, places = self.observed.only(keep), self.corners.only(keep), self.places.only(keep)
        return RefinedMarkers(self.ids[keep], self.view.only(keep), observed, corners, places, self.twist)


class Refiner:
    """Refines markers of a dictionary in moving frames.

    Parameters
    ----------
    behind : (M, 4, m, 2) of :func:`thermal_fiducial.core.detection.corners.sides.edges_behind`
    """

    def __init__(self, behind: Float32Array) -> None:
        self._behind = behind

    def refine(
        self,
        frame: Frame,
        found: FoundMarkers,
        track: MotionTrack,
        config: ArucoDetectorConfig,
    ) -> RefinedMarkers:
        """Corners of N markers.

        Parameters
        ----------
        track : the frames before, which with the corners give the twist
        """
        columns, hardly = _OF_CLEAR if np.abs(found.cnr).min() > CLEAR_CNR else _OF_FAINT
        twist, places = frame.twist, found.places
        for _ in range(_ROUNDS):
            view = _view(frame, places, twist, hardly)
            start = places.at.moved(view.shift, frame.camera)
            behind = self._behind[found.ids]
            blur = config.blur_px, view.spread
            seen = refine_corners(view.image, start, frame.camera, behind, *blur, columns, view.to_tails)
            refinement = self._at_stamp(frame, found, places, view, seen, twist, track)
            change = np.abs(refinement.corners.corners_px - seen.corners_px + view.shift)
            if refinement.twist is None or change.max(initial=0.0) < _BLUR_THAT_MATTERS_PX:
                break
            twist, places = refinement.twist, refinement.places
        return refinement

    def _at_stamp(
        self,
        frame: Frame,
        found: FoundMarkers,
        places: Places,
        view: DeblurredView,
        seen: RefinedCorners,
        known: Twist | None,
        track: MotionTrack,
    ) -> RefinedMarkers:
        """The corners without lag and as if all rows were seen at once, by the twist that they themselves correct."""
        at = places.at.moved(seen.corners_px - view.shift - places.at.px, frame.camera)
        variances = seen.covariances.diagonal(axis1=-2, axis2=-1)
        deviation = np.sqrt(variances.mean(axis=(1, 2))) / frame.camera.focal_px
        # Corners that make no square are those of something else.
        doubted = seen.covariances + seen.doubt[:, None, None, None] * _EYE
        # The same displacement in two frames in a row hides from the first twist; once freed, they are not alike.
        twist = known
        if frame.twist is not None or known is None:
            twist = track.correct(frame.stamp_ns, frame.twist, found.ids, at.x, places.depth, deviation)
        if twist is None:
            unsure = doubted + self._never_seen(frame, places, seen, unknown_twist())
            corners_there = seen._replace(covariances=unsure)
            return RefinedMarkers(found.ids, view, seen, corners_there, replace(places, at=at), None)
        lag_blur = places.lag_blur(twist, frame.lag)
        rolling = rolling_displacement(places, twist, frame, (seen.corners_px + view.removed)[..., 1])
        corners = seen.corners_px - lag_blur + view.removed - rolling
        unknown = places.unknown(twist, frame.lag) + wrong_lag(lag_blur)
        if frame.twist is None:
            unknown = unknown + self._never_seen(frame, places, seen, twist)
        refined = seen._replace(corners_px=corners, covariances=doubted + unknown)
        return RefinedMarkers(found.ids, view, seen, refined, replace(places, at=at.at_pixels(corners)), twist)

    def _never_seen(self, frame: Frame, places: Places, seen: RefinedCorners, twist: Twist) -> FloatArray:
        """Covariances (N, 4, 2, 2) [px^2] by a motion that the frames before show nothing of."""
        since = frame.lag - delays(seen.corners_px[..., 1], frame)
        unsharpness = seen.noise / np.maximum(np.abs(seen.contrast), 1e-6)
        cell = sides_px(seen.corners_px) / self._behind.shape[2]
        return unknown_motion(since[..., None, None] * places.flow, twist.covariance_ago(frame.lag), unsharpness, cell)


def _view(frame: Frame, places: Places, twist: Twist | None, hardly_px: float) -> DeblurredView:
    """The frame with the known motion blur of all markers, to be taken out where it matters."""
    lag_blur = np.zeros_like(places.at.px) if twist is None else places.lag_blur(twist, frame.lag)
    mean, rolling = lag_blur.mean(axis=1), rolling_displacement(places, twist, frame)
    if twist is None or (mean * mean).sum(axis=1).max() <= hardly_px**2:
        return DeblurredView(frame.image, None, lag_blur + rolling, np.zeros_like(lag_blur), mean)
    tail = lag_tail(places, twist, frame)
    removed = (1.0 - REMAINING) * tail
    shift = lag_blur - removed + rolling
    return DeblurredView(frame.image, lag_tail_maps(places.at.px + shift, tail), shift, removed, SPREAD * mean)


def sides_px(corners: FloatArray) -> FloatArray:
    """Mean sides (N,) of quadrilaterals (N, 4, 2)."""
    span = corners.take(_NEXT, axis=1) - corners
    return np.asarray(np.sqrt((span * span).sum(axis=-1)).mean(axis=1))
