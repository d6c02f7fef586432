"""Fit of whole markers' sides, and the corners in which they meet.

Columns of whole pixels across the sides are fitted with the model of a blurred edge, segment by segment, on raw counts.
A robust adjustment of the four corners to all segments follows; both are repeated until the corners converge.
"""

import math

import numpy as np

from thermal_fiducial.core.detection.corner_errors import OF_ALL_SIDES_PX, OF_LAG_FORM
from thermal_fiducial.core.detection.corners.reach import ending_sides, Reach
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
from thermal_fiducial.core.detection.corners.uneven_contrast import freed_of_unevenness
from thermal_fiducial.core.detection.frame import counts_of, MotionBlur, WITHOUT_TAIL
from thermal_fiducial.core.detection.refined_corners import RefinedCorners
from thermal_fiducial.core.geometry.camera import Camera, ImagePoints
from thermal_fiducial.core.types import BoolArray, Float32Array, FloatArray, IntArray

#: Columns of pixels per cell for clear markers, and for faint ones.
OF_CLEAR, OF_FAINT = 6, 12
_EYE = np.eye(2)
# Indices of the corners, clockwise, among the ends of the sides.
_CORNERS = np.array([0, 1, 3, 2])
# Largest number of passes. A corner has converged when its last step is below _UNSURE of its standard deviations,
# clipped to the limits _SETTLED_PX [px].
_PASSES = 4
_SETTLED_PX, _UNSURE = (0.3, 1.0), 2.0


def refine_corners(
    image: Float32Array,
    corners: ImagePoints,
    camera: Camera,
    behind: Float32Array,
    blur_px: float,
    columns: int = OF_CLEAR,
    motion: MotionBlur | None = None,
    passes: int = _PASSES,
    reach: Reach | None = None,
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
    reach : which pixels count; all that the cells allow when left out
    """
    motion, reach = motion or MotionBlur.none(len(corners.px)), reach or Reach.everywhere(len(corners.px))
    # Where lag tails stay, the blur is so small that it hardly differs from one Gaussian.
    parts = ONE_GAUSSIAN if motion.to_tails is None else WITHOUT_TAIL
    widest = math.hypot(blur_px, float(np.hypot(*motion.spread.T).max()))
    sides = sides_of(corners.x, camera, image.shape, behind.shape[2], columns, widest)
    blur = blur_of(sides, blur_px, motion.spread, parts)
    counts = counts_of(sides.pixel, image, motion.to_tails)
    modelled = model(sides, behind, blur)
    reach.bound(modelled[2], sides)
    outward = reach.outward(sides, blur.width)
    measured, displaced_px = _measured(counts, modelled, sides, blur, outward, motion)
    segments, shows = with_gradients(measured, sides, widest)
    refined, moving = _moved(sides, segments, as_squares(corners, *adjust(sides, segments)), displaced_px)
    ending = ending_sides(counts, modelled, sides, measured, outward, blur.width, np.hypot(*motion.spread.T))
    # From farther off near pixels pull towards another edge, and another edge ends the surface.
    shows[moving] = False
    ending &= (np.abs(refined.corners_px - corners.px).max(axis=(1, 2)) < _SETTLED_PX[1])[:, None]
    fewer = np.flatnonzero((shows & ~reach.near) | ending.any(axis=1))
    if len(fewer):
        moving, reach = np.union1d(moving, fewer), reach.nearer(shows, ending, sides, blur)
    if passes == 1 or len(moving) == 0:
        return refined
    start = corners.only(moving).at_pixels(refined.corners_px[moving])
    again = refine_corners(
        image, start, camera, behind[moving], blur_px, columns, motion.only(moving), passes - 1, reach.only(moving)
    )
    return refined.with_others(moving, again)


def _measured(
    counts: Float32Array,
    modelled: tuple[Float32Array, Float32Array, BoolArray],
    sides: Sides,
    blur: Blur,
    outward: FloatArray,
    motion: MotionBlur,
) -> tuple[Segments, FloatArray]:
    """Segments of N markers as if their contrast were even, and what its slope may displace sides by (N,) [px]."""
    segments = measure(counts, modelled, REACHED * blur.width)
    displaced_px = segments.displaced_by_slopes()
    # Where sides have larger errors anyway, the correction is not worth its own.
    noise = np.median(segments.variance, axis=1) / sides.across.shape[1]
    form = OF_LAG_FORM**2 * (motion.spread * motion.spread).sum(axis=1)
    which = np.flatnonzero(displaced_px > np.sqrt(OF_ALL_SIDES_PX**2 + form + noise))
    if len(which):
        segments = freed_of_unevenness(segments, which, sides, outward, blur.width)
    return segments, displaced_px


def _moved(
    sides: Sides, segments: Segments, known: Squared, displaced_px: FloatArray
) -> tuple[RefinedCorners, IntArray]:
    """Corners after one linearised adjustment, and places (M,) of the markers that have not converged."""
    covariances = known.corner_covariances + OF_ALL_SIDES_PX**2 * _EYE
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
    covariances = covariances + (displaced_px * displaced_px)[:, None, None, None] * _EYE
    no = np.zeros(len(doubt), dtype=bool)
    return RefinedCorners(corners, covariances, contrast, noise, doubt, no, no, no), np.flatnonzero(moving)
