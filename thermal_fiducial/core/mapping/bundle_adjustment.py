"""Bundle adjustment of the map: sparse, over keyframes and markers.

Minimises the whitened re-projection errors of all corners over the poses of all keyframes and markers. Keyframes are
eliminated first (none has a term with another one), which leaves a sparse system of the markers (the Schur complement;
B. Triggs et al., "Bundle adjustment - a modern synthesis", 2000, section 6). Odometry gives priors of the keyframes, an
earlier map priors of the markers. The gauge is the fixed markers: they are held, and their covariance enters that of
the others (as consider parameters; S. Schmidt, 1966).

A pure function on a snapshot: it may run in another thread or process while the mapper processes frames.
"""

from dataclasses import dataclass, replace

import numpy as np

from thermal_fiducial.core.error_model import noise_factor
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.geometry.rigid_fit import EASED, MOST_DAMPED, STIFFENED
from thermal_fiducial.core.geometry.se3 import retract
from thermal_fiducial.core.mapping.adjustment_problem import Linearised, MapProblem, Poses, Snapshot
from thermal_fiducial.core.mapping.candidates import MAX_VIEWS, UNAMBIGUOUS
from thermal_fiducial.core.mapping.error_sources import ErrorSources
from thermal_fiducial.core.mapping.map_data import MapMarker
from thermal_fiducial.core.mapping.undeclared_readout import ReadoutEstimate
from thermal_fiducial.core.types import BoolArray, FloatArray, TINY

MAX_ITERATIONS = 25
# Decrease of the cost, in units of chi square at the actual noise, that ends the iteration: a step of a third of the
# standard deviation of one pose, for all poses together.
_CONVERGED = 0.1
# Gauss-Newton steps of a mirrored marker: its cost then differs by less than a thousandth.
_MIRRORED_STEPS = 4
# Median of chi square of eight degrees of freedom.
_MEDIAN_CHI2 = 7.34
# A marker is at two places if it has this many outlying views at least, and this share of all, and another pose
# explains this share of their squared error. Six parameters explain 0.08 of ten views of noise, and 0.5 of motion blur
# over some frames.
_FEWEST, _LEAST, _EXPLAINED = 10, 0.1, 0.8


@dataclass(frozen=True)
class FoundAspect:
    """What an adjustment has found of the error of the aspect ratio of the pixels."""

    #: the calibration that has this error
    camera: Camera
    #: as a share of the declared one, and (K,) draws of what is left of it
    share: float
    left: FloatArray


@dataclass(frozen=True)
class AdjustedMap:
    """Result of a bundle adjustment."""

    #: adjusted markers by ID, without those that were held
    markers: dict[int, MapMarker]
    #: stamp of each keyframe to its adjusted T_map_camera
    keyframes: dict[int, FloatArray]
    #: rms re-projection error [px]
    rms_px: float
    #: robust sum of squared whitened residuals, in units of their actual variance
    cost: float
    #: adjusted markers that were moved or duplicated, by ID: the share of its views that are outliers
    inconsistent: dict[int, float]
    map_revision: int
    aspect: FoundAspect
    #: what the readout time is declared too short by; its prior where nothing shows it
    readout: ReadoutEstimate


def refine(snapshot: Snapshot) -> AdjustedMap | None:
    """Adjust the map to all keyframes; None when they don't determine anything."""
    problem = MapProblem.build(snapshot)
    if problem is None:
        return None
    now = _minimise(problem, problem.evaluate(problem.start))
    mirrored = _with_mirrored(problem, now)
    now = now if mirrored is None else _minimise(problem, mirrored)
    return _result(problem, snapshot, now)


def _error_sources(problem: MapProblem, snapshot: Snapshot, now: Linearised) -> ErrorSources | None:
    """What the errors of the adjusted map come from; None where its equations are singular."""
    scale = _scale(now.chi2)
    weights = now.weights(scale)
    full = weights == 1.0
    unknowns = 6 * (len(problem.stamps) + np.count_nonzero(~problem.held))
    factor = noise_factor(float(np.sum(now.chi2[full])), int(8 * np.count_nonzero(full) - unknowns))
    # What corners are off beyond their claim says nothing of priors: these keep theirs.
    problem = replace(
        problem,
        odometry=problem.odometry.divided(factor),
        known=problem.known.divided(factor),
        common_information=problem.common_information * (1.0, factor),
    )
    system = problem.equations.reduced(problem.normal(now, scale)[0])
    if system is None:
        return None
    return ErrorSources(problem, system, now, weights, snapshot.errors, factor, np.random.default_rng(0))


def _minimise(problem: MapProblem, now: Linearised) -> Linearised:
    """Levenberg-Marquardt; each step scales the corners' variance to the residuals."""
    scale, damping = _scale(now.chi2), 1e-5
    for _ in range(MAX_ITERATIONS):
        if damping >= MOST_DAMPED:
            break
        trial = problem.step(now, scale, damping)
        gain = -np.inf if trial is None else now.cost(scale) - trial.cost(scale)
        if trial is None or not gain >= 0.0:
            damping *= STIFFENED
            continue
        now, scale, damping = trial, _scale(trial.chi2), max(EASED * damping, TINY)
        if gain <= _CONVERGED * scale:
            break
    return now


def _with_mirrored(problem: MapProblem, now: Linearised) -> Linearised | None:
    """The state with markers in their other pose where all their views together prefer it; None if none do.

    A marker enters the map by a few views, whose errors may favour the wrong one of the planar ambiguity together. All
    views are asked only of markers whose other pose is not ruled out by as many of them as place a new marker.
    """
    scale = _scale(now.chi2)
    _, gains = _mirrored(problem, now, problem.thinned(MAX_VIEWS), scale)
    possible = ~problem.held & ~problem.known.information.any(axis=(1, 2)) & (gains > -UNAMBIGUOUS * scale)
    if not possible.any():
        return None
    T_mirrored, gains = _mirrored(problem, now, possible[problem.marker], scale)
    better = possible & (gains > UNAMBIGUOUS * scale)
    if not better.any():
        return None
    T_map_marker = np.where(better[:, None, None], T_mirrored, now.state.T_map_marker)
    return problem.evaluate(replace(now.state, T_map_marker=T_map_marker))


def _mirrored(problem: MapProblem, now: Linearised, views: BoolArray, scale: float) -> tuple[FloatArray, FloatArray]:
    """Poses (M, 4, 4) of all markers mirrored and fitted each alone, and what this lowers the costs (M,) by.

    Both by some of the ``views`` (n,).
    """
    by_some = problem.only(views)
    other = _turned(by_some, now.state)
    for _ in range(_MIRRORED_STEPS):
        other = _markers_stepped(by_some, by_some.evaluate(other), scale)
    gains = now.view_costs(scale)[views] - by_some.evaluate(other).view_costs(scale)
    return other.T_map_marker, by_some.over_markers(gains)


def _turned(problem: MapProblem, state: Poses) -> Poses:
    """The state with each marker in about the other pose that its views allow: turned by 180 deg about them."""
    sight = state.T_map_camera[problem.frame, :3, 3] - state.T_map_marker[problem.marker, :3, 3]
    mean = problem.over_markers(sight / np.maximum(np.linalg.norm(sight, axis=-1, keepdims=True), TINY))
    mean /= np.maximum(np.linalg.norm(mean, axis=-1, keepdims=True), TINY)
    about_sight = 2.0 * mean[:, :, None] * mean[:, None, :] - np.eye(3)
    T_map_marker = state.T_map_marker.copy()
    T_map_marker[:, :3, :3] = about_sight @ T_map_marker[:, :3, :3] @ np.diag([-1.0, -1.0, 1.0])
    return replace(state, T_map_marker=T_map_marker)


def _markers_stepped(problem: MapProblem, now: Linearised, scale: float) -> Poses:
    """After one Gauss-Newton step of each marker alone."""
    J_transposed = now.weights(scale)[:, None, None] * np.swapaxes(now.J, -1, -2)
    known = problem.known.weighted(now.marker_chi2)
    information = problem.over_markers(J_transposed @ now.J) + known
    sides = problem.over_markers(J_transposed @ now.r[..., None]) + known @ now.marker_apart[..., None]
    largest = np.max(information, axis=(1, 2), keepdims=True)
    steps = np.linalg.solve(information + (TINY * largest + TINY) * np.eye(6), sides)
    return replace(now.state, T_map_marker=retract(now.state.T_map_marker, steps[..., 0]))


def _scale(chi2: FloatArray) -> float:
    """Ratio of the corners' variance to the claimed one, at least 1; by the median, for robustness."""
    return max(1.0, float(np.nanmedian(chi2)) / _MEDIAN_CHI2)


def _result(problem: MapProblem, snapshot: Snapshot, now: Linearised) -> AdjustedMap | None:
    """The outcome with its covariances; None where these do not exist."""
    sources = _error_sources(problem, snapshot, now)
    if sources is None:
        return None
    full = sources.weights == 1.0
    known = np.stack([snapshot.markers[key].draws for key in problem.ids])
    unit = snapshot.errors.readout_time_std
    covariances, draws, aspect_left, readout_std = sources.of_markers(known)
    if not np.all(np.isfinite(covariances)):
        return None
    markers, inconsistent = {}, {}
    for i in np.flatnonzero(~problem.held).tolist():
        key, own = problem.ids[i], problem.marker == i
        markers[key] = replace(
            snapshot.markers[key],
            T_map_marker=now.state.T_map_marker[i],
            covariance=covariances[i],
            draws=draws[i],
            surveyed=False,
        )
        if two_places(now.r[own], now.J[own], ~full[own]):
            inconsistent[key] = float(np.mean(~full[own]))
    return AdjustedMap(
        markers,
        dict(zip(problem.stamps, now.state.T_map_camera, strict=True)),
        problem.rms_px(now),
        now.cost(_scale(now.chi2)) / sources.variance_factor,
        inconsistent,
        snapshot.map_revision,
        FoundAspect(problem.camera, float(now.state.common[0]), aspect_left),
        ReadoutEstimate(unit * float(now.state.common[1]), unit * readout_std),
    )


def two_places(residuals: FloatArray, J: FloatArray, outlying: BoolArray) -> bool:
    """Whether one other pose explains most of a marker's outlying views: it was moved or is duplicated.

    Parameters
    ----------
    residuals, J : (n, 8), (n, 8, 6), whitened, of all views of one marker, J with respect to its pose
    outlying : (n,)
    """
    norms = np.linalg.norm(residuals, axis=-1)
    # In a diverged map residuals are zero for a marker behind the camera, and not finite for one in its plane.
    outlying = outlying & np.isfinite(norms) & (norms > 0.0) & np.isfinite(J).all(axis=(1, 2))
    count = np.count_nonzero(outlying)
    if count < _FEWEST or count < _LEAST * len(residuals):
        return False
    # Views are normalised, so that a linear step suffices whatever the size of their residuals.
    norms = norms[outlying]
    r = (residuals[outlying] / norms[:, None]).ravel()
    A = (J[outlying] / norms[:, None, None]).reshape(-1, 6)
    step, *_ = np.linalg.lstsq(A, r, rcond=None)
    left = r - A @ step
    return bool(left @ left < (1.0 - _EXPLAINED) * count)
