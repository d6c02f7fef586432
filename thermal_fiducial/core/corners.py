"""Sub-pixel corners: the sides of the markers located on raw counts.

Columns of whole pixels across the sides are compared with the model of a blurred edge, segment by segment; a robust
adjustment of the four corners to all segments of the marker follows, until the corners no longer move.
"""

from dataclasses import dataclass
import math

import numpy as np

from thermal_fiducial.core.adjustment import edges
from thermal_fiducial.core.adjustment.segments import adjust, counts_across, HOPELESS, measure, Memory
from thermal_fiducial.core.adjustment.sides import sides_of
from thermal_fiducial.core.camera import Camera, ImagePoints
from thermal_fiducial.core.types import BoolArray, Float32Array, FloatArray, IntArray

# Factors on the blur, pass by pass: a wide one catches, narrow ones measure, until the corners no longer move.
_PASSES = (1.4, 1.0, 1.0, 1.0, 1.0)
# Steps below which they are settled, and below which outlines that are no squares stay so.
_SETTLED_PX, _STILL_PX = 0.3, 0.1
# A linearised displacement is good for this many blurs.
_REACHED = 2.0
# Standard deviation of what is known of the corners beforehand, and of their places among themselves [px].
_PRIOR_PX, _PRIOR_SHAPE_PX = 3.0, 0.7
_PRIOR = np.eye(8) / _PRIOR_PX**2
_PRIOR_OF_SHAPE = np.linalg.inv(_PRIOR_SHAPE_PX**2 * np.eye(8) + _PRIOR_PX**2 * np.kron(np.ones((4, 4)), np.eye(2)))


@dataclass(frozen=True, slots=True)
class RefinedCorners:
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

    def only(self, keep: BoolArray | IntArray) -> 'RefinedCorners':
        """Those of the markers ``keep``."""
        return RefinedCorners(
            self.corners_px[keep], self.covariances[keep], self.contrast[keep], self.noise[keep], self.doubt[keep]
        )


def refine_corners(
    image: Float32Array,
    corners: ImagePoints,
    camera: Camera,
    behind: Float32Array,
    blur_px: float,
    smear_px: FloatArray | None = None,
    columns: int = 6,
    *,
    near: BoolArray | None = None,
    memory: Memory | None = None,
) -> RefinedCorners:
    """Corners of N markers, refined.

    Parameters
    ----------
    image : (height, width) counts
    corners : (N, 4) to within two pixels, or a third of a cell
    behind : (N, 4, m, 2) of :func:`thermal_fiducial.core.adjustment.edges.edges_behind`
    blur_px : standard deviation of optics and pixel
    smear_px : (N, 2) standard deviation of what motion adds to the blur, along its direction; none when left out
    columns : of pixels, in a segment
    near : (N,) which corners are good to a pixel already, so that nothing wide need catch them
    memory : what to take out of the image; nothing when left out
    """
    count = len(corners.px)
    px, covariances = corners.px.copy(), np.zeros((count, 4, 2, 2))
    contrast, noise, doubt = np.zeros(count), np.zeros(count), np.zeros(count)
    smear = np.zeros((count, 2)) if smear_px is None else smear_px
    away = np.ones(count, dtype=bool) if near is None else ~near
    for factor in _PASSES:
        active = np.flatnonzero(away)
        if len(active) == 0:
            away[:] = factor > 1.0
            continue
        start = corners if len(active) == count else corners.only(active)
        so_far = px[active] - start.px
        if so_far.any():
            start = start.moved(so_far, camera)
        prior = _PRIOR_OF_SHAPE if factor > 1.0 else _PRIOR
        shift, *rest = _pass(
            image,
            start,
            camera,
            behind[active],
            factor * blur_px,
            smear[active],
            prior,
            columns,
            None if memory is None else memory.only(active),
        )
        px[active] = start.px + shift
        covariances[active], contrast[active], noise[active], doubt[active] = rest
        step = np.abs(shift).max(axis=(1, 2))
        away[active] = step > np.where(doubt[active] > 0.0, _STILL_PX, _SETTLED_PX)
        away |= factor > 1.0
    return RefinedCorners(px, covariances, contrast, noise, doubt)


def _pass(
    image: Float32Array,
    start: ImagePoints,
    camera: Camera,
    behind: Float32Array,
    optics: float,
    smear: FloatArray,
    prior: FloatArray,
    columns: int,
    memory: Memory | None,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """One linearised adjustment: shifts (N, 4, 2), then covariances, contrasts, noise and doubts of RefinedCorners."""
    cells = behind.shape[2]
    widest = math.hypot(optics, math.sqrt(float(np.sum(smear * smear, axis=1).max())))
    half = min(max(math.ceil(2.5 * widest + 1.0), 4), 10)
    sides = sides_of(start.x, camera, image.shape, cells * columns, half)
    blur = edges.blurs(sides.normal[:, cells * columns // 2], optics, smear)
    counts = counts_across(image, sides, memory)
    segments = measure(counts, edges.model(sides, behind, blur), cells, _REACHED * blur[0])
    moved, covariances, doubt = adjust(sides, segments, prior, start)
    good = segments.variance < HOPELESS
    noise = np.sqrt(_mean_where(segments.noise, good))
    return moved, covariances, _mean_where(segments.contrast, good), noise, doubt


def _mean_where(values: FloatArray, good: BoolArray) -> FloatArray:
    return np.asarray(np.sum(values * good, axis=1) / np.maximum(np.count_nonzero(good, axis=1), 1))
