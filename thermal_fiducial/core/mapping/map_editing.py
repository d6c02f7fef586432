"""Editing of marker maps: each function answers a new map of the next revision and leaves its input alone."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from thermal_fiducial.core.geometry.reprojection import corners_in_map
from thermal_fiducial.core.geometry.se3 import apply, transform
from thermal_fiducial.core.mapping.map_data import MapMarker, MarkerMap
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


def set_fixed(marker_map: MarkerMap, ids: Iterable[int], fixed: bool) -> MarkerMap:
    """Declare markers fixed (they never move) or free.

    Raises
    ------
    InputError
        An ID that is not in the map.
    """
    return _changed(marker_map, {key: replace(_get(marker_map, key), fixed=fixed) for key in ids})


def move(marker_map: MarkerMap, marker_id: int, T_map_marker: FloatArray, covariance: FloatArray) -> MarkerMap:
    """Put a marker somewhere else; its statistics start anew.

    Raises
    ------
    InputError
        An ID that is not in the map.
    """
    marker = _get(marker_map, marker_id)
    moved = MapMarker(marker_id, marker.size, marker.fixed, T_map_marker, covariance)
    return _changed(marker_map, {marker_id: moved})


def rename(marker_map: MarkerMap, old: int, new: int) -> MarkerMap:
    """Give a marker another ID.

    Raises
    ------
    InputError
        No marker ``old``, or there is a marker ``new`` already.
    """
    marker = _get(marker_map, old)
    if new in marker_map.markers:
        raise InputError(f'marker {new} is in the map already')
    renamed = _changed(marker_map, {new: replace(marker, id=new)})
    del renamed.markers[old]
    return renamed


def delete(marker_map: MarkerMap, ids: Iterable[int]) -> MarkerMap:
    """Take markers out.

    Raises
    ------
    InputError
        An ID that is not in the map.
    """
    smaller = _changed(marker_map, {})
    for key in ids:
        _get(marker_map, key)
        smaller.markers.pop(key, None)
    return smaller


def transformed(marker_map: MarkerMap, T_new_old: FloatArray) -> MarkerMap:
    """The whole map in another frame; covariances turn along."""
    turn = np.kron(np.eye(2), T_new_old[:3, :3])
    return _changed(
        marker_map,
        {
            key: replace(
                marker, T_map_marker=T_new_old @ marker.T_map_marker, covariance=turn @ marker.covariance @ turn.T
            )
            for key, marker in marker_map.markers.items()
        },
    )


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


def _distances(T: FloatArray, target: FloatArray, source: FloatArray) -> FloatArray:
    """Rms distance (K,) of the corners (K, 4, 3) of each marker."""
    return np.asarray(np.sqrt(np.mean(np.sum((apply(T, source) - target) ** 2, axis=-1), axis=-1)))


def rigid(target: FloatArray, source: FloatArray) -> FloatArray:
    """T_target_source (4, 4) with the least squares of ``target - T source``, points (N, 3)."""
    centre_target, centre_source = target.mean(axis=0), source.mean(axis=0)
    U, _, Vt = np.linalg.svd((target - centre_target).T @ (source - centre_source))
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    return transform(R, centre_target - R @ centre_source)


def merge(resting: MarkerMap, moving: MarkerMap) -> tuple[MarkerMap, Alignment]:
    """Both maps in the frame of ``resting``.

    Common markers keep the pose of whichever map knows it better; the others of ``moving`` come over, their covariance
    enlarged by how badly the common ones fit.

    Raises
    ------
    InputError
        No marker in common, sizes or dictionaries that differ.
    """
    if resting.dictionary != moving.dictionary:
        raise InputError(f'the maps are of different dictionaries: {resting.dictionary} and {moving.dictionary}')
    alignment = align(resting.markers, moving.markers)
    moved = transformed(moving, alignment.T).markers
    agreeing = [r for key, r in alignment.residuals_m.items() if key not in alignment.outliers]
    mean_square = float(np.mean(np.square(agreeing)))
    spread = float(np.mean([np.linalg.norm(moved[key].T_map_marker[:3, 3]) for key in moved])) or 1.0
    slack = np.diag([mean_square / 3.0] * 3 + [mean_square / max(spread, 0.1) ** 2] * 3)
    changes: dict[int, MapMarker] = {}
    for key, marker in moved.items():
        own = resting.markers.get(key)
        if own is None:
            changes[key] = replace(marker, fixed=False, covariance=marker.covariance + slack)
        elif key not in alignment.outliers and not own.fixed:
            better = marker if np.trace(marker.covariance) < np.trace(own.covariance) and marker.trusted else own
            changes[key] = replace(
                better,
                fixed=False,
                observations=own.observations + marker.observations,
                first_seen_ns=min(own.first_seen_ns, marker.first_seen_ns),
                last_seen_ns=max(own.last_seen_ns, marker.last_seen_ns),
            )
    return _changed(resting, changes), alignment


def anchor(marker_map: MarkerMap, surveyed: Mapping[int, FloatArray]) -> tuple[MarkerMap, dict[int, float]]:
    """Move the whole map onto surveyed positions (3,) [m] of the centres of at least three markers.

    Returns
    -------
    The map, and the distance of each surveyed centre after the alignment [m].

    Raises
    ------
    InputError
        Fewer than three surveyed markers in the map, or all on a line.
    """
    common = sorted(marker_map.markers.keys() & surveyed.keys())
    if len(common) < 3:
        raise InputError(f'{len(common)} surveyed markers are in the map: three are needed')
    target = np.stack([surveyed[key] for key in common])
    source = np.stack([marker_map.markers[key].T_map_marker[:3, 3] for key in common])
    extents = np.linalg.svd(target - target.mean(axis=0), compute_uv=False)
    if extents[1] < 0.02 * extents[0]:
        raise InputError('the surveyed markers lie on a line: they leave a rotation open')
    T = rigid(target, source)
    distances = np.linalg.norm(apply(T, source) - target, axis=-1)
    return transformed(marker_map, T), dict(zip(common, distances.tolist(), strict=True))


def with_covariances(marker_map: MarkerMap, position_std: float, rotation_std: float) -> MarkerMap:
    """The map with standard deviations [m, rad] for the markers that are neither fixed nor have any.

    The mapper takes such a marker for exact and never moves it; whoever writes one by hand does not mean that.
    """
    covariance = np.diag([position_std**2] * 3 + [rotation_std**2] * 3)
    exact = [key for key, m in marker_map.markers.items() if not m.fixed and not np.any(m.covariance)]
    changed = {key: replace(marker_map.markers[key], covariance=covariance) for key in exact}
    return replace(marker_map, markers={**marker_map.markers, **changed})


def _corners(markers: list[MapMarker]) -> FloatArray:
    T = np.stack([marker.T_map_marker for marker in markers])
    return corners_in_map(T, np.array([marker.size for marker in markers]))


def _get(marker_map: MarkerMap, marker_id: int) -> MapMarker:
    if marker_id not in marker_map.markers:
        known = ', '.join(str(key) for key in sorted(marker_map.markers)) or 'none'
        raise InputError(f'marker {marker_id} is not in the map (there are {known})')
    return marker_map.markers[marker_id]


def _changed(marker_map: MarkerMap, changes: Mapping[int, MapMarker]) -> MarkerMap:
    return replace(marker_map, markers={**marker_map.markers, **changes}, revision=marker_map.revision + 1)
