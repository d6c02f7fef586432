"""How two maps of one place lie to each other, by the markers that both have."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from thermal_fiducial.core.geometry.reprojection import corners_in_map
from thermal_fiducial.core.geometry.se3 import apply, transform
from thermal_fiducial.core.mapping.map_data import MapMarker
from thermal_fiducial.core.types import FloatArray
from thermal_fiducial.errors import InputError

# Residual of a common marker, in units of the median, beyond which it doesn't take part in an alignment.
_OUTLIER = 4.0
# Residual that is never an outlier [m].
_TOLERANCE_M = 0.01
_REWEIGHTINGS = 4


@dataclass(frozen=True)
class Alignment:
    """A rigid transform between two maps, from what they have in common."""

    #: (4, 4) takes the moving map into the resting one
    T: FloatArray
    #: rms distance of the corners of each common marker after the alignment [m]
    residuals_m: dict[int, float]
    #: common markers that did not take part, because they disagree with the others
    outliers: tuple[int, ...]


def align(resting: Mapping[int, MapMarker], moving: Mapping[int, MapMarker]) -> Alignment:
    """Rigid transform that takes ``moving`` onto ``resting``, by the corners of the markers that both have.

    Least squares (B. Horn, "Closed-form solution of absolute orientation using unit quaternions", 1987; here by
    singular values); markers that disagree with the others (moved between the two surveys) are left out.

    Raises
    ------
    InputError
        No marker in common, or sizes that differ.
    """
    common = sorted(resting.keys() & moving.keys())
    if not common:
        raise InputError('the maps have no marker in common')
    for key in common:
        if abs(resting[key].size - moving[key].size) > 1e-3 * resting[key].size:
            raise InputError(f'marker {key} is {resting[key].size} m in one map and {moving[key].size} m in the other')
    target, source = (_corners([markers[key] for key in common]) for markers in (resting, moving))
    # Each marker alone gives a transform; the one that suits the median marker best shows who disagrees.
    single = [rigid(t, s) for t, s in zip(target, source, strict=True)]
    T = min(single, key=lambda T: float(np.median(_distances(T, target, source))))
    for _ in range(_REWEIGHTINGS):
        residuals = _distances(T, target, source)
        used = residuals <= max(_OUTLIER * float(np.median(residuals)), _TOLERANCE_M)
        T = rigid(target[used].reshape(-1, 3), source[used].reshape(-1, 3))
    residuals = _distances(T, target, source)
    outliers = tuple(key for key, keep in zip(common, used, strict=True) if not keep)
    return Alignment(T, dict(zip(common, residuals.tolist(), strict=True)), outliers)


def jump(new: Mapping[int, MapMarker], old: Mapping[int, MapMarker]) -> FloatArray | None:
    """T_new_old (4, 4) of two maps of one place; None where they have no marker in common, or one of two sizes."""
    try:
        return align(new, old).T
    except InputError:
        return None


def _distances(T: FloatArray, target: FloatArray, source: FloatArray) -> FloatArray:
    """Rms distance (K,) of the corners (K, 4, 3) of each marker."""
    return np.asarray(np.sqrt(np.mean(np.sum((apply(T, source) - target) ** 2, axis=-1), axis=-1)))


def rigid(target: FloatArray, source: FloatArray) -> FloatArray:
    """T_target_source (4, 4) with the least squares of ``target - T source``, points (N, 3)."""
    centre_target, centre_source = target.mean(axis=0), source.mean(axis=0)
    U, _, Vt = np.linalg.svd((target - centre_target).T @ (source - centre_source))
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    return transform(R, centre_target - R @ centre_source)


def _corners(markers: list[MapMarker]) -> FloatArray:
    T = np.stack([marker.T_map_marker for marker in markers])
    return corners_in_map(T, np.array([marker.size for marker in markers]))
