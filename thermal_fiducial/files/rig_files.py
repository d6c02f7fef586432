"""Camera and IMU of a recording from the YAML files of ours, of EuRoC (ASL) and of Kalibr."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.geometry.se3 import inverse, transform_from_quaternion
from thermal_fiducial.core.types import FloatArray
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.camera_info import MODEL_SYNONYMS
from thermal_fiducial.files.plain_yaml import load_plain

#: Kalibr's names of the densities, which are ours.
NOISE_NAMES = (
    'gyroscope_noise_density',
    'accelerometer_noise_density',
    'gyroscope_random_walk',
    'accelerometer_random_walk',
)


@dataclass(frozen=True)
class Rig:
    """A camera and an IMU."""

    camera: Camera
    #: (4, 4)
    T_body_camera: FloatArray
    #: by :data:`NOISE_NAMES`; what is not known is not there
    imu_noise: dict[str, float] = field(default_factory=dict)
    #: t_imu = t_camera + offset [s]
    time_offset: float = 0.0
    #: of the markers [m], 0: unknown
    marker_size: float = 0.0
    dictionary: str = ''


def read_yaml(path: Path) -> dict[str, Any]:
    """The document of a YAML file.

    Raises
    ------
    InputError
        Unreadable, or not a mapping.
    """
    # OpenCV's head, as some of EuRoC's files have it, is no YAML of version 1.1.
    document = load_plain(path, head='%YAML:1.0')
    if not isinstance(document, dict):
        raise InputError(f'{path}: no names with values')
    return document


def of_rig(path: Path, camera: str) -> Rig:
    """Of our ``rig.yaml``: ``cameras: {cam0: {width, height, model, K, D, T_body_camera}}``, ``imu``, ``marker_size``.

    Instead of ``T_body_camera``, ``camera_position`` and ``camera_orientation``, as the parameters have them.

    Raises
    ------
    InputError
        A missing or unusable entry.
    """
    document = read_yaml(path)
    entry = _section(path, _section(path, document, 'cameras'), camera)
    where = f'{path}: {camera}'
    lens = _camera(where, entry.get('model'), (entry.get('width'), entry.get('height')), entry.get('K'), entry.get('D'))
    if 'T_body_camera' in entry:
        T_body_camera = matrix(f'{where} T_body_camera', entry['T_body_camera'])
    else:
        position = _vector(f'{where} camera_position', entry.get('camera_position'), 3)
        orientation = _vector(f'{where} camera_orientation', entry.get('camera_orientation'), 4)
        T_body_camera = transform_from_quaternion(position, orientation)
    size = float(_vector(f'{path} marker_size', [document.get('marker_size', 0.0)], 1)[0])
    offset = float(_vector(f'{where} time_offset', [entry.get('time_offset', 0.0)], 1)[0])
    noise = _noise(path, document.get('imu') or {})
    return Rig(lens, T_body_camera, noise, offset, size, str(document.get('dictionary', '')))


def of_sensor(camera: Path, imu: Path) -> Rig:
    """Of EuRoC's two ``sensor.yaml``; ``T_BS`` maps the sensor's coordinates to the body's.

    Raises
    ------
    InputError
        A missing or unusable entry.
    """
    entry, other = read_yaml(camera), read_yaml(imu)
    D = entry.get('distortion_coefficients')
    lens = _camera(str(camera), entry.get('distortion_model'), entry.get('resolution'), _pinhole(camera, entry), D)
    places = [
        matrix(f'{path} T_BS', _section(path, content, 'T_BS').get('data'))
        for path, content in ((imu, other), (camera, entry))
    ]
    # ASL's gyroscope_random_walk and so on are Kalibr's.
    return Rig(lens, inverse(places[0]) @ places[1], _noise(imu, other))


def of_camchain(path: Path, camera: str, noise: Mapping[str, float]) -> Rig:
    """Of Kalibr's camchain with ``T_cam_imu`` and ``timeshift_cam_imu``, which is our offset.

    Raises
    ------
    InputError
        A missing or unusable entry, or a camera model that is no pinhole.
    """
    entry = _section(path, read_yaml(path), camera)
    if entry.get('camera_model', 'pinhole') != 'pinhole':
        raise InputError(f'{path}: {camera} has camera_model {entry["camera_model"]}, not pinhole')
    D = entry.get('distortion_coeffs')
    K = _pinhole(path, entry)
    lens = _camera(f'{path}: {camera}', entry.get('distortion_model'), entry.get('resolution'), K, D)
    T_camera_body = matrix(f'{path} T_cam_imu', entry.get('T_cam_imu'))
    offset = float(_vector(f'{path} timeshift_cam_imu', [entry.get('timeshift_cam_imu', 0.0)], 1)[0])
    return Rig(lens, inverse(T_camera_body), dict(noise), offset)


def matrix(where: str, values: Any) -> FloatArray:
    """A rigid transform (4, 4) from 16 numbers, nested or not.

    Raises
    ------
    InputError
        Other than that.
    """
    T = _vector(where, values, 16).reshape(4, 4)
    if np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max() > 1e-3 or np.linalg.det(T[:3, :3]) < 0.0:
        raise InputError(f'{where} is no rigid transform')
    return T


def _section(path: Path, document: Mapping[str, Any], name: str) -> dict[str, Any]:
    entry = document.get(name)
    if not isinstance(entry, dict):
        raise InputError(f'{path}: no {name}; it has {", ".join(map(str, document)) or "nothing"}')
    return entry


def _vector(where: str, values: Any, size: int) -> FloatArray:
    try:
        result = np.array(values, dtype=np.float64).reshape(-1)
    except (TypeError, ValueError):
        raise InputError(f'{where} does not hold numbers') from None
    if result.size != size or not np.isfinite(result).all():
        raise InputError(f'{where} is not {size} finite numbers')
    return result


def _pinhole(path: Path, entry: Mapping[str, Any]) -> FloatArray:
    fx, fy, cx, cy = _vector(f'{path} intrinsics', entry.get('intrinsics'), 4)
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def _camera(where: str, model: Any, resolution: Any, K: Any, D: Any) -> Camera:
    name = MODEL_SYNONYMS.get(str(model or 'plumb_bob'), str(model or 'plumb_bob'))
    width, height = _vector(f'{where} resolution', resolution, 2)
    coefficients = [] if D is None else D
    try:
        return Camera(
            int(width),
            int(height),
            _vector(f'{where} K', K, 9).reshape(3, 3),
            name,
            _vector(f'{where} D', coefficients, len(coefficients)),
        )
    except InputError as error:
        raise InputError(str(error) if str(error).startswith(where) else f'{where}: {error}') from None


def _noise(path: Path, section: Mapping[str, Any]) -> dict[str, float]:
    return {name: float(_vector(f'{path} {name}', [section[name]], 1)[0]) for name in NOISE_NAMES if name in section}
