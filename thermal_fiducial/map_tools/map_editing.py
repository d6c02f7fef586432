"""Editing of marker maps: each function returns a new map with the next revision; the input is unchanged."""

from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np

from thermal_fiducial.core.geometry.reprojection import corners_in_map, lever_arm, turned
from thermal_fiducial.core.geometry.se3 import apply, rigid_alignment
from thermal_fiducial.core.mapping.map_data import align, Alignment, MapMarker, MarkerMap
from thermal_fiducial.core.types import FloatArray
from thermal_fiducial.core.wording import listed, number_of
from thermal_fiducial.errors import InputError

# Distance of a surveyed marker from its place, as a share of the surveyed part's radius, beyond which the survey
# contradicts the map: maps by one marker are off by a per cent, an exchanged ID or another unit by much more.
_CONTRADICTS = 0.1


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

    The covariances of ``moving`` are inflated by the misfit of the common markers. Of these the pose with the smaller
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
    middle, slack = _misfit(resting, moved, agreeing, alignment)
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


def _misfit(
    resting: MarkerMap, moved: Mapping[int, MapMarker], common: list[int], alignment: Alignment
) -> tuple[FloatArray, FloatArray]:
    """Middle (3,) of the common markers, about which an alignment turns the others, and its covariance (6, 6) there.

    One common marker fits exactly: it shows no misfit, and the errors of both of its poses count.
    """
    markers = [moved[key] for key in common]
    corners = corners_in_map(np.stack([m.T_map_marker for m in markers]), np.array([m.size for m in markers]))
    middle = corners.mean(axis=(0, 1))
    if len(common) == 1:
        return middle, markers[0].covariance + resting.markers[common[0]].covariance
    mean_square = float(np.mean(np.square([alignment.residuals_m[key] for key in common])))
    spread = float(np.mean(np.sum((corners - middle) ** 2, axis=-1)))
    return middle, np.diag([mean_square / 3.0] * 3 + [mean_square / spread] * 3)


def anchor(marker_map: MarkerMap, surveyed: Mapping[int, FloatArray]) -> tuple[MarkerMap, dict[int, float]]:
    """Align the map to surveyed positions (3,) [m] of the centres of at least three markers.

    Returns
    -------
    The map, and the distance of each surveyed centre after the alignment [m].

    Raises
    ------
    InputError
        Fewer than three surveyed markers in the map, or all collinear, or in places that contradict the map.
    """
    common = sorted(marker_map.markers.keys() & surveyed.keys())
    if len(common) < 3:
        raise InputError(f'{number_of(len(common), "surveyed marker")} in the map: three are needed')
    target = np.stack([surveyed[key] for key in common])
    source = np.stack([marker_map.markers[key].T_map_marker[:3, 3] for key in common])
    extents = np.linalg.svd(target - target.mean(axis=0), compute_uv=False)
    if extents[1] <= 0.02 * extents[0]:
        raise InputError('the surveyed markers lie on a line, or in one place: they leave a rotation open')
    T = rigid_alignment(target, source)
    distances = np.linalg.norm(apply(T, source) - target, axis=-1)
    worst = int(np.argmax(distances))
    if distances[worst] > _CONTRADICTS * np.linalg.norm(source - source.mean(axis=0), axis=-1).max():
        raise InputError(
            f'the survey contradicts the map: marker {common[worst]} would be {distances[worst]:.3g} m from its place '
            'there: are its numbers metres, its IDs right?'
        )
    return transformed(marker_map, T), dict(zip(common, distances.tolist(), strict=True))


def marker_of(marker_map: MarkerMap, marker_id: int) -> MapMarker:
    """The marker of an ID. Raises InputError if it is not in the map."""
    if marker_id not in marker_map.markers:
        known = listed(sorted(marker_map.markers)) or 'none'
        raise InputError(f'marker {marker_id} is not in the map; the IDs of its markers: {known}')
    return marker_map.markers[marker_id]


def _changed(marker_map: MarkerMap, changes: Mapping[int, MapMarker]) -> MarkerMap:
    return replace(marker_map, markers={**marker_map.markers, **changes}, revision=marker_map.revision + 1)
