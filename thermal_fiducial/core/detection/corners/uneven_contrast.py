"""Displacement of the sides of a marker whose contrast is uneven, as before a heater that is weaker towards its edges.

A segment is fitted as a step of one contrast. Where the contrast has a slope across the side, the step looks displaced
by it. Along a side the slope is seen: segments have different contrasts. If the contrast is quadratic across the
marker, with the axes of its sides, those of all four sides show the slopes across them, too.
"""

from functools import cache
from typing import NamedTuple

import numpy as np

from thermal_fiducial.core.detection.corners.corner_errors import SURFACE_FALLS
from thermal_fiducial.core.detection.corners.segments import Segments
from thermal_fiducial.core.detection.corners.sides import Sides
from thermal_fiducial.core.types import BoolArray, FloatArray

# Displacement of a blurred step with a slope on one side of it, fitted as a step, over the product of its blur, the
# distance up to which pixels count, and the slope over the contrast: 0.80 to 0.87 for a blur of 0.5 to 0.9 px and
# pixels up to 1.5 to 10 px away.
_DISPLACES = 0.83
# Mean distance outward at which a segment shows the contrast: this share of the distance up to which pixels count, and
# of the blur.
_SHOWN_AT, _SHOWN_AT_BLUR = 0.5, 0.6
# Standard deviations of the contrast's coefficients before the segments are seen, in contrasts and sides: level,
# slopes, curvatures, and a change along each side that has the same sign all around the marker: where columns of pixels
# cross a side obliquely, they show the contrast of places displaced along it. At the corners both curvatures together
# are half of one.
_BEFORE = np.array([1.0, 1.0, 1.0, 2.0 * SURFACE_FALLS, 2.0 * SURFACE_FALLS, 2.0 * SURFACE_FALLS])
_PRIOR = np.diag(_BEFORE**-2.0).ravel()
# Least number of segments that show it, and range of their contrasts over that of the typical one: others are not of
# the marker alone. Least contrast by which a displacement is divided.
_FEWEST, _ODD, _LEAST = 8, 0.7, 0.3
# Least variance of a contrast that the quadratic function leaves.
_SCATTER = 1e-6


class _Perimeter(NamedTuple):
    """The S segments along the sides of a marker, and a quadratic function of the place there, over its sides."""

    #: (S, 6) its terms: level, slopes, curvatures, change around the marker
    terms: FloatArray
    #: (S, 36) products of each of them with each
    products: FloatArray
    #: (3, 6, S) of each: its value, its slope inward if it is linear, and that if it is quadratic
    drawn: FloatArray
    #: (S,) whether segments are not at the ends of their sides, and (S, S) what a fit to these leaves of values there
    inner: BoolArray
    left: FloatArray


@cache
def _perimeter(cells: int) -> _Perimeter:
    """The segments of a marker of ``cells`` along a side, in its frame of unit side."""
    along, end = (np.arange(cells) + 0.5) / cells - 0.5, np.full(cells, 0.5)
    x, y = np.concatenate([along, along, -end, end]), np.concatenate([-end, end, along, along])
    across_x = np.repeat([False, False, True, True], cells)
    outward = np.sign(np.stack([np.where(across_x, x, 0.0), np.where(across_x, 0.0, y)]))
    turning = outward[0] * y - outward[1] * x
    terms = np.stack([np.ones_like(x), x, y, x * x, y * y, turning], axis=-1)
    inner = np.tile(np.abs(along) < 0.5 - 1.0 / cells, 4)
    left = np.zeros((len(x), len(x)))
    left[np.ix_(inner, inner)] = np.eye(inner.sum()) - terms[inner] @ np.linalg.pinv(terms[inner])
    products = (terms[:, :, None] * terms[:, None]).reshape(len(x), -1)
    drawn = np.zeros((3, *terms.T.shape))
    drawn[0], drawn[1, 1:3], drawn[2, 3:5] = terms.T, -outward, -2.0 * outward * np.stack([x, y])
    return _Perimeter(terms, products, drawn, inner, left)


def freed_of_unevenness(
    segments: Segments, used: BoolArray, sides: Sides, outward: FloatArray, blur: FloatArray
) -> Segments:
    """The segments of N markers, without what slopes of the contrast across the sides displace those ``used`` by.

    Parameters
    ----------
    used : (N, S) the measured ones of uneven markers
    outward : (E, m) distance up to which pixels outside the sides count [px]
    blur : (E, m) standard deviation of the blur across the sides [px]
    """
    relative = segments.contrast / np.where(segments.typical == 0.0, 1.0, segments.typical)
    reached, blurred = ((part / sides.across).reshape(used.shape) for part in (outward, blur))
    # Farther out are steeper slopes of a curvature, and larger differences by a slope.
    farther = 1.0 + 2.0 * (_SHOWN_AT * reached + _SHOWN_AT_BLUR * blurred)
    contrast, linear, quadratic = _quadratic(relative, used, sides.across.shape[1])
    slope = linear / farther + quadratic * farther
    displaced = _DISPLACES * blur.reshape(used.shape) * reached * slope / np.maximum(contrast, _LEAST)
    return segments._replace(shift=segments.shift - displaced * used)


def _quadratic(contrast: FloatArray, used: BoolArray, cells: int) -> FloatArray:
    """The contrast (N, S) as a quadratic function, and its slopes inward by linear and by quadratic terms, over sides.

    Returns
    -------
    (3, N, S)
    """
    around = _perimeter(cells)
    good = (used & around.inner & (np.abs(contrast - 1.0) < _ODD)).astype(float)
    number = good.sum(axis=1, keepdims=True)
    # What noise and the cells behind the sides make of contrasts.
    left = (1.0 + good * (contrast - 1.0)) @ around.left
    scatter = (left * left * good).sum(axis=1, keepdims=True) / np.maximum(number - len(_BEFORE), 1.0)
    scatter = np.maximum(scatter, _SCATTER)
    information = good @ around.products + scatter * _PRIOR
    amounts = np.linalg.solve(
        information.reshape(-1, len(_BEFORE), len(_BEFORE)), ((good * contrast) @ around.terms)[..., None]
    )[..., 0]
    amounts[:, 1:] *= number >= _FEWEST
    return np.asarray(amounts @ around.drawn)
