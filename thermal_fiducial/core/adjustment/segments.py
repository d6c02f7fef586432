"""Displacements of a marker's sides, segment by segment, and of the corners that explain them.

One segment, a bit long, measures how far its side is off with a level and a contrast of its own and a variance from its
own residuals; a robust adjustment of the four corners to all segments of the marker follows. Clutter, dead pixels and
hidden stretches cost the segments that they touch.
"""

from typing import NamedTuple

import cv2
import numpy as np

from thermal_fiducial.core.adjustment.sides import ENDS, Sides, STARTS
from thermal_fiducial.core.adjustment.squares import as_squares
from thermal_fiducial.core.camera import ImagePoints
from thermal_fiducial.core.types import BoolArray, Float32Array, FloatArray, IntArray

#: Variance of a segment that measures nothing.
HOPELESS = 1e6
# Weight of a pixel or segment falls off beyond this many standard deviations.
_PIXEL_OUTLIER = 4.5
_SEGMENT_OUTLIER = 2.5
# Variance of a standard normal variable of which no more than that is kept.
_KEPT_VARIANCE = 0.911
# Standard deviation of a corner that no image noise explains: the optics' blur is not quite a Gaussian [px]; and of
# what all four sides have in common of it, so that it leaves a square one.
_FLOOR, _COMMON_FLOOR = 0.010**2 * np.eye(8), 0.005**2 * np.eye(2)
# Contrast of a segment over that of the marker: less is hidden, more is the edge of something else; and by how much the
# contrast of a plate varies.
_LEAST_CONTRAST, _MOST_CONTRAST, _CONTRAST_VARIES = 0.3, 2.5, 0.3
# Weights of segments are found in so many rounds.
_ROUNDS = 3
_SIDES = np.arange(4)


class Memory(NamedTuple):
    """What the image still shows of the past, to be taken out round N markers.

    Parameters
    ----------
    maps : (N, 2, 3) of the pixels (u, v, 1) to those that show what they remember
    gain : (N,) weight of the present, so that 1 takes nothing out
    """

    maps: FloatArray
    gain: FloatArray

    def only(self, keep: IntArray) -> 'Memory':
        """That round the markers ``keep``."""
        return Memory(self.maps[keep], self.gain[keep])


class Segments(NamedTuple):
    """What the S segments of each of N markers measured, (N, S) each."""

    #: displacement of their sides along the normals, inward [px]
    shift: FloatArray
    #: its variance [px^2]
    variance: FloatArray
    contrast: FloatArray
    #: variance of a pixel about the model
    noise: FloatArray


class _Fit(NamedTuple):
    """Least squares of segments (...) over level, contrast and contrast times displacement."""

    contrast: FloatArray
    #: contrast times displacement
    product: FloatArray
    #: their variances for noise of 1
    contrast_variance: FloatArray
    product_variance: FloatArray
    level: FloatArray
    #: sum of squared residuals, and number of pixels
    square: FloatArray
    number: FloatArray


def counts_across(image: Float32Array, sides: Sides, memory: Memory | None = None) -> Float32Array:
    """Counts (E, K, M) of the pixels across sides, without memory."""
    counts: Float32Array = image.ravel().take(sides.pixel, mode='clip')
    if memory is None or not (memory.gain > 1.0).any():
        return counts
    pixel, which = sides.pixel.reshape(len(memory.gain), -1), np.flatnonzero(memory.gain > 1.0)
    v, u = (a.astype(np.float32) for a in np.divmod(pixel[which].astype(np.int32), np.int32(image.shape[1])))
    maps = memory.maps[which].astype(np.float32)[..., None]
    to_u, to_v = (maps[:, row, 0] * u + maps[:, row, 1] * v + maps[:, row, 2] for row in (0, 1))
    past = cv2.remap(image, to_u, to_v, cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REPLICATE)
    gain, of_marker = memory.gain[which, None].astype(np.float32), counts.reshape(pixel.shape)
    of_marker[which] = gain * of_marker[which] + (np.float32(1.0) - gain) * past
    return counts


def measure(
    counts: Float32Array,
    modelled: tuple[Float32Array, Float32Array, Float32Array],
    cells: int,
    reach: FloatArray,
) -> Segments:
    """Displacement of each segment, one of ``cells`` on a side.

    Parameters
    ----------
    counts : (E, K, M) of :func:`counts_across`
    modelled : value, derivative and weight of each pixel, of :func:`thermal_fiducial.core.adjustment.edges.model`
    reach : (E,) longest displacement for which the model can be linearised [px]
    """
    value, slope, weight = (each.reshape(len(reach) * cells, -1) for each in modelled)
    counts = counts.reshape(weight.shape)
    X = np.empty((len(weight), 4, weight.shape[1]), dtype=np.float32)
    X[:, 0], X[:, 1], X[:, 2] = weight, value, slope
    np.subtract(counts, counts[:, weight.shape[1] // 2, None], out=X[:, 3])
    X[:, 1:] *= weight[:, None]
    fit, shape = _fit(X), (-1, 4 * cells)
    noise = _noise(fit, shape)
    outlier = np.abs(_residuals(fit, X)) > (_PIXEL_OUTLIER * np.sqrt(noise)).astype(np.float32).reshape(-1, 1)
    touched = np.flatnonzero(outlier.any(axis=1))
    if len(touched):
        for all_of, again in zip(fit, _fit(X[touched] * ~outlier[touched, None]), strict=True):
            all_of[touched] = again
        noise = _noise(fit, shape)
    return _judged(fit, noise, np.repeat(reach, cells).reshape(shape))


def _fit(X: Float32Array) -> _Fit:
    """Least squares of the last of four columns X (segments, 4, pixels) on the others: (1, model, derivative).

    All are zero of pixels that do not count.
    """
    sums = (X @ X.swapaxes(1, 2)).astype(np.float64)
    number = sums[:, 0, 0].copy()
    safe = np.maximum(number, 1.0)
    mean = sums[:, 0] / safe[:, None]
    # Without their means the columns leave two unknowns.
    about = (sums[:, 1:, 1:] - sums[:, 1:, :1] * mean[:, None, 1:]).transpose(1, 2, 0)
    ridge = 1e-6 * number + 1e-6
    a, b, c, p, q = about[0, 0] + ridge, about[0, 1], about[1, 1] + ridge, about[0, 2], about[1, 2]
    determinant = a * c - b * b
    a, b, c = a / determinant, b / determinant, c / determinant
    contrast, product = c * p - b * q, a * q - b * p
    square = np.maximum(about[2, 2] - contrast * p - product * q, 0.0)
    level = mean[:, 3] - contrast * mean[:, 1] - product * mean[:, 2]
    return _Fit(contrast, product, c, a, level, square, number)


def _residuals(fit: _Fit, X: Float32Array) -> Float32Array:
    """What the model leaves of the pixels (segments, pixels)."""
    terms = np.ones((len(X), 1, 4), dtype=np.float32)
    terms[:, 0, 0], terms[:, 0, 1], terms[:, 0, 2] = -fit.level, -fit.contrast, -fit.product
    return np.asarray((terms @ X)[:, 0])


def _noise(fit: _Fit, shape: tuple[int, int]) -> FloatArray:
    """Variances of pixels (N, S): of a marker's typical segment, or a segment's own where that is much larger."""
    free = fit.number.reshape(shape) - 3.0
    own = fit.square.reshape(shape) / np.maximum(free, 1.0)
    typical = _Median(free > 1.5)(own)
    return np.where(own > 2.5 * typical, own, typical) + 1e-3


def _judged(fit: _Fit, noise: FloatArray, reach: FloatArray) -> Segments:
    """Which segments measure anything, within their reach (N, S)."""
    contrast, product, number, own, unit = (
        a.reshape(reach.shape)
        for a in (fit.contrast, fit.product, fit.number, fit.contrast_variance, fit.product_variance)
    )
    usable = number > 4.5
    typical = _Median(usable)(contrast)
    own = noise * own
    scale = np.sign(typical) / np.maximum(np.abs(typical), 1e-6)
    relative, unsure = contrast * scale, 2.0 * np.sqrt(own) * np.abs(scale)
    usable &= (relative > _LEAST_CONTRAST - unsure) & (relative < _MOST_CONTRAST + unsure)
    # A faint segment hardly tells its contrast, by which its displacement is divided: the others tell it better.
    others = (_CONTRAST_VARIES * typical) ** 2 + 1e-9
    safe = np.where(usable, (contrast * others + typical * own) / (others + own), 1.0)
    shift = np.where(usable, np.minimum(np.maximum(-product / safe, -reach), reach), 0.0)
    return Segments(shift, np.where(usable, noise * unit / (safe * safe), HOPELESS), contrast, noise)


class _Median:
    """Medians (N, 1) of the good ones of values (N, S), 0 where there is none."""

    def __init__(self, good: BoolArray) -> None:
        number = good.sum(axis=1)
        self._good, self._none = good, number == 0
        self._place = np.arange(len(good)), np.maximum(number - 1, 0) // 2

    def __call__(self, values: FloatArray) -> FloatArray:
        order = np.where(self._good, values, np.inf)
        order.sort(axis=1)
        median = order[self._place]
        median[self._none] = 0.0
        return np.asarray(median[:, None])


def adjust(
    sides: Sides, segments: Segments, prior: FloatArray, at: ImagePoints
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """How corners move (N, 4, 2) to explain the shifts of all segments, and their covariances (N, 4, 2, 2).

    And the variances (N,) [px^2] of corners that make no square, zero where they do.

    Parameters
    ----------
    prior : (8, 8) information on the eight numbers beforehand
    at : (N, 4) corners so far
    """
    used = segments.variance < HOPELESS
    median, sharpness = _Median(used), 1.0 / np.sqrt(segments.variance)
    A, shift = _design(sides, sharpness.shape) * sharpness[..., None], segments.shift * sharpness
    weighted = turned = A.swapaxes(1, 2)
    for _ in range(_ROUNDS):
        covariance = np.linalg.inv(weighted @ A + prior)
        moved = covariance @ (weighted @ shift[..., None])
        left = np.abs(shift - (A @ moved)[..., 0])
        scale = np.maximum(1.4826 * median(left), 1.0)
        robust = 1.0 / np.maximum(left / (_SEGMENT_OUTLIER * scale), 1.0) ** 2
        weighted = turned * robust[:, None]
    kept = used & (robust > 0.99)
    chi2 = np.einsum('ns,ns,ns->n', left, left, kept) / _KEPT_VARIANCE
    free = np.maximum(kept.sum(axis=1) - 8.0, 0.0)
    # The scatter of the segments corrects the noise of their pixels, as far as there are segments to tell.
    covariance = covariance * ((chi2 + 24.0) / (free + 24.0))[:, None, None] + _FLOOR
    known = as_squares(at, moved, covariance)
    # Corners told by one another err together. Taken for independent, they would tell a pose so much too well.
    together = (8.0 / (8.0 - known.told))[:, None, None, None]
    blocks = together * np.einsum('nikil->nikl', known.covariance.reshape(-1, 4, 2, 4, 2))
    # A side of an outline that is no square's is that of something else.
    doubt = known.doubt * sides.along.reshape(-1, 4).mean(axis=1) ** 2
    return known.moved.reshape(-1, 4, 2), blocks + _COMMON_FLOOR, doubt


def _design(sides: Sides, shape: tuple[int, ...]) -> FloatArray:
    """Derivative (N, S, 8) of the segments' displacements along their normals by the corners'."""
    cells = shape[1] // 4
    fresh = sides.fresh.reshape(len(sides.t), cells, -1)
    t = (sides.t.reshape(fresh.shape) * fresh).sum(axis=-1) / np.maximum(fresh.sum(axis=-1), 1)
    normal = sides.normal.reshape(*fresh.shape, 2)[:, :, fresh.shape[-1] // 2].reshape(-1, 4, cells, 2)
    by_end = t.reshape(-1, 4, cells, 1) * normal
    A = np.zeros((len(normal), 4, cells, 4, 2))
    # Separated by a slice, the two indices come first.
    A[:, _SIDES, :, STARTS] = np.swapaxes(normal - by_end, 0, 1)
    A[:, _SIDES, :, ENDS] = np.swapaxes(by_end, 0, 1)
    return A.reshape(-1, 4 * cells, 8)
