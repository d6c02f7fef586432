"""Sub-pixel corners: the sides of the markers located on raw counts.

Columns of whole pixels across the sides are compared with the model of a blurred edge, segment by segment; a robust
adjustment of the four corners to all segments of the marker follows, until the corners no longer move.
"""

from dataclasses import dataclass
import math

import numpy as np

from thermal_fiducial.core.detection.corners.segments import adjust, HOPELESS, measure, REACHED
from thermal_fiducial.core.detection.corners.sides import blurs, half_width, model, sides_of
from thermal_fiducial.core.geometry.camera import Camera, ImagePoints
from thermal_fiducial.core.types import BoolArray, Float32Array, FloatArray, Stacked

# Passes follow one another until the last step was short enough [px]: at best, at worst, between in deviations of it.
_PASSES = 4
_SETTLED_PX, _UNSURE = (0.3, 1.0), 2.0
# Standard deviation of what is known of the corners beforehand [px].
_PRIOR_PX = 3.0


@dataclass(frozen=True, slots=True)
class RefinedCorners(Stacked):
    """Corners of N markers.

    Parameters
    ----------
    corners_px : (N, 4, 2)
    covariances : (N, 4, 2, 2) [px^2]
    contrast : (N,) white minus black [counts]
    noise : (N,) standard deviation of a pixel about the model [counts]
    doubt : (N,) variance of corners that make no square, zero where they do [px^2]; not in the covariances
    """

    corners_px: FloatArray
    covariances: FloatArray
    contrast: FloatArray
    noise: FloatArray
    doubt: FloatArray

    @staticmethod
    def none() -> 'RefinedCorners':
        """No corners."""
        no = np.zeros(0)
        return RefinedCorners(np.zeros((0, 4, 2)), np.zeros((0, 4, 2, 2)), no, no, no)


def refine_corners(
    image: Float32Array,
    corners: ImagePoints,
    camera: Camera,
    behind: Float32Array,
    blur_px: float,
    lag_blur_px: FloatArray | None = None,
    columns: int = 6,
    to_tails: FloatArray | None = None,
) -> RefinedCorners:
    """Corners of N markers, refined.

    Parameters
    ----------
    image : (height, width) counts
    corners : (N, 4) to within two pixels, or a third of a cell
    behind : (N, 4, m, 2) of :func:`thermal_fiducial.core.detection.corners.sides.edges_behind`
    blur_px : standard deviation of optics and pixel
    lag_blur_px : (N, 2) standard deviation of what motion adds to the blur, along its direction; none when left out
    columns : of pixels, in a segment
    to_tails : (N, 2, 3) maps of pixels to lag tails that are to be taken out; none when left out
    """
    lag_blur = np.zeros((len(corners.px), 2)) if lag_blur_px is None else lag_blur_px
    found, moving = _pass(image, corners, camera, behind, blur_px, lag_blur, columns, to_tails)
    which = np.arange(len(moving))
    for _ in range(_PASSES - 1):
        which = which[moving]
        if len(which) == 0:
            break
        tails = None if to_tails is None else to_tails[which]
        start = corners.only(which).moved(found.corners_px[which] - corners.px[which], camera)
        again, moving = _pass(image, start, camera, behind[which], blur_px, lag_blur[which], columns, tails)
        found = found.with_others(which, again)
    return found


def _pass(
    image: Float32Array,
    start: ImagePoints,
    camera: Camera,
    behind: Float32Array,
    blur_px: float,
    lag_blur: FloatArray,
    columns: int,
    to_tails: FloatArray | None,
) -> tuple[RefinedCorners, BoolArray]:
    """Where one linearised adjustment moves the corners, and for which markers (N,) that was not the last."""
    cells = behind.shape[2]
    half = half_width(math.hypot(blur_px, math.sqrt(float((lag_blur * lag_blur).sum(axis=1).max()))))
    sides = sides_of(start.x, camera, image.shape, cells, columns, half)
    blur = blurs(sides.normal[cells // 2], blur_px, lag_blur)
    segments = measure(sides.counts(image, to_tails), model(sides, behind, blur), REACHED * blur[0])
    shift, covariances, doubt = adjust(sides, segments, _PRIOR_PX, start)
    good = segments.variance < HOPELESS
    share = good / np.maximum(good.sum(axis=1), 1)[:, None]
    contrast, noise = (segments.contrast * share).sum(axis=1), np.sqrt((segments.noise * share).sum(axis=1))
    deviation = np.sqrt(covariances.diagonal(axis1=2, axis2=3))
    moving: BoolArray = np.asarray((np.abs(shift) > np.clip(_UNSURE * deviation, *_SETTLED_PX)).any(axis=(1, 2)))
    return RefinedCorners(start.px + shift, covariances, contrast, noise, doubt), moving
