"""Candidates for markers: quadrilaterals among the outlines of regions darker than their surroundings.

The threshold is a share of the local standard deviation, so that markers of any contrast are found. Below a floor of
the order of the noise it rises again: a marker of twice the noise is still segmented, a bare wall hardly at all. It is
estimated by mean absolute deviations, none of which counts for more than a marker's: of squares, or without that bound,
a flame or a lamp beside a marker would be nearly all.
"""

import math
from typing import Any, NamedTuple, TypeAlias

import cv2
import numpy as np

from thermal_fiducial.core.geometry.reprojection import grown, squared_sides
from thermal_fiducial.core.types import Float32Array, FloatArray, Gray, TINY

# Window of the local standard deviation, at a quarter of the resolution: 68 px, a marker at working distance.
_LOCAL = 17
_WINDOW = np.ones((_LOCAL, _LOCAL), dtype=np.uint8)
# Odd width of the median before the background is taken, the largest that OpenCV has for floating-point numbers.
_MEDIAN = 5
# Share of the range within which the background is about its mean: two standard deviations of the noise.
_NO_EDGE = 0.1
# Standard deviation over mean absolute deviation, of a Gaussian.
_STD_OF_MEAN = math.sqrt(0.5 * math.pi)
# Odd width of the median filter that removes specks.
_SPECKS = 3
# In a picture for a display: odd width of the surroundings, no wider than the white around the smallest markers; least
# difference of a dark pixel from their mean [gray levels] and [standard deviations of the noise].
_PICTURE_WINDOW_PX, _PICTURE_STEP, _PICTURE_NOISE = 5, 3.0, 2.0
# The eight pixels around one.
_NEIGHBOURS = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], dtype=np.uint8)
# Where all markers have a high contrast: floor of the local standard deviation, largest deviation that counts for it
# [standard deviations of the noise].
_FLOOR_OF_CLEAR, _MOST_OF_CLEAR = 4.0, 300.0
# Tolerance of polygon approximation as a share of an outline's length: above the effect of noise, below a side.
_STRAIGHT = 0.05
_CORNERS = 4
# Image as OpenCV's functions are typed.
_Image: TypeAlias = np.ndarray[Any, Any]


def halved(counts: Float32Array) -> Float32Array:
    """Half the resolution: means of 2 x 2 pixels, with half the noise; without the last of odd rows and columns."""
    height, width = counts.shape
    return _smaller(counts[: height // 2 * 2, : width // 2 * 2])


def _smaller(counts: Float32Array) -> Float32Array:
    """The whole image at about half the resolution: of odd sizes the places of pixels are stretched."""
    height, width = counts.shape[0] // 2, counts.shape[1] // 2
    return np.asarray(cv2.resize(counts, (width, height), interpolation=cv2.INTER_AREA), dtype=np.float32)


def halfway(places: FloatArray) -> FloatArray:
    """Places (..., 2) in pixels of half the resolution."""
    return 0.5 * (places - 0.5)


class Segmentation(NamedTuple):
    """Parameters of the segmentation at one resolution."""

    #: standard deviation of the Gaussian before the search [px]
    smoothing_px: float
    #: odd width of the surroundings, and by how much lower the resolution is at which their mean is taken
    window_px: int
    window_shrink: int
    #: least difference from the mean of the surroundings, in local standard deviations
    depth: float
    #: local standard deviation below which the threshold rises again, in standard deviations of the pixel noise
    floor: float
    #: largest deviation that counts for the local standard deviation, in standard deviations of the pixel noise
    most: float


class DarkRegions:
    """Masks of what is darker than its surroundings, at one resolution.

    The images of a frame are kept for the next one: fresh memory takes as long as what is computed in it.
    """

    def __init__(self, segmentation: Segmentation) -> None:
        self._segmentation = segmentation
        self._smooth: _Image | None = None
        self._limit: _Image | None = None
        self._mask: _Image | None = None

    def mask(self, counts: Float32Array, noise: float, *, clear: bool) -> Gray:
        """Mask (height, width), 255 where ``counts`` are darker than their surroundings; the next one overwrites it.

        Parameters
        ----------
        counts : (height, width) counts or gray levels
        noise : standard deviation of the noise of a pixel [counts]
        clear : whether all markers have a high contrast: less noise is followed then, and faint markers are missed
        """
        segmentation, size = self._segmentation, counts.shape[::-1]
        reach = 2 * round(2.5 * segmentation.smoothing_px) + 1
        self._smooth = cv2.GaussianBlur(counts, (reach, reach), segmentation.smoothing_px, dst=self._smooth)
        coarse = counts if segmentation.window_shrink == 1 else _smaller(counts)
        window = segmentation.window_px, segmentation.window_px
        limit = cv2.blur(self._smooth if segmentation.window_shrink == 1 else coarse, window)
        small = _smaller(coarse)
        most = (_MOST_OF_CLEAR if clear else segmentation.most) * noise
        deviation = np.minimum(cv2.absdiff(small, cv2.blur(small, (_LOCAL, _LOCAL))), most)
        spread = np.maximum(_STD_OF_MEAN * cv2.blur(deviation, (_LOCAL, _LOCAL)), TINY)
        floor = (_FLOOR_OF_CLEAR if clear else segmentation.floor) * noise
        asked = segmentation.depth * (spread + floor * floor / spread)
        cv2.subtract(limit, cv2.resize(asked, limit.shape[::-1], interpolation=cv2.INTER_LINEAR), dst=limit)
        if limit.shape != counts.shape:
            limit = self._limit = cv2.resize(limit, size, dst=self._limit, interpolation=cv2.INTER_LINEAR)
        self._mask = cv2.compare(self._smooth, limit, cv2.CMP_LT, dst=self._mask)
        # Specks of noise are many, and each is an outline to follow.
        return np.asarray(cv2.medianBlur(self._mask, _SPECKS, dst=self._mask))


def about_background(counts: Float32Array, most: float) -> Float32Array:
    """Deviations of ``counts`` (height, width) from the background, clipped at ``most``.

    The background is what is larger than a window: an opening and closing follows the edges of a panel or of the sky,
    and leaves out flames and markers (J. Serra, "Image Analysis and Mathematical Morphology", 1982). It has the least
    and the most of the noise, so that a median is taken before, and the mean where it has no such edge.
    """
    opened = cv2.morphologyEx(cv2.medianBlur(_smaller(counts), _MEDIAN), cv2.MORPH_OPEN, _WINDOW)
    background = cv2.morphologyEx(opened, cv2.MORPH_CLOSE, _WINDOW)
    mean = cv2.blur(background, (_LOCAL, _LOCAL))
    background = np.where(cv2.absdiff(background, mean) < _NO_EDGE * most, mean, background)
    deviation = counts - cv2.resize(background, counts.shape[::-1], interpolation=cv2.INTER_LINEAR)
    return np.asarray(np.clip(deviation, -most, most, out=deviation))


def dark_in_picture(picture: Float32Array, noise: float) -> Gray:
    """Dark pixels of a picture for a display, which has little noise: markers of cells of a pixel show in it."""
    mean = np.asarray(cv2.blur(picture, (_PICTURE_WINDOW_PX, _PICTURE_WINDOW_PX)), dtype=np.float32)
    limit = mean - np.float32(max(_PICTURE_STEP, _PICTURE_NOISE * noise))
    return np.asarray(cv2.compare(picture, limit, cv2.CMP_LT), dtype=np.uint8)


def without_single_pixels(mask: Gray) -> Gray:
    """A mask without what is no marker, but thousands of outlines to follow: pixels without neighbours in it."""
    return np.bitwise_and(mask, cv2.dilate(mask, _NEIGHBOURS), dtype=np.uint8)


def find_quads(mask: Gray, min_side_px: float, hidden: FloatArray, edge_px: float = 0.0) -> FloatArray:
    """Convex quadrilaterals (Q, 4, 2) [px], clockwise, among the outlines in a mask, of its spots and of its holes.

    Parameters
    ----------
    mask : (height, width), in which what is hidden is cleared
    min_side_px : shortest side of an outline
    hidden : (N, 4, 2) where not to look [px]
    edge_px : distance from the centres of a region's outermost pixels, where outlines run, to its edge
    """
    for quad in np.rint(hidden).astype(np.int32):
        cv2.fillConvexPoly(mask, quad, 0)
    outlines, _ = cv2.findContours(mask, cv2.RETR_LIST, cv2.CHAIN_APPROX_SIMPLE)
    shortest, longest = 3.2 * min_side_px, 2.0 * sum(mask.shape)
    quads, spots = [], []
    for outline in outlines:
        if len(outline) < _CORNERS or not shortest <= cv2.arcLength(outline, True) <= longest:
            continue
        hull = cv2.convexHull(outline)
        simple = cv2.approxPolyDP(hull, _STRAIGHT * cv2.arcLength(hull, True), True)
        if len(simple) == _CORNERS:
            quads.append(simple[:, 0])
            spots.append(cv2.contourArea(outline, oriented=True) < 0.0)
    if not quads:
        return np.zeros((0, 4, 2))
    found = np.array(quads, dtype=np.float64)
    sides = np.sqrt(squared_sides(found))
    large = (sides >= min_side_px).all(axis=1)
    if not large.any():
        return np.zeros((0, 4, 2))
    # Outlines of holes run through the region around them: their edges lie inside.
    outward = np.where(np.array(spots)[large], 1.0, -1.0)
    factor = 1.0 + 2.0 * edge_px * outward / sides[large].mean(axis=1)
    edges = grown(found[large], factor[:, None, None])
    diagonal, other = edges[:, 2] - edges[:, 0], edges[:, 3] - edges[:, 1]
    turned = diagonal[:, 0] * other[:, 1] - diagonal[:, 1] * other[:, 0] < 0.0
    return np.where(turned[:, None, None], edges[:, ::-1], edges)
