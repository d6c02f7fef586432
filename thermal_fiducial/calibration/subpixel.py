"""Refinement of board points to a few hundredths of a pixel, on raw counts.

The model of the board around a point (:mod:`appearance`) is fitted to the counts in a window, on a sloping background.
The local grid maps the model to the image, with perspective and lens distortion. There are three rounds:
a sample of the points, each alone; all points, with common blur and width; and with the contrast predicted from the
neighbours. So neither hot spots nor contrast that fades or reverses (in a reflection) displace a point, and covered
points are rejected.

Points are fitted in batches: their windows are small, and a numpy call takes longer than the fit of one point.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from thermal_fiducial.calibration.appearance import Appearance
from thermal_fiducial.calibration.point_fit import fit_points, PointFits, Shared
from thermal_fiducial.calibration.surface import CLOSELY, local_surfaces, ROUGHLY, Surfaces
from thermal_fiducial.calibration.windows import PointWindows, windows_around, with_expected_contrast
from thermal_fiducial.core.types import BoolArray, Float32Array, FloatArray, IntArray

_LEAST_POINTS = 6
# Number of points, spread over the board, for blur and width; each determines them to a few per cent. And for the blur
# of a grid that is refused.
_SAMPLE, _FEW = 48, 8
# Most samples, since a width far from the described one takes another window, and relative change that takes none.
_MOST_SAMPLES, _SAME_WIDTH = 4, 0.05
# Variance of the residuals, relative to the usual, of points that are fitted again without what deviates: their windows
# hold something else too, the border of the board or a hand.
_ODD = 3.0
# Points and pixels per batch: enough for long rows, few enough for a processor's cache.
_POINTS_AT_A_TIME, _PIXELS_AT_A_TIME = 160, 30000


class Refined(NamedTuple):
    """Points (N, 2) of a board, NaN where lost, and the width of its pattern [steps], see :class:`Appearance`.

    ``width_sigma`` is the standard error of the width.
    """

    pixels: FloatArray
    width: float
    width_sigma: float
    blur_px: float


def refine(
    image: Float32Array,
    nodes: FloatArray,
    pixels: FloatArray,
    board: FloatArray,
    appearance: Appearance,
    *,
    grid: BoolArray | None = None,
    typical: BoolArray | None = None,
) -> Refined:
    """Refine the points of a board.

    Parameters
    ----------
    nodes : (N, 2) nodes in the grid
    pixels : (N, 2) initial pixels, to within a few pixels or a tenth of their spacing
    board : (M, 2) places of all points of the board
    grid : (N,) mask of the points that define the grid; the others may not belong to it. None: all
    typical : (N,) mask of those whose contrast predicts that of all. None: all
    """
    appearance = appearance.at(nodes, board)
    every = np.arange(len(nodes))
    grid = np.ones(len(nodes), dtype=np.bool_) if grid is None else grid
    first, lost = _sampled(image, nodes, pixels, appearance, grid), np.full_like(pixels, np.nan)
    found = np.isfinite(first.fits.contrast)
    if np.sum(found) < _LEAST_POINTS:
        return Refined(lost, appearance.width, np.inf, np.nan)
    appearance, alone = first.appearance, first.fits
    width, blur_px = float(np.median(alone.width[found])), float(np.exp(np.median(alone.log_blur[found])))
    # Of a median, whose error is a quarter more than that of a mean.
    spread = 1.4826 * float(np.median(np.abs(alone.width[found] - width)))
    known = width, 1.25 * spread / np.sqrt(np.sum(found)), blur_px
    log_blur = _plane(nodes[found], alone.log_blur[found], nodes)
    shared = Shared(log_blur, np.full(len(nodes), width))
    pixels = _next_starts(nodes, pixels, alone.pixels, first.some, grid, ROUGHLY)
    alike = _round(image, nodes, pixels, appearance, every, grid, shared, None)
    if np.sum(np.isfinite(alike.contrast)) < _LEAST_POINTS:
        return Refined(lost, *known)
    pixels = _next_starts(nodes, pixels, alike.pixels, every, grid, CLOSELY)
    contrast = _Contrast(alike.contrast, np.ones_like(grid) if typical is None else typical)
    refined = _round(image, nodes, pixels, appearance, every, grid, shared, contrast)
    noise = float(np.sqrt(np.nanmedian(refined.variance))) if np.any(np.isfinite(refined.variance)) else 0.0
    odd = np.flatnonzero(refined.variance > _ODD * noise**2)
    if len(odd):
        starts = _next_starts(nodes, pixels, _without(refined.pixels, odd), every, grid, CLOSELY)
        again = _round(image, nodes, starts, appearance, odd, grid, shared, contrast, noise)
        for values, new in zip(refined, again, strict=True):
            values[odd] = new[odd]
    enough = np.sum(np.isfinite(refined.contrast)) >= _LEAST_POINTS
    return Refined(refined.pixels if enough else lost, *known)


def _without(pixels: FloatArray, lost: IntArray) -> FloatArray:
    """Pixels (N, 2) with NaN at the indices ``lost``."""
    left = pixels.copy()
    left[lost] = np.nan
    return left


def blur_of(image: Float32Array, nodes: FloatArray, pixels: FloatArray, appearance: Appearance) -> float:
    """Blur of the points of a grid [px]; NaN where they do not look like the appearance."""
    every = np.ones(len(nodes), dtype=np.bool_)
    fits = _sampled(image, nodes, pixels, appearance.at(nodes, nodes), every, _FEW).fits
    found = np.isfinite(fits.contrast)
    return float(np.exp(np.median(fits.log_blur[found]))) if np.sum(found) >= _LEAST_POINTS else np.nan


class _Contrast(NamedTuple):
    """Contrast of points (N,), NaN where lost, and mask (N,) of those that predict it for the others."""

    measured: FloatArray
    typical: BoolArray


class _Sample(NamedTuple):
    """Points ``some`` of a grid, fitted each alone, and the appearance of their median width."""

    some: IntArray
    fits: PointFits
    appearance: Appearance


def _sampled(
    image: Float32Array,
    nodes: FloatArray,
    pixels: FloatArray,
    appearance: Appearance,
    grid: BoolArray,
    count: int = _SAMPLE,
) -> _Sample:
    """Fit some points of a ``grid``, again with other windows while their width is another than that of the windows."""
    some = np.sort(np.random.default_rng(0).permutation(np.flatnonzero(grid))[:count])
    for _ in range(_MOST_SAMPLES):
        fits = _round(image, nodes, pixels, appearance, some, grid, None, None)
        found = np.isfinite(fits.contrast)
        if np.sum(found) < _LEAST_POINTS:
            break
        before, appearance = appearance.width, appearance.of_width(float(np.median(fits.width[found])))
        if abs(appearance.width - before) <= _SAME_WIDTH * before:
            break
    return _Sample(some, fits, appearance)


def _next_starts(
    nodes: FloatArray,
    starts: FloatArray,
    refined: FloatArray,
    fitted: IntArray,
    grid: BoolArray,
    ridge: float,
) -> FloatArray:
    """Starts (N, 2) of the next round; ``fitted`` points that were lost start at the grid's prediction.

    Once all points have been fitted, they show the curvature of the grid, by perspective and lens. Without it, outer
    corners are predicted up to 2 px off; fits that start there take the edges for what deviates.
    """
    starts = np.where(np.isfinite(refined), refined, starts)
    lost = fitted[np.isnan(refined[fitted, 0])]
    others = np.setdiff1d(np.flatnonzero(grid), lost)
    surfaces = local_surfaces(nodes[others], starts[others], nodes[lost], ridge)
    starts[lost[surfaces.determined]] = surfaces.centres[surfaces.determined]
    return starts


def _round(
    image: Float32Array,
    nodes: FloatArray,
    pixels: FloatArray,
    appearance: Appearance,
    index: IntArray,
    grid: BoolArray,
    shared: Shared | None,
    contrast: _Contrast | None,
    noise: float | None = None,
) -> PointFits:
    """Fit points ``index`` once; with ``contrast``, points without one are lost and not used for the ``grid``."""
    known = grid if contrast is None else grid & np.isfinite(contrast.measured)
    ridge = ROUGHLY if shared is None else CLOSELY
    fits = PointFits(np.full_like(pixels, np.nan), *np.full((4, len(nodes)), np.nan))
    for first in range(0, len(index), _POINTS_AT_A_TIME):
        part = index[first : first + _POINTS_AT_A_TIME]
        surfaces = local_surfaces(nodes[known], pixels[known], nodes[part], ridge)
        for rows in _alike_in_size(surfaces):
            some = part[rows]
            blur = None if shared is None else np.exp(shared.log_blur[some])
            windows = windows_around(image, pixels[some], surfaces.rows(rows), appearance.rows(some), blur)
            if contrast is not None:
                like = known & contrast.typical
                windows = with_expected_contrast(windows, nodes[some], nodes[like], contrast.measured[like])
            _fit_into(fits, some, windows, shared, with_contrast=contrast is not None, noise=noise)
    return fits


def _fit_into(
    fits: PointFits,
    points: IntArray,
    windows: PointWindows,
    shared: Shared | None,
    *,
    with_contrast: bool,
    noise: float | None,
) -> None:
    """Fit ``points`` in their windows, and write them into the ``fits`` of all."""
    for batch in _few_pixels(windows):
        index = points[batch.index]
        common = None if shared is None else Shared(*(values[index] for values in shared))
        fitted = fit_points(batch, common, with_contrast=with_contrast, noise=noise)
        for values, new in zip(fits, fitted, strict=True):
            values[index] = new


def _alike_in_size(surfaces: Surfaces) -> list[IntArray]:
    """Rows of points in batches with windows of similar size, as each window takes the room of the largest."""
    area = np.abs(surfaces.steps).sum(axis=2).prod(axis=1)
    order = np.argsort(area, kind='stable')
    batch = np.cumsum(area[order]) // _PIXELS_AT_A_TIME
    return np.split(order, np.flatnonzero(np.diff(batch)) + 1)


def _few_pixels(windows: PointWindows) -> Iterator[PointWindows]:
    """Split windows into batches."""
    count, size = windows.weight.shape
    at_a_time = max(1, _PIXELS_AT_A_TIME // max(1, size))
    for first in range(0, count, at_a_time):
        yield windows.rows(np.arange(first, min(first + at_a_time, count)))


def _plane(nodes: FloatArray, values: FloatArray, places: FloatArray) -> FloatArray:
    """Values at ``places`` of the plane fitted to ``values`` at ``nodes`` without outliers."""
    off = np.abs(values - np.median(values))
    kept = off <= 4.0 * np.median(off) + 0.05
    design = np.column_stack([np.ones(len(nodes)), nodes])
    coefficients = np.linalg.lstsq(design[kept], values[kept], rcond=None)[0]
    return np.asarray(np.column_stack([np.ones(len(places)), places]) @ coefficients)
