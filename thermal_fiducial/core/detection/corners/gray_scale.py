"""Gray scale of a display, as the markers of a frame show it: which counts its gray levels stand for.

Bolometers lag, and then a gain control bends their counts: gray levels are no sums of older ones, from which lag tails
could be removed. So the gray scale is undone first. It is one rising function for all markers of a frame, and in counts
each of these is linear in the terms of its pattern. Alternating least squares find both (F. Young, J. de Leeuw, Y.
Takane, "Regression with qualitative and quantitative variables", Psychometrika 41, 1976): the terms that fit the counts
of the gray levels, and the mean gray level where the terms give the same count. Not the mean count of each gray level:
gray levels have noise.
"""

import math
from typing import NamedTuple

import numpy as np

from thermal_fiducial.core.detection.corners.blurred_patterns import (
    blurred,
    cells_by_pixels,
    LINEAR,
    linear_terms,
    pattern_grid,
    PatternView,
)
from thermal_fiducial.core.detection.corners.pattern_residuals import blank, fitted, products_of, Unevenness
from thermal_fiducial.core.detection.patterns import Decoder
from thermal_fiducial.core.types import Float32Array, FloatArray, IntArray, TINY

_LEVELS = np.arange(256.0)
# Samples along a cell, and rounds of the alternation, which begins with the gray scale known before: with six samples,
# six rounds, or 32 parts of the range, corners are the same to a tenth.
_DENSITY, _ROUNDS = 4, 3
# Parts of the range of counts, of which each gets its mean gray level, and least number of samples in one.
_PARTS, _FEWEST = 64, 5
# Change of the gray scale, root mean square over what markers show and as a share of that, after which other corners
# follow: until it has settled, and then. Across an edge 2.5 px wide, lag tails that are wrong by 0.02 displace the
# middle by 0.05 px; with 0.03, a flight behind a plateau equalisation that begins in motion is off by a pixel first.
# What one or two markers show of a scale that has settled changes by 0.02 to 0.04 from one refinement to the next.
_MATTERS_AT_FIRST, _MATTERS = 0.02, 0.05


class GrayScale(NamedTuple):
    """Counts of the gray levels of a display; their zero and unit are about those of the gray levels."""

    #: (256,) rising
    counts: FloatArray
    #: levels from the darkest to the brightest one that markers show
    shown: slice
    #: whether it has been about the same in two frames
    settled: bool = False

    def differs(self, before: 'GrayScale') -> bool:
        """Whether other corners follow from it than from the one that was known ``before``."""
        counts, others = self.counts[self.shown], before.counts[self.shown]
        (variance, common), (_, others_variance) = np.cov(counts, others, bias=True)
        # What a linear function of the other one leaves.
        left = math.sqrt(max(variance - common * common / (others_variance + TINY), 0.0))
        return left > (_MATTERS if before.settled else _MATTERS_AT_FIRST) * float(np.ptp(counts))

    def estimated_by(
        self, view: PatternView, corners_px: FloatArray, ids: IntArray, decoder: Decoder, blur_px: float
    ) -> 'GrayScale':
        """The gray scale that markers ``ids`` (N,) show where this one is known before.

        Parameters
        ----------
        view : of gray levels, with the whole lag; what is saturated has no counts
        corners_px : (N, 4, 2) in it
        blur_px : standard deviation of the blur of optics and pixels
        """
        grid, white = pattern_grid(decoder.cells, _DENSITY), decoder.patterns(ids, np.zeros_like(ids))
        to_cells = cells_by_pixels(corners_px, decoder.cells)
        model, spread = blurred(view, to_cells, np.full(len(ids), blur_px), white, grid)
        terms = linear_terms(model, spread, grid, decoder.cells, displayed=False)[:, LINEAR]
        places = view.places(corners_px, grid)
        known, gray = view.known(*places), view.values(*places)
        blank(terms, known)
        products = products_of(terms)
        pattern, apart_px = grid.patches(model.value), grid.apart_px(to_cells)
        scale = self
        for _ in range(_ROUNDS):
            counts = np.interp(gray, _LEVELS, scale.counts).astype(np.float32)
            rest = grid.patches(fitted(terms, products, (counts - counts[:, :1]) * known, None)[1])
            uneven = Unevenness.estimated(pattern, rest, grid.patches(known.astype(np.float32)), apart_px)
            even_rest = uneven.weighted(rest).reshape(counts.shape)
            scale = _by_means((counts - even_rest)[known], gray[known], scale)
        return scale._replace(settled=self.settled)


#: That of a display of which nothing is known: linear.
UNKNOWN_SCALE = GrayScale(_LEVELS, slice(0, len(_LEVELS)))


def _by_means(counts: Float32Array, gray: Float32Array, before: GrayScale) -> GrayScale:
    """The gray scale by the mean of gray levels (P,) of pixels with about the same ``counts`` (P,).

    Counts get the mean and the deviation of the gray levels. Beyond all pixels the gray scale is linear.
    """
    if len(counts) < _FEWEST:
        return before
    part = (_PARTS - 1e-3) * (counts - counts.min()) / (np.ptp(counts) + TINY)
    bins = part.astype(np.int64)
    number = np.bincount(bins, minlength=_PARTS)
    used = number >= _FEWEST
    if used.sum() < 2:
        return before
    x, y = (np.bincount(bins, values, _PARTS)[used] / number[used] for values in (gray, counts))
    # Halfway between the rising functions nearest above and nearest below.
    x = 0.5 * (np.maximum.accumulate(x) + np.minimum.accumulate(x[::-1])[::-1])
    x += np.linspace(0.0, 1e-3, len(x))
    y = gray.mean() + (y - counts.mean()) * gray.std() / (counts.std() + TINY)
    beyond = np.minimum(_LEVELS - x[0], 0.0) + np.maximum(_LEVELS - x[-1], 0.0)
    shown = slice(max(int(x[0]), 0), int(x[-1]) + 2)
    return GrayScale(np.interp(_LEVELS, x, y) + beyond * (y[-1] - y[0]) / (x[-1] - x[0]), shown)
