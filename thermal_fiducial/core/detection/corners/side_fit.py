"""Fit of whole markers' sides, where these can be measured by themselves, and the corners in which they meet.

Columns of whole pixels across the sides are fitted with the model of a blurred edge, segment by segment, on raw counts.
A robust adjustment of the four corners to all segments follows; both are repeated until the corners converge.
"""

import math

import numpy as np

from thermal_fiducial.core.detection.corners.corner_errors import OF_ALL_SIDES_PX, OF_LAG_FORM, RefinedCorners
from thermal_fiducial.core.detection.corners.segments import (
    adjust,
    measure,
    median_of,
    REACHED,
    Segments,
    UNMEASURED,
    with_gradients,
)
from thermal_fiducial.core.detection.corners.sides import (
    Blur,
    blur_of,
    EdgeModel,
    free_distance,
    model,
    Sides,
    sides_of,
)
from thermal_fiducial.core.detection.corners.squares import as_squares, Squared
from thermal_fiducial.core.detection.corners.warm_surface import ending_sides, freed_of_unevenness, shortened_reach
from thermal_fiducial.core.detection.prediction.frame import counts_of, MotionBlur
from thermal_fiducial.core.geometry.camera import Camera, ImagePoints
from thermal_fiducial.core.geometry.reprojection import widths
from thermal_fiducial.core.types import BoolArray, Float32Array, FloatArray, IntArray, Pixels

#: Columns of pixels per cell for clear markers, and for faint ones.
OF_CLEAR, OF_FAINT = 6, 12
_EYE = np.eye(2)
# Indices of the corners, clockwise, among the ends of the sides.
_CORNERS = np.array([0, 1, 3, 2])
#: Largest number of passes.
PASSES = 4
# A corner has converged when its last step is below _UNSURE of its standard deviations, clipped to the limits
# _SETTLED_PX [px].
_SETTLED_PX, _UNSURE = (0.3, 1.0), 2.0
# Width of cells, in blurs of the optics, below which whole patterns are fitted: at 7 a frame of 45 markers would take
# twice the time.
_NARROW = 6.0
# The same in blurs of optics and motion together: at 6 a fast frame takes a third longer, and a wrong time constant of
# the bolometers displaces corners more.
_NARROW_IN_MOTION = 4.5


def too_small_for_sides(corners_px: FloatArray, cells: int, blur_px: float) -> BoolArray:
    """Which markers (N, 4, 2) have sides that are not measured by themselves, for a blur of the optics [px].

    Of a marker that is turned away the cells are narrow along one direction only, and that is what counts.
    """
    return np.asarray(widths(corners_px) < _NARROW * blur_px * cells)


def too_blurred_for_sides(corners_px: FloatArray, cells: int, blur_px: float, motion: MotionBlur) -> BoolArray:
    """Which markers (N, 4, 2) have sides that are not measured by themselves, for their size or for motion blur."""
    blurs_px = np.hypot(blur_px, motion.spread_px)
    return np.asarray(widths(corners_px) < np.maximum(_NARROW * blur_px, _NARROW_IN_MOTION * blurs_px) * cells)


def refine_corners(
    image: Pixels,
    corners: ImagePoints,
    camera: Camera,
    cells: int,
    blur_px: float,
    columns: int = OF_CLEAR,
    motion: MotionBlur | None = None,
    passes: int = PASSES,
    reach: FloatArray | None = None,
) -> RefinedCorners:
    """Corners of N markers; those that have not converged are refined again, in so many passes at most.

    Parameters
    ----------
    image : (height, width) counts
    corners : (N, 4) initial values, accurate to two pixels or a third of a cell
    cells : m along a side
    blur_px : standard deviation of optics and pixel
    columns : of pixels, in a segment
    motion : blur by motion; none when left out
    reach : (N, 2, 4) how far inside and outside the sides pixels count [px]; when left out, as far as cells allow
    """
    motion = motion or MotionBlur.none(len(corners.px))
    motion_px = motion.spread_px
    widest = math.hypot(blur_px, motion_px.max())
    sides = sides_of(corners.x, camera, image.shape, cells, columns, widest)
    blur = blur_of(sides, blur_px, motion.spread)
    counts = counts_of(sides.pixel, image, motion.to_tails)
    reach = np.full((len(corners.px), 2, 4), np.inf) if reach is None else reach
    free = free_distance(sides, blur.across)
    inside, outside = (np.minimum(free, reach[:, part].reshape(-1, 1)) for part in (0, 1))
    modelled = model(sides, blur, inside, outside)
    # No farther than columns reach.
    outward = np.minimum(outside, (len(sides.distance) // 2) * np.abs(sides.normal).max(axis=2))
    measured, displaced_px = _with_even_contrast(counts, modelled, sides, blur, outward, motion_px)
    segments, gradient_shows = with_gradients(measured, sides, widest)
    square = as_squares(corners.at_pixels(corners.px - motion.rolling), *adjust(sides, segments))
    refined, moving = _adjusted(sides, segments, square, displaced_px)
    if passes == 1:
        return refined
    ending = ending_sides(counts, modelled, sides, measured, outward, blur.across, motion_px)
    shifts = refined.corners_px - corners.px
    which, reach = _to_repeat(moving, gradient_shows, ending, shifts, reach, outward, blur.across)
    if len(which) == 0:
        return refined
    start = corners.only(which).at_pixels(refined.corners_px[which])
    again = refine_corners(image, start, camera, cells, blur_px, columns, motion.only(which), passes - 1, reach[which])
    refined.put(which, again)
    return refined


def _to_repeat(
    moving: BoolArray,
    gradient_shows: BoolArray,
    ending: BoolArray,
    shifts: FloatArray,
    reach: FloatArray,
    outward: FloatArray,
    width: FloatArray,
) -> tuple[IntArray, FloatArray]:
    """Places (M,) of those of N markers that are to be refined again, and the reach of all.

    Where corners are still far off, the reach stays: near pixels would pull them towards another edge, and another
    edge would look like the end of the surface.

    Parameters
    ----------
    moving, gradient_shows, ending : of :func:`_adjusted`, :func:`with_gradients` and :func:`ending_sides`
    shifts : (N, 4, 2) displacement of the corners [px]
    outward, width : of :func:`ending_sides`
    """
    gradient_shows = gradient_shows & ~moving
    if ending.any():
        ending = ending & (np.abs(shifts).max(axis=(1, 2)) < _SETTLED_PX[1])[:, None]
    if gradient_shows.any() or ending.any():
        is_near = np.isfinite(reach[:, 0]).any(axis=1)
        moving = moving | (gradient_shows & ~is_near) | ending.any(axis=1)
        reach = shortened_reach(reach, gradient_shows, ending, outward, width)
    return moving.nonzero()[0], reach


def _with_even_contrast(
    counts: Float32Array,
    modelled: EdgeModel,
    sides: Sides,
    blur: Blur,
    outward: FloatArray,
    motion_px: FloatArray,
) -> tuple[Segments, FloatArray]:
    """Segments of N markers as if their contrast were even, and what its slope may displace sides by (N,) [px]."""
    segments = measure(counts, modelled, REACHED * blur.across)
    displaced_px = segments.displaced_by_slopes()
    # Where sides have larger errors anyway, the correction is not worth its own.
    used = segments.variance < UNMEASURED
    noise = median_of(segments.variance, used)[:, 0] / sides.across.shape[1]
    which = displaced_px**2 > OF_ALL_SIDES_PX**2 + (OF_LAG_FORM * motion_px) ** 2 + noise
    if which.any():
        segments = freed_of_unevenness(segments, used & which[:, None], sides, outward, blur.across)
    return segments, displaced_px


def _adjusted(
    sides: Sides, segments: Segments, square: Squared, displaced_px: FloatArray
) -> tuple[RefinedCorners, BoolArray]:
    """Corners after one linearised adjustment, and which of the markers (N,) have not converged."""
    covariances = square.corner_covariances + OF_ALL_SIDES_PX**2 * _EYE
    # In an outline that is inconsistent with a square, some side belongs to another object.
    doubt = square.doubt * (sides.along.reshape(-1, 4).sum(axis=1) / 4) ** 2
    good = segments.variance < UNMEASURED
    share = good / np.maximum(good.sum(axis=1), 1)[:, None]
    contrast, noise = (segments.contrast * share).sum(axis=1), np.sqrt((segments.noise * share).sum(axis=1))
    shift, deviation = square.moved.reshape(-1, 4, 2), np.sqrt(covariances.diagonal(axis1=2, axis2=3))
    least, most = _SETTLED_PX
    settled = np.minimum(np.maximum(_UNSURE * deviation, least), most)
    moving: BoolArray = np.asarray((np.abs(shift) > settled).any(axis=(1, 2)))
    # Corners that have not converged are known no better than by their last step.
    doubt = np.where(moving, np.maximum(doubt, (shift * shift).max(axis=(1, 2))), doubt)
    corners = sides.ends.reshape(-1, 8, 2).take(_CORNERS, axis=1) + shift
    # More passes would not make corners better that are displaced by their own contrast.
    covariances = covariances + (displaced_px * displaced_px)[:, None, None, None] * _EYE
    return RefinedCorners.by_edges(corners, covariances, contrast, noise, doubt), moving
