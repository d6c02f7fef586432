"""Sub-pixel refinement of corners in frames that are blurred by motion and bolometer lag.

The camera's twist gives the motion blur of each marker. Where it is large, the lag tail is removed around the marker
(see :mod:`frame`); the edge model contains the blur that remains, and the known displacement by lag is subtracted from
the corners. The corners then correct the twist; if that changes the blur much, the refinement is repeated.

Columns of whole pixels across the sides are fitted with the model of a blurred edge, segment by segment, on raw counts.
A robust adjustment of the four corners to all segments follows; both are repeated until the corners converge.
"""

from dataclasses import dataclass, replace
import math

import numpy as np

from thermal_fiducial.config import ArucoDetectorConfig
from thermal_fiducial.core.detection.blurred_patterns import PatternView
from thermal_fiducial.core.detection.corner_errors import (
    OF_ALL_SIDES_PX,
    of_motion_blur,
    OF_UNEVEN_CONTRAST_PX,
    unknown_motion,
)
from thermal_fiducial.core.detection.corners.segments import (
    adjust,
    measure,
    REACHED,
    Segments,
    UNMEASURED,
    with_gradients,
)
from thermal_fiducial.core.detection.corners.sides import Blur, blur_of, model, ONE_GAUSSIAN, Sides, sides_of
from thermal_fiducial.core.detection.corners.squares import as_squares, Squared
from thermal_fiducial.core.detection.frame import (
    counts_of,
    delays,
    Frame,
    LAG_TAIL_AGE,
    lag_tail_maps,
    Places,
    REMAINING,
    rolling_displacement,
    SPREAD,
    stretch,
    WITHOUT_TAIL,
)
from thermal_fiducial.core.detection.known_markers import FoundMarkers
from thermal_fiducial.core.detection.pattern_fit import fitted_patterns, too_small_for_sides
from thermal_fiducial.core.detection.patterns import Decoder
from thermal_fiducial.core.detection.refined_corners import RefinedCorners
from thermal_fiducial.core.detection.tracking import MotionTrack
from thermal_fiducial.core.detection.twist import Twist, UNKNOWN_TWIST
from thermal_fiducial.core.geometry.camera import Camera, ImagePoints
from thermal_fiducial.core.geometry.se3 import sides_px
from thermal_fiducial.core.types import BoolArray, Float32Array, FloatArray, IntArray, Stacked, TINY

#: Contrast-to-noise ratio above which a marker is clear: it is found at full and at half resolution.
CLEAR_CNR = 20.0
# Columns of pixels per cell for clear markers, and for faint ones.
_OF_CLEAR, _OF_FAINT = 6, 12
# Displacement of a corner by lag, about the blur of the optics, up to which it is modelled as symmetric blur [px].
# Beyond it, the lag tail is removed.
_HARDLY_PX = 0.6
# Change of the displacement by lag below which the refinement is not repeated [px].
_BLUR_THAT_MATTERS_PX = 0.4
_ROUNDS = 2
_EYE = np.eye(2)
# Indices of the corners, clockwise, among the ends of the sides.
_CORNERS = np.array([0, 1, 3, 2])
# Distance from the sides [blurs] beyond which pixels do not count where a gradient of temperature displaces a side: it
# displaces it by as much less as pixels are nearer, and noise by a tenth more.
_WITH_GRADIENT = 4.0
# Largest number of passes. A corner has converged when its last step is below _UNSURE of its standard deviations,
# clipped to the limits _SETTLED_PX [px].
_PASSES = 4
_SETTLED_PX, _UNSURE = (0.3, 1.0), 2.0


@dataclass(frozen=True, slots=True)
class MotionBlur(Stacked):
    """Displacement and blur of N markers by motion, after the lag tail is removed where it is large."""

    #: (N, 2, 3) affine maps from pixels to their lag tails, which are removed; None: the blur is too small for that
    to_tails: FloatArray | None
    #: (N, 4, 2) displacement of the corners in the image from their places at the stamp [px]
    shift: FloatArray
    #: (N, 4, 2) part of the displacement that vanishes with the lag tail [px]
    removed: FloatArray
    #: (N, 2) standard deviation of the remaining motion blur, along the motion [px]
    spread: FloatArray

    @staticmethod
    def none(count: int) -> 'MotionBlur':
        """Of ``count`` markers at rest."""
        still = np.zeros((count, 4, 2))
        return MotionBlur(None, still, still, still[:, 0])


@dataclass(frozen=True, slots=True)
class RefinedMarkers(Stacked):
    """Refined corners of N markers."""

    #: (N,)
    ids: IntArray
    #: as observed in the frame, displaced by ``blur``
    observed: RefinedCorners
    blur: MotionBlur
    #: at the stamp, with the uncertainty of the motion
    corners: RefinedCorners
    #: places of the corners, before later corrections for displays: the next frame's motion is measured from them
    places: Places
    #: of the camera, corrected by the corners
    twist: Twist | None

    @staticmethod
    def none(frame: Frame) -> 'RefinedMarkers':
        """No markers."""
        found, corners = FoundMarkers.none(), RefinedCorners.none()
        return RefinedMarkers(found.ids, corners, MotionBlur.none(0), corners, found.places, frame.twist)


def refine(
    frame: Frame,
    found: FoundMarkers,
    behind: Float32Array,
    track: MotionTrack,
    decoder: Decoder,
    config: ArucoDetectorConfig,
) -> RefinedMarkers:
    """Corners of N markers.

    Parameters
    ----------
    behind : (N, 4, m, 2) of :func:`thermal_fiducial.core.detection.corners.sides.edges_behind`
    track : motion and markers of the last frame, which with the corners give the twist
    decoder : of the dictionary, for markers that are refined by their whole patterns
    """
    if len(found.ids) == 0:
        return RefinedMarkers.none(frame)
    clear = np.abs(found.cnr).min() > CLEAR_CNR
    columns = _OF_CLEAR if clear else _OF_FAINT
    twist, places = frame.twist, found.places
    for _ in range(_ROUNDS):
        blur = _motion_blur(frame, places, twist)
        start = places.at.at_pixels(places.at.px + blur.shift)
        small = too_small_for_sides(start.px, decoder.cells, config.blur_px)
        sides, patterns = np.flatnonzero(~small), np.flatnonzero(small)
        seen = RefinedCorners.none()
        if len(sides):
            seen = refine_corners(
                frame.image, start.only(sides), frame.camera, behind[sides], config.blur_px, columns,
                blur.only(sides),
            )  # fmt: skip
        if len(patterns):
            moving = blur.only(patterns)
            view = PatternView(frame.image, moving.to_tails, moving.spread, frame.displayed)
            fitted = fitted_patterns(frame, found.only(patterns), start.only(patterns), view, decoder, config.blur_px)
            seen = seen.joined(fitted).only(np.argsort(np.concatenate([sides, patterns])))
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
    """Corners at the stamp, without lag and rolling shutter, by the twist that they correct."""
    at = places.at.at_pixels(seen.corners_px - blur.shift)
    variances = seen.covariances.diagonal(axis1=-2, axis2=-1)
    deviation = np.sqrt(variances.mean(axis=(1, 2))) / frame.camera.focal_px
    # Corners that are inconsistent with a square get a larger covariance.
    doubted = seen.covariances + seen.doubt[:, None, None, None] * _EYE
    # Without a predicted twist, the first round measures one between two lagging frames, and the second must not again:
    # its corners are corrected for lag, those of the last frame are not.
    twist = known
    if frame.twist is not None or known is None:
        sure = np.ones(len(ids), dtype=bool)
        if frame.displayed:
            # What looks like a small marker may be another thing.
            sure = seen.evident | ~seen.by_pattern
        twist = track.correct(frame.stamp_ns, frame.twist, ids[sure], at.x[sure], places.depth[sure], deviation[sure])
    if twist is None:
        unsure = doubted + _of_unpredicted_motion(frame, places, seen, UNKNOWN_TWIST, cells)
        return RefinedMarkers(
            ids, seen, blur, replace(seen, covariances=unsure), Places(at, places.depth, places.flow), None
        )
    lag_blur = places.lag_blur(twist, frame.lag)
    rolling = rolling_displacement(places, twist, frame, (seen.corners_px + blur.removed)[..., 1])
    px = seen.corners_px - lag_blur + blur.removed - rolling
    unknown = of_motion_blur(frame.lag * places.flow, twist.covariance, lag_blur)
    if frame.twist is None:
        unknown = unknown + _of_unpredicted_motion(frame, places, seen, twist, cells)
    corners = replace(seen, corners_px=px, covariances=doubted + unknown)
    return RefinedMarkers(ids, seen, blur, corners, Places(at.at_pixels(px), places.depth, places.flow), twist)


def _of_unpredicted_motion(frame: Frame, places: Places, seen: RefinedCorners, twist: Twist, cells: int) -> FloatArray:
    """Covariances (N, 4, 2, 2) [px^2] by the motion in a frame without a predicted twist."""
    since = frame.lag - delays(seen.corners_px[..., 1], frame)
    unsharpness = seen.noise / np.maximum(np.abs(seen.contrast), TINY)
    cell = sides_px(seen.corners_px) / cells
    return unknown_motion(since[..., None, None] * places.flow, twist.covariance, unsharpness, cell)


def _motion_blur(frame: Frame, places: Places, twist: Twist | None) -> MotionBlur:
    """Motion blur of all markers; lag tails are removed if the largest displacement by lag is not small."""
    lag_blur = np.zeros_like(places.at.px) if twist is None else places.lag_blur(twist, frame.lag)
    mean, rolling = lag_blur.mean(axis=1), rolling_displacement(places, twist, frame)
    if twist is None or (lag_blur * lag_blur).sum(axis=-1).max() <= _HARDLY_PX**2:
        return MotionBlur(None, lag_blur + rolling, np.zeros_like(lag_blur), mean)
    # So far the velocity has carried the image since its lag tail was seen, as the read-out shows it.
    tail = places.lag_blur(twist, frame.lag, LAG_TAIL_AGE)
    if frame.readout > 0.0:
        tail = tail * stretch(places, twist, frame)[..., None]
    removed = (1.0 - REMAINING) * tail
    shift = lag_blur - removed + rolling
    return MotionBlur(lag_tail_maps(places.at.px + shift, tail), shift, removed, SPREAD * mean)


def refine_corners(
    image: Float32Array,
    corners: ImagePoints,
    camera: Camera,
    behind: Float32Array,
    blur_px: float,
    columns: int = _OF_CLEAR,
    motion: MotionBlur | None = None,
    passes: int = _PASSES,
    uneven: BoolArray | None = None,
) -> RefinedCorners:
    """Corners of N markers; those that have not converged are refined again, in so many passes at most.

    Parameters
    ----------
    image : (height, width) counts
    corners : (N, 4) initial values, accurate to two pixels or a third of a cell
    behind : (N, 4, m, 2) of :func:`thermal_fiducial.core.detection.corners.sides.edges_behind`
    blur_px : standard deviation of optics and pixel
    columns : of pixels, in a segment
    motion : blur by motion; none when left out
    uneven : (N,) whether a gradient of temperature displaces a side; so far of none when left out
    """
    motion = motion or MotionBlur.none(len(corners.px))
    uneven = np.zeros(len(corners.px), dtype=bool) if uneven is None else uneven
    # Where lag tails stay, the blur is so small that it hardly differs from one Gaussian.
    parts = ONE_GAUSSIAN if motion.to_tails is None else WITHOUT_TAIL
    widest = math.hypot(blur_px, math.sqrt(float((motion.spread * motion.spread).sum(axis=1).max())))
    sides = sides_of(corners.x, camera, image.shape, behind.shape[2], columns, widest)
    blur = blur_of(sides, blur_px, motion.spread, parts)
    counts = counts_of(sides.pixel, image, motion.to_tails)
    modelled = model(sides, behind, blur)
    if uneven.any():
        modelled[2][:] &= _near(sides, blur, uneven)
    segments, shows = with_gradients(measure(counts, modelled, REACHED * blur.width), sides, widest)
    refined, moving = _moved(sides, segments, as_squares(corners, *adjust(sides, segments)))
    if shows.any():
        moving, uneven = _again(moving, shows, uneven)
    if passes == 1 or len(moving) == 0:
        return refined
    start = corners.only(moving).at_pixels(refined.corners_px[moving])
    again = refine_corners(
        image, start, camera, behind[moving], blur_px, columns, motion.only(moving), passes - 1,
        uneven[moving],
    )  # fmt: skip
    return refined.with_others(moving, again)


def _again(moving: IntArray, shows: BoolArray, uneven: BoolArray) -> tuple[IntArray, BoolArray]:
    """Places (M,) of the markers to refine again, and which (N,) of all by near pixels.

    Only those that have converged with all pixels: from farther off near pixels pull towards another edge.
    """
    displaced = shows & ~uneven
    displaced[moving] = False
    return np.union1d(moving, np.flatnonzero(displaced)), uneven | displaced


def _near(sides: Sides, blur: Blur, uneven: BoolArray) -> BoolArray:
    """Which pixels (M, C, E, m) count: all, or those near the sides where markers (N,) are ``uneven``."""
    farthest = np.repeat(np.where(uneven, _WITH_GRADIENT, np.inf), 4)[:, None] * blur.width
    return np.asarray(np.abs(sides.distance) <= farthest.astype(np.float32))


def _moved(sides: Sides, segments: Segments, known: Squared) -> tuple[RefinedCorners, IntArray]:
    """Corners after one linearised adjustment, and places (M,) of the markers that have not converged."""
    # Corners that constrain one another have correlated errors: as independent ones they would claim too much.
    together = (8 / (8 - known.constrained))[:, None, None, None]
    blocks = known.covariance.reshape(-1, 4, 2, 4, 2).diagonal(axis1=1, axis2=3).transpose(0, 3, 1, 2)
    covariances = together * blocks + OF_ALL_SIDES_PX**2 * _EYE
    # In an outline that is inconsistent with a square, some side belongs to another object.
    doubt = known.doubt * (sides.along.reshape(-1, 4).sum(axis=1) / 4) ** 2
    good = segments.variance < UNMEASURED
    share = good / np.maximum(good.sum(axis=1), 1)[:, None]
    contrast, noise = (segments.contrast * share).sum(axis=1), np.sqrt((segments.noise * share).sum(axis=1))
    shift, deviation = known.moved.reshape(-1, 4, 2), np.sqrt(covariances.diagonal(axis1=2, axis2=3))
    least, most = _SETTLED_PX
    settled = np.minimum(np.maximum(_UNSURE * deviation, least), most)
    moving: BoolArray = np.asarray((np.abs(shift) > settled).any(axis=(1, 2)))
    # Corners that have not converged are known no better than by their last step.
    doubt = np.where(moving, np.maximum(doubt, (shift * shift).max(axis=(1, 2))), doubt)
    corners = sides.ends.reshape(-1, 8, 2).take(_CORNERS, axis=1) + shift
    # More passes would not make corners better that are displaced by their own contrast.
    uneven = OF_UNEVEN_CONTRAST_PX * segments.slope_of_contrast() / np.maximum(np.abs(contrast), TINY)
    covariances = covariances + (uneven * uneven)[:, None, None, None] * _EYE
    no = np.zeros(len(doubt), dtype=bool)
    return RefinedCorners(corners, covariances, contrast, noise, doubt, no, no, no), np.flatnonzero(moving)
