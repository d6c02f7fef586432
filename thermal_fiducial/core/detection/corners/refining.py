"""Sub-pixel refinement of corners in frames that are blurred by motion and bolometer lag.

The camera's twist gives the motion blur of each marker. Where it is large, the lag tail is removed around the marker
(see :mod:`prediction.frame`); the edge model contains the blur that remains, and the known displacement by lag is
subtracted from the corners. The corners then correct the twist; if that changes the blur much, the refinement is
repeated.

Corners are those of the fitted sides (:mod:`side_fit`), or of the whole pattern where cells are narrow for their blur,
and in pictures for a display (:mod:`pattern_fit`). A gain control for displays is a nonlinear function of the counts:
all dark regions grow, or all shrink, and only the whole pattern shows by how much. Before lag tails are removed, it is
undone as far as it is known (:mod:`gray_scale`); the markers then show it better, and if that changes it much, the
refinement is repeated as well. Pixels that are as black or as white as it goes have no counts, only bounds of these
(:class:`prediction.frame.Saturation`).
"""

from dataclasses import dataclass, replace

import numpy as np

from thermal_fiducial.core.detection.corners.blurred_patterns import lens_bends, PatternView
from thermal_fiducial.core.detection.corners.corner_errors import of_motion_blur, RefinedCorners, unknown_motion
from thermal_fiducial.core.detection.corners.gray_scale import GrayScale
from thermal_fiducial.core.detection.corners.pattern_fit import fitted_patterns, nearness
from thermal_fiducial.core.detection.corners.side_fit import (
    OF_CLEAR,
    OF_FAINT,
    PASSES,
    refine_corners,
    too_blurred_for_sides,
)
from thermal_fiducial.core.detection.patterns import Decoder
from thermal_fiducial.core.detection.prediction.frame import (
    delays,
    Frame,
    motion_blur,
    MotionBlur,
    Places,
    rolling_displacement,
)
from thermal_fiducial.core.detection.prediction.known_markers import FoundMarkers
from thermal_fiducial.core.detection.prediction.tracking import MeasuredCorners, MotionTrack
from thermal_fiducial.core.detection.prediction.twist import Twist, UNKNOWN_TWIST
from thermal_fiducial.core.geometry.camera import ImagePoints
from thermal_fiducial.core.geometry.reprojection import sides_px
from thermal_fiducial.core.types import BoolArray, FloatArray, IntArray, Stacked, TINY

#: Contrast-to-noise ratio above which a marker is clear: it is found at full and at half resolution.
CLEAR_CNR = 20.0
# Change of the displacement by lag below which the refinement is not repeated [px].
_BLUR_THAT_MATTERS_PX = 0.4
# Number of refinements, and of those where a gray scale is to be found as well: with 2, markers of 40 px behind a
# plateau equalisation that was not known before are 0.13 instead of 0.06 px off.
_ROUNDS, _ROUNDS_ON_DISPLAYS = 2, 4
# Number of markers that show the gray scale: corners are as good as by all of eight, with three up to a tenth worse.
_SHOW_SCALE = 4
_EYE = np.eye(2)


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
    #: places of the corners, from which the next frame's motion is measured
    places: Places
    #: of the camera, corrected by the corners
    twist: Twist | None


def refine(
    frame: Frame, found: FoundMarkers, track: MotionTrack, gray_scale: GrayScale, decoder: Decoder
) -> tuple[RefinedMarkers, GrayScale]:
    """Corners of N markers, and the gray scale of the display as it is known then.

    Parameters
    ----------
    track : motion and markers of the last frame, which with the corners give the twist
    gray_scale : of the display, as far as it is known; counts have none
    decoder : of the dictionary
    """
    if len(found.ids) == 0:
        corners = RefinedCorners.none()
        return RefinedMarkers(found.ids, corners, MotionBlur.none(0), corners, found.places, frame.twist), gray_scale
    clear = np.abs(found.cnr).min() > CLEAR_CNR
    columns = OF_CLEAR if clear else OF_FAINT
    twist, places, of_last = frame.twist, found.places, gray_scale
    # Markers whose places are accurate to a pixel or two, no better.
    rough = ~found.certain
    for _ in range(_ROUNDS_ON_DISPLAYS if frame.displayed else _ROUNDS):
        blur, before = motion_blur(frame, places, twist), gray_scale
        start = places.points.at_pixels(places.points.px + blur.shift)
        bent = frame.displayed and blur.to_tails is not None
        in_counts = frame.in_counts(gray_scale.counts) if bent else frame
        refined = _measured(in_counts, found, start, blur, columns, decoder, rough)
        markers = _at_stamp(frame, found.ids, places, blur, refined, twist, track, decoder.cells)
        if bent:
            gray_scale = _estimated_scale(frame, gray_scale, markers, start, decoder)
        change = np.abs(markers.corners.corners_px - refined.corners_px + blur.shift)
        settled = change.max(initial=0.0) < _BLUR_THAT_MATTERS_PX and not (bent and gray_scale.differs(before))
        if markers.twist is None or settled:
            break
        twist, places, rough = markers.twist, markers.places, np.zeros_like(rough)
    if bent:
        gray_scale = gray_scale._replace(settled=not gray_scale.differs(of_last))
    return markers, gray_scale


def _estimated_scale(
    frame: Frame, before: GrayScale, markers: RefinedMarkers, start: ImagePoints, decoder: Decoder
) -> GrayScale:
    """The gray scale of the display that markers show, which were looked for at ``start`` (N, 4)."""
    number = len(markers.ids)
    if number > _SHOW_SCALE:
        which = np.linspace(0, number - 1, _SHOW_SCALE).round().astype(np.int64)
        markers, start = markers.only(which), start.only(which)
    bends = lens_bends(start, frame.camera)
    view = PatternView(frame.image, lag=markers.blur.lag, bends=bends, saturation=frame.saturation)
    corners = markers.observed.corners_px + markers.blur.removed
    return before.estimated_by(view, corners, markers.ids, decoder, frame.blur_px)


def _measured(
    frame: Frame,
    found: FoundMarkers,
    start: ImagePoints,
    blur: MotionBlur,
    columns: int,
    decoder: Decoder,
    rough: BoolArray,
) -> RefinedCorners:
    """Corners of N markers in the image: by their sides, or by their whole patterns.

    ``rough`` (N,): whether ``start`` (N, 4) is accurate to a pixel or two, else to a tenth of a cell.
    """
    whole = too_blurred_for_sides(start.px, decoder.cells, frame.blur_px, blur)
    if frame.displayed:
        # All are fitted as patterns: sides are where fits begin, and that is known of the others.
        whole |= ~rough
    if whole.all():
        return _by_patterns(frame, found, start, blur, decoder)
    corners, of_sides = (start.only(~whole), blur.only(~whole)) if whole.any() else (start, blur)
    # On displays sides are where fits of patterns begin.
    passes = 1 if frame.displayed else PASSES
    image = frame.pixels if blur.to_tails is None else frame.image
    refined = refine_corners(image, corners, frame.camera, decoder.cells, frame.blur_px, columns, of_sides, passes)
    if frame.displayed:
        # Fits of large patterns do not converge from corners that are off by half a cell.
        px = start.px.copy()
        px[~whole] = refined.corners_px
        return _by_patterns(frame, found, start.at_pixels(px), blur, decoder)
    if not whole.any():
        return refined
    fitted = _by_patterns(frame, found.only(whole), start.only(whole), blur.only(whole), decoder)
    return refined.joined(fitted).only(_original_order(whole))


def _by_patterns(
    frame: Frame, found: FoundMarkers, start: ImagePoints, blur: MotionBlur, decoder: Decoder
) -> RefinedCorners:
    """Corners of N markers by their whole patterns."""
    near = nearness(start.px, decoder.cells, np.hypot(frame.blur_px, blur.spread_px))
    groups = np.unique(near).tolist()
    if len(groups) == 1:
        return _sampled_alike(frame, found, start, blur, groups[0], decoder)
    refined = RefinedCorners.none()
    for nearer in groups:
        which = near == nearer
        group = found.only(which), start.only(which), blur.only(which)
        refined = refined.joined(_sampled_alike(frame, *group, nearer, decoder))
    return refined.only(_original_order(near))


def _sampled_alike(
    frame: Frame, found: FoundMarkers, start: ImagePoints, blur: MotionBlur, nearer: int, decoder: Decoder
) -> RefinedCorners:
    """Corners of N markers by their whole patterns, which are sampled as ``nearer`` of :func:`nearness` says."""
    # At rest the model of a bent gray scale contains its ends.
    saturation = None if blur.to_tails is None else frame.saturation
    bends = lens_bends(start, frame.camera)
    view = PatternView(frame.image, blur.to_tails, blur.spread, None, frame.displayed, bends, saturation)
    return fitted_patterns(frame, found, start, blur.rolling, view, nearer, decoder)


def _original_order(groups: BoolArray | IntArray) -> IntArray:
    """Where each of N items of some ``groups`` (N,) is in a batch that has these one after the other, (N,)."""
    return np.argsort(np.argsort(groups, kind='stable'))


def _at_stamp(
    frame: Frame,
    ids: IntArray,
    places: Places,
    blur: MotionBlur,
    refined: RefinedCorners,
    known: Twist | None,
    track: MotionTrack,
    cells: int,
) -> RefinedMarkers:
    """Corners at the stamp, without lag and rolling shutter, by the twist that they correct."""
    at = places.points.at_pixels(refined.corners_px - blur.shift)
    deviation = np.sqrt(refined.mean_variance) / frame.camera.focal_px
    # Without a predicted twist, the first round measures one between two lagging frames, and the second must not again:
    # its corners are corrected for lag, those of the last frame are not.
    twist = known
    if frame.twist is not None or known is None:
        measured = MeasuredCorners(ids, at.x, places.depth, deviation)
        twist = track.correct(frame.stamp_ns, frame.twist, measured)
    rows = (refined.corners_px + blur.removed)[..., 1]
    lag_blur, rolling = places.lag_blur(twist, frame.lag), rolling_displacement(places, twist, frame, rows)
    px = refined.corners_px - lag_blur + blur.removed - rolling
    # Corners that are inconsistent with a square get a larger covariance.
    doubted = refined.covariances + refined.doubt[:, None, None, None] * _EYE
    if twist is None:
        unknown = _of_unpredicted_motion(frame, places, refined, UNKNOWN_TWIST, cells)
    else:
        unknown = of_motion_blur(frame.lag * places.flow, twist.covariance, lag_blur, displayed=frame.displayed)
        if frame.twist is None:
            unknown = unknown + _of_unpredicted_motion(frame, places, refined, twist, cells)
        elif frame.readout != 0.0:
            # By a wrong twist rows are displaced the more, the farther they are from the middle one.
            by_twist = delays(rows, frame)[..., None, None] * places.flow
            unknown = unknown + by_twist @ twist.covariance @ by_twist.swapaxes(-1, -2)
    corners = replace(refined, corners_px=px, covariances=doubted + unknown)
    return RefinedMarkers(ids, refined, blur, corners, Places(at.at_pixels(px), places.depth, places.flow), twist)


def _of_unpredicted_motion(
    frame: Frame, places: Places, refined: RefinedCorners, twist: Twist, cells: int
) -> FloatArray:
    """Covariances (N, 4, 2, 2) [px^2] by the motion in a frame without a predicted twist."""
    since = frame.lag - delays(refined.corners_px[..., 1], frame)
    unsharpness = refined.noise / np.maximum(np.abs(refined.contrast), TINY)
    cell = sides_px(refined.corners_px) / cells
    return unknown_motion(since[..., None, None] * places.flow, twist.covariance, unsharpness, cell)
