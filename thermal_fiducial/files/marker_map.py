"""Marker maps on disk: YAML, written so that a kill at any moment leaves the old map or the new one, whole."""

from collections.abc import Mapping
import os
from pathlib import Path
import tempfile
from typing import Any

import numpy as np
import yaml

from thermal_fiducial.core.geometry.se3 import quaternion_from_rotation, transform_from_quaternion
from thermal_fiducial.core.mapping.map_data import MapMarker, MarkerMap
from thermal_fiducial.core.types import FloatArray
from thermal_fiducial.errors import InputError

FORMAT = 'thermal_fiducial/marker_map'

# Positions are written to a nanometre, rotations to a nanoradian: below any measurement.
_DIGITS = 9
_KEYS = {
    'id', 'size', 'fixed', 'position', 'orientation', 'covariance', 'reprojection_error_px', 'observations',
    'first_seen_ns', 'last_seen_ns', 'trusted',
}  # fmt: skip


def load_map(
    path: str | Path, marker_size: float | None = None, size_overrides: Mapping[int, float] | None = None
) -> MarkerMap:
    """Marker map from a YAML file.

    Parameters
    ----------
    path : the file
    marker_size : side of markers whose entry has none [m]
    size_overrides : marker ID to side [m], before ``marker_size``

    Raises
    ------
    InputError
        The file can't be read, is no marker map, or has a broken entry; the message names file and entry.
    """
    path = Path(path)
    document = _read(path)
    sizes = dict(size_overrides or {})
    markers: dict[int, MapMarker] = {}
    for index, entry in enumerate(_entries(path, document)):
        marker = _marker(f'{path}: markers[{index}]', entry, marker_size, sizes)
        if marker.id in markers:
            raise InputError(f'{path}: markers[{index}]: marker {marker.id} is there twice')
        markers[marker.id] = marker
    return MarkerMap(
        markers,
        frame_id=_text(path, document, 'frame_id', 'map'),
        dictionary=_text(path, document, 'dictionary', 'DICT_4X4_50'),
        version=_count(str(path), document, 'version', 1),
    )


def save_map(path: str | Path, marker_map: MarkerMap) -> None:
    """Write ``marker_map`` atomically: a temporary file in the same folder, synced, then renamed.

    Raises
    ------
    InputError
        The folder doesn't exist or can't be written to.
    """
    path = Path(path)
    try:
        write_atomically(path, dump_map(marker_map))
    except OSError as error:
        raise InputError(f'{path}: cannot write the map: {error.strerror}') from error


def dump_map(marker_map: MarkerMap) -> str:
    """YAML text of ``marker_map``, one line a marker, ordered by ID."""
    lines = [
        f'format: {FORMAT}',
        f'version: {marker_map.version}',
        f'frame_id: {_flow(marker_map.frame_id)}',
        f'dictionary: {_flow(marker_map.dictionary)}',
        'markers:' if marker_map.markers else 'markers: []',
    ]
    lines += [f'  - {_flow(_record(marker_map.markers[key]))}' for key in sorted(marker_map.markers)]
    return '\n'.join(lines) + '\n'


def write_atomically(path: Path, text: str) -> None:
    """Replace the content of ``path``; whoever reads it, at any time, sees the old text or the new one.

    Raises
    ------
    OSError
        As the file system says; the old file is then untouched.
    """
    descriptor, name = tempfile.mkstemp(prefix=f'.{path.name}.', suffix='.tmp', dir=path.parent)
    temporary = Path(name)
    try:
        with os.fdopen(descriptor, 'w', encoding='utf-8') as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        temporary.chmod(path.stat().st_mode if path.exists() else 0o644)
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    _sync_folder(path.parent)


def _sync_folder(folder: Path) -> None:
    """Make the rename itself survive a power cut."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _read(path: Path) -> dict[str, Any]:
    try:
        document = yaml.load(path.read_text(encoding='utf-8'), Loader=getattr(yaml, 'CSafeLoader', yaml.SafeLoader))
    except OSError as error:
        raise InputError(f'{path}: cannot read the map: {error.strerror}') from error
    except UnicodeDecodeError as error:
        raise InputError(f'{path}: not a text file') from error
    except yaml.YAMLError as error:
        mark = getattr(error, 'problem_mark', None)
        line = f' line {mark.line + 1}' if mark else ''
        raise InputError(f'{path}:{line} not valid YAML: {getattr(error, "problem", None) or "broken text"}') from error
    if not isinstance(document, dict):
        raise InputError(f'{path}: not a marker map: no "format: {FORMAT}"')
    if document.get('format') != FORMAT:
        raise InputError(f'{path}: format {document.get("format")!r} is not {FORMAT!r}')
    return document


def _entries(path: Path, document: dict[str, Any]) -> list[Any]:
    entries = document.get('markers')
    if not isinstance(entries, list):
        raise InputError(f'{path}: no list of markers: the file is broken or cut short')
    return entries


def _marker(where: str, entry: Any, marker_size: float | None, sizes: Mapping[int, float]) -> MapMarker:
    if not isinstance(entry, dict):
        raise InputError(f'{where}: {entry!r} is not a marker')
    marker_id = _count(where, entry, 'id', None)
    where = f'{where} (marker {marker_id})'
    unknown = sorted(str(key) for key in entry if key not in _KEYS)
    if unknown:
        raise InputError(f'{where}: unknown field {unknown[0]!r}')
    return MapMarker(
        id=marker_id,
        size=_size(where, entry, sizes.get(marker_id, marker_size)),
        fixed=_flag(where, entry, 'fixed', False),
        T_map_marker=transform_from_quaternion(_numbers(where, entry, 'position', 3), _orientation(where, entry)),
        covariance=_covariance(where, entry),
        reprojection_error_px=_error_px(where, entry),
        observations=_count(where, entry, 'observations', 0),
        first_seen_ns=_count(where, entry, 'first_seen_ns', 0),
        last_seen_ns=_count(where, entry, 'last_seen_ns', 0),
        trusted=_flag(where, entry, 'trusted', True),
    )


def _size(where: str, entry: dict[str, Any], default: float | None) -> float:
    size = entry.get('size', default)
    if size is None:
        raise InputError(f'{where}: no size, and no marker size was given')
    if not _is_number(size) or not 0.0 < size < 100.0:
        raise InputError(f'{where}: size: {size!r} is not a side in metres')
    return float(size)


def _orientation(where: str, entry: dict[str, Any]) -> FloatArray:
    q = _numbers(where, entry, 'orientation', 4)
    norm = float(np.linalg.norm(q))
    if not 0.99 < norm < 1.01:
        raise InputError(f'{where}: orientation is no unit quaternion x y z w (norm {norm:.3g})')
    return q


def _covariance(where: str, entry: dict[str, Any]) -> FloatArray:
    if 'covariance' not in entry:
        return np.zeros((6, 6))
    covariance = _numbers(where, entry, 'covariance', 36).reshape(6, 6)
    scale = float(np.max(np.abs(covariance)))
    if np.max(np.abs(covariance - covariance.T)) > 1e-6 * scale:
        raise InputError(f'{where}: covariance is not symmetric')
    if np.linalg.eigvalsh(covariance)[0] < -1e-6 * scale:
        raise InputError(f'{where}: covariance has a negative variance')
    return 0.5 * (covariance + covariance.T)


def _error_px(where: str, entry: dict[str, Any]) -> float:
    error = entry.get('reprojection_error_px', 0.0)
    if not _is_number(error) or error < 0.0:
        raise InputError(f'{where}: reprojection_error_px: {error!r} is not an error in pixels')
    return float(error)


def _numbers(where: str, entry: dict[str, Any], key: str, length: int) -> FloatArray:
    try:
        # float() also takes '1e-4', which YAML 1.1 reads as text for want of a decimal point.
        values = np.array([float(value) for value in entry[key]])
    except (KeyError, TypeError, ValueError):
        values = np.empty(0)
    if len(values) != length or not np.all(np.isfinite(values)):
        raise InputError(f'{where}: {key} is not a list of {length} numbers')
    return values


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and bool(np.isfinite(value))


def _count(where: str, entry: dict[str, Any], key: str, default: int | None) -> int:
    value = entry.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int) or value < 0:
        raise InputError(f'{where}: {key}: {value!r} is not a whole number')
    return value


def _flag(where: str, entry: dict[str, Any], key: str, default: bool) -> bool:
    value = entry.get(key, default)
    if not isinstance(value, bool):
        raise InputError(f'{where}: {key}: {value!r} is neither true nor false')
    return value


def _text(path: Path, document: dict[str, Any], key: str, default: str) -> str:
    value = document.get(key, default)
    if not isinstance(value, str) or not value:
        raise InputError(f'{path}: {key}: {value!r} is not a name')
    return value


def _record(marker: MapMarker) -> dict[str, Any]:
    T = marker.T_map_marker
    record: dict[str, Any] = {
        'id': marker.id,
        'size': marker.size,
        'fixed': marker.fixed,
        'position': _rounded(T[:3, 3]),
        'orientation': _rounded(quaternion_from_rotation(T[:3, :3])),
    }
    if np.any(marker.covariance):
        record['covariance'] = [float(f'{value:.6g}') for value in marker.covariance.ravel()]
    if marker.observations:
        record |= {
            'reprojection_error_px': round(marker.reprojection_error_px, 6),
            'observations': marker.observations,
            'first_seen_ns': marker.first_seen_ns,
            'last_seen_ns': marker.last_seen_ns,
        }
    if not marker.trusted:
        record['trusted'] = False
    return record


def _rounded(values: FloatArray) -> list[float]:
    return [round(float(value), _DIGITS) + 0.0 for value in values]


def _flow(value: Any) -> str:
    """``value`` as YAML on one line."""
    text: str = yaml.safe_dump(value, default_flow_style=True, width=float('inf'), sort_keys=False)
    return text.removesuffix('\n').removesuffix('\n...').strip()
