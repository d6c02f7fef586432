"""Markers of the map that are not near their predictions, as the filter has drifted.

After seconds without markers, predictions are off by more than the half cell that is tried around them. Then the marker
that the image resembles most, as far from its prediction as the covariance of the predicted camera allows, is taken for
right; with it the others are predicted anew, and have to be near. They are found if the evidence of all of them
together is enough for as many places as were looked at. So markers are found again that are too small, too blurred or
too faint for their outlines to show.

Sources: J. Civera, O. Grasa, A. Davison, J. Montiel, "1-Point RANSAC for EKF Filtering", Journal of Field Robotics
2010; of the similarity at many shifts, J. Lewis, "Fast Normalized Cross-Correlation", 1995.
"""

from collections.abc import Sequence
import math
from typing import NamedTuple

import cv2
import numpy as np

from thermal_fiducial.core.detection.finding.quads import halfway, halved
from thermal_fiducial.core.detection.patterns import Decoder, NEAR_CELLS
from thermal_fiducial.core.geometry.reprojection import grown, sides_px
from thermal_fiducial.core.types import BoolArray, Float32Array, FloatArray, IntArray, TINY

# Standard deviations of a prediction within which a marker is looked for.
_SIGMAS = 3.0
# Standard deviation of a match along an axis [cells].
_OF_MATCH = 0.3
# Bound on the number of false finds in a search, were all of the image squares with a border around random bits.
_FALSE_FINDS = 0.001
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


def drifted_markers(
    image: Float32Array,
    ids: IntArray,
    corners: FloatArray,
    flow: FloatArray,
    of_camera: FloatArray,
    farthest_px: float,
    polarities: tuple[float, ...],
    decoder: Decoder,
) -> tuple[BoolArray, FloatArray]:
    """Which of N markers the image shows away from their predictions, and where.

    Parameters
    ----------
    image : (height, width) counts or gray levels
    ids, corners : (N,), (N, 4, 2) of markers, as predicted [px]
    flow : (N, 2, 6) derivative of their centres by a displacement of the camera in its axes, position first [px/m, rad]
    of_camera : (6, 6) covariance of that displacement
    farthest_px : largest distance that is searched
    polarities : 1 for markers darker than their surroundings, -1 for brighter

    Returns
    -------
    (N,), and (N, 4, 2) corners, accurate to half a cell
    """
    cells = sides_px(corners) / decoder.cells
    reach = np.minimum(_SIGMAS * _stds_px(flow, of_camera), farthest_px)
    if (reach < NEAR_CELLS.max() * cells[:, None]).all():
        return np.zeros(len(ids), dtype=np.bool_), corners
    images = [image]
    for _ in range(halvings(cells.max())):
        images.append(halved(images[-1]))
    views = zip(ids.tolist(), corners, reach, strict=True)
    templates = [MarkerTemplate(images, *view, polarities, decoder) for view in views]
    alone = [template.best(np.zeros(2), near) for template, near in zip(templates, reach, strict=True)]
    variances = (_OF_MATCH * cells) ** 2
    likely = [place for place, match in enumerate(alone) if match.gain > 0.0]
    for first in sorted(likely, key=lambda place: -alone[place].gain):
        mean, left = _camera_given_match(of_camera, flow[first], alone[first].shift_px, variances[first])
        near = _SIGMAS * np.sqrt(_stds_px(flow, left) ** 2 + variances[:, None])
        matches = [template.best(*at) for template, *at in zip(templates, flow @ mean, near, strict=True)]
        matches[first] = alone[first]
        gains = np.array([match.gain for match in matches])
        # Each of the others shows or does not, with equal odds.
        of_others = np.delete(np.logaddexp(gains, 0.0) - math.log(2.0), first)
        if gains[first] + of_others.sum() > math.log(len(ids) / _FALSE_FINDS):
            shifts = np.stack([match.shift_px for match in matches])
            return gains > 0.0, corners + shifts[:, None]
    return np.zeros(len(ids), dtype=np.bool_), corners


def _stds_px(flow: FloatArray, of_camera: FloatArray) -> FloatArray:
    """Standard deviations (N, 2) of markers along columns and rows by a covariance (6, 6) of the camera."""
    return np.asarray(np.sqrt(((flow @ of_camera) * flow).sum(axis=-1)))


def _camera_given_match(
    of_camera: FloatArray, flow: FloatArray, shift_px: FloatArray, variance: float
) -> tuple[FloatArray, FloatArray]:
    """Mean (6,) and covariance (6, 6) of the camera's displacement after one marker with ``flow`` (2, 6) is matched."""
    gain = of_camera @ flow.T @ np.linalg.inv(flow @ of_camera @ flow.T + variance * np.eye(2))
    return gain @ shift_px, of_camera - gain @ flow @ of_camera


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
    polarities : 1 for markers darker than their surroundings, -1 for brighter
    """

    def __init__(
        self,
        images: Sequence[Float32Array],
        marker_id: int,
        corners: FloatArray,
        reach_px: FloatArray,
        polarities: tuple[float, ...],
        decoder: Decoder,
    ) -> None:
        cell = float(sides_px(corners[None])[0]) / decoder.cells
        number = halvings(cell)
        self._pixel, self._image = 2.0**number, images[number]
        for _ in range(number):
            corners = halfway(corners)
        self._id, self._corners, self._decoder = np.array([marker_id]), corners, decoder
        self._square_px = (cell / self._pixel * decoder.cells) ** 2
        template, weights, origin = _template_of(decoder.patterns(self._id, np.array([0]))[0], corners)
        size, reach = np.array(template.shape[::-1]), np.ceil(reach_px / self._pixel).astype(np.int64)
        low, high = np.maximum(origin - reach, 0), np.minimum(origin + size + reach, self._image.shape[::-1])
        self._first, self._similarity = low - origin, np.zeros((0, 0), dtype=np.float32)
        if (high - low >= size).all():
            window = self._image[low[1] : high[1], low[0] : high[0]]
            # Small numbers for sums in single precision.
            alike = cv2.matchTemplate(window - window.mean(), template, cv2.TM_CCOEFF_NORMED, mask=weights)
            alike = np.nan_to_num(alike, nan=0.0, posinf=0.0, neginf=0.0)
            self._similarity = np.max([polarity * alike for polarity in polarities], axis=0)

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


def _template_of(pattern: FloatArray, corners: FloatArray) -> tuple[Float32Array, Float32Array, IntArray]:
    """A ``pattern`` (m, m) as seen with its ``corners`` (4, 2), weights of the pixels, (h, w), and the origin [px]."""
    drawn = np.pad(pattern, _MARGIN, constant_values=1.0).repeat(_DRAWN_PX, axis=0).repeat(_DRAWN_PX, axis=1)
    compared, edge = np.zeros_like(drawn), round((_MARGIN - _COMPARED) * _DRAWN_PX)
    compared[edge:-edge, edge:-edge] = 1.0
    begin, end = _MARGIN * _DRAWN_PX - 0.5, (_MARGIN + len(pattern)) * _DRAWN_PX - 0.5
    square = np.array([[begin, begin], [end, begin], [end, end], [begin, end]])
    (outer,) = grown(corners[None], 1.0 + 2.0 * _COMPARED / len(pattern))
    origin = np.floor(outer.min(axis=0)).astype(np.int64)
    width, height = (np.ceil(outer.max(axis=0)).astype(np.int64) - origin + 1).tolist()
    finer = _FINER * (corners - origin + 0.5) - 0.5
    to_image = cv2.getPerspectiveTransform(square.astype(np.float32), finer.astype(np.float32))
    both = np.stack([drawn, compared], axis=-1).astype(np.float32)
    seen = cv2.warpPerspective(both, to_image, (_FINER * width, _FINER * height))
    levels, weights = cv2.split(cv2.resize(seen, (width, height), interpolation=cv2.INTER_AREA))
    template = cv2.GaussianBlur(levels, (0, 0), _BLUR_PX)
    return np.asarray(template, dtype=np.float32), np.asarray(weights, dtype=np.float32), origin
