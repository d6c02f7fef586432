"""Choice of lens model and coefficients: the fewest whose error on held-out views is not clearly larger.

Stepwise: a coefficient enters when it lowers the error of held-out views by more than the standard error of the
difference, view by view; what does not enter stays at zero. A model that folds back before the image's corners is none.
T. Hastie, R. Tibshirani, J. Friedman, "The Elements of Statistical Learning", 2009, section 7.10 (one standard error).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from thermal_fiducial.calibration.intrinsics import board_pose, calibrate, calibrate_from, Calibration
from thermal_fiducial.calibration.lens_check import reaches_corners
from thermal_fiducial.calibration.lens_fit import FittedBoard, LensFit, NEARLY
from thermal_fiducial.calibration.targets import Sighting
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.types import FloatArray
from thermal_fiducial.errors import InputError

_FOLDS = 5
# A share of the mean squared error that no one would notice.
_NEAR_TIE = 0.02
# Coefficients that enter together, each group's in their order: radial ones, then tangential ones. Models from the
# fewest parameters to the most: of equals the first is chosen.
_GROUPS: dict[str, tuple[tuple[tuple[int, ...], ...], ...]] = {
    'equidistant': (((0,), (1,), (2,), (3,)),),
    'plumb_bob': (((0,), (1,), (4,)), ((2, 3),)),
    'rational_polynomial': (((0, 5), (1, 6), (4, 7)), ((2, 3),)),
}
CANDIDATES = tuple(_GROUPS)


@dataclass(frozen=True)
class _FittedLens:
    """A fit to all views, and the mean squared error (V,) [px^2] of each view when it is held out.

    If not ``usable``, the model folds back within the image; further coefficients may cure that.
    """

    fit: Calibration
    squares: FloatArray
    usable: bool

    @property
    def error(self) -> float:
        return float(np.mean(self.squares))

    def clearly_better_than(self, other: '_FittedLens') -> bool:
        """Whether the mean is lower by more than the standard error of the differences, and not next to nothing."""
        gain = other.squares - self.squares
        error = float(np.std(gain, ddof=1) / np.sqrt(len(gain)))
        return bool(np.mean(gain) > max(error, _NEAR_TIE * self.error))

    def finished(self) -> Calibration:
        rms = float(np.sqrt(self.error))
        sigma = float(np.std(self.squares, ddof=1) / np.sqrt(len(self.squares)) / (2.0 * rms)) if rms > 0.0 else 0.0
        return replace(self.fit, held_out_px=(rms, sigma))


def choose_model(
    sightings: Sequence[Sighting],
    width: int,
    height: int,
    models: Sequence[str] = CANDIDATES,
    *,
    radius: float = 0.0,
    focal_px: float = 600.0,
    board_std: float = 0.0,
) -> tuple[Calibration, dict[str, Calibration]]:
    """The best lens, and the best of each model; see the module's head.

    Where the board may be off by ``board_std`` [m], it is chosen twice: with the board as described, and as it is found
    with all coefficients of the best model, as a board of another shape looks like a lens of more of them.

    Raises
    ------
    InputError
        As :func:`calibrate`; or no model reaches the corners.
    """
    best, fits = _chosen(sightings, width, height, models, radius, focal_px)
    if not board_std:
        return best, fits
    found = _released(sightings, replace(best, free=tuple(range(len(best.camera.D)))), radius, board_std)
    best, fits = _chosen(_as_found(sightings, found), width, height, models, radius, focal_px)
    fits = {model: _released(sightings, fit, radius, board_std) for model, fit in fits.items()}
    return fits[best.camera.model], fits


def _released(sightings: Sequence[Sighting], near: Calibration, radius: float, board_std: float) -> Calibration:
    """Fit of the same coefficients to the same views, with the points of the board as unknowns."""
    used = [sightings[index] for index in near.views.tolist()]
    fit = calibrate_from(
        used, near.camera, near.T_camera_board, radius=radius, free=near.free, drop=False, board_std=board_std
    )
    return replace(fit, views=near.views, dropped=near.dropped, held_out_px=near.held_out_px)


def _as_found(sightings: Sequence[Sighting], found: Calibration) -> list[Sighting]:
    """Sightings of the board as it was found; those that no used view shows stay as described."""
    return [replace(view, points=np.stack([found.board.found(point) for point in view.points])) for view in sightings]


def _chosen(
    sightings: Sequence[Sighting], width: int, height: int, models: Sequence[str], radius: float, focal_px: float
) -> tuple[Calibration, dict[str, Calibration]]:
    """:func:`choose_model` with the board as described."""
    starts = [_start(sightings, width, height, model, radius, focal_px) for model in models]
    # For a fair comparison all models drop the outliers of the best-fitting one.
    reference = min(starts, key=lambda fit: (len(fit.dropped), fit.rms_px))
    used = [sightings[index] for index in reference.views.tolist()]
    chosen: dict[str, _FittedLens] = {}
    for start in starts:
        candidate = _stepwise(used, start, radius)
        if candidate is not None:
            chosen[candidate.fit.camera.model] = candidate
    if not chosen:
        raise InputError('no lens model fits these views that goes on growing out to the corners of the image')
    best = min(chosen.values(), key=lambda candidate: candidate.error)
    equals = [candidate.fit for candidate in chosen.values() if not best.clearly_better_than(candidate)]
    simplest = min(equals, key=lambda fit: (len(fit.free), CANDIDATES.index(fit.camera.model)))
    fits = {
        model: replace(candidate.finished(), views=reference.views, dropped=reference.dropped)
        for model, candidate in chosen.items()
    }
    return fits[simplest.camera.model], fits


def _start(
    sightings: Sequence[Sighting], width: int, height: int, model: str, radius: float, focal_px: float
) -> Calibration:
    """The model with its first two radial terms: enough to see which views do not belong."""
    free = [index for group in _GROUPS[model][0][:2] for index in group]
    return calibrate(sightings, width, height, model, radius=radius, focal_px=focal_px, free=free)


def _stepwise(sightings: Sequence[Sighting], start: Calibration, radius: float) -> _FittedLens | None:
    """The model with the coefficients that the views determine; None where none of it is usable."""
    camera = replace(start.camera, D=np.zeros_like(start.camera.D))
    poses = np.stack([board_pose(sighting, camera) for sighting in sightings])
    groups = _GROUPS[camera.model]
    entered = [0] * len(groups)
    bare = _fit(sightings, replace(start, camera=camera, T_camera_board=poses), (), radius)
    current = _held_out(sightings, bare, radius)
    best = current if current.usable else None
    while True:
        steps = [
            (place, _step(sightings, current.fit, (*current.fit.free, *group[count]), radius))
            for place, (group, count) in enumerate(zip(groups, entered, strict=True))
            if count < len(group)
        ]
        better = [(place, step) for place, step in steps if step is not None and step.clearly_better_than(current)]
        if not better:
            return best
        place, current = min(better, key=lambda step: step[1].error)
        entered[place] += 1
        if current.usable and (best is None or current.clearly_better_than(best)):
            best = current


def _step(
    sightings: Sequence[Sighting], current: Calibration, free: tuple[int, ...], radius: float
) -> _FittedLens | None:
    """Fit with more coefficients than the ``current`` one; None if the gain on fitted views is negligible.

    The gain on held-out views would be smaller still.
    """
    fit = _fit(sightings, current, free, radius)
    gains = current.rms_px**2 > (1.0 + _NEAR_TIE) * fit.rms_px**2
    return _held_out(sightings, fit, radius) if gains else None


def _fit(sightings: Sequence[Sighting], near: Calibration, free: tuple[int, ...], radius: float) -> Calibration:
    """Fit from a solution ``near`` by."""
    return calibrate_from(sightings, near.camera, near.T_camera_board, radius=radius, free=free, drop=False)


def _held_out(sightings: Sequence[Sighting], fit: Calibration, radius: float) -> _FittedLens:
    return _FittedLens(fit, _held_out_squares(sightings, fit, radius), reaches_corners(fit.camera))


def _held_out_squares(sightings: Sequence[Sighting], fit: Calibration, radius: float) -> FloatArray:
    """Mean squared error (V,) [px^2] of views whose pose alone was fitted, with intrinsics from the other folds.

    A fold moves a camera by a part of its errors: circles' centroids stay where they are for all views.
    """
    squares = np.zeros(len(sightings))
    every = LensFit(sightings, fit.camera, radius)
    centroids = every.centroids(FittedBoard(fit.camera, fit.T_camera_board, every.described))
    # Few views: all but one at a time.
    folds = _FOLDS if len(sightings) >= 2 * _FOLDS else len(sightings)
    index = np.arange(len(sightings))
    for fold in range(folds):
        inside, outside = index[index % folds != fold].tolist(), index[fold::folds].tolist()
        part = _part(sightings, centroids, inside, fit.camera, fit.free)
        trained = part.solve(fit.T_camera_board[inside]).camera
        held_out = _part(sightings, centroids, outside, trained, None)
        posed = held_out.solve(fit.T_camera_board[outside])
        for view, residual in zip(outside, held_out.residuals(posed), strict=True):
            squares[view] = float(np.mean(np.sum(residual**2, axis=1)))
    return squares


def _part(
    sightings: Sequence[Sighting],
    centroids: Sequence[FloatArray],
    index: Sequence[int],
    camera: Camera,
    free: tuple[int, ...] | None,
) -> LensFit:
    """Fit of some of the views; without coefficients to estimate (None), of their poses alone."""
    return LensFit(
        [sightings[k] for k in index],
        camera,
        0.0,
        free,
        poses_only=free is None,
        centroids=[centroids[k] for k in index],
        converged=NEARLY,
    )
