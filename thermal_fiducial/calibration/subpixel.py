"""Refinement of board points to a few hundredths of a pixel, on raw counts.

The model of the board around a point (:mod:`appearance`) is fitted to the counts in a window, on a sloping background.
The local grid maps the model to the image, with perspective and lens distortion. There are three rounds:
a sample of the points, each alone; all points, with common blur and width; and with the contrast predicted from the
neighbours. So neither hot spots nor contrast that fades or reverses (in a reflection) displace a point, and covered
points are rejected.

Points are fitted in batches: their windows are small, and a numpy call takes longer than the fit of one point.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from thermal_fiducial.calibration.appearance import Appearance
from thermal_fiducial.calibration.surface import CLOSELY, local_surfaces, ROUGHLY
from thermal_fiducial.calibration.windows import PointWindows, windows_around, with_expected_contrast
from thermal_fiducial.core.types import BoolArray, Float32Array, FloatArray, IntArray

# Initial blur in steps of the grid, and its lower limit in pixels.
_BLUR, _LEAST_BLUR = 0.06, 0.8
# Most steps of a fit, rejected ones included; length of the last step, in the last round and before, whose error is a
# tenth of it; initial damping, and damping at which the fit gives up.
_MOST_STEPS, _CONVERGED_PX, _NEARLY_PX, _DAMPING, _MOST_DAMPED = 40, 5e-3, 3e-2, 1e-3, 1e3
# A point is lost when its standard deviation exceeds this [px], when the fit moves further than this from the start
# [steps], or when its contrast relative to that predicted from the neighbours is outside these limits.
_MOST_SIGMA_PX, _MOST_MOVE, _CONTRAST = 0.5, 0.25, (0.6, 1.6)
_LEAST_POINTS = 6
# Number of points, spread over the board, for blur and width; each determines them to a few per cent.
_SAMPLE = 48
# Most samples, since a width far from the described one takes another window, and relative change that takes none.
_MOST_SAMPLES, _SAME_WIDTH = 4, 0.05
# Number of linear parameters of a fit: background (level and slope) and contrast.
_LINEAR = 4
# Points and pixels per batch: enough for long rows, few enough for a processor's cache.
_POINTS_AT_A_TIME, _PIXELS_AT_A_TIME = 160, 30000


class Refined(NamedTuple):
    """Points (N, 2) of a board, NaN where lost, and the width of its pattern, see :class:`Appearance` [steps]."""

    pixels: FloatArray
    width: float


def refine(
    image: Float32Array,
    nodes: FloatArray,
    pixels: FloatArray,
    board: FloatArray,
    appearance: Appearance,
    *,
    grid: BoolArray | None = None,
) -> Refined:
    """Refine the points of a board.

    Parameters
    ----------
    nodes : (N, 2) nodes in the grid
    pixels : (N, 2) initial pixels, to within a few pixels or a tenth of their spacing
    board : (M, 2) places of all points of the board
    grid : (N,) mask of the points that define the grid; the others may not belong to it. None: all
    """
    appearance = appearance.at(nodes, board)
    every = np.arange(len(nodes))
    grid = np.ones(len(nodes), dtype=np.bool_) if grid is None else grid
    some = np.sort(np.random.default_rng(0).permutation(np.flatnonzero(grid))[:_SAMPLE])
    for _ in range(_MOST_SAMPLES):
        alone = _round(image, nodes, pixels, appearance, some, grid, None, None)
        found = np.isfinite(alone.contrast)
        if np.sum(found) < _LEAST_POINTS:
            return Refined(np.full_like(pixels, np.nan), appearance.width)
        width = float(np.median(alone.width[found]))
        before, appearance = appearance.width, appearance.of_width(width)
        if abs(appearance.width - before) <= _SAME_WIDTH * before:
            break
    log_blur = _plane(nodes[found], alone.log_blur[found], nodes)
    shared = _Shared(log_blur, np.full(len(nodes), width))
    pixels = _next_starts(nodes, pixels, alone.pixels, some, grid)
    alike = _round(image, nodes, pixels, appearance, every, grid, shared, None)
    if np.sum(np.isfinite(alike.contrast)) < _LEAST_POINTS:
        return Refined(np.full_like(pixels, np.nan), width)
    pixels = _next_starts(nodes, pixels, alike.pixels, every, grid)
    refined = _round(image, nodes, pixels, appearance, every, grid, shared, alike.contrast)
    enough = np.sum(np.isfinite(refined.contrast)) >= _LEAST_POINTS
    return Refined(refined.pixels if enough else np.full_like(pixels, np.nan), width)


def _next_starts(
    nodes: FloatArray, starts: FloatArray, refined: FloatArray, fitted: IntArray, grid: BoolArray
) -> FloatArray:
    """Starts (N, 2) of the next round; ``fitted`` points that were lost start at the grid's prediction."""
    starts = np.where(np.isfinite(refined), refined, starts)
    lost = fitted[np.isnan(refined[fitted, 0])]
    others = np.setdiff1d(np.flatnonzero(grid), lost)
    surfaces = local_surfaces(nodes[others], starts[others], nodes[lost])
    starts[lost[surfaces.determined]] = surfaces.centres[surfaces.determined]
    return starts


class _Shared(NamedTuple):
    """Common parameters of a board's points: blur at each point (N,) [log px], width (N,) [steps]."""

    log_blur: FloatArray
    width: FloatArray


class _Fits(NamedTuple):
    """Points (N, 2), logarithm of the blur (N,) [px], width (N,) [steps] and contrast (N,); NaN where lost."""

    pixels: FloatArray
    log_blur: FloatArray
    width: FloatArray
    contrast: FloatArray


def _round(
    image: Float32Array,
    nodes: FloatArray,
    pixels: FloatArray,
    appearance: Appearance,
    index: IntArray,
    grid: BoolArray,
    shared: _Shared | None,
    contrast: FloatArray | None,
) -> _Fits:
    """Fit points ``index`` once; with ``contrast``, points without one are lost and not used for the ``grid``."""
    known = grid if contrast is None else grid & np.isfinite(contrast)
    ridge = ROUGHLY if shared is None else CLOSELY
    fits = _Fits(np.full_like(pixels, np.nan), *np.full((3, len(nodes)), np.nan))
    for first in range(0, len(index), _POINTS_AT_A_TIME):
        part = index[first : first + _POINTS_AT_A_TIME]
        surfaces = local_surfaces(nodes[known], pixels[known], nodes[part], ridge)
        blur = None if shared is None else np.exp(shared.log_blur[part])
        windows = windows_around(image, pixels[part], surfaces, appearance.rows(part), blur)
        if contrast is not None:
            windows = with_expected_contrast(windows, nodes[part], nodes[known], contrast[known])
        for some in _few_pixels(windows):
            points = part[some.index]
            common = None if shared is None else _Shared(*(values[points] for values in shared))
            fitted = _fit(some, common, with_contrast=contrast is not None)
            for values, new in zip(fits, fitted, strict=True):
                values[points] = new
    return fits


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


def _fit(windows: PointWindows, shared: _Shared | None, *, with_contrast: bool) -> _Fits:
    """Levenberg-Marquardt fit of all parameters of each point, or of places alone with ``shared`` ones given."""
    parameters = np.zeros((len(windows.index), 4))
    if shared is None:
        parameters[:, 2] = np.log(np.maximum(_LEAST_BLUR, _BLUR / windows.scale.max(axis=1)))
        parameters[:, 3] = windows.appearance.width
        free = 4
    else:
        parameters[:, 2], parameters[:, 3] = shared
        free = 2
        windows = windows.with_neighbours_held(parameters)
    state = _CornerState.at(windows, parameters, free)
    damping = np.full(len(parameters), _DAMPING)
    moving = np.arange(len(parameters))
    enough = _CONVERGED_PX if with_contrast else _NEARLY_PX
    for _ in range(_MOST_STEPS):
        step = state.rows(moving).step(damping[moving])
        short = np.abs(step[:, :2]).max(axis=1) < enough
        # Too short a step for the cost to be evaluated again.
        state.parameters[moving[short]] += step[short]
        moving, step = moving[~short], step[~short]
        if len(moving) == 0:
            break
        tried = _CornerState.at(windows.rows(moving), state.parameters[moving] + step, free)
        better = tried.cost <= state.cost[moving]
        state.put(moving[better], tried.rows(np.flatnonzero(better)))
        damping[moving] *= np.where(better, 0.1, 10.0)
        moving = moving[(damping[moving] < _MOST_DAMPED) & (_moved(windows, state)[moving] < 2.0 * _MOST_MOVE)]
        if len(moving) == 0:
            break
    lost = ~_well_determined(windows, state)
    if with_contrast:
        lost |= ~((_CONTRAST[0] < state.contrast) & (state.contrast < _CONTRAST[1]))
    values = np.column_stack([windows.starts + state.parameters[:, :2], state.parameters[:, 2:], state.contrast])
    values[lost] = np.nan
    return _Fits(values[:, :2], *values[:, 2:].T)


def _well_determined(windows: PointWindows, state: '_CornerState') -> BoolArray:
    """Mask (P,) of the fits with a small standard deviation that end near their start."""
    freedom = np.maximum(1.0, (windows.weight**2).sum(axis=1) - state.free - _LINEAR)
    # A ridge in place of the zeros of a fit without contrast, which determines nothing.
    ridge = 1e-12 * np.trace(state.normal, axis1=1, axis2=2) + 1e-30
    covariance = np.linalg.inv(state.normal + ridge[:, None, None] * np.eye(state.free + 1))
    variance = state.cost / freedom * (covariance[:, 0, 0] + covariance[:, 1, 1])
    return np.asarray((variance < _MOST_SIGMA_PX**2) & (_moved(windows, state) < _MOST_MOVE))


def _moved(windows: PointWindows, state: '_CornerState') -> FloatArray:
    """Distances (P,) from the starts [steps]."""
    return np.asarray(np.linalg.norm((windows.inverse @ state.parameters[:, :2, None])[..., 0], axis=1))


@dataclass(frozen=True)
class _CornerState:
    """Parameters (P, 4) of fits, of which ``free`` are estimated, with the normal equations there.

    Parameters
    ----------
    contrast : (P,) least-squares contrast
    cost : (P,) sum of squared residuals of the counts
    normal : (P, free + 1, free + 1) normal matrix of the free parameters and the contrast
    gradient : (P, free + 1)
    """

    free: int
    parameters: FloatArray
    contrast: FloatArray
    cost: FloatArray
    normal: FloatArray
    gradient: FloatArray

    @classmethod
    def at(cls, windows: PointWindows, parameters: FloatArray, free: int) -> '_CornerState':
        """State at ``parameters``."""
        among, with_counts = windows.products(parameters, free)
        size = among[:, 0, 0] + 1e-12
        contrast = with_counts[:, 0] / size
        cost = (windows.counts**2).sum(axis=1) - with_counts[:, 0] ** 2 / size
        # The derivatives of the pattern by the parameters, times the contrast, and the pattern itself.
        order, scale = [*range(1, 1 + free), 0], np.ones((len(size), free + 1))
        scale[:, :free] = contrast[:, None]
        normal = among[:, order][:, :, order] * scale[:, :, None] * scale[:, None]
        gradient = scale * (with_counts - contrast[:, None] * among[:, 0])[:, order]
        return cls(free, parameters, contrast, cost, normal, gradient)

    def step(self, damping: FloatArray) -> FloatArray:
        """Damped step (P, 4) downhill."""
        damped = self.normal.copy()
        diagonal = np.arange(self.free + 1)
        damped[:, diagonal, diagonal] += damping[:, None] * (damped[:, diagonal, diagonal] + 1e-9)
        step = np.zeros_like(self.parameters)
        step[:, : self.free] = np.linalg.solve(damped, self.gradient[..., None])[:, : self.free, 0]
        return step

    def rows(self, index: IntArray) -> '_CornerState':
        """The state of a subset of the points."""
        return _CornerState(self.free, *(values[index] for values in self._arrays()))

    def put(self, index: IntArray, other: '_CornerState') -> None:
        """Replace the state of points ``index`` by ``other``."""
        for values, new in zip(self._arrays(), other._arrays(), strict=True):
            values[index] = new

    def _arrays(self) -> tuple[FloatArray, ...]:
        return self.parameters, self.contrast, self.cost, self.normal, self.gradient
