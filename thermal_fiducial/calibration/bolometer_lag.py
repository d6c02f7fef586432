"""Time constant of the bolometers, from the tails that moving markers leave in raw counts.

A pixel y follows the scene x with ``tau dy/dt = x - y``, so behind each edge of a marker that moves with w there is an
exponential of the length tau w. It is antisymmetric along the motion. Optics and exposure blur symmetrically, and what
is late, by the clock or line by line, is displaced. So everything else is fitted to each view as well: corners, blur,
blur along the motion, level and contrast.
"""

from collections.abc import Sequence
from dataclasses import dataclass
import math
from typing import NamedTuple

import numpy as np

from thermal_fiducial.calibration.moving_markers import MovingMarker, USUAL_LAG_S
from thermal_fiducial.core.detection.corners.blurred_patterns import (
    Ages,
    BLUR,
    CORNERS,
    PatternGrid,
    PatternView,
)
from thermal_fiducial.core.detection.corners.pattern_fit import nearness, sample_grid
from thermal_fiducial.core.detection.corners.pattern_residuals import PatternResiduals, residuals_at
from thermal_fiducial.core.detection.patterns import Decoder
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.geometry.reprojection import sides_px
from thermal_fiducial.core.types import Float32Array, FloatArray, SIGMA_OF_MEDIAN, TINY
from thermal_fiducial.errors import InputError

# Gaussians that stand for the exponential: with four, answers are up to 4 % too small.
_AGES = Ages.lasting(0.4, 0.5, 0.7, 0.9, 1.4, 40.0)
# Length of tails [px], the shortest and the best: shorter ones hardly differ from another blur, longer ones hide cells.
_SHORTEST_PX, _BEST_PX = 0.7, 1.5
# Most and fewest views that are fitted.
_MOST, _FEWEST = 96, 24
# Groups of successive views: what they have in common, they err alike by.
_GROUPS = 8
# What the forms of blur and response leave unknown, as a share: up to 1.2 % of drawings without noise, where tails are
# as long as half a cell 3 %.
_OF_FORM = 0.02
# Lag [s] below which there is none, and standard deviation above which nothing was found: data sheets say as much.
_NONE_S, _UNKNOWN_S = 0.002, 0.002
# Most steps of a fit, and lengths of its last one: of corners [px], of the lag [s].
_STEPS, _CONVERGED_PX, _CONVERGED_S = 15, 5e-3, 1e-4
# Longest steps of corners and blur [px] and of the lag [s]; ranges of blur and lag.
_LONGEST_PX, _LONGEST_BLUR_PX, _LONGEST_S = 1.0, 0.2, 4e-3
_BLURS_PX, _LAGS_S = (0.2, 4.0), (2e-4, 0.05)
# Differences that derivatives are taken by [s]: of the lag, and of the standard deviation of another blur in time.
_MORE_LAG, _MORE_EXPOSURE = 3e-4, 3e-3


class LagOfView(NamedTuple):
    """What a view shows [s], and its standard deviation by noise."""

    lag: float
    std: float


@dataclass(frozen=True)
class LagCalibration:
    """Result.

    Parameters
    ----------
    lag : thermal time constant [s]; 0: none that would matter
    std : its standard deviation [s]; where there is none, the length of the shortest that would have shown
    views : number that was used
    scatter : standard deviation of what single views show [s]
    speeds : slowest and fastest motion in them [px/s]
    """

    lag: float
    std: float
    views: int
    scatter: float
    speeds: tuple[float, float]


def calibrate_lag(views: Sequence[MovingMarker], decoder: Decoder, camera: Camera, blur_px: float) -> LagCalibration:
    """Estimate the time constant.

    Parameters
    ----------
    views : in order
    decoder : of the markers' dictionary
    blur_px : standard deviation of the blur of optics and pixels that fits begin with

    Raises
    ------
    InputError
        Motion that is too slow to show it, or views that do not agree on it.
    """
    speeds = np.array([view.speed for view in views])
    lag, shown = USUAL_LAG_S, dict[int, LagOfView | None]()
    # What single views show depends little on where their tails are looked for: twice is enough.
    for _ in range(2):
        chosen = _chosen(speeds, lag)
        if len(chosen) < _FEWEST:
            return _without_views(speeds, lag, camera, begun=bool(shown))
        for index in chosen:
            if index not in shown:
                shown[index] = lag_of_view(views[index], decoder, blur_px)
        lags = {k: view.lag for k in chosen if (view := shown[k]) is not None and view.std < _UNKNOWN_S}
        result = _combined(speeds[list(lags)], np.array(list(lags.values())))
        lag = max(result.lag, _LAGS_S[0])
    if result.std > _UNKNOWN_S:
        raise InputError(
            f'views do not agree on the lag: {_in_words(result)}; warmer markers, in focus, near the camera'
        )
    return result


def _chosen(speeds: FloatArray, lag: float) -> list[int]:
    """Numbers of the views to fit, in order, by their speeds (N,): those whose tails have the best lengths."""
    tails = lag * speeds
    best = np.argsort(np.abs(np.log(tails / _BEST_PX)), kind='stable')
    return sorted(int(index) for index in best[tails[best] > _SHORTEST_PX][:_MOST])


def _without_views(speeds: FloatArray, lag: float, camera: Camera, *, begun: bool) -> LagCalibration:
    """The result where too few views, of speeds (N,), have a tail: none if one would have shown, and error otherwise.

    ``begun``: whether views with longer tails by the usual lag have shown that it is as short as ``lag``.
    """
    fastest = np.sort(speeds)[-_FEWEST:]
    shortest = _SHORTEST_PX / float(fastest[0]) if len(fastest) == _FEWEST else math.inf
    if begun and shortest < _NONE_S:
        return LagCalibration(0.0, shortest, _FEWEST, 0.0, (float(fastest[0]), float(fastest[-1])))
    needed = _SHORTEST_PX / lag
    turn = math.degrees(needed / camera.focal_px)
    raise InputError(
        f'rows do not move fast enough to show the lag: markers that move evenly by {needed:.0f} px/s and more, as in '
        f'turns of {turn:.0f} deg/s, are in {np.count_nonzero(speeds > needed)} frames, and {_FEWEST} are needed'
    )


def _combined(speeds: FloatArray, lags: FloatArray) -> LagCalibration:
    """Result of what views (N,) show: the mean of the medians of groups, which scatter as the answer does.

    Raises InputError for too few views.
    """
    if len(lags) < _FEWEST:
        raise InputError(f'only {len(lags)} views of markers look as their dictionary has them, {_FEWEST} are needed')
    medians = np.array([np.median(group) for group in np.array_split(lags, _GROUPS)])
    lag = float(medians.mean())
    std = math.hypot(float(medians.std(ddof=1)) / math.sqrt(_GROUPS), _OF_FORM * lag)
    scatter = SIGMA_OF_MEDIAN * float(np.median(np.abs(lags - np.median(lags))))
    return LagCalibration(lag, std, len(lags), scatter, (float(speeds.min()), float(speeds.max())))


def _in_words(result: LagCalibration) -> str:
    return f'{1e3 * result.lag:.1f} +- {1e3 * result.std:.1f} ms'


def lag_of_view(view: MovingMarker, decoder: Decoder, blur_px: float) -> LagOfView | None:
    """The time constant that a view shows; None if no tail fits it.

    Gauss-Newton on corners, blur, the amounts of all linear terms, blur along the motion and lag.
    """
    model = _Model.of(view, decoder, blur_px)
    corners, blur, lag = view.corners_px[None].copy(), blur_px, USUAL_LAG_S
    for _ in range(_STEPS):
        now = model.residuals(corners, blur, lag)
        by_exposure = now.rest - model.residuals(corners, blur, lag, _MORE_EXPOSURE).rest
        by_lag = (now.rest - model.residuals(corners, blur, lag + _MORE_LAG).rest) / _MORE_LAG
        J = np.concatenate([now.J[0], by_exposure, by_lag]).astype(np.float64)
        sizes = np.linalg.norm(J, axis=1) + TINY
        J /= sizes[:, None]
        covariance = np.linalg.pinv(J @ J.T, hermitian=True)
        step = covariance @ (J @ now.rest[0]) / sizes
        moved = np.clip(step[CORNERS], -_LONGEST_PX, _LONGEST_PX)
        corners += moved.reshape(2, 4).T
        blur = float(np.clip(blur + np.clip(step[BLUR], -_LONGEST_BLUR_PX, _LONGEST_BLUR_PX), *_BLURS_PX))
        lag = float(np.clip(lag + np.clip(step[-1], -_LONGEST_S, _LONGEST_S), *_LAGS_S))
        if (np.abs(moved).max() < _CONVERGED_PX and abs(step[-1]) < _CONVERGED_S) or lag == _LAGS_S[0]:
            # Neighbouring samples are not independent where they are closer than pixels.
            variance = float(np.mean(now.rest * now.rest)) / float(now.apart_px[0]) ** 2
            return LagOfView(lag, math.sqrt(variance * covariance[-1, -1]) / float(sizes[-1]))
    return None


class _Model(NamedTuple):
    """What stays as it is in the fit of a view."""

    view: MovingMarker
    image: Float32Array
    white: FloatArray
    grid: PatternGrid

    @staticmethod
    def of(view: MovingMarker, decoder: Decoder, blur_px: float) -> '_Model':
        corners, cells = view.corners_px[None], decoder.cells
        grid = sample_grid(sides_px(corners) / cells, cells, int(nearness(corners, cells, np.array([blur_px]))[0]))
        white = decoder.patterns(np.array([view.marker_id]), np.zeros(1, dtype=np.int64))
        return _Model(view, view.counts.astype(np.float32), white, grid)

    def residuals(self, corners: FloatArray, blur_px: float, lag: float, exposure: float = 0.0) -> PatternResiduals:
        """Of the pattern at ``corners`` (1, 4, 2), which an ``exposure`` of such a deviation [s] blurs, too."""
        velocity = self.view.velocity[None]
        view = PatternView(
            self.image,
            motion=exposure * velocity.mean(axis=1),
            lag=-lag * velocity,
            bends=self.view.bends,
            ages=_AGES,
        )
        return residuals_at(view, corners, np.array([blur_px]), self.white, self.grid)
