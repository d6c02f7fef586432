"""Displacements of a marker's sides, segment by segment, and a robust adjustment of the corners to them.

A segment is as long as a cell. It measures the displacement of its side, with a level and a contrast of its own and a
variance from its own residuals. Clutter, dead pixels and covered parts make outliers of the segments that they affect.
"""

from functools import cache
import math
from typing import NamedTuple

import numpy as np

from thermal_fiducial.core.detection.corners.corner_errors import (
    GRADIENT_AS_CONTRAST_PX,
    OF_GRADIENT_PX2,
    OF_SIDES_PX,
    OF_UNEVEN_CONTRAST_PX,
)
from thermal_fiducial.core.detection.corners.sides import EdgeModel, ENDS, Sides, STARTS
from thermal_fiducial.core.types import BoolArray, Float32Array, FloatArray, SIGMA_OF_MEDIAN, TINY

#: Largest displacement for which the linearisation holds, in standard deviations of the blur.
REACHED = 2.0
#: Variance of a segment that measures nothing.
UNMEASURED = 1e6
# Least number of pixels of a segment: two more than its unknowns.
_FEWEST_PIXELS = 5
# Ratio of a segment's pixel variance to the marker's typical one beyond which its own variance is used.
_NOISIER = 2.5
# Weight of a pixel or segment falls off beyond this many standard deviations.
_PIXEL_OUTLIER = 4.5
_SEGMENT_OUTLIER = 2.5
# Regularisation of nearly collinear columns, for sums in single precision.
_RIDGE = 1e-6
# Degrees of freedom at which the scatter of the segments and the noise of their pixels have equal weight.
_SCATTER_COUNTS = 24.0
# Variance of standard normal variables below _SEGMENT_OUTLIER.
_KEPT_VARIANCE = 1.0 - math.sqrt(2.0 / math.pi) * _SEGMENT_OUTLIER * math.exp(-0.5 * _SEGMENT_OUTLIER**2) / math.erf(
    math.sqrt(0.5) * _SEGMENT_OUTLIER
)
# Range of a segment's contrast over the marker's: less is covered, more is another object's edge; standard deviation of
# the contrast within a plate.
_LEAST_CONTRAST, _MOST_CONTRAST, _CONTRAST_VARIES = 0.3, 2.5, 0.3
# Standard deviations of a side, by noise and by a blur that is not Gaussian, beyond which the displacement by a
# gradient counts. Beyond noise alone most frames of even plates in fast flight would be fitted once more.
_GRADIENT_SHOWS = 2.0
# Largest number of rounds of robust weighting, and the change of weights below which it ends.
_ROUNDS, _SETTLED = 3, 0.1
_EYE = np.eye(8)
# Information on the corners beforehand [px^-2]: they are known to 3 px.
_PRIOR = _EYE / 3.0**2
# (4, 1, 4) shares of the corners in a point of each side: at its start, and their change from there to its end.
_AT_START = np.eye(4)[STARTS, None]
_ONWARD = np.eye(4)[ENDS, None] - _AT_START
# Factors of the products in a segment's least squares, among 1, model, derivative and counts; all of them together.
_FIRST, _SECOND = np.array([1, 1, 1, 2, 2, 3]), np.array([1, 2, 3, 2, 3, 3])
_PLANES = 4 + len(_FIRST)


class Segments(NamedTuple):
    """Measurements of the S segments of each of N markers, (N, S) each."""

    #: displacement of their sides along the normals, inward [px]
    shift: FloatArray
    #: variance of the displacement [px^2]
    variance: FloatArray
    contrast: FloatArray
    #: variance of a pixel about the model; the least one is that of the typical segment
    noise: FloatArray
    #: (N, 1) contrast of the typical segment, 0 where there is none
    typical: FloatArray

    def displaced_by_slopes(self) -> FloatArray:
        """Displacement (N,) of a side by a slope of its contrast across it as large as that along it, rms [px].

        A slope changes the contrast twice as much over two segments as over one. Noise and the cells behind the sides
        change it as much over either, so that they cancel in the difference of the squares. Medians leave out the few
        segments that other objects cover.
        """
        used = (self.variance < UNMEASURED).reshape(len(self.variance), 4, -1)
        contrast, sizes = self.contrast.reshape(used.shape), []
        for apart in (1, 2):
            change = np.abs(contrast[..., apart:] - contrast[..., :-apart]).reshape(len(used), -1)
            both = (used[..., apart:] & used[..., :-apart]).reshape(change.shape)
            sizes.append(median_of(change, both)[:, 0])
        squared = np.maximum(sizes[1] * sizes[1] - sizes[0] * sizes[0], 0.0)
        slope = SIGMA_OF_MEDIAN / math.sqrt(3.0) * np.sqrt(squared)
        return np.asarray(OF_UNEVEN_CONTRAST_PX * slope / np.maximum(np.abs(self.typical[:, 0]), TINY))


class RobustFit(NamedTuple):
    """N fits of P unknowns to S shifts."""

    #: (N, P, 1)
    moved: FloatArray
    #: (N, P, P) for the given standard deviations of the shifts, prior included, and their scatter
    covariance: FloatArray
    #: (N, S) inliers
    kept: BoolArray


class _SegmentFit(NamedTuple):
    """Least squares of segments (...) over level, contrast and contrast times displacement."""

    contrast: FloatArray
    #: contrast times displacement
    product: FloatArray
    #: their variances for noise of 1
    contrast_variance: FloatArray
    product_variance: FloatArray
    level: FloatArray
    #: which have enough pixels
    usable: BoolArray
    #: variances of pixels: of a marker's typical segment, or a segment's own where that is much larger
    noise: FloatArray


def measure(
    counts: Float32Array,
    modelled: EdgeModel,
    reach: FloatArray,
    of_each: int = 4,
) -> Segments:
    """Displacement of each segment, S = 4 m to a marker: the m of one side after those of the other.

    Parameters
    ----------
    counts : (M, C, E, m) of the pixels across the sides
    reach : (E, m) longest displacement for which the model can be linearised [px]
    of_each : number of sides of a marker
    """
    segments = of_each * counts.shape[3]
    X = np.empty((_PLANES, *counts.shape), dtype=np.float32)
    X[0] = modelled.counting
    np.multiply(modelled.value, X[0], out=X[1])
    np.multiply(modelled.slope, X[0], out=X[2])
    np.subtract(counts, counts[counts.shape[0] // 2, counts.shape[1] // 2], out=X[3])
    X[3] *= X[0]
    X = X.reshape(_PLANES, counts.shape[0] * counts.shape[1], -1)
    fit = _fit(X, segments)
    lines = np.array([fit.level, fit.contrast, fit.product, _PIXEL_OUTLIER * np.sqrt(fit.noise)], dtype=np.float32)
    lines = lines.reshape(4, 1, -1)
    # In the room for products: fresh memory takes as long as what is computed in it.
    np.multiply(X[:3], lines[:3], out=X[4:7])
    left = np.subtract(X[3], X[4], out=X[4])
    left -= X[5]
    left -= X[6]
    inliers = np.abs(left, out=left) <= lines[3]
    if not inliers.all():
        left[:] = inliers
        X[:4] *= left
        fit = _fit(X, segments)
    return _judged(fit, reach.reshape(fit.noise.shape))


def _fit(X: Float32Array, segments: int) -> _SegmentFit:
    """Least squares of the counts on (1, model, derivative), by marker (N, S).

    ``X`` (10, pixels, N S): 1, model, derivative and counts, zero for pixels that do not count, and room for products.
    """
    np.multiply(X[1], X[1:4], out=X[4:7])
    np.multiply(X[2], X[2:4], out=X[7:9])
    np.multiply(X[3], X[3], out=X[9])
    # A product of matrices adds up three times as fast as a sum.
    moments = np.ones(X.shape[1], dtype=np.float32) @ X
    sums = moments.astype(np.float64).reshape(len(X), -1, segments)
    number = sums[0]
    means = sums[:4] / np.maximum(number, 1.0)
    # Without their means the columns leave two unknowns.
    # Sums of the products of model m, derivative d and counts y.
    mm, md, my, dd, dy, yy = sums[4:] - sums.take(_FIRST, axis=0) * means.take(_SECOND, axis=0)
    ridge = _RIDGE * (number + 1.0)
    mm += ridge
    dd += ridge
    determinant = mm * dd - md * md
    contrast, product = (dd * my - md * dy) / determinant, (mm * dy - md * my) / determinant
    own = np.maximum(yy - contrast * my - product * dy, 0.0) / np.maximum(number - 3.0, 1.0)
    level = means[3] - contrast * means[1] - product * means[2]
    usable: BoolArray = np.asarray(number >= _FEWEST_PIXELS)
    typical = median_of(own, usable)
    noise = np.where(own > _NOISIER * typical, own, typical) + TINY
    return _SegmentFit(contrast, product, dd / determinant, mm / determinant, level, usable, noise)


def _judged(fit: _SegmentFit, reach: FloatArray) -> Segments:
    """Displacements and variances (N, S) of segments; ``UNMEASURED`` for unusable ones and those beyond ``reach``."""
    contrast, product, noise = fit.contrast, fit.product, fit.noise
    typical = median_of(contrast, fit.usable)
    own = noise * fit.contrast_variance
    scale = np.sign(typical) / np.maximum(np.abs(typical), TINY)
    relative, unsure = contrast * scale, 2.0 * np.sqrt(own) * np.abs(scale)
    usable = fit.usable & (relative > _LEAST_CONTRAST - unsure) & (relative < _MOST_CONTRAST + unsure)
    # A faint segment hardly shows its contrast, by which its displacement is divided: the others show it better.
    others = (_CONTRAST_VARIES * typical) ** 2 + TINY
    safe = np.where(usable, (contrast * others + typical * own) / (others + own), 1.0)
    shift = np.where(usable, np.minimum(np.maximum(-product / safe, -reach), reach), 0.0)
    variance = np.where(usable, noise * fit.product_variance / (safe * safe), UNMEASURED)
    return Segments(shift, variance, contrast, noise, typical)


def with_gradients(segments: Segments, sides: Sides, blur_px: float) -> tuple[Segments, BoolArray]:
    """The segments of whole markers, with the error by a gradient of temperature in the plate or behind it.

    Opposite sides show the gradient by their contrasts. A plate that is half warm has sides whose contrast is no more
    than what the gradient alone looks like: they measure nothing. The segments of a side are displaced alike.

    Parameters
    ----------
    sides : of the markers
    blur_px : standard deviation of the blur, by which noise of a displacement is one of the contrast

    Returns
    -------
    the segments, and whether (N,) a gradient displaces a side of a marker by more than its other errors do
    """
    # Opposite sides follow each other: (N, 2, 2) are pairs of them.
    opposite, shape = (..., slice(None, None, -1)), (len(segments.shift), 2, 2, sides.across.shape[1])
    good = (segments.variance < UNMEASURED).reshape(shape)
    used = good.sum(axis=3)
    number, measured = np.maximum(used, 1), used > 0
    contrast = (segments.contrast.reshape(shape) * good).sum(axis=3) / number
    relative = (segments.variance.reshape(shape) * good).sum(axis=3) / (number * blur_px) ** 2
    noise = contrast * contrast * relative
    both, difference = measured & measured[opposite], contrast - contrast[opposite]
    change = np.where(both, difference * difference - noise - noise[opposite], 0.0)
    gradient = np.sqrt(np.maximum(change, 0.0)) * (shape[3] / sides.across.reshape(shape).sum(axis=3))
    left = np.abs(contrast) - GRADIENT_AS_CONTRAST_PX * gradient
    std = np.where(left > 0.0, OF_GRADIENT_PX2 * gradient / np.maximum(left, TINY), np.inf)
    error = np.sqrt(blur_px**2 * relative / number + OF_SIDES_PX**2)
    beyond_error = (std > _GRADIENT_SHOWS * error) & both
    variance = np.minimum(segments.variance.reshape(shape) + (number * std * std)[..., None], UNMEASURED)
    return (
        segments._replace(variance=variance.reshape(segments.variance.shape)),
        np.asarray(beyond_error.any(axis=(1, 2))),
    )


def median_of(values: FloatArray, good: BoolArray) -> FloatArray:
    """Medians (N, 1) of the good ones of values (N, S), 0 where there is none."""
    if good.all():
        middle, order = (values.shape[1] - 1) // 2, values.copy()
        order.partition(middle, axis=1)
        return order[:, middle, None]
    number = good.sum(axis=1)
    order = np.where(good, values, np.inf)
    order.sort(axis=1)
    median = order[np.arange(len(good)), (number - 1) // 2]
    median[number == 0] = 0.0
    return np.asarray(median[:, None])


def adjust(sides: Sides, segments: Segments) -> tuple[FloatArray, FloatArray]:
    """Displacements (N, 8, 1) of the corners that fit all segments, and their covariances (N, 8, 8)."""
    used, cells = segments.variance < UNMEASURED, sides.normal.shape[1]
    A = (_shares(cells)[..., None] * sides.normal.reshape(-1, 4, cells, 1, 2)).reshape(-1, 4 * cells, 8)
    sharpness = 1.0 / np.sqrt(segments.variance)
    fit = robust_fit(A * sharpness[..., None], segments.shift * sharpness, used, _PRIOR)
    return fit.moved, fit.covariance + OF_SIDES_PX**2 * _EYE


@cache
def _shares(cells: int) -> FloatArray:
    """Weights (4, m, 4) of the four corners in the middle of each of m segments of a side, by linear interpolation."""
    return np.asarray(_AT_START + ((np.arange(cells) + 0.5) / cells)[:, None] * _ONWARD)


def robust_fit(A: FloatArray, shift: FloatArray, used: BoolArray, prior: FloatArray) -> RobustFit:
    """Robust least squares of shifts (N, S) on A (N, S, P), both divided by their standard deviations.

    Parameters
    ----------
    used : (N, S) which of them are measurements
    prior : (P, P) or (N, P, P) information
    """
    weighted = turned = A.swapaxes(1, 2)
    robust = np.ones_like(shift)
    for _ in range(_ROUNDS):
        covariance = np.linalg.inv(weighted @ A + prior)
        moved = covariance @ (weighted @ shift[..., None])
        left = np.abs(shift - (A @ moved)[..., 0])
        former = robust
        scale = np.maximum(SIGMA_OF_MEDIAN * median_of(left, used), 1.0)
        robust = 1.0 / np.maximum(left / (_SEGMENT_OUTLIER * scale), 1.0) ** 2
        if np.abs(robust - former).max() < _SETTLED:
            break
        weighted = turned * robust[:, None]
    kept = used & (robust == 1.0)
    chi2 = (left * left * kept).sum(axis=1) / _KEPT_VARIANCE
    free = np.maximum(kept.sum(axis=1) - A.shape[2], 0.0)
    scatter = (chi2 + _SCATTER_COUNTS) / (free + _SCATTER_COUNTS)
    return RobustFit(np.asarray(moved), np.asarray(covariance * scatter[:, None, None]), kept)
