"""What the warm surface behind a marker does to its sides, where it is uneven, and where it ends beside the marker.

A segment is fitted as a step of one contrast. Where the contrast has a slope across the side, as before a heater that
is weaker towards its edges, the step looks displaced by it. Along a side the slope is seen: segments have different
contrasts. If the contrast is quadratic across the marker, with the axes of its sides, those of all four sides show the
slopes across them, too.

Pixels across the sides count as far as the model of a side holds. Where a gradient of temperature displaces sides, near
pixels alone count. And where the warm surface ends within the columns, or something warmer begins, only those before
its end: it shows on a side whose white is darker or brighter outward.
"""

from functools import cache
from typing import NamedTuple

import numpy as np

from thermal_fiducial.core.detection.corners.corner_errors import SURFACE_FALLS
from thermal_fiducial.core.detection.corners.segments import median_of, Segments, UNMEASURED
from thermal_fiducial.core.detection.corners.sides import EdgeModel, Sides
from thermal_fiducial.core.types import BoolArray, Float32Array, FloatArray

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
_FEWEST_SEGMENTS, _ODD, _LEAST = 8, 0.7, 0.3
# Least variance of a contrast that the quadratic function leaves.
_SCATTER = 1e-6
# Distance from the sides [blurs] beyond which pixels do not count where a gradient of temperature displaces a side: it
# displaces it by as much less as pixels are nearer, and noise by a tenth more.
_WITH_GRADIENT = 4.0
# The white outside a side begins so far from it [blurs]; the model of a blurred step needs that much of it.
_WHITE_BEGINS, _LEAST_WHITE = 1.2, 1.5
# Before its end, as the outer half of the white shows it, the surface is whole: distance from there [blurs].
_END_REACHES = 2.0
# What the outer half of the white is darker by than the inner one at the end of the surface: more than this share of
# the contrast, by which a heater that is weaker by half at the corners of a marker of 26 px fades in a pixel, and so
# many standard deviations more. What it is brighter by where something warmer begins: more than a lag tail of motion
# that is not known makes of it.
_FADES, _SURE, _WARMER = 0.04, 3.0, 0.2
# Least number of pixels in each half.
_FEWEST_PIXELS = 6
# What pixels are off by, in contrasts, where the model of a side does not hold: even markers leave up to 0.013.
_MISFIT = 0.03
# Motion blur beyond which the end of the surface is not looked for: what lags behind a side fades as well [px].
_STILL_PX = 0.3


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
    amounts[:, 1:] *= number >= _FEWEST_SEGMENTS
    return np.asarray(amounts @ around.drawn)


def shortened_reach(
    reach: FloatArray, uneven: BoolArray, ending: BoolArray, outward: FloatArray, width: FloatArray
) -> FloatArray:
    """The ``reach``, shorter for ``uneven`` markers (N,), and outside ``ending`` sides (N, 4).

    Parameters
    ----------
    reach : (N, 2, 4) distances inside and outside the sides of N markers up to which pixels count [px]
    outward, width : (E, m) distance outside the sides up to which pixels count, and the blur [px]
    """
    outward, width = (part.mean(axis=1).reshape(-1, 4) for part in (outward, width))
    near = np.where(uneven[:, None], _WITH_GRADIENT * width, np.inf)
    before = np.where(ending, np.maximum(outward - _END_REACHES * width, _LEAST_WHITE * width), np.inf)
    return np.asarray(np.minimum(reach, np.stack([near, np.minimum(near, before)], axis=1)))


def ending_sides(
    counts: Float32Array,
    modelled: EdgeModel,
    sides: Sides,
    segments: Segments,
    outward: FloatArray,
    width: FloatArray,
    motion_px: FloatArray,
) -> BoolArray:
    """Sides (N, 4) within whose columns the warm surface ends, or something warmer begins.

    Parameters
    ----------
    counts, modelled : as of :func:`thermal_fiducial.core.detection.corners.segments.measure`
    segments : measured with them
    outward, width : (E, m) distance outside the sides up to which pixels count, and the blur [px]
    motion_px : (N,) blur by motion
    """
    contrast, noise = np.repeat(segments.typical[:, 0], 4), np.repeat(segments.noise.min(axis=1), 4)
    # Where not all of a side is measured, something much warmer is so near that fewer pixels would show that instead.
    measured = segments.variance.reshape(width.shape) < UNMEASURED
    ends: BoolArray = np.asarray(measured.all(axis=1) & np.repeat(motion_px < _STILL_PX, 4))
    ends &= median_of(segments.noise.reshape(width.shape), measured)[:, 0] > (_MISFIT * contrast) ** 2
    which = np.flatnonzero(ends)
    if len(which) == 0:
        return ends.reshape(-1, 4)
    contrast, noise, outward, width = (of_sides[which] for of_sides in (contrast, noise, outward, width))
    # For each part, not for each side: numpy is slow where it repeats the few numbers of a row.
    begins = _WHITE_BEGINS * width
    contrasts = np.repeat(contrast, width.shape[1]).reshape(width.shape)
    limits = np.array([begins, 0.5 * (begins + outward), contrasts], dtype=np.float32)
    counting, value, outside = (v[:, :, which] for v in (modelled.counting, modelled.value, -sides.distance))
    planes = np.empty((4, *outside.shape), dtype=np.float32)
    np.multiply(counting, outside > limits[0], out=planes[0])
    np.multiply(planes[0], outside > limits[1], out=planes[1])
    rest = counts[:, :, which] - counts[0, 0, 0, 0]
    rest -= value * limits[2]
    np.multiply(planes[:2], rest, out=planes[2:])
    # Of all the white, and of its outer half. A product of matrices adds up three times as fast as a sum.
    moments = np.ones(outside[:, :, 0, 0].size, dtype=np.float32) @ planes.reshape(4, -1, value[0, 0].size)
    white, outer, white_sum, outer_sum = moments.reshape(4, *value.shape[2:]).sum(axis=2)
    number = np.array([outer, white - outer])
    level = np.array([outer_sum, white_sum - outer_sum]) / np.maximum(number, 1)
    variance = noise * (1.0 / np.maximum(number, 1)).sum(axis=0)
    darker, unsure = (level[1] - level[0]) * np.sign(contrast), _SURE * np.sqrt(variance)
    fades = (darker > _FADES * np.abs(contrast) + unsure) | (-darker > _WARMER * np.abs(contrast) + unsure)
    judged = (number >= _FEWEST_PIXELS).all(axis=0) & (outward > _LEAST_WHITE * width).all(axis=1)
    ends[which] = fades & judged
    return ends.reshape(-1, 4)
