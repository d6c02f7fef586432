"""Similarity of an image to the pattern of a marker, as it would look from a predicted place, at many shifts.

Source: J. Lewis, "Fast Normalized Cross-Correlation", 1995.
"""

from collections.abc import Sequence
import math
from typing import NamedTuple

import cv2
import numpy as np

from thermal_fiducial.core.detection.finding.quads import halfway
from thermal_fiducial.core.detection.patterns import Decoder
from thermal_fiducial.core.geometry.reprojection import sides_px
from thermal_fiducial.core.types import Float32Array, FloatArray, IntArray, TINY

# Width of cells up to which the image is searched at full resolution, else at a lower one [px]: a pattern is as
# distinct there, with less noise, and is found in less time.
_CELL_PX = 3.0
# Pixels of a drawn pattern to the side of a cell, and white around it [cells], of which half a cell is compared: no
# plate has less.
_DRAWN_PX, _MARGIN, _COMPARED = 4, 1, 0.5
# The drawing as seen has so many pixels to the side of one of the image, whose mean that is.
_FINER = 2
# Blur of the template: of the optics, and of a place that is wrong by half a pixel [px].
_BLUR_PX = 0.7


class Match(NamedTuple):
    """Where the image resembles a marker most."""

    #: (2,) from the predicted place [px]
    shift_px: FloatArray
    #: log-likelihood ratio of the marker over a square with a border and anything else inside
    evidence: float
    #: squares of its size that have room where it was looked for
    places: float

    @property
    def gain(self) -> float:
        """Logarithm of the odds, if any of the squares may be the marker: below 0 it is rather not."""
        return self.evidence - math.log(self.places)


#: Of a marker that is not in the image.
NOT_THERE = Match(np.zeros(2), -math.inf, 1.0)


def halvings(cell_px: float) -> int:
    """How many times the resolution is halved at which a marker with cells of this width is looked for."""
    return max(math.ceil(math.log2(cell_px / _CELL_PX)), 0)


class MarkerTemplate:
    """A marker as predicted, and how similar its pattern is to the image around the predicted place.

    Parameters
    ----------
    images : the image, and those of half the resolution of the one before, as many as :func:`halvings` says
    marker_id, corners : its ID, and (4, 2) as predicted [px]
    reach_px : (2,) how far it is looked for along columns and rows [px]
    kinds : polarities, 1 for markers darker than their surroundings, -1 for brighter
    """

    def __init__(
        self,
        images: Sequence[Float32Array],
        marker_id: int,
        corners: FloatArray,
        reach_px: FloatArray,
        kinds: tuple[float, ...],
        decoder: Decoder,
    ) -> None:
        cell = float(sides_px(corners[None])[0]) / decoder.cells
        number = halvings(cell)
        self._pixel, self._image = 2.0**number, images[number]
        for _ in range(number):
            corners = halfway(corners)
        self._id, self._corners, self._decoder = np.array([marker_id]), corners, decoder
        self._square_px = (cell / self._pixel * decoder.cells) ** 2
        template, weights, origin = _seen(decoder.patterns(self._id, np.array([0]))[0], corners)
        size, reach = np.array(template.shape[::-1]), np.ceil(reach_px / self._pixel).astype(np.int64)
        low, high = np.maximum(origin - reach, 0), np.minimum(origin + size + reach, self._image.shape[::-1])
        self._first, self._similarity = low - origin, np.zeros((0, 0), dtype=np.float32)
        if (high - low >= size).all():
            window = self._image[low[1] : high[1], low[0] : high[0]]
            # Small numbers for sums in single precision.
            alike = cv2.matchTemplate(window - window.mean(), template, cv2.TM_CCOEFF_NORMED, mask=weights)
            alike = np.nan_to_num(alike, nan=0.0, posinf=0.0, neginf=0.0)
            self._similarity = np.max([kind * alike for kind in kinds], axis=0)

    def best(self, shift_px: FloatArray, reach_px: FloatArray) -> Match:
        """The best match at shifts that are no farther than ``reach_px`` (2,) from ``shift_px`` (2,)."""
        centre, reach = shift_px / self._pixel - self._first, np.maximum(reach_px / self._pixel, 1.0)
        low = np.maximum(np.ceil(centre - reach), 0).astype(np.int64)
        high = np.minimum(np.floor(centre + reach) + 1, self._similarity.shape[::-1]).astype(np.int64)
        if (high <= low).any():
            return NOT_THERE
        near = self._similarity[low[1] : high[1], low[0] : high[0]]
        row, column = np.unravel_index(int(near.argmax()), near.shape)
        at = low + np.array([column, row])
        shift = self._first + at + self._between_pixels(at)
        evidence = self._decoder.evidence(self._image, self._corners[None] + shift, self._id)[0]
        # As many independent values as blur leaves of the pixels.
        share = min(self._square_px / (4.0 * math.pi * _BLUR_PX**2) / self._decoder.bits, 1.0)
        return Match(self._pixel * shift, share * evidence, max(near.size / self._square_px, 1.0))

    def _between_pixels(self, at: IntArray) -> FloatArray:
        """Offset (2,) from a maximum ``at`` (2,) of the similarity to that of the parabolas through its neighbours."""
        offset = np.zeros(2)
        for axis, line in enumerate((self._similarity[at[1]], self._similarity[:, at[0]])):
            if 0 < at[axis] < len(line) - 1:
                before, here, after = line[at[axis] - 1 : at[axis] + 2].tolist()
                bend = 2.0 * here - before - after
                offset[axis] = 0.5 * (after - before) / bend if bend > TINY else 0.0
        return np.clip(offset, -0.5, 0.5)


def _seen(pattern: FloatArray, corners: FloatArray) -> tuple[Float32Array, Float32Array, IntArray]:
    """A ``pattern`` (m, m) as seen with its ``corners`` (4, 2), weights of the pixels, (h, w), and the origin [px]."""
    drawn = np.pad(pattern, _MARGIN, constant_values=1.0).repeat(_DRAWN_PX, axis=0).repeat(_DRAWN_PX, axis=1)
    compared, edge = np.zeros_like(drawn), round((_MARGIN - _COMPARED) * _DRAWN_PX)
    compared[edge:-edge, edge:-edge] = 1.0
    begin, end = _MARGIN * _DRAWN_PX - 0.5, (_MARGIN + len(pattern)) * _DRAWN_PX - 0.5
    square = np.array([[begin, begin], [end, begin], [end, end], [begin, end]])
    middle = corners.mean(axis=0)
    outer = middle + (1.0 + 2.0 * _COMPARED / len(pattern)) * (corners - middle)
    origin = np.floor(outer.min(axis=0)).astype(np.int64)
    width, height = (np.ceil(outer.max(axis=0)).astype(np.int64) - origin + 1).tolist()
    finer = _FINER * (corners - origin + 0.5) - 0.5
    to_image = cv2.getPerspectiveTransform(square.astype(np.float32), finer.astype(np.float32))
    both = np.stack([drawn, compared], axis=-1).astype(np.float32)
    seen = cv2.warpPerspective(both, to_image, (_FINER * width, _FINER * height))
    levels, weights = cv2.split(cv2.resize(seen, (width, height), interpolation=cv2.INTER_AREA))
    template = cv2.GaussianBlur(levels, (0, 0), _BLUR_PX)
    return np.asarray(template, dtype=np.float32), np.asarray(weights, dtype=np.float32), origin
