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
    Places,
    REMAINING,
    rolling_displacement,
    SPREAD,
)
from thermal_fiducial.core.detection.known_markers import FoundMarkers
from thermal_fiducial.core.detection.tracking import MotionTrack
from thermal_fiducial.core.detection.twist import Twist, unknown_twist
from thermal_fiducial.core.types import Float32Array, FloatArray, IntArray, Stacked, TINY

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
class MotionBlur(Stacked):
    """How motion displaces and blurs N markers in a frame, of which the lag tail is taken out where it matters."""

    #: (N, 2, 3) affine maps of pixels to their lag tails, which are to be taken out; None: there is hardly any blur
    to_tails: FloatArray | None
    #: (N, 4, 2) where the corners appear, off their places at the stamp [px]
    shift: FloatArray
    #: (N, 4, 2) how much of the blur's shift is taken out
    removed: FloatArray
    #: (N, 2) standard deviation of what is left of the blur, along it
    spread: FloatArray


@dataclass(frozen=True, slots=True)
class RefinedMarkers(Stacked):
    """Refined corners of N markers."""

    #: (N,)
    ids: IntArray
    #: as the frame shows them, blurred so
    observed: RefinedCorners
    blur: MotionBlur
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
        blur = _motion_blur(frame, found.places, None, 0.0)
        return RefinedMarkers(found.ids, corners, blur, corners, found.places, frame.twist)


def refined(
    frame: Frame, found: FoundMarkers, behind: Float32Array, track: MotionTrack, config: ArucoDetectorConfig
) -> RefinedMarkers:
    """Corners of N markers.

    Parameters
    ----------
    behind : (N, 4, m, 2) of :func:`thermal_fiducial.core.detection.corners.sides.edges_behind`
    track : the frames before, which with the corners give the twist
    """
    columns, hardly = _OF_CLEAR if np.abs(found.cnr).min() > CLEAR_CNR else _OF_FAINT
    twist, places = frame.twist, found.places
    for _ in range(_ROUNDS):
        blur = _motion_blur(frame, places, twist, hardly)
        start = places.at.moved(blur.shift, frame.camera)
        widths = config.blur_px, blur.spread
        seen = refine_corners(frame.image, start, frame.camera, behind, *widths, columns, blur.to_tails)
        markers = _at_stamp(frame, found.ids, places, blur, seen, twist, track, behind.shape[2])
        change = np.abs(markers.corners.corners_px - seen.corners_px + blur.shift)
        if markers.twist is None or change.max(initial=0.0) < _BLUR_THAT_MATTERS_PX:
            break
        twist, places = markers.twist, markers.places
    return markers


def _at_stamp(
    frame: Frame,
    ids: IntArray,
    places: Places,
    blur: MotionBlur,
    seen: RefinedCorners,
    known: Twist | None,
    track: MotionTrack,
    cells: int,
) -> RefinedMarkers:
    """The corners without lag and as if all rows were seen at once, by the twist that they themselves correct."""
    at = places.at.moved(seen.corners_px - blur.shift - places.at.px, frame.camera)
    variances = seen.covariances.diagonal(axis1=-2, axis2=-1)
    deviation = np.sqrt(variances.mean(axis=(1, 2))) / frame.camera.focal_px
    # Corners that make no square are those of something else.
    doubted = seen.covariances + seen.doubt[:, None, None, None] * _EYE
    # The same displacement in two frames in a row hides from the first twist; once freed, they are not alike.
    twist = known
    if frame.twist is not None or known is None:
        twist = track.correct(frame.stamp_ns, frame.twist, ids, at.x, places.depth, deviation)
    if twist is None:
        unsure = doubted + _never_seen(frame, places, seen, unknown_twist(), cells)
        return RefinedMarkers(ids, seen, blur, replace(seen, covariances=unsure), replace(places, at=at), None)
    lag_blur = places.lag_blur(twist, frame.lag)
    rolling = rolling_displacement(places, twist, frame, (seen.corners_px + blur.removed)[..., 1])
    px = seen.corners_px - lag_blur + blur.removed - rolling
    unknown = places.unknown(twist, frame.lag) + wrong_lag(lag_blur)
    if frame.twist is None:
        unknown = unknown + _never_seen(frame, places, seen, twist, cells)
    corners = replace(seen, corners_px=px, covariances=doubted + unknown)
    return RefinedMarkers(ids, seen, blur, corners, replace(places, at=at.at_pixels(px)), twist)


def _never_seen(frame: Frame, places: Places, seen: RefinedCorners, twist: Twist, cells: int) -> FloatArray:
    """Covariances (N, 4, 2, 2) [px^2] by a motion that the frames before show nothing of."""
    since = frame.lag - delays(seen.corners_px[..., 1], frame)
    unsharpness = seen.noise / np.maximum(np.abs(seen.contrast), TINY)
    cell = sides_px(seen.corners_px) / cells
    return unknown_motion(since[..., None, None] * places.flow, twist.covariance_ago(frame.lag), unsharpness, cell)


def _motion_blur(frame: Frame, places: Places, twist: Twist | None, hardly_px: float) -> MotionBlur:
    """The known blur of all markers; its lag tails are to be taken out where it is more than ``hardly_px``."""
    lag_blur = np.zeros_like(places.at.px) if twist is None else places.lag_blur(twist, frame.lag)
    mean, rolling = lag_blur.mean(axis=1), rolling_displacement(places, twist, frame)
    if twist is None or (mean * mean).sum(axis=1).max() <= hardly_px**2:
        return MotionBlur(None, lag_blur + rolling, np.zeros_like(lag_blur), mean)
    tail = lag_tail(places, twist, frame)
    removed = (1.0 - REMAINING) * tail
    shift = lag_blur - removed + rolling
    return MotionBlur(lag_tail_maps(places.at.px + shift, tail), shift, removed, SPREAD * mean)


def sides_px(corners: FloatArray) -> FloatArray:
    """Mean sides (N,) of quadrilaterals (N, 4, 2)."""
    span = corners.take(_NEXT, axis=1) - corners
    return np.asarray(np.sqrt((span * span).sum(axis=-1)).mean(axis=1))
