"""Sub-pixel corners: the grid lines of the markers located on raw counts.

The sides of a marker, and where it helps the lines between its bits, are straight in normalised image coordinates,
gentle curves in the raw image. Across a line, columns (or rows, whichever cross it more squarely) of whole pixels are
compared with the known pattern blurred by the optics. One segment, a bit long, measures the displacement of its line
with levels of its own and a variance from its own residuals; a robust adjustment of the four corners to all segments
of the marker follows. Clutter, dead pixels and hidden stretches cost the segments that they touch. No pixel is
interpolated, so noise stays white and covariances honest.
"""

from dataclasses import dataclass
import math

import numpy as np

from thermal_fiducial.core.camera import Camera, ImagePoints
from thermal_fiducial.core.types import BoolArray, Float32Array, FloatArray, Gray, IntArray

# A curved line is a quartic through five of its points.
_T_NODES = np.linspace(0.0, 1.0, 5)
_QUARTIC = np.linalg.inv(np.vander(_T_NODES, increasing=True))
# Cells narrower than this many blurs show their neighbours' edges in every profile.
_NARROW = 5.0
_NEIGHBOURS = (-2, -1, 1, 2)
# Weight of a pixel or segment falls off beyond this many standard deviations.
_PIXEL_OUTLIER = 4.5
_SEGMENT_OUTLIER = 2.5
# Variance of a standard normal variable of which no more than that is kept.
_KEPT_VARIANCE = 0.911
# Standard deviation of a corner that no image noise explains: the optics' blur is not quite a Gaussian [px].
_FLOOR_PX = 0.010
# Factors on the blur, pass by pass: a wide one catches, narrow ones measure, until the corners no longer move.
_PASSES = (1.4, 1.0, 1.0, 1.0, 1.0)
_SETTLED_PX = 0.3
# Contrast of a segment over that of the marker: less is hidden, more is the edge of something else; and by how much the
# contrast of a plate varies.
_LEAST_CONTRAST, _MOST_CONTRAST, _CONTRAST_VARIES = 0.3, 2.5, 0.3
# A linearised displacement is good for this many blurs.
_REACHED = 2.0
# Standard deviation of what is known of the corners beforehand, and of their places among themselves [px].
_PRIOR_PX, _PRIOR_SHAPE_PX = 3.0, 0.7
_PRIOR = np.eye(8) / _PRIOR_PX**2
_PRIOR_OF_SHAPE = np.linalg.inv(_PRIOR_SHAPE_PX**2 * np.eye(8) + _PRIOR_PX**2 * np.kron(np.ones((4, 4)), np.eye(2)))
_HOPELESS = 1e6
# Pixels of the image that a line must have on both sides.
_BOTH_SIDES = 3


@dataclass(frozen=True, slots=True)
class RefinedCorners:
    """Corners of N markers.

    Parameters
    ----------
    corners_px : (N, 4, 2)
    covariances : (N, 4, 2, 2) [px^2]
    contrast : (N,) white minus black [counts]
    noise : (N,) standard deviation of a pixel about the model [counts]
    """

    corners_px: FloatArray
    covariances: FloatArray
    contrast: FloatArray
    noise: FloatArray

    def only(self, keep: BoolArray) -> 'RefinedCorners':
        """Those of the markers ``keep`` (N,)."""
        return RefinedCorners(self.corners_px[keep], self.covariances[keep], self.contrast[keep], self.noise[keep])


@dataclass(frozen=True, slots=True)
class GridPattern:
    """What lies on both sides of the grid lines of all markers of a dictionary with m x m cells, border included.

    Parameters
    ----------
    before : (M, 2, m + 1, m) value, 0 black and 1 white, before each of the lines; the first index says along columns
        (lines from left to right, counted from the top) or along rows (lines from the top down, counted from the left)
    step : the same of the change of value across the line
    """

    before: Float32Array
    step: Float32Array

    @property
    def cells(self) -> int:
        """Number of cells along a side, the border included."""
        return int(self.step.shape[-1])


def grid_pattern(bits: Gray) -> GridPattern:
    """Pattern of markers with ``bits`` (M, n, n), white round the black border."""
    grid = np.pad(bits.astype(np.float32), ((0, 0), (1, 1), (1, 1)))
    surrounded = np.pad(grid, ((0, 0), (1, 1), (0, 0)), constant_values=1.0)
    turned = np.pad(np.swapaxes(grid, 1, 2), ((0, 0), (1, 1), (0, 0)), constant_values=1.0)
    both = np.stack([surrounded, turned], axis=1)
    return GridPattern(both[:, :, :-1], np.diff(both, axis=2))


@dataclass(frozen=True, slots=True)
class _Lines:
    """Pixels across E grid lines, K columns of M pixels each."""

    #: (E, K) share of the line at which a column crosses it
    t: FloatArray
    #: (E, K) which columns repeat no other
    fresh: FloatArray
    #: (E, K, M) distance of each pixel [px]: downward for lines from left to right, rightward for those from the top
    distance: Float32Array
    #: (E, K, M) place of each pixel in the flat image
    pixel: IntArray
    #: (E, K, M) whether it lies in the image
    inside: np.ndarray
    #: (E, K, 2) unit normal, along which distances grow
    normal: FloatArray


@dataclass(frozen=True, slots=True)
class _Shifts:
    """Displacements of their lines (E, S) that segments measured, (E, S) variances, contrasts, noise variances."""

    shift: FloatArray
    variance: FloatArray
    contrast: FloatArray
    noise: FloatArray


def refine_corners(
    image: Float32Array,
    corners: ImagePoints,
    camera: Camera,
    before: Float32Array,
    step: Float32Array,
    blur_px: float,
    smear_px: FloatArray | None = None,
    columns: int = 6,
    *,
    near: BoolArray | None = None,
    inner: bool = False,
) -> RefinedCorners:
    """Corners of N markers, refined.

    Parameters
    ----------
    image : (height, width) counts
    corners : to within two pixels, or a third of a cell
    before, step : (N, 2, m + 1, m) of :class:`GridPattern`
    blur_px : standard deviation of optics and pixel
    smear_px : (N, 2) standard deviation of what motion adds to the blur, along its direction; none when left out
    columns : of pixels, in a segment
    near : (N,) which corners are good to a pixel already, so that nothing wide need catch them
    inner : whether the lines between the bits are used besides the sides
    """
    count = len(corners.px)
    px, covariances = corners.px.copy(), np.zeros((count, 4, 2, 2))
    contrast, noise = np.zeros(count), np.zeros(count)
    smear = np.zeros((count, 2)) if smear_px is None else smear_px
    away = np.ones(count, dtype=bool) if near is None else ~near
    for factor in _PASSES:
        active = np.flatnonzero(away)
        if len(active) == 0:
            away[:] = factor > 1.0
            continue
        part = corners if len(active) == count else corners.only(active)
        start = part.moved(px[active] - part.px, camera)
        blur = (factor * blur_px, smear[active])
        prior = _PRIOR_OF_SHAPE if factor > 1.0 else _PRIOR
        shift, *rest = _pass(image, start, camera, before[active], step[active], blur, prior, inner, columns)
        px[active] = start.px + shift
        covariances[active], contrast[active], noise[active] = rest
        away[active] = np.abs(shift).max(axis=(1, 2)) > _SETTLED_PX
        away |= factor > 1.0
    return RefinedCorners(px, covariances, contrast, noise)


def _pass(
    image: Float32Array,
    corners: ImagePoints,
    camera: Camera,
    before: Float32Array,
    step: Float32Array,
    blur: tuple[float, FloatArray],
    prior: FloatArray,
    inner: bool,
    columns: int,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """One linearised adjustment: shifts (N, 4, 2), covariances (N, 4, 2, 2), contrasts (N,), noise (N,)."""
    cells = step.shape[-1]
    optics, smear = blur
    numbers = np.arange(cells + 1) if inner else np.array([0, cells])
    widest = math.hypot(optics, float(np.linalg.norm(smear, axis=1).max()))
    lines, extent = _lines(corners.x, camera, image.shape, numbers / cells, cells * columns, widest)
    blurs = _blur_of_lines(lines.normal[:, cells * columns // 2], optics, smear)
    shifts = _measure(image, lines, before, step, numbers, extent, blurs)
    moved, covariances = _adjust(lines, shifts, numbers / cells, cells, prior)
    good = shifts.variance < _HOPELESS
    contrast = _mean_where(shifts.contrast, good)
    return moved, covariances, contrast, np.sqrt(_mean_where(shifts.noise, good))


def _blur_of_lines(normal: FloatArray, optics: float, smear: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Blur (E,) across and along lines with normals (E, 2), of markers with smear (N, 2) [px]."""
    vector = np.repeat(smear, len(normal) // len(smear), axis=0)
    across = np.sum(vector * normal, axis=1)
    along = vector[:, 1] * normal[:, 0] - vector[:, 0] * normal[:, 1]
    return np.hypot(optics, across), np.hypot(optics, along)


def _mean_where(values: FloatArray, good: np.ndarray) -> FloatArray:
    return np.asarray(np.sum(values * good, axis=1) / np.maximum(good.sum(axis=1), 1))


def _lines(
    x: FloatArray, camera: Camera, shape: tuple[int, ...], levels: FloatArray, count: int, blur: float
) -> tuple[_Lines, tuple[FloatArray, FloatArray]]:
    """Pixels across the grid lines at ``levels`` (L,) of both directions, and the marker's extent there."""
    height, width = shape
    nodes = _nodes(x, camera, levels).reshape(-1, len(_T_NODES), 2)
    span = nodes[:, -1] - nodes[:, 0]
    steep = np.abs(span[:, 1]) > np.abs(span[:, 0])
    curve: FloatArray = np.asarray(_QUARTIC @ np.where(steep[:, None, None], nodes[..., ::-1], nodes), dtype=np.float64)
    along, across = curve[..., 0], curve[..., 1]
    t: FloatArray = np.tile((np.arange(count) + 0.5) / count, (len(nodes), 1))
    whole: FloatArray = np.rint(_value(along, t))
    fresh = np.ones(whole.shape)
    fresh[:, 1:] = whole[:, 1:] != whole[:, :-1]
    for _ in range(2):
        t = np.asarray(t - (_value(along, t) - whole) / _slope(along, t))
    centre, slope = _value(across, t), _slope(across, t) / _slope(along, t)
    # Distances grow downward across lines from left to right, and rightward across those from the top down.
    first = np.arange(len(nodes)) // len(levels) % 2 == 0
    sign = np.where(steep, -np.sign(span[:, 1]), np.sign(span[:, 0])) * np.where(first, 1.0, -1.0)
    pitch = sign[:, None] / np.sqrt(1.0 + slope**2)
    half = int(np.clip(np.ceil(2.5 * blur + 1.0), 4, 10))
    base = np.rint(centre)
    offsets = np.arange(-half, half + 1)
    distance = (((base - centre)[..., None] + offsets) * pitch[..., None]).astype(np.float32)
    place = base.astype(np.int64)[..., None] + offsets
    far, end = np.where(steep, width, height)[:, None, None], np.where(steep, height, width)[:, None]
    fresh = fresh * ((whole >= 0) & (whole < end) & (base >= _BOTH_SIDES) & (base < far[..., 0] - _BOTH_SIDES))
    inside = (place >= 0) & (place < far)
    across_stride, along_stride = np.where(steep, 1, width)[:, None, None], np.where(steep, width, 1)[:, None]
    pixel = place * across_stride + (whole.astype(np.int64) * along_stride)[..., None]
    normal = np.stack([-slope * pitch, pitch], axis=-1)
    normal = np.where(steep[:, None, None], normal[..., ::-1], normal)
    return _Lines(t, fresh, distance, pixel, inside, normal), _cell_sizes(nodes, len(levels), normal[:, count // 2])


def _cell_sizes(nodes: FloatArray, levels: int, normal: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Extent of the marker across and along each of its E lines [px]."""
    middle = nodes[:, 2].reshape(-1, levels, 2)
    across = np.repeat(middle[:, -1] - middle[:, 0], levels, axis=0)
    return np.abs(np.sum(across * normal, axis=-1)), np.linalg.norm(nodes[:, -1] - nodes[:, 0], axis=-1)


def _nodes(c: FloatArray, camera: Camera, levels: FloatArray) -> FloatArray:
    """Pixels (N, 2, L, 5, 2) of five points on every grid line of quadrilaterals (N, 4, 2), normalised."""
    # Projective map of the unit square (P. Heckbert, "Fundamentals of texture mapping", 1989, section 2.2.3).
    d1, d2, d3 = c[:, 1] - c[:, 2], c[:, 3] - c[:, 2], c[:, 0] - c[:, 1] + c[:, 2] - c[:, 3]
    determinant = d1[:, 0] * d2[:, 1] - d1[:, 1] * d2[:, 0]
    g = ((d3[:, 0] * d2[:, 1] - d3[:, 1] * d2[:, 0]) / determinant)[:, None]
    h = ((d1[:, 0] * d3[:, 1] - d1[:, 1] * d3[:, 0]) / determinant)[:, None]
    right, down = c[:, 1] - c[:, 0] + g * c[:, 1], c[:, 3] - c[:, 0] + h * c[:, 3]
    level, t = np.meshgrid(levels, _T_NODES, indexing='ij')
    a, b = np.stack([t, level]).ravel(), np.stack([level, t]).ravel()
    x = (c[:, None, 0] + a[:, None] * right[:, None] + b[:, None] * down[:, None]) / (1.0 + a * g + b * h)[..., None]
    return camera.distort(x).reshape(len(c), 2, len(levels), len(_T_NODES), 2)


def _value(quartic: FloatArray, t: FloatArray) -> FloatArray:
    c = quartic[:, :, None]
    return np.asarray((((c[:, 4] * t + c[:, 3]) * t + c[:, 2]) * t + c[:, 1]) * t + c[:, 0])


def _slope(quartic: FloatArray, t: FloatArray) -> FloatArray:
    c = quartic[:, :, None]
    return np.asarray(((4.0 * c[:, 4] * t + 3.0 * c[:, 3]) * t + 2.0 * c[:, 2]) * t + c[:, 1])


# The normal distribution and its density, over +-_REACH standard deviations.
_REACH, _FINENESS = 6.0, 64
_NORMAL = np.array(
    [0.5 * math.erfc(-z / math.sqrt(2.0)) for z in np.arange(-_REACH * _FINENESS, _REACH * _FINENESS + 1) / _FINENESS],
    dtype=np.float32,
)
_DENSITY = np.gradient(_NORMAL, 1.0 / _FINENESS).astype(np.float32)


def _blurred_step(distance: Float32Array, sharpness: Float32Array) -> tuple[Float32Array, Float32Array]:
    """A step from 0 to 1 at zero, and its derivative, both [1/px] blurred by the inverse of ``sharpness``."""
    limit = np.float32(_REACH * _FINENESS)
    index = (np.clip(distance * (sharpness * np.float32(_FINENESS)), -limit, limit) + (limit + np.float32(0.5))).astype(
        np.intp
    )
    return _NORMAL.take(index), _DENSITY.take(index) * sharpness


def _along(values: Float32Array, t: FloatArray, extent: FloatArray, blur: FloatArray) -> Float32Array:
    """Values (E, m, V) of the cells along the lines, 0 beyond, as blurred columns at t (E, K) see them: (E, K, V)."""
    cells = values.shape[1]
    z = (t[..., None] * cells - np.arange(cells + 1)) * (extent / (cells * blur))[:, None, None]
    step = 0.5 + 0.5 * np.tanh(0.7988 * z * (1.0 + 0.04417 * z * z))
    return np.asarray((step[..., :-1] - step[..., 1:]).astype(np.float32) @ values)


def _model(
    lines: _Lines,
    before: Float32Array,
    step: Float32Array,
    numbers: IntArray,
    extent: tuple[FloatArray, FloatArray],
    blurs: tuple[FloatArray, FloatArray],
) -> tuple[Float32Array, Float32Array, Float32Array]:
    """White's share of every pixel, its derivative by distance, and the weight of the pixel, each (E, K, M)."""
    cells = step.shape[-1]
    cell, along = extent[0] / cells, extent[1]
    blur, blur_along = blurs
    sharpness = (1.0 / blur).astype(np.float32)[:, None, None]
    # Black is what the cells take away from the white around: nothing beyond the ends of a line.
    near = np.stack([1.0 - before[:, :, numbers], step[:, :, numbers]], axis=-1).reshape(-1, cells, 2)
    black, own = np.split(_along(near, lines.t, along, blur_along), 2, axis=-1)
    value, slope = _blurred_step(lines.distance, sharpness)
    value, slope = own * value - black, own * slope
    narrow = np.flatnonzero(cell < _NARROW * blur)
    if len(narrow):
        t, distance = lines.t[narrow], lines.distance[narrow]
        width = cell[narrow].astype(np.float32)[:, None, None]
        padded = np.pad(step, ((0, 0), (0, 0), (2, 2), (0, 0)))
        beyond = np.stack([padded[:, :, numbers + 2 + offset] for offset in _NEIGHBOURS], axis=-1)
        amounts = _along(beyond.reshape(-1, cells, len(_NEIGHBOURS))[narrow], t, along[narrow], blur_along[narrow])
        for index, offset in enumerate(_NEIGHBOURS):
            share, rise = _blurred_step(distance - offset * width, sharpness[narrow])
            amount = amounts[..., index : index + 1]
            value[narrow] += amount * (share if offset > 0 else share - 1.0)
            slope[narrow] += amount * rise
    reach = np.where(cell < _NARROW * blur, 1.6 * cell, cell - 2.0 * blur)
    quiet = np.minimum(reach, np.maximum(cell - blur, 2.5))
    number = np.tile(numbers, len(cell) // len(numbers))
    low = np.where(number == 0, quiet, reach)[:, None, None]
    high = np.where(number == cells, quiet, reach)[:, None, None]
    weight = lines.inside & (lines.distance >= -low) & (lines.distance <= high)
    weight = weight & ((np.abs(own[..., 0]) > 0.7) & (lines.fresh > 0.0))[..., None]
    return value, slope, weight.astype(np.float32)


def _measure(
    image: Float32Array,
    lines: _Lines,
    before: Float32Array,
    step: Float32Array,
    numbers: IntArray,
    extent: tuple[FloatArray, FloatArray],
    blurs: tuple[FloatArray, FloatArray],
) -> _Shifts:
    """Displacement of each segment, one a cell long, by least squares over level, contrast and displacement."""
    value, slope, weight = _model(lines, before, step, numbers, extent, blurs)
    cells = step.shape[-1]
    reach = _REACHED * np.repeat(blurs[0], cells).reshape(len(step), -1)
    shape = (value.shape[0] * cells, -1)
    counts = image.ravel().take(lines.pixel, mode='clip').reshape(shape)
    middle = counts[:, counts.shape[1] // 2][:, None]
    X = np.stack([np.ones_like(counts), value.reshape(shape), slope.reshape(shape), counts - middle], axis=1)
    weight = weight.reshape(shape)
    fit = _fit(X, weight)
    shifts = _judged(fit, reach)
    residual = X[:, 3] - (fit[0].astype(np.float32)[:, None] @ X[:, :3])[:, 0]
    outlier = (np.abs(residual) > _PIXEL_OUTLIER * np.sqrt(shifts.noise).reshape(-1, 1)) & (weight > 0.0)
    touched = np.flatnonzero(outlier.any(axis=1))
    if len(touched):
        for all_of, again in zip(fit, _fit(X[touched], weight[touched] * ~outlier[touched]), strict=True):
            all_of[touched] = again
        shifts = _judged(fit, reach)
    return shifts


#: Coefficients (..., 3) of level, contrast and its product with the displacement, variances (..., 2) of the last two
#: for noise of 1, sum of squared residuals (...), number of pixels (...).
_Fit = tuple[FloatArray, FloatArray, FloatArray, FloatArray]


def _fit(X: Float32Array, weight: Float32Array) -> _Fit:
    """Least squares of the last of four columns X (segments, 4, pixels) on the others: (1, model, derivative)."""
    gram = ((X * weight[:, None]) @ np.swapaxes(X, -1, -2)).astype(np.float64)
    number = gram[:, 0, 0].copy()
    ridge = (1e-6 * number + 1e-6)[:, None, None] * np.eye(3)
    inverse: FloatArray = np.asarray(np.linalg.inv(gram[:, :3, :3] + ridge), dtype=np.float64)
    right = gram[:, :3, 3]
    coefficients: FloatArray = np.asarray((inverse @ right[..., None])[..., 0])
    square: FloatArray = np.maximum(gram[:, 3, 3] - np.sum(coefficients * right, axis=-1), 0.0)
    return coefficients, inverse[:, [1, 2], [1, 2]], square, number


def _judged(fit: _Fit, reach: FloatArray) -> _Shifts:
    """Which segments measure anything, within their reach (N, S)."""
    shape = reach.shape
    coefficients, unit_variances, square, number = fit
    free = (number - 3.0).reshape(shape)
    usable = free > 1.5
    noise = square.reshape(shape) / np.maximum(free, 1.0)
    contrast = coefficients[:, 1].reshape(shape)
    typical_noise, typical = _median_where(noise, usable), _median_where(contrast, usable)
    noise = np.where(noise > 2.5 * typical_noise, noise, typical_noise) + 1e-3
    own = noise * unit_variances[:, 0].reshape(shape)
    scale = np.sign(typical) / np.maximum(np.abs(typical), 1e-6)
    relative, unsure = contrast * scale, 2.0 * np.sqrt(own) * np.abs(scale)
    usable &= (relative > _LEAST_CONTRAST - unsure) & (relative < _MOST_CONTRAST + unsure)
    # A faint segment hardly tells its contrast, by which its displacement is divided: the others tell it better.
    others = (_CONTRAST_VARIES * typical) ** 2 + 1e-9
    safe = np.where(usable, (contrast * others + typical * own) / (others + own), 1.0)
    shift = np.where(usable, np.clip(-coefficients[:, 2].reshape(shape) / safe, -reach, reach), 0.0)
    variance = np.where(usable, noise * unit_variances[:, 1].reshape(shape) / safe**2, _HOPELESS)
    return _Shifts(shift, variance, contrast, noise)


def _median_where(values: FloatArray, good: np.ndarray) -> FloatArray:
    """Medians (N, 1) of the good ones of values (N, S), 0 where there is none."""
    order = np.sort(np.where(good, values, np.inf), axis=1)
    middle = np.maximum(good.sum(axis=1) - 1, 0) // 2
    median = np.take_along_axis(order, middle[:, None], axis=1)
    return np.where(np.isfinite(median), median, 0.0)


def _adjust(
    lines: _Lines, shifts: _Shifts, levels: FloatArray, cells: int, prior: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """How corners move (N, 4, 2) to explain the shifts of all segments, and their covariances (N, 4, 2, 2)."""
    count = len(shifts.shift)
    A = _design(lines, levels, cells, count)
    deviation = np.sqrt(shifts.variance)
    robust = np.ones_like(deviation)
    for _ in range(3):
        weighted = A * (robust / shifts.variance)[..., None]
        information = np.swapaxes(weighted, -1, -2) @ A + prior
        covariance = np.linalg.inv(information)
        moved = (covariance @ (np.swapaxes(weighted, -1, -2) @ shifts.shift[..., None]))[..., 0]
        normalised = (shifts.shift - (A @ moved[..., None])[..., 0]) / deviation
        used = shifts.variance < _HOPELESS
        scale = np.maximum(1.4826 * _median_where(np.abs(normalised), used), 1.0)
        robust = 1.0 / np.maximum(np.abs(normalised) / (_SEGMENT_OUTLIER * scale), 1.0) ** 2
    kept = used & (robust > 0.99)
    chi2 = np.sum(np.where(kept, normalised**2, 0.0), axis=1) / _KEPT_VARIANCE
    free = np.maximum(kept.sum(axis=1) - 8.0, 0.0)
    # The scatter of the segments corrects the noise of their pixels, as far as there are segments to tell.
    covariance = covariance * ((chi2 + 24.0) / (free + 24.0))[:, None, None]
    blocks = np.einsum('nikil->nikl', covariance.reshape(count, 4, 2, 4, 2))
    return moved.reshape(count, 4, 2), blocks + _FLOOR_PX**2 * np.eye(2)


def _design(lines: _Lines, levels: FloatArray, cells: int, count: int) -> FloatArray:
    """Derivative (N, segments, 8) of the segments' displacements along their normals by the corners'."""
    edges = len(lines.t)
    fresh = lines.fresh.reshape(edges, cells, -1)
    t = np.sum(lines.t.reshape(fresh.shape) * fresh, axis=-1) / np.maximum(fresh.sum(axis=-1), 1.0)
    t = t.reshape(count, 2, len(levels), cells)
    level = np.broadcast_to(levels[:, None], t.shape[1:])
    a = np.stack([t[:, 0], np.broadcast_to(level[0], t[:, 0].shape)], axis=1)
    b = np.stack([np.broadcast_to(level[0], t[:, 0].shape), t[:, 1]], axis=1)
    share = np.stack([(1.0 - a) * (1.0 - b), a * (1.0 - b), a * b, (1.0 - a) * b], axis=-1)
    normal = lines.normal.reshape(edges, cells, -1, 2)[:, :, fresh.shape[-1] // 2].reshape(*t.shape, 1, 2)
    return np.asarray((share[..., None] * normal).reshape(count, -1, 8))
