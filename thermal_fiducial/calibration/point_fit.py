"""Fit of the model of a board to the windows of its points, many at a time."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from thermal_fiducial.calibration.windows import PointWindows
from thermal_fiducial.core.types import BoolArray, FloatArray, IntArray, TINY

# Initial blur in steps of the grid, and its lower limit in pixels.
_BLUR, _LEAST_BLUR = 0.06, 0.8
# Most steps of a fit, rejected ones included; length of the last step, in the last round and before, whose error is a
# tenth of it; initial damping, and damping at which the fit gives up.
_MOST_STEPS, _CONVERGED_PX, _NEARLY_PX, _DAMPING, _MOST_DAMPED = 40, 5e-3, 3e-2, 1e-3, 1e3
# A point is lost when its standard deviation exceeds this [px], when the fit moves further than this from the start
# [steps], or when its contrast relative to that predicted from the neighbours is outside these limits.
_MOST_SIGMA_PX, _MOST_MOVE, _CONTRAST = 0.5, 0.25, (0.6, 1.6)
# Fits with less weight for deviating pixels; deviation [standard deviations] where half is left; least share left.
_REWEIGHTED, _DEVIATING, _LEAST_LEFT = 4, 3.0, 0.4
# Number of linear parameters of a fit: background (level and slope) and contrast.
_LINEAR = 4


class Shared(NamedTuple):
    """Common parameters of a board's points: blur at each point (N,) [log px], width (N,) [steps]."""

    log_blur: FloatArray
    width: FloatArray


class PointFits(NamedTuple):
    """Points (N, 2), logarithm of the blur (N,) [px], width (N,) [steps] and contrast (N,); NaN where lost.

    ``variance`` (N,) is that of the residuals [counts^2].
    """

    pixels: FloatArray
    log_blur: FloatArray
    width: FloatArray
    contrast: FloatArray
    variance: FloatArray


def fit_points(
    windows: PointWindows, shared: Shared | None, *, with_contrast: bool, noise: float | None = None
) -> PointFits:
    """Levenberg-Marquardt fit of all parameters of each point, or of places alone with ``shared`` ones given.

    Parameters
    ----------
    noise : standard deviation of residuals [counts]; pixels that deviate by more lose weight. None: all count alike
    """
    parameters = np.zeros((len(windows.index), 4))
    if shared is None:
        parameters[:, 2] = np.log(np.maximum(_LEAST_BLUR, _BLUR / windows.scale.max(axis=1)))
        parameters[:, 3] = windows.appearance.width
        free = 4
    else:
        parameters[:, 2], parameters[:, 3] = shared
        free = 2
        windows = windows.with_neighbours_held(parameters)
    enough = _CONVERGED_PX if with_contrast else _NEARLY_PX
    whole = (windows.weight**2).sum(axis=1)
    if noise is None:
        state = _minimised(windows, parameters, free, enough)
    else:
        windows, state = _without_deviating(windows, parameters, noise, enough)
    lost = ~_well_determined(windows, state) | ((windows.weight**2).sum(axis=1) < _LEAST_LEFT * whole)
    if with_contrast:
        lost |= ~((_CONTRAST[0] < state.contrast) & (state.contrast < _CONTRAST[1]))
    variance = state.cost / _freedom(windows, free)
    parts = windows.starts + state.parameters[:, :2], state.parameters[:, 2:], state.contrast, variance
    values = np.column_stack(parts)
    values[lost] = np.nan
    return PointFits(values[:, :2], *values[:, 2:].T)


def _without_deviating(
    windows: PointWindows, parameters: FloatArray, noise: float, enough: float
) -> tuple[PointWindows, '_CornerState']:
    """Windows in which deviating pixels have less weight, and the fit of places to them.

    The first weights are those at the start, with the contrast of the neighbours: a fit to all pixels would go towards
    what deviates, and lose weight for the rest.
    """
    every, contrast = windows, np.ones(len(parameters))
    for _ in range(_REWEIGHTED):
        off = every.residuals(parameters, contrast) / np.maximum(every.weight, TINY)
        windows = every.reweighted(1.0 / np.sqrt(1.0 + (off / (_DEVIATING * noise)) ** 2))
        state = _minimised(windows, parameters, 2, enough)
        parameters, contrast = state.parameters, state.contrast
    return windows, state


def _minimised(windows: PointWindows, parameters: FloatArray, free: int, enough: float) -> '_CornerState':
    """State after the fit from ``parameters`` (P, 4), whose last step is shorter than ``enough`` [px]."""
    state = _CornerState.at(windows, parameters, free)
    damping = np.full(len(parameters), _DAMPING)
    moving = np.arange(len(parameters))
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
    return state


def _freedom(windows: PointWindows, free: int) -> FloatArray:
    return np.asarray(np.maximum(1.0, (windows.weight**2).sum(axis=1) - free - _LINEAR))


def _well_determined(windows: PointWindows, state: '_CornerState') -> BoolArray:
    """Mask (P,) of the fits with a small standard deviation that end near their start."""
    # A ridge in place of the zeros of a fit without contrast, which determines nothing.
    ridge = 1e-12 * np.trace(state.normal, axis1=1, axis2=2) + 1e-30
    covariance = np.linalg.inv(state.normal + ridge[:, None, None] * np.eye(state.free + 1))
    variance = state.cost / _freedom(windows, state.free) * (covariance[:, 0, 0] + covariance[:, 1, 1])
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
