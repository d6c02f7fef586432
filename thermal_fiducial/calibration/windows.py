"""Pixel windows around the points of a board, with the background removed."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from thermal_fiducial.calibration.appearance import Appearance
from thermal_fiducial.calibration.surface import Surfaces
from thermal_fiducial.core.types import BoolArray, Float32Array, FloatArray, IntArray

#: Smallest spacing of points for a sub-pixel fit [px].
LEAST_SPACING = 4.0
_LEAST_PIXELS = 12
# Bounds of the blur [px].
_BLUR_BOUNDS = (0.2, 60.0)
# Smallest contrast relative to the neighbours'; where contrast reverses, a point is not observable.
_LEAST_CONTRAST = 0.25
# Prediction of contrast from neighbours: reach [steps], fewest neighbours, ridge on the slope.
_NEAR, _LEAST_NEIGHBOURS, _SLOPE_RIDGE = 2, 4, 0.1


@dataclass(frozen=True)
class PointWindows:
    """Pixels around P points, in rows of N, padded by pixels of zero weight.

    Parameters
    ----------
    appearance : of each point
    index : (P,) indices of the points
    starts : (P, 2) [px]
    places : (P, N, 2) on the board, relative to ``starts`` [steps]
    counts : (P, N) weighted, projected off the background
    weight : (P, N)
    ground : (P, N, 3) orthonormal basis of the background (level and slope)
    inverse : (P, 2, 2) derivative of steps by pixels
    scale : (P, 2) steps along the axes per pixel
    expected : (P, N) contrast predicted from the neighbours, or 1 everywhere
    beside : (P, N) contribution of fixed neighbours
    """

    appearance: Appearance
    index: IntArray
    starts: FloatArray
    places: FloatArray
    counts: FloatArray
    weight: FloatArray
    ground: FloatArray
    inverse: FloatArray
    scale: FloatArray
    expected: FloatArray
    beside: FloatArray

    def rows(self, index: IntArray) -> 'PointWindows':
        """The windows of a subset of the points."""
        parts = {name: values[index] for name, values in vars(self).items() if name != 'appearance'}
        return PointWindows(self.appearance.rows(index), **parts)

    def products(self, parameters: FloatArray, free: int) -> tuple[FloatArray, FloatArray]:
        """Inner products of the pattern and its derivatives by the first parameters, without their background.

        Returns (P, 1 + free, 1 + free) with each other and (P, 1 + free) with the counts. A fit needs no more of them,
        and the background of the products takes far less than that of each pixel.

        Parameters
        ----------
        parameters : (P, 4) offset of the point [px], logarithm of the blur [px], width [steps]
        """
        places = self.places - (self.inverse @ parameters[:, :2, None]).swapaxes(1, 2)
        log_blur = parameters[:, 2, None]
        low, high = np.log(_BLUR_BOUNDS)
        values, slopes = self.appearance.shape(places, self._blur(parameters), parameters[:, 3], free)
        rows = np.empty((len(values), 1 + free, values.shape[1]))
        np.add(values, self.beside, out=rows[:, 0])
        for pixel_axis in range(2):
            towards = self.inverse[:, :, pixel_axis, None]
            rows[:, 1 + pixel_axis] = -slopes[0] * towards[:, 0] - slopes[1] * towards[:, 1]
        if free > 2:
            rows[:, 3] = slopes[2] * ((low < log_blur) & (log_blur < high))
        if free > 3:
            rows[:, 4] = slopes[3]
        rows *= (self.weight * self.expected)[:, None]
        background = rows @ self.ground
        among = rows @ rows.swapaxes(1, 2) - background @ background.swapaxes(1, 2)
        return among, (rows @ self.counts[..., None])[..., 0]

    def residuals(self, parameters: FloatArray, contrast: FloatArray) -> FloatArray:
        """Weighted residuals (P, N) of the counts, for fits of places alone, without their background."""
        places = self.places - (self.inverse @ parameters[:, :2, None]).swapaxes(1, 2)
        values, _ = self.appearance.shape(places, self._blur(parameters), parameters[:, 3], 0)
        rows = (values + self.beside) * self.weight * self.expected
        rows -= (self.ground @ (self.ground.swapaxes(1, 2) @ rows[..., None]))[..., 0]
        return np.asarray(self.counts - contrast[:, None] * rows)

    def reweighted(self, factor: FloatArray) -> 'PointWindows':
        """Windows whose weights are multiplied by a ``factor`` (P, N)."""
        ground = np.linalg.qr(self.ground * factor[..., None])[0]
        counts = self.counts * factor
        counts -= (ground @ (ground.swapaxes(1, 2) @ counts[..., None]))[..., 0]
        return replace(self, weight=self.weight * factor, ground=ground, counts=counts)

    def with_neighbours_held(self, parameters: FloatArray) -> 'PointWindows':
        """Windows for fits of places alone, with the neighbours fixed at their grid positions."""
        return replace(self, beside=self.appearance.beside(self.places, self._blur(parameters), parameters[:, 3]))

    def _blur(self, parameters: FloatArray) -> FloatArray:
        """Blur (P, 2) along the axes [steps]."""
        return np.exp(np.clip(parameters[:, 2, None], *np.log(_BLUR_BOUNDS))) * self.scale


def windows_around(
    image: Float32Array, starts: FloatArray, surfaces: Surfaces, appearance: Appearance, blur: FloatArray | None
) -> PointWindows:
    """Windows of the size of the pattern, with weights that fall towards the border, of points with enough pixels.

    Parameters
    ----------
    starts : (P, 2) [px]
    blur : (P,) [px], if known
    """
    spacing = np.linalg.norm(surfaces.steps, axis=1).min(axis=1)
    index = np.flatnonzero(surfaces.determined & (spacing >= LEAST_SPACING))
    starts, surfaces, appearance = starts[index], surfaces.rows(index), appearance.rows(index)
    reach = appearance.reach(spacing[index], None if blur is None else blur[index])
    inverse: FloatArray = np.asarray(np.linalg.inv(surfaces.steps), dtype=np.float64)
    pixels, in_box = _box(image, starts, 1.2 * reach[:, None] * np.abs(surfaces.steps).sum(axis=2))
    offsets = pixels - starts[:, None]
    places = surfaces.places(offsets) if appearance.bent else offsets @ inverse.swapaxes(1, 2)
    away = (places[..., 0] ** 2 + places[..., 1] ** 2) / (reach * reach)[:, None]
    inside = in_box & (away < 1.0)
    whole = np.pi * reach**2 * np.abs(np.linalg.det(surfaces.steps))
    count = inside.sum(axis=1)
    enough = np.flatnonzero(count >= np.maximum(_LEAST_PIXELS, appearance.least_visible * whole))
    weights = np.sqrt(np.maximum(1.0 - away, 0.0))
    every = (values[enough] for values in (weights, offsets, places, pixels))
    weight, offsets, places, pixels = _packed(inside[enough], *every)
    v, u = pixels[..., ::-1].astype(np.int64).transpose(2, 0, 1)
    counts = image[v, u].astype(np.float64) * weight
    ground = np.linalg.qr(np.concatenate([np.ones_like(offsets[..., :1]), offsets], axis=2) * weight[..., None])[0]
    counts -= (ground @ (ground.swapaxes(1, 2) @ counts[..., None]))[..., 0]
    return PointWindows(
        appearance=appearance.rows(enough),
        index=index[enough],
        starts=starts[enough],
        places=places,
        counts=counts,
        weight=weight,
        ground=ground,
        inverse=inverse[enough],
        scale=np.linalg.norm(inverse[enough], axis=2),
        expected=np.ones_like(weight),
        beside=np.zeros_like(weight),
    )


def _packed(inside: BoolArray, *every: FloatArray) -> Iterator[FloatArray]:
    """Values (P, N, ...) of the pixels ``inside`` (P, M) of each window, in their order, and zeros behind them.

    Parameters
    ----------
    every : (P, M, ...) values of one kind each
    """
    point, pixel = np.nonzero(inside)
    column = (np.cumsum(inside, axis=1) - 1)[point, pixel]
    room = len(inside), inside.sum(axis=1).max(initial=0)
    for values in every:
        packed = np.zeros((*room, *values.shape[2:]))
        packed[point, column] = values[point, pixel]
        yield packed


def _box(image: Float32Array, starts: FloatArray, extent: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Pixels (P, N, 2) in a box of the largest extent around each start; mask of those in its window and the image."""
    half = np.ceil(extent.max(axis=0, initial=0.0)).astype(np.int64) + 1
    v, u = np.mgrid[-half[1] : half[1] + 1, -half[0] : half[0] + 1]
    pixels = np.rint(starts)[:, None] + np.stack([u.reshape(-1), v.reshape(-1)], axis=1)
    low = np.maximum(starts - extent, 0.0)
    high = np.minimum(starts + extent, np.array(image.shape[::-1]) - 1.0)
    inside = (pixels >= low[:, None]) & (pixels <= high[:, None])
    return pixels, np.asarray(inside[..., 0] & inside[..., 1])


def with_expected_contrast(
    windows: PointWindows, nodes: FloatArray, known: FloatArray, contrast: FloatArray
) -> PointWindows:
    """Windows with the contrast predicted from the neighbours, linear over each, of points with enough neighbours.

    Parameters
    ----------
    nodes : (P, 2) of all points
    known, contrast : (K, 2) nodes of points with known contrast (K,)
    """
    away = known - nodes[windows.index][:, None]
    near = np.abs(away).max(axis=-1) <= _NEAR
    design = np.concatenate([np.ones_like(away[..., :1]), away], axis=2) * near[..., None]
    normal = design.swapaxes(1, 2) @ design + np.diag([0.0, _SLOPE_RIDGE, _SLOPE_RIDGE])
    enough = near.sum(axis=1) >= _LEAST_NEIGHBOURS
    normal[~enough] = np.eye(3)
    level_and_slope = np.linalg.solve(normal, design.swapaxes(1, 2) @ contrast[:, None])
    level = level_and_slope[:, 0, 0]
    largest = np.where(near, np.abs(contrast), 0.0).max(axis=1, initial=0.0)
    kept = np.flatnonzero(enough & (np.abs(level) >= _LEAST_CONTRAST * largest))
    expected = level[:, None] + (windows.places @ level_and_slope[:, 1:])[..., 0]
    return replace(windows, expected=expected).rows(kept)
