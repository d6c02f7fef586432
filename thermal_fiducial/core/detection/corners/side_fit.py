"""Fit of whole markers' sides, and the corners in which they meet.

Columns of whole pixels across the sides are fitted with the model of a blurred edge, segment by segment, on raw counts.
A robust adjustment of the four corners to all segments follows; both are repeated until the corners converge.
"""

import math

import numpy as np

from thermal_fiducial.core.detection.corner_errors import OF_ALL_SIDES_PX, OF_LAG_FORM
from thermal_fiducial.core.detection.corners.segments import (
    adjust,
    measure,
    REACHED,
    Segments,
    UNMEASURED,
    with_gradients,
)
from thermal_fiducial.core.detection.corners.sides import Blur, blur_of, model, ONE_GAUSSIAN, reaches, Sides, sides_of
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
# Distance from the sides [blurs] beyond which pixels do not count where a gradient of temperature displaces a side: it
# displaces it by as much less as pixels are nearer, and noise by a tenth more.
_WITH_GRADIENT = 4.0
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
    measured, displaced_px = _measured(counts, modelled, sides, blur, _outward(sides, blur, uneven), motion)
    segments, shows = with_gradients(measured, sides, widest)
    refined, moving = _moved(sides, segments, as_squares(corners, *adjust(sides, segments)), displaced_px)
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
    # Where corners have larger errors, those of this correction are not worth it.
    least = np.hypot(OF_ALL_SIDES_PX, OF_LAG_FORM * np.linalg.norm(motion.spread, axis=1))
    which = np.flatnonzero(displaced_px > least)
    if len(which):
        segments = freed_of_unevenness(segments, which, sides, outward, blur.width)
    return segments, displaced_px


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


def _outward(sides: Sides, blur: Blur, uneven: BoolArray) -> FloatArray:
    """Distance (E, m) outside the sides up to which pixels count [px]."""
    _, outward = reaches(sides, blur.width)
    farthest = np.where(np.repeat(uneven, 4)[:, None], _WITH_GRADIENT * blur.width, np.inf)
    return np.asarray(np.minimum(np.minimum(outward, farthest), np.abs(sides.distance[0]).mean(axis=0)))


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
