"""Errors of a map against the true one, per marker."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from thermal_fiducial.core.geometry.se3 import so3_log
from thermal_fiducial.core.mapping.map_data import MapMarker, MarkerMap
from thermal_fiducial.errors import InputError
from thermal_fiducial.report.metrics import rigid_residuals, rms, spread

#: Fewest markers whose residuals after a rigid alignment are meaningful.
_FEWEST_TO_ALIGN = 4


@dataclass(frozen=True)
class MarkerError:
    """Error of one marker, with the map's standard deviations."""

    id: int
    fixed: bool
    position_mm: float
    attitude_deg: float
    #: standard deviations of the map: position (three axes together) and attitude
    sigma_mm: float
    sigma_deg: float
    #: NEES per degree of freedom; None without covariance
    nees: float | None


def sigmas(marker: MapMarker) -> tuple[float, float]:
    """Standard deviations of position [mm] and attitude [deg], three axes together."""
    position, attitude = (max(float(np.trace(marker.covariance[i : i + 3, i : i + 3])), 0.0) for i in (0, 3))
    return 1e3 * float(np.sqrt(position)), float(np.rad2deg(np.sqrt(attitude)))


def marker_errors(estimate: MarkerMap, truth: MarkerMap) -> dict[int, MarkerError]:
    """Errors of the markers that both maps have, by ID."""
    common = sorted(estimate.markers.keys() & truth.markers.keys())
    return {key: _marker_error(estimate.markers[key], truth.markers[key]) for key in common}


def doubt_of_dictionary(estimate: MarkerMap, truth: MarkerMap) -> str:
    """That the two maps have other markers under the same IDs, in words; empty if not."""
    own, true = Path(estimate.dictionary).name, Path(truth.dictionary).name
    return '' if own == true else f'The map has markers of {own}, the true one of {true}.'


def _marker_error(marker: MapMarker, true: MapMarker) -> MarkerError:
    T, T_true = marker.T_map_marker, true.T_map_marker
    d = np.concatenate([T_true[:3, 3] - T[:3, 3], so3_log(T_true[:3, :3] @ T[:3, :3].T)])
    P = marker.covariance
    claimed = not marker.fixed and float(np.linalg.eigvalsh(P)[0]) > 0.0
    return MarkerError(
        marker.id,
        marker.fixed,
        1e3 * float(np.linalg.norm(d[:3])),
        float(np.rad2deg(np.linalg.norm(d[3:]))),
        *sigmas(marker),
        float(d @ np.linalg.solve(P, d)) / 6.0 if claimed else None,
    )


def map_accuracy(estimate: MarkerMap, truth: MarkerMap) -> dict[str, float]:
    """Errors of the markers that are not fixed, in the map frame; positions also after rigid alignment.

    Raises
    ------
    InputError
        The maps have no marker in common.
    """
    errors = marker_errors(estimate, truth)
    if not errors:
        raise InputError('the two maps have no marker in common')
    free = [error for error in errors.values() if not error.fixed] or list(errors.values())
    result: dict[str, float] = {'markers': len(errors), 'not_fixed': sum(not error.fixed for error in errors.values())}
    position, attitude = np.array([(error.position_mm, error.attitude_deg) for error in free]).T
    result |= spread(position, attitude, ('rms', 'max'))
    claimed = [error.nees for error in free if error.nees is not None]
    if claimed:
        result['nees_per_dof'] = float(np.mean(claimed))
    if len(errors) >= _FEWEST_TO_ALIGN:
        places = [np.array([m.markers[key].T_map_marker[:3, 3] for key in errors]) for m in (estimate, truth)]
        result['position_aligned_rms_mm'] = 1e3 * rms(np.linalg.norm(rigid_residuals(*places), axis=1))
    return result
