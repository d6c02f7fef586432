"""Displacement of the sides of a marker whose contrast is uneven, as before a heater that is weaker towards its edges.

A segment is fitted as a step of one contrast. Where the contrast has a slope across the side, the step looks displaced
by it. Along a side the slope is seen: segments have different contrasts. If the contrast is quadratic across the
marker, with the axes of its sides, those of all four sides show the slopes across them, too.
"""

from functools import cache
from typing import NamedTuple

import numpy as np

from thermal_fiducial.core.detection.corner_errors import SURFACE_FALLS
from thermal_fiducial.core.detection.corners.segments import median_of, Segments, UNMEASURED
from thermal_fiducial.core.detection.corners.sides import Sides
from thermal_fiducial.core.types import BoolArray, FloatArray, IntArray

# Displacement of a blurred step with a slope on one side of it, fitted as a step, over the product of its blur, the
# distance up to which pixels count, and the slope over the contrast: 0.80 to 0.87 for a blur of 0.5 to 0.9 px and
# pixels up to 1.5 to 10 px away.
_DISPLACES = 0.83
# Mean distance outward at which a segment shows the contrast: this share of the distance up to which pixels count, and
# of the blur.
_SHOWN_AT, _SHOWN_AT_BLUR = 0.5, 0.6
# Standard deviations of the contrast's coefficients before the segments are seen, in contrasts and sides: level,
# slopes, curvatures, and a change along the sides that is the same going around the marker: columns of pixels that
# cross sides obliquely show places displaced along them. At the corners both curvatures together are half of one.
_BEFORE = np.array([1.0, 1.0, 1.0, 2.0 * SURFACE_FALLS, 2.0 * SURFACE_FALLS, 2.0 * SURFACE_FALLS])
# Least number of segments that show it, and range of their contrasts over that of the typical one: others are not of
# the marker alone. Least contrast by which a displacement is divided.
_FEWEST, _ODD, _LEAST = 8, 0.7, 0.3
# Least variance of a contrast that the quadratic function leaves.
_SCATTER = 1e-6


class _Perimeter(NamedTuple):
    """The S segments along the sides of a marker, and a quadratic function of the place there, over its sides."""

    #: (S, 6) its terms: level, slopes, curvatures, change around the marker
    terms: FloatArray
    #: (2, S), (2, S) slopes inward of the linear terms and of the quadratic ones
    of_linear: FloatArray
    of_quadratic: FloatArray
    #: (S,) whether segments are not at the ends of their sides, and (S, S) what a fit to these leaves of values there
    inner: BoolArray
    left: FloatArray


@cache
def _perimeter(cells: int) -> _Perimeter:
    along, end = (np.arange(cells) + 0.5) / cells - 0.5, np.full(cells, 0.5)
    x, y = np.concatenate([along, along, -end, end]), np.concatenate([-end, end, along, along])
    across_x = np.repeat([False, False, True, True], cells)
    outward = np.sign(np.stack([np.where(across_x, x, 0.0), np.where(across_x, 0.0, y)]))
    turning = outward[0] * y - outward[1] * x
    terms = np.stack([np.ones_like(x), x, y, x * x, y * y, turning], axis=-1)
    inner = np.tile(np.abs(along) < 0.5 - 1.0 / cells, 4)
    left = np.zeros((len(x), len(x)))
    left[np.ix_(inner, inner)] = np.eye(inner.sum()) - terms[inner] @ np.linalg.pinv(terms[inner])
    return _Perimeter(terms, -outward, -2.0 * outward * np.stack([x, y]), inner, left)


def freed_of_unevenness(
    segments: Segments, which: IntArray, sides: Sides, outward: FloatArray, blur: FloatArray
) -> Segments:
    """The segments of N markers, at ``which`` without what slopes of the contrast across the sides displace them by.

    Parameters
    ----------
    outward : (E, m) distance up to which pixels outside the sides count [px]
    blur : (E, m) standard deviation of the blur across the sides [px]
    """
    used = segments.variance < UNMEASURED
    typical = median_of(segments.contrast, used)
    across, outward, blur = (part.reshape(used.shape)[which] for part in (sides.across, outward, blur))
    relative = segments.contrast[which] / typical[which]
    away = (_SHOWN_AT * outward + _SHOWN_AT_BLUR * blur) / across
    contrast, slope = _quadratic(relative, used[which], away, sides.across.shape[1])
    displaced = _DISPLACES * blur * outward * slope / (across * np.maximum(contrast, _LEAST))
    shift = segments.shift.copy()
    shift[which] -= np.where(used[which], displaced, 0.0)
    return segments._replace(shift=shift)


def _quadratic(contrast: FloatArray, used: BoolArray, away: FloatArray, cells: int) -> tuple[FloatArray, FloatArray]:
    """The contrast (N, S) as a quadratic function, and its slope inward across the sides, over sides.

    ``away`` (N, S): distance of the places from the sides, outward [sides].
    """
    around = _perimeter(cells)
    good = used & around.inner & (np.abs(contrast - 1.0) < _ODD)
    number = good.sum(axis=1)
    # What noise and the cells behind the sides make of contrasts.
    left = np.where(good, contrast, 1.0) @ around.left
    free = np.maximum(number - around.terms.shape[1], 1)
    scatter = np.maximum((left * left * good).sum(axis=1) / free, _SCATTER)
    weighted = around.terms.T * (good / scatter[:, None])[:, None]
    amounts = np.linalg.solve(weighted @ around.terms + np.diag(_BEFORE**-2), weighted @ contrast[..., None])[..., 0]
    amounts[number < _FEWEST, 1:] = 0.0
    # Farther out are steeper slopes of a curvature, and larger differences by a slope.
    farther = 1.0 + 2.0 * away
    slope = amounts[:, 1:3] @ around.of_linear / farther + amounts[:, 3:5] @ around.of_quadratic * farther
    return amounts @ around.terms.T, slope
