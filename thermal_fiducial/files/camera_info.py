"""Calibration files: the YAML of ROS camera_info, as camera_calibration and camera_info_manager write it."""

from pathlib import Path
from typing import Any

import numpy as np
import yaml

from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.types import FloatArray
from thermal_fiducial.errors import InputError

#: Names that other tools use for our models.
MODEL_SYNONYMS = {'fisheye': 'equidistant', 'radtan': 'plumb_bob', 'radial-tangential': 'plumb_bob'}


def load_camera(path: str | Path) -> Camera:
    """Read a calibration.

    Raises
    ------
    InputError
        Unreadable, not a calibration, or values that no camera has.
    """
    path = Path(path)
    try:
        content = yaml.safe_load(path.read_text(encoding='utf-8'))
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f'calibration {path}: {_first_line(error)}') from None
    except yaml.YAMLError as error:
        raise InputError(f'calibration {path} is not YAML: {_first_line(error)}') from None
    if not isinstance(content, dict):
        raise InputError(f'calibration {path} is not a camera_info file')
    try:
        return _camera(content)
    except InputError as error:
        raise InputError(f'calibration {path}: {error}') from None


def _camera(content: dict[str, Any]) -> Camera:
    model = str(content.get('distortion_model', 'plumb_bob'))
    return Camera(
        width=_integer(content, 'image_width'),
        height=_integer(content, 'image_height'),
        K=_matrix(content, 'camera_matrix', 9).reshape(3, 3),
        model=MODEL_SYNONYMS.get(model, model),
        D=_matrix(content, 'distortion_coefficients', None),
    )


def _integer(content: dict[str, Any], key: str) -> int:
    value = content.get(key)
    if not isinstance(value, int) or isinstance(value, bool):
        raise InputError(f'{key} is {"missing" if value is None else "not a whole number"}')
    return value


def _matrix(content: dict[str, Any], key: str, size: int | None) -> FloatArray:
    entry = content.get(key)
    data = entry.get('data') if isinstance(entry, dict) else entry
    if data is None:
        raise InputError(f'{key} is missing')
    try:
        values = np.array(data, dtype=np.float64).reshape(-1)
    except (TypeError, ValueError):
        raise InputError(f'{key} does not hold numbers') from None
    if size is not None and values.size != size:
        raise InputError(f'{key} holds {values.size} numbers, not {size}')
    return values


def _first_line(error: Exception) -> str:
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return str(error).splitlines()[0]


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
    try:
        Path(path).write_text(yaml.safe_dump(content, sort_keys=False, default_flow_style=None), encoding='utf-8')
    except OSError as error:
        raise InputError(f'calibration {path}: {error.strerror}') from None


def _entry(matrix: FloatArray) -> dict[str, Any]:
    return {'rows': matrix.shape[0], 'cols': matrix.shape[1], 'data': [float(value) for value in matrix.ravel()]}
