"""Marker maps on disk: YAML, written atomically."""

from collections.abc import Mapping
import math
from pathlib import Path

import numpy as np

from thermal_fiducial.core.geometry.plausibility import require_side
from thermal_fiducial.core.geometry.se3 import quaternion_from_rotation, transform_from_quaternion
from thermal_fiducial.core.mapping.map_data import MapMarker, MarkerMap
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.map_format import dump_document, MapDocument, MarkerEntry, read_document
from thermal_fiducial.files.writing import write_text

# Largest relative difference of two measurements of one side: of 20 mm, by half a millimetre.
_SAME_SIDE = 0.025


def load_map(
    path: str | Path, marker_size: float | None = None, size_overrides: Mapping[int, float] | None = None
) -> MarkerMap:
    """Marker map from a YAML file.

    Parameters
    ----------
    path : the file
    marker_size : side of markers whose entry has none [m]
    size_overrides : marker ID to side [m], instead of ``marker_size``

    Raises
    ------
    InputError
        The file can't be read, is not a marker map, or has an invalid entry; the message names file and entry. Or a
        side that was given is none.
    """
    document = read_document(str(path))
    sizes = size_overrides or {}
    markers = {}
    for entry in document.markers:
        size = sizes.get(entry.id, marker_size) if entry.size is None else entry.size
        if size is None:
            raise InputError(f'{path}: marker {entry.id} has no size, and no marker size was given')
        if entry.size is None:
            require_side(size, f'marker size for {path}')
        markers[entry.id] = _marker(entry, size)
    return MarkerMap(markers, document.frame_id, document.dictionary, document.revision)


def other_frame(of: str, published: str) -> str:
    """Warning if a map's frame differs from that of the published poses; else empty."""
    return (
        '' if of == published else f'the map is in frame {of!r}, but poses are published in {published!r} (map_frame)'
    )


def other_sides(marker_map: MarkerMap, marker_size: float, size_overrides: Mapping[int, float]) -> str:
    """Warning if no marker of a map has the side [m] that the parameters say: one of both is wrong; else empty."""
    sides = {key: (marker.size, size_overrides.get(key, marker_size)) for key, marker in marker_map.markers.items()}
    if not sides or any(math.isclose(*both, rel_tol=_SAME_SIDE) for both in sides.values()):
        return ''
    key, (in_map, declared) = next(iter(sides.items()))
    by = 'marker_size_overrides' if key in size_overrides else 'marker_size'
    return f'no marker has the side of the parameters: marker {key} is {in_map:g} m in the map, {declared:g} m by {by}'


def save_map(path: str | Path, marker_map: MarkerMap) -> None:
    """Write ``marker_map`` atomically: a temporary file in the same folder, synced, then renamed.

    Raises
    ------
    InputError
        The folder doesn't exist or can't be written to, or the map has a value that the reader would refuse.
    """
    marker_map.require_usable()
    write_text(path, dump_map(marker_map))


def dump_map(marker_map: MarkerMap) -> str:
    """YAML text of ``marker_map``, one line a marker, ordered by ID.

    Raises
    ------
    InputError
        The map has a value that the reader would refuse.
    """
    entries = tuple(_entry(marker) for marker in marker_map.markers.values())
    return dump_document(MapDocument(entries, marker_map.frame_id, marker_map.dictionary, marker_map.revision))


def _marker(entry: MarkerEntry, size: float) -> MapMarker:
    covariance = np.reshape(entry.covariance, (6, 6)) if entry.covariance else np.zeros((6, 6))
    return MapMarker(
        entry.id,
        size,
        entry.fixed,
        transform_from_quaternion(entry.position, entry.orientation),
        0.5 * (covariance + covariance.T),
        entry.reprojection_error_px,
        entry.observations,
        entry.first_seen_ns,
        entry.last_seen_ns,
        entry.trusted,
    )


def _entry(marker: MapMarker) -> MarkerEntry:
    T = marker.T_map_marker
    return MarkerEntry(
        marker.id,
        marker.size,
        marker.fixed,
        tuple(T[:3, 3].tolist()),
        tuple(quaternion_from_rotation(T[:3, :3]).tolist()),
        tuple(marker.covariance.ravel().tolist()),
        marker.reprojection_error_px,
        marker.observations,
        marker.first_seen_ns,
        marker.last_seen_ns,
        marker.trusted,
    )
