"""Points of a board to a few hundredths of a pixel, on raw counts.

What the board looks like around a point (:mod:`appearance`) is fitted to the counts in a window, on ground that may
slope. The grid shows how the board is seen there, so perspective and lens bend the pattern as they bend the image.
Three rounds: each point alone; with the blur and the width that the board has in common; and with the contrast that the
neighbours lead one to expect. So neither a lamp's spot of heat nor contrast that fades over the board, or reverses in
a reflection, moves a point, and what covers a point is noticed.
"""

from dataclasses import dataclass, replace
import math
from typing import NamedTuple

import numpy as np

from thermal_fiducial.calibration.appearance import Appearance
from thermal_fiducial.calibration.surface import CLOSELY, local_surface, ROUGHLY, Surface
from thermal_fiducial.core.types import Float32Array, FloatArray

# Points closer than this [px] are too close to give sub-pixel points.
_LEAST_SPACING = 5.0
# Blur to start from, in steps of the grid and at least in pixels; and its bounds.
_BLUR, _LEAST_BLUR, _BLUR_BOUNDS = 0.06, 0.8, (0.2, 60.0)
_MOST_STEPS, _CONVERGED_PX, _DIFFERENCE, _HOPELESS = 20, 1e-3, 1e-4, 1e3
# A point is lost when its standard deviation is larger than this [px], when the fit goes further from the start, in
# steps of the grid, or when its contrast is not, within these shares, what the neighbours promise.
_MOST_SIGMA_PX, _MOST_MOVE, _CONTRAST = 0.5, 0.25, (0.6, 1.6)
# Where contrast reverses, at this share of the neighbours' or less, nothing shows where the point is.
_LEAST_CONTRAST = 0.25
# Nodes whose contrast shows that of another, in steps, how many of them, and how firmly the slope is held down.
_NEAR, _LEAST_NEIGHBOURS, _SLOPE_RIDGE = 2, 4, 0.1
_LEAST_POINTS, _LEAST_PIXELS = 6, 12
# What the linear part of a fit determines: ground (level and slope) and contrast.
_LINEAR = 4


def refine(
    image: Float32Array, nodes: FloatArray, pixels: FloatArray, board: FloatArray, appearance: Appearance
) -> FloatArray:
    """Points (N, 2) of a board, NaN where they are lost.

    Parameters
    ----------
    nodes : (N, 2) place of each in the grid
    pixels : (N, 2) within a few pixels, or a tenth of their distance
    board : (M, 2) places of all points of the board
    """
    shared: list[_Shared | None] = [None] * len(nodes)
    contrast: FloatArray | None = None
    for last in (False, False, True):
        fits = _round(image, nodes, pixels, board, appearance, shared, contrast)
        found = np.flatnonzero([fit is not None for fit in fits])
        kept = [fit for fit in fits if fit is not None]
        refined = np.full_like(pixels, np.nan)
        if len(kept) < _LEAST_POINTS:
            return refined
        refined[found] = [fit.pixel for fit in kept]
        if last:
            return refined
        pixels = np.where(np.isfinite(refined), refined, pixels)
        if shared[0] is None:
            log_blur = _plane(nodes[found], np.array([fit.log_blur for fit in kept]), nodes)
            width = float(np.median([fit.width for fit in kept]))
            shared = [_Shared(value, width) for value in log_blur.tolist()]
        else:
            contrast = np.full(len(nodes), np.nan)
            contrast[found] = [fit.contrast for fit in kept]
    raise AssertionError('the last round returns')


class _Shared(NamedTuple):
    """What a board's points have in common: blur at a point [log px], width [steps]."""

    log_blur: float
    width: float


class _Fitted(NamedTuple):
    pixel: FloatArray
    log_blur: float
    width: float
    contrast: float


def _round(
    image: Float32Array,
    nodes: FloatArray,
    pixels: FloatArray,
    board: FloatArray,
    appearance: Appearance,
    shared: list[_Shared | None],
    contrast: FloatArray | None,
) -> list[_Fitted | None]:
    """Fit all points once; with ``contrast``, points without one are lost ones and say nothing of the grid."""
    known = np.ones(len(nodes), dtype=np.bool_) if contrast is None else np.isfinite(contrast)
    ridge = ROUGHLY if shared[0] is None else CLOSELY
    fits = []
    for node, start, common in zip(nodes, pixels, shared, strict=True):
        surface, here = local_surface(nodes[known], pixels[known], node, ridge), appearance.at(node, board)
        window = None if surface is None else _window(image, start, surface, here, common)
        if window is not None and contrast is not None:
            window = _promised(window, nodes[known] - node, contrast[known])
        fits.append(None if window is None else _fit(window, here, common))
    return fits


def _plane(nodes: FloatArray, values: FloatArray, places: FloatArray) -> FloatArray:
    """Values at ``places`` of the plane through those at ``nodes``, without those that stick out."""
    off = np.abs(values - np.median(values))
    kept = off <= 4.0 * np.median(off) + 0.05
    design = np.column_stack([np.ones(len(nodes)), nodes])
    coefficients = np.linalg.lstsq(design[kept], values[kept], rcond=None)[0]
    return np.asarray(np.column_stack([np.ones(len(places)), places]) @ coefficients)


@dataclass(frozen=True)
class _Window:
    """Pixels around a point.

    Parameters
    ----------
    start : (2,) [px]
    place : (N, 2) on the board, relative to ``start`` [steps]
    counts : (N,) times their weight, what the ground explains taken out
    weight : (N,)
    ground : (N, 3) orthonormal: what level and slope explain
    inverse : (2, 2) steps of the grid by pixels
    scale : (2,) steps along the axes in a pixel
    promise : (N,) contrast that the neighbours promise, or 1 everywhere
    promised : whether they do
    """

    start: FloatArray
    place: FloatArray
    counts: FloatArray
    weight: FloatArray
    ground: FloatArray
    inverse: FloatArray
    scale: FloatArray
    promise: FloatArray
    promised: bool

    def above_ground(self, values: FloatArray) -> FloatArray:
        """Weighted values (N,) without what ground could explain."""
        return np.asarray(values - self.ground @ (self.ground.T @ values))

    def shape(self, parameters: FloatArray, appearance: Appearance) -> FloatArray:
        """The pattern (N,) above ground, by the point's offset [px], the blur's logarithm and the width."""
        place = self.place - self.inverse @ parameters[:2]
        blur = min(max(math.exp(parameters[2]), _BLUR_BOUNDS[0]), _BLUR_BOUNDS[1]) * self.scale
        return self.above_ground(self.weight * self.promise * appearance.shape(place, blur, float(parameters[3])))


def _window(
    image: Float32Array, start: FloatArray, surface: Surface, appearance: Appearance, shared: _Shared | None
) -> _Window | None:
    """Pixels within the reach of a pattern, with weights that fall towards the border."""
    spacing = float(np.linalg.norm(surface.steps, axis=0).min())
    if spacing < _LEAST_SPACING:
        return None
    reach = appearance.reach(spacing, None if shared is None else float(np.exp(shared.log_blur)))
    extent = 1.2 * reach * np.abs(surface.steps).sum(axis=1)
    low = np.maximum(np.ceil(start - extent), 0).astype(int).tolist()
    high = np.minimum(np.floor(start + extent), np.array(image.shape[::-1]) - 1).astype(int).tolist()
    v, u = np.mgrid[low[1] : high[1] + 1, low[0] : high[0] + 1]
    offset = np.column_stack([u.reshape(-1), v.reshape(-1)]) - start
    inverse = np.asarray(np.linalg.inv(surface.steps), dtype=np.float64)
    place = surface.place(offset) if appearance.bent else offset @ inverse.T
    away = np.sum(place**2, axis=1) / reach**2
    inside = away < 1.0
    whole = np.pi * reach**2 * abs(float(np.linalg.det(surface.steps)))
    if np.sum(inside) < max(_LEAST_PIXELS, appearance.least_seen * whole):
        return None
    weight = np.asarray(np.sqrt(1.0 - away[inside]), dtype=np.float64)
    ground, _ = np.linalg.qr(np.column_stack([np.ones(len(weight)), offset[inside]]) * weight[:, None])
    counts = image[low[1] : high[1] + 1, low[0] : high[0] + 1].reshape(-1)[inside].astype(np.float64) * weight
    counts -= ground @ (ground.T @ counts)
    scale = np.asarray(np.linalg.norm(inverse, axis=1))
    return _Window(start, place[inside], counts, weight, ground, inverse, scale, np.ones(len(weight)), promised=False)


def _promised(window: _Window, away: FloatArray, contrast: FloatArray) -> _Window | None:
    """Window with the contrast, linear over it, that neighbours ``away`` (K, 2) [steps] promise by theirs (K,)."""
    near = np.max(np.abs(away), axis=1) <= _NEAR
    if np.sum(near) < _LEAST_NEIGHBOURS:
        return None
    design = np.column_stack([np.ones(np.sum(near)), away[near]])
    normal = design.T @ design + np.diag([0.0, _SLOPE_RIDGE, _SLOPE_RIDGE])
    level_and_slope = np.linalg.solve(normal, design.T @ contrast[near])
    if abs(level_and_slope[0]) < _LEAST_CONTRAST * np.abs(contrast[near]).max():
        return None
    promise = level_and_slope[0] + window.place @ level_and_slope[1:]
    return replace(window, promise=promise, promised=True)


def _fit(window: _Window, appearance: Appearance, shared: _Shared | None) -> _Fitted | None:
    """Fit a point by Levenberg's and Marquardt's method: all of it, or the point alone with what is shared given."""
    if shared is None:
        blur = max(_LEAST_BLUR, _BLUR / float(window.scale.max()))
        parameters = np.array([0.0, 0.0, np.log(blur), appearance.width])
        free = 4 if appearance.width_free else 3
    else:
        parameters, free = np.array([0.0, 0.0, *shared]), 2
    state, damping = _State.at(window, appearance, parameters), 1e-3
    J = state.jacobian(window, appearance, free)
    for _ in range(_MOST_STEPS):
        normal, gradient = J.T @ J, J.T @ state.residual
        while damping < _HOPELESS:
            step = np.linalg.solve(normal + damping * np.diag(np.diag(normal) + 1e-9), gradient)[:free]
            moved = _State.at(window, appearance, state.parameters + np.pad(step, (0, 4 - free)))
            if moved.cost <= state.cost:
                break
            damping *= 10.0
        else:
            break
        state, damping = moved, 0.1 * damping
        J = state.jacobian(window, appearance, free)
        if np.abs(step[:2]).max() < _CONVERGED_PX:
            break
    variance = state.cost / max(1.0, float(np.sum(window.weight**2)) - free - _LINEAR)
    sigma = float(np.sqrt(variance * np.trace(np.linalg.pinv(J.T @ J, hermitian=True)[:2, :2])))
    moved_steps = float(np.linalg.norm(window.inverse @ state.parameters[:2]))
    kept = not window.promised or _CONTRAST[0] < state.contrast < _CONTRAST[1]
    if not (sigma < _MOST_SIGMA_PX and moved_steps < _MOST_MOVE and kept):
        return None
    log_blur, width = state.parameters[2:].tolist()
    return _Fitted(window.start + state.parameters[:2], log_blur, width, state.contrast)


@dataclass(frozen=True)
class _State:
    """Parameters of a fit, with the best contrast for them and what is left of the counts (N,)."""

    parameters: FloatArray
    shape: FloatArray
    contrast: float
    residual: FloatArray

    @classmethod
    def at(cls, window: _Window, appearance: Appearance, parameters: FloatArray) -> '_State':
        """State at ``parameters``."""
        shape = window.shape(parameters, appearance)
        contrast = float(shape @ window.counts) / float(shape @ shape + 1e-12)
        return cls(parameters, shape, contrast, window.counts - contrast * shape)

    @property
    def cost(self) -> float:
        """Sum of squares."""
        return float(self.residual @ self.residual)

    def jacobian(self, window: _Window, appearance: Appearance, free: int) -> FloatArray:
        """Derivative (N, free + 1) of the pattern by the first ``free`` parameters and the contrast."""
        columns = []
        for ahead in self.parameters + _DIFFERENCE * np.eye(4)[:free]:
            columns.append((window.shape(ahead, appearance) - self.shape) * (self.contrast / _DIFFERENCE))
        return np.column_stack([*columns, self.shape])
