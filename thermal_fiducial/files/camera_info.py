"""Calibration files: the camera_info YAML of ROS's camera_calibration and camera_info_manager."""

from pathlib import Path
from typing import Any

import numpy as np

from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.geometry.plausibility import require_usable
from thermal_fiducial.core.types import FloatArray
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.plain_yaml import save_plain
from thermal_fiducial.files.schema import load_yaml, Value

_LARGEST_SIDE = 65_535


def load_camera(path: str | Path) -> Camera:
    """Read a calibration.

    Raises
    ------
    InputError
        Unreadable, not a calibration, or impossible values.
    """
    try:
        root = load_yaml(path)
    except InputError as error:
        raise InputError(f'calibration {error}') from None
    try:
        return require_usable(_camera(root.mapping()))
    except InputError as error:
        # Errors of a single value name its place; errors of their combination do not.
        place = '' if str(error).startswith(str(path)) else f'{path}: '
        raise InputError(f'calibration {place}{error}') from None


def _camera(fields: dict[str, Value]) -> Camera:
    return Camera(
        width=_integer(fields, 'image_width'),
        height=_integer(fields, 'image_height'),
        K=_matrix(fields, 'camera_matrix', 9).reshape(3, 3),
        model=fields['distortion_model'].text() if 'distortion_model' in fields else 'plumb_bob',
        D=_matrix(fields, 'distortion_coefficients', None),
    )


def _integer(fields: dict[str, Value], key: str) -> int:
    if key not in fields:
        raise InputError(f'{key} is missing')
    return fields[key].integer(0, _LARGEST_SIDE)


def _matrix(fields: dict[str, Value], key: str, size: int | None) -> FloatArray:
    entry = fields.get(key)
    if entry is not None and isinstance(entry.content, dict):
        entry = entry.mapping().get('data')
    if entry is None:
        raise InputError(f'{key} is missing')
    rows = [value.items() if isinstance(value.content, list) else [value] for value in entry.items()]
    values = [value.number() for row in rows for value in row]
    if len(values) != size and size is not None:
        raise entry.error(f'holds {len(values)} numbers, not {size}')
    return np.array(values)


def save_camera(path: str | Path, camera: Camera, name: str = 'tau2') -> None:
    """Write ``camera`` so that :func:`load_camera` and ROS's camera_info_manager read it.

    Raises
    ------
    InputError
        The file can't be written.
    """
    projection = np.hstack([camera.K, np.zeros((3, 1))])
    content = {
        'image_width': camera.width,
        'image_height': camera.height,
        'camera_name': name,
        'camera_matrix': _entry(camera.K),
        'distortion_model': camera.model,
        'distortion_coefficients': _entry(camera.D[None]),
        'rectification_matrix': _entry(np.eye(3)),
        'projection_matrix': _entry(projection),
    }
    save_plain(path, content)


def _entry(matrix: FloatArray) -> dict[str, Any]:
    return {'rows': matrix.shape[0], 'cols': matrix.shape[1], 'data': [float(value) for value in matrix.ravel()]}
