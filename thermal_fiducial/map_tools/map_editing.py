"""Editing of marker maps: each function returns a new map with the next revision; the input is unchanged."""

from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np

from thermal_fiducial.core.geometry.se3 import lever_arm, turned
from thermal_fiducial.core.mapping.map_data import align, Alignment, corners_of_markers, MapMarker, MarkerMap
from thermal_fiducial.core.types import FloatArray
from thermal_fiducial.core.wording import listed
from thermal_fiducial.errors import InputError


def set_fixed(marker_map: MarkerMap, ids: Iterable[int], fixed: bool) -> MarkerMap:
    """Declare markers fixed (they never move) or free.

    Raises
    ------
    InputError
        An ID that is not in the map.
    """
    return _changed(marker_map, {key: replace(marker_of(marker_map, key), fixed=fixed) for key in ids})


def move(marker_map: MarkerMap, marker_id: int, T_map_marker: FloatArray, covariance: FloatArray) -> MarkerMap:
    """Set a marker's pose; its statistics are reset.

    Raises
    ------
    InputError
        An ID that is not in the map.
    """
    marker = marker_of(marker_map, marker_id)
    moved = MapMarker(marker_id, marker.size, marker.fixed, T_map_marker, covariance)
    return _changed(marker_map, {marker_id: moved})


def rename(marker_map: MarkerMap, old: int, new: int) -> MarkerMap:
    """Give a marker another ID.

    Raises
    ------
    InputError
        There is no marker ``old``, or already a marker ``new``.
    """
    marker = marker_of(marker_map, old)
    if new in marker_map.markers:
        raise InputError(f'marker {new} is in the map already')
    renamed = _changed(marker_map, {new: replace(marker, id=new)})
    del renamed.markers[old]
    return renamed


def delete(marker_map: MarkerMap, ids: Iterable[int]) -> MarkerMap:
    """Remove markers.

    Raises
    ------
    InputError
        An ID that is not in the map.
    """
    smaller = _changed(marker_map, {})
    for key in ids:
        marker_of(marker_map, key)
        smaller.markers.pop(key, None)
    return smaller


def transformed(marker_map: MarkerMap, T_new_old: FloatArray) -> MarkerMap:
    """The map in another frame, covariances included."""
    return _changed(
        marker_map,
        {
            key: replace(
                marker,
                T_map_marker=T_new_old @ marker.T_map_marker,
                covariance=turned(marker.covariance, T_new_old[:3, :3]),
            )
            for key, marker in marker_map.markers.items()
        },
    )


def merge(resting: MarkerMap, moving: MarkerMap) -> tuple[MarkerMap, Alignment]:
    """Both maps in the frame of ``resting``.

    The covariances of ``moving`` are inflated by what the common markers leave open. Of these the pose with the smaller
    covariance is kept; the others of ``moving`` are added.

    Raises
    ------
    InputError
        No common marker, or different sizes or dictionaries.
    """
    if resting.dictionary != moving.dictionary:
        raise InputError(f'the maps are of different dictionaries: {resting.dictionary} and {moving.dictionary}')
    alignment = align(resting.markers, moving.markers)
    moved = transformed(moving, alignment.T).markers
    agreeing = [key for key in alignment.residuals_m if key not in alignment.outliers]
    middle, slack = _left_open(resting, moved, agreeing, alignment)
    changes: dict[int, MapMarker] = {}
    for key, marker in moved.items():
        own = resting.markers.get(key)
        arm = lever_arm(marker.T_map_marker[:3, 3] - middle)
        placed = replace(marker, fixed=False, covariance=marker.covariance + arm @ slack @ arm.T)
        if own is None:
            changes[key] = placed
        elif key not in alignment.outliers and not own.fixed:
            better = placed if np.trace(placed.covariance) < np.trace(own.covariance) and placed.trusted else own
            changes[key] = replace(
                better,
                observations=own.observations + marker.observations,
                first_seen_ns=min((seen for seen in (own.first_seen_ns, marker.first_seen_ns) if seen), default=0),
                last_seen_ns=max(own.last_seen_ns, marker.last_seen_ns),
            )
    return _changed(resting, changes), alignment


def _left_open(
    resting: MarkerMap, moved: Mapping[int, MapMarker], common: list[int], alignment: Alignment
) -> tuple[FloatArray, FloatArray]:
    """Middle (3,) of the common markers, about which an alignment turns the others, and its covariance (6, 6) there.

    The errors of both poses of the common markers, whose correlations no file has: covariances times their number
    bound those of the sum for any. What the misfit has beyond these errors is added.
    """
    markers = [moved[key] for key in common]
    corners = corners_of_markers(markers)
    middle = corners.mean(axis=(0, 1))
    covariances = np.stack([marker.covariance + resting.markers[marker.id].covariance for marker in markers])
    centres = np.stack([marker.T_map_marker[:3, 3] for marker in markers])
    # Displacements of the corners by one of the alignment about the middle, and by one of their marker.
    by_all, by_own = (lever_arm(corners - about)[..., :3, :] for about in (middle, centres[:, None]))
    shares = np.linalg.solve(np.einsum('kcij,kcil->jl', by_all, by_all), np.einsum('kcij,kcil->kjl', by_all, by_own))
    bound = len(common) * np.sum(shares @ covariances @ shares.swapaxes(1, 2), axis=0)
    expected = float(np.einsum('kcij,kjl,kcil->', by_own, covariances, by_own)) / (4 * len(common))
    misfit = float(np.mean(np.square([alignment.residuals_m[key] for key in common])))
    beyond = max(misfit - expected, 0.0)
    spread = float(np.mean(np.sum((corners - middle) ** 2, axis=-1)))
    return middle, bound + np.diag([beyond / 3.0] * 3 + [beyond / spread] * 3)


def marker_of(marker_map: MarkerMap, marker_id: int) -> MapMarker:
    """The marker of an ID. Raises InputError if it is not in the map."""
    if marker_id not in marker_map.markers:
        known = listed(sorted(marker_map.markers)) or 'none'
        raise InputError(f'marker {marker_id} is not in the map; the IDs of its markers: {known}')
    return marker_map.markers[marker_id]


def _changed(marker_map: MarkerMap, changes: Mapping[int, MapMarker]) -> MarkerMap:
    return replace(marker_map, markers={**marker_map.markers, **changes}, revision=marker_map.revision + 1)
