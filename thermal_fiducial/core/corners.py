"""Sub-pixel corners: the outer edges of the black squares located on raw counts.

Every side is a straight line in normalised image coordinates, a gentle curve in the raw image. Along it, columns (or
rows, whichever cross it more squarely) of whole pixels are compared with the profile of a blurred, lagging step
between the local levels of both sides (:mod:`.edge_profile`), the known bits next to a narrow border included. The
columns are grouped in segments, each of which measures one displacement with its own levels and its variance from its
own residuals; a robust line through the segments of a side, and the intersections of the lines, are the corners.
Clutter, dead pixels and hidden stretches cost the segments that they touch. No pixel is interpolated, so noise stays
white and covariances honest.
"""

from dataclasses import dataclass

import numpy as np

from thermal_fiducial.core.camera import Camera
from thermal_fiducial.core.edge_profile import EdgeProfiles
from thermal_fiducial.core.types import BoolArray, Float32Array, FloatArray, Gray, IntArray

_SEGMENTS = 8
_COLUMNS = 4
_NODES = 5
# Columns this many blurs (and the lag's tail) away from a corner see one edge only.
_CORNER_BLURS = 2.0


@dataclass(frozen=True, slots=True)
class RefinedCorners:
    """Corners of N markers.

    Parameters
    ----------
    corners_px : (N, 4, 2)
    covariances : (N, 4, 2, 2) [px^2]
    contrast : (N,) white minus black [counts]
    """

    corners_px: FloatArray
    covariances: FloatArray
    contrast: FloatArray


@dataclass(frozen=True, slots=True)
class _Columns:
    """Pixels across the E = 4 N sides: K columns of M pixels each."""

    #: (E, K) share of the side at which a column crosses it
    t: FloatArray
    #: (E, K, M) outward distance of each pixel [px]
    distance: Float32Array
    #: (E, K, M) place of each pixel in the flat image
    pixel: IntArray
    #: (E, K, M) 1 for a pixel in the image, in a column that repeats no other
    weight: Float32Array
    #: (E, 2) outward normal in the image, at the middle
    normal: FloatArray


@dataclass(frozen=True, slots=True)
class _Shifts:
    """Outward displacements that the segments (E, S) measured."""

    t: FloatArray
    shift: FloatArray
    variance: FloatArray
    contrast: FloatArray


def edge_bits(bits: Gray) -> Gray:
    """The two rows of bits next to each side (M, 4, 2, n) of patterns (M, n, n), in the direction of the sides."""
    turned = np.stack([np.rot90(bits, turn, axes=(1, 2)) for turn in range(4)], axis=1)
    return turned[:, :, :2]


def refine_corners(
    image: Float32Array,
    corners_px: FloatArray,
    camera: Camera,
    border_bits: Gray,
    blur_px: float,
    lag_px: FloatArray,
    passes: tuple[float, ...] = (2.0, 1.0, 1.0),
) -> RefinedCorners:
    """Corners of N markers, refined.

    Parameters
    ----------
    image : (height, width) counts
    corners_px : (N, 4, 2) to within two pixels, or a third of a bit
    border_bits : (N, 4, 2, n) of :func:`edge_bits`
    blur_px : standard deviation of optics and pixel
    lag_px : (N, 2) image motion within the bolometers' time constant, against the motion
    passes : factor on the blur, for each pass: a wide one catches, narrow ones measure
    """
    count = len(corners_px)
    x = camera.normalise(corners_px)
    lag = np.repeat(lag_px, 4, axis=0)
    bits = border_bits.reshape(4 * count, 2, -1)
    for factor in passes:
        blur = factor * blur_px
        half = int(np.clip(np.ceil(2.5 * blur + 1.5 * np.abs(lag_px).max(initial=0.0) + 1.0), 4, 10))
        columns, cell = _columns(x, camera, image.shape, bits.shape[-1] + 2, half, blur, lag)
        shifts = _measure(image, columns, cell, bits, blur, np.sum(lag * columns.normal, axis=-1))
        x, covariances = _intersect(x, camera, shifts)
    J = camera.distort_jacobian(x)
    return RefinedCorners(
        camera.distort(x),
        J @ covariances @ np.swapaxes(J, -1, -2),
        np.median(shifts.contrast.reshape(count, -1), axis=1),
    )


_T_NODES = np.linspace(0.0, 1.0, _NODES)
_POLYNOMIAL = np.linalg.inv(np.vander(_T_NODES, increasing=True))


def _columns(
    x: FloatArray, camera: Camera, shape: tuple[int, ...], cells: int, half: int, blur: float, lag: FloatArray
) -> tuple[_Columns, FloatArray]:
    """Columns across the sides of quadrilaterals (N, 4, 2), and the size (E,) of a bit across each side [px]."""
    height, width = shape
    start = x.reshape(-1, 2)
    chord = (np.roll(x, -1, axis=1) - x).reshape(-1, 2)
    nodes = camera.distort(start[:, None] + _T_NODES[:, None] * chord[:, None])
    span = nodes[:, -1] - nodes[:, 0]
    length = np.linalg.norm(span, axis=-1)
    tangent = span / length[:, None]
    normal = np.stack([tangent[:, 1], -tangent[:, 0]], axis=-1)
    inward = (np.roll(x, 1, axis=1) - x).reshape(-1, 2)
    corners = nodes[:, 0].reshape(x.shape)
    neighbour = (np.roll(corners, 1, axis=1) - corners).reshape(-1, 2)
    opposite = (np.roll(corners, -2, axis=1) - np.roll(corners, -1, axis=1)).reshape(-1, 2)
    cell = -0.5 * np.sum((neighbour + opposite) * normal, axis=-1) / cells
    del inward
    steep = np.abs(span[:, 1]) > np.abs(span[:, 0])
    curve = np.einsum('ij,ejk->eik', _POLYNOMIAL, nodes)
    along = np.where(steep[:, None], curve[..., 1], curve[..., 0])
    across = np.where(steep[:, None], curve[..., 0], curve[..., 1])
    margin_px = _CORNER_BLURS * blur + 1.0 + 1.5 * np.abs(np.sum(lag * tangent, axis=-1))
    margin = np.minimum(margin_px / length, 0.2)[:, None]
    count = _SEGMENTS * _COLUMNS
    share = (np.arange(count) + 0.5) / count
    t = margin + (1.0 - 2.0 * margin) * share
    whole = np.rint(_value(along, t))
    repeated = np.zeros(whole.shape, dtype=bool)
    repeated[:, 1:] = whole[:, 1:] == whole[:, :-1]
    for _ in range(2):
        t = t - (_value(along, t) - whole) / _slope(along, t)
    centre = _value(across, t)
    d_along, d_across = _slope(along, t), _slope(across, t)
    # Outward is (dv, -du) of a clockwise tangent (du, dv); what counts is its component across the columns.
    sign = np.where(steep, 1.0, -1.0)[:, None]
    pitch = sign * d_along / np.hypot(d_along, d_across)
    base = np.rint(centre)
    offsets = np.arange(-half, half + 1)
    distance = (((base - centre)[..., None] + offsets) * pitch[..., None]).astype(np.float32)
    place = base[..., None].astype(np.int64) + offsets
    extent_across = np.where(steep, width, height)[:, None, None]
    extent_along = np.where(steep, height, width)[:, None]
    inside = (place >= 0) & (place < extent_across) & ((whole >= 0) & (whole < extent_along) & ~repeated)[..., None]
    stride_across = np.where(steep, 1, width)[:, None, None]
    stride_along = np.where(steep, width, 1)[:, None]
    pixel = np.where(inside, place * stride_across + (whole.astype(np.int64) * stride_along)[..., None], 0)
    inner = np.where(cell >= 5.0 * blur, cell - 2.0 * blur, 2.0 * cell - 1.5 * blur)[:, None, None]
    outer = np.maximum(cell, 2.5)[:, None, None]
    inside &= (distance >= -inner) & (distance <= outer)
    return _Columns(t, distance, pixel, inside.astype(np.float32), normal), cell


def _value(polynomial: FloatArray, t: FloatArray) -> FloatArray:
    result = polynomial[:, -1:] * t
    for order in range(_NODES - 2, 0, -1):
        result = (result + polynomial[:, order : order + 1]) * t
    return np.asarray(result + polynomial[:, :1])


def _slope(polynomial: FloatArray, t: FloatArray) -> FloatArray:
    result = (_NODES - 1.0) * polynomial[:, -1:] * t
    for order in range(_NODES - 2, 1, -1):
        result = (result + order * polynomial[:, order : order + 1]) * t
    return np.asarray(result + polynomial[:, 1:2])


def _measure(
    image: Float32Array, columns: _Columns, cell: FloatArray, bits: Gray, blur: float, lag: FloatArray
) -> _Shifts:
    profiles = EdgeProfiles(blur, lag)
    index = profiles.index(columns.distance)
    model, slope = profiles.value(index), profiles.slope(index)
    narrow = np.flatnonzero(cell < 5.0 * blur)
    if len(narrow):
        subset = EdgeProfiles(blur, lag[narrow])
        w = cell[narrow].astype(np.float32)[:, None, None]
        b1, b2 = _blurred_bits(bits[narrow], columns.t[narrow], cell[narrow], blur)
        for step, amount in ((1.0, b1), (2.0, b2 - b1)):
            index = subset.index(columns.distance[narrow] + step * w)
            model[narrow] += amount * (1.0 - subset.value(index))
            slope[narrow] -= amount * subset.slope(index)
    edges = len(cell)
    shape = (edges * _SEGMENTS, -1)
    counts = image.ravel().take(columns.pixel).reshape(shape)
    weight = columns.weight.reshape(shape)
    X = np.stack([np.ones_like(counts), model.reshape(shape), slope.reshape(shape), counts - counts[:, :1]], axis=1)
    gram = ((X * weight[:, None]) @ np.swapaxes(X, -1, -2)).astype(np.float64)
    shift, variance, contrast, coefficients, noise = _solve(gram, edges)
    residual = X[:, 3] - np.einsum('sip,si->sp', X[:, :3], coefficients.astype(np.float32))
    outlier = np.abs(residual) > 4.5 * np.sqrt(noise)[:, None].astype(np.float32)
    if np.any(outlier & (weight > 0)):
        weight = weight * ~outlier
        gram = ((X * weight[:, None]) @ np.swapaxes(X, -1, -2)).astype(np.float64)
        shift, variance, contrast, coefficients, noise = _solve(gram, edges)
    column_weight = columns.weight.max(axis=-1)
    t = columns.t.reshape(edges, _SEGMENTS, _COLUMNS)
    used = column_weight.reshape(edges, _SEGMENTS, _COLUMNS)
    t = np.sum(t * used, axis=-1) / np.maximum(used.sum(axis=-1), 1.0)
    return _Shifts(
        t,
        shift.reshape(edges, _SEGMENTS),
        variance.reshape(edges, _SEGMENTS),
        contrast.reshape(edges, _SEGMENTS),
    )


def _solve(gram, edges):
    """Least squares of level, contrast and displacement per segment."""
    number = gram[:, 0, 0]
    A = gram[:, :3, :3] + 1e-6 * np.maximum(number, 1.0)[:, None, None] * np.eye(3)
    inverse = np.linalg.inv(A)
    right = gram[:, :3, 3]
    coefficients = (inverse @ right[..., None])[..., 0]
    square = np.maximum(gram[:, 3, 3] - np.sum(coefficients * right, axis=-1), 0.0)
    freedom = number - 3.0
    own = np.where(freedom > 0.5, square / np.maximum(freedom, 1.0), np.inf)
    own = own.reshape(-1, 4 * _SEGMENTS)
    level = np.nanmedian(np.where(np.isfinite(own), own, np.nan), axis=1, keepdims=True)
    noise = np.where(own > 2.5 * level, own, level).reshape(-1)
    contrast = coefficients[:, 1]
    safe = np.where(np.abs(contrast) > 1e-3, contrast, 1e-3)
    shift = -coefficients[:, 2] / safe
    variance = np.where(freedom > 0.5, noise * inverse[:, 2, 2] / safe**2, np.inf)
    variance = np.where(np.isfinite(variance), variance, 1e6)
    typical = np.median(contrast.reshape(-1, 4 * _SEGMENTS), axis=1).repeat(4 * _SEGMENTS)
    variance = np.where(contrast * np.sign(typical) > 0.3 * np.abs(typical), variance, 1e6)
    return np.clip(shift, -2.0, 2.0), variance, contrast, coefficients, noise


def _blurred_bits(bits: Gray, t: FloatArray, cell: FloatArray, blur: float) -> tuple[Float32Array, Float32Array]:
    n = bits.shape[-1]
    position = t[..., None] * (n + 2) - np.arange(1, n + 2)
    step = 0.5 + 0.5 * np.tanh(0.8 * position * (cell / blur)[:, None, None])
    window = step[..., :-1] - step[..., 1:]
    first = np.einsum('ekn,en->ek', window, bits[:, 0].astype(np.float64))
    second = np.einsum('ekn,en->ek', window, bits[:, 1].astype(np.float64))
    return first[..., None].astype(np.float32), second[..., None].astype(np.float32)


def _intersect(x: FloatArray, camera: Camera, shifts: _Shifts) -> tuple[FloatArray, FloatArray]:
    """Corners (N, 4, 2) of the moved lines, normalised, and their covariances (N, 4, 2, 2)."""
    start = x.reshape(-1, 2)
    chord = (np.roll(x, -1, axis=1) - x).reshape(-1, 2)
    n = np.stack([chord[:, 1], -chord[:, 0]], axis=-1) / np.linalg.norm(chord, axis=-1, keepdims=True)
    J = camera.distort_jacobian(start[:, None] + shifts.t[..., None] * chord[:, None])
    image_tangent = (J @ chord[:, None, :, None])[..., 0]
    image_normal = np.stack([image_tangent[..., 1], -image_tangent[..., 0]], axis=-1)
    image_normal /= np.linalg.norm(image_normal, axis=-1, keepdims=True)
    gain = np.einsum('esi,esij,ej->es', image_normal, J, n)
    moved, deviation = shifts.shift / gain, np.sqrt(shifts.variance) / gain
    basis = np.stack([1.0 - shifts.t, shifts.t], axis=-1)
    weight = 1.0 / deviation**2
    prior = np.eye(2) / (3.0 / gain.mean(axis=1))[:, None, None] ** 2
    robust = np.ones_like(weight)
    for _ in range(3):
        total = weight * robust
        information = np.einsum('es,esi,esj->eij', total, basis, basis) + prior
        covariance = np.linalg.inv(information)
        ends = np.einsum('eij,es,esj->ei', covariance, total * moved, basis)
        normalised = (moved - np.einsum('esi,ei->es', basis, ends)) / deviation
        scale = np.maximum(1.4826 * np.median(np.abs(normalised), axis=1, keepdims=True), 1.0)
        robust = 1.0 / np.maximum(np.abs(normalised) / (2.5 * scale), 1.0) ** 2
    kept = robust > 0.99
    chi2 = np.sum(np.where(kept, normalised**2, 0.0).reshape(len(x), -1), axis=1)
    freedom = np.maximum(np.sum((kept & (shifts.variance < 1e5)).reshape(len(x), -1), axis=1) - 8.0, 0.0)
    factor = (chi2 + 24.0) / (freedom + 24.0)
    covariance = covariance * np.repeat(factor, 4)[:, None, None]
    ends = ends.reshape(-1, 4, 2)
    variance = np.einsum('eii->ei', covariance).reshape(-1, 4, 2)
    n = n.reshape(-1, 4, 2)
    N = np.stack([np.roll(n, 1, axis=1), n], axis=-2)
    offsets = np.stack([np.roll(ends[..., 1], 1, axis=1), ends[..., 0]], axis=-1)
    spread = np.stack([np.roll(variance[..., 1], 1, axis=1), variance[..., 0]], axis=-1)
    inverse = np.linalg.inv(N)
    delta = (inverse @ offsets[..., None])[..., 0]
    return x + delta, (inverse * spread[..., None, :]) @ np.swapaxes(inverse, -1, -2)
