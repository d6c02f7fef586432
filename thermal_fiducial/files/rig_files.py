"""Camera and IMU of a recording from YAML files of this package, EuRoC (ASL) and Kalibr."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from thermal_fiducial.config import ImuNoise, LARGEST_SIDE, parameters
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.geometry.plausibility import is_rigid, require_usable
from thermal_fiducial.core.geometry.se3 import inverse, transform_from_quaternion
from thermal_fiducial.core.map_limits import LARGEST_COORDINATE
from thermal_fiducial.core.types import FloatArray
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.reading import read_text, shown
from thermal_fiducial.files.schema import parse_yaml, Value

#: Names of the noise densities, those of Kalibr.
NOISE_NAMES = (
    'gyroscope_noise_density',
    'accelerometer_noise_density',
    'gyroscope_random_walk',
    'accelerometer_random_walk',
)
#: Largest noise densities, as the nodes take them.
_LARGEST_NOISE = {name: item.metadata['maximum'] for name, item, _ in parameters(ImuNoise) if name in NOISE_NAMES}
_LONGEST_SIDE = 65_535
#: Largest offset between the clocks of camera and IMU [s]: the range of the parameter ``camera_time_offset``.
LARGEST_OFFSET_S = 1.0
#: Header of OpenCV in some of EuRoC's files, which YAML 1.1 does not allow.
_OPENCV_HEAD = '%YAML:1.0'


@dataclass(frozen=True)
class Rig:
    """A camera and an IMU."""

    camera: Camera
    #: pose (4, 4) of the camera in the IMU frame
    T_body_camera: FloatArray
    #: noise densities by :data:`NOISE_NAMES`; unknown ones are missing
    imu_noise: dict[str, float] = field(default_factory=dict)
    #: t_imu = t_camera + offset [s]
    time_offset: float = 0.0
    #: side of the markers [m]; 0: unknown
    marker_size: float = 0.0
    dictionary: str = ''


def of_rig(path: Path, camera: str) -> Rig:
    """Read ``rig.yaml``: ``cameras: {cam0: {width, height, model, K, D, T_body_camera}}``, ``imu``, ``marker_size``.

    ``camera_position`` and ``camera_orientation``, as in the parameters, may stand in for ``T_body_camera``.

    Raises
    ------
    InputError
        A missing or unusable entry.
    """
    root = _document(path)
    entry = _needed(_needed(root, 'cameras'), camera)
    fields, top = entry.mapping(), root.mapping()
    K = _numbers(_needed(entry, 'K'), 9).reshape(3, 3)
    lens = _lens(entry, _size(_needed(entry, 'width')), _size(_needed(entry, 'height')), K, 'model', 'D')
    if 'T_body_camera' in fields:
        T_body_camera = _rigid(fields['T_body_camera'])
    else:
        orientation = _needed(entry, 'camera_orientation').unit_quaternion()
        position = _needed(entry, 'camera_position').numbers(3, LARGEST_COORDINATE)
        T_body_camera = transform_from_quaternion(position, orientation)
    size = top['marker_size'].number(0.0, LARGEST_SIDE) if 'marker_size' in top else 0.0
    dictionary = top['dictionary'].text() if 'dictionary' in top else ''
    return Rig(lens, T_body_camera, _noise(top.get('imu')), _offset(fields, 'time_offset'), size, dictionary)


def of_sensor(camera: Path, imu: Path) -> Rig:
    """Rig from EuRoC's two ``sensor.yaml``; ``T_BS`` maps sensor coordinates to body coordinates.

    Raises
    ------
    InputError
        A missing or unusable entry.
    """
    entry, other = _document(camera), _document(imu)
    lens = _lens(entry, *_resolution(entry), _pinhole(entry), 'distortion_model', 'distortion_coefficients')
    # ASL's names of the noise densities are those of Kalibr.
    return Rig(lens, inverse(_body_sensor(other)) @ _body_sensor(entry), _noise(other))


def body_sensor(path: Path) -> FloatArray:
    """``T_BS`` (4, 4) of EuRoC's ``sensor.yaml``.

    Raises
    ------
    InputError
        Missing or no rigid transform.
    """
    return _body_sensor(_document(path))


def _body_sensor(document: Value) -> FloatArray:
    return _rigid(_needed(_needed(document, 'T_BS'), 'data'))


def of_camchain(path: Path, camera: str, noise: Mapping[str, float]) -> Rig:
    """Rig from Kalibr's camchain with ``T_cam_imu`` and ``timeshift_cam_imu``, which equals ``time_offset``.

    Raises
    ------
    InputError
        A missing or unusable entry, or a camera model other than pinhole.
    """
    entry = _needed(_document(path), camera)
    fields = entry.mapping()
    if 'camera_model' in fields and fields['camera_model'].content != 'pinhole':
        raise fields['camera_model'].error(f'{fields["camera_model"].quoted()} is not pinhole')
    lens = _lens(entry, *_resolution(entry), _pinhole(entry), 'distortion_model', 'distortion_coeffs')
    T_camera_body = _rigid(_needed(entry, 'T_cam_imu'))
    return Rig(lens, inverse(T_camera_body), dict(noise), _offset(fields, 'timeshift_cam_imu'))


def densities(path: Path) -> dict[str, float]:
    """Noise densities of Kalibr's IMU file by :data:`NOISE_NAMES`; missing ones are omitted.

    Raises
    ------
    InputError
        Unreadable, or invalid values.
    """
    root = _document(path)
    return _noise(root.mapping().get('imu0', root))


def _document(path: Path) -> Value:
    root = parse_yaml(str(path), read_text(path).removeprefix(_OPENCV_HEAD))
    root.mapping()
    return root


def _needed(value: Value, name: str) -> Value:
    fields = value.mapping()
    if name not in fields:
        there = ', '.join(shown(field) for field in list(fields)[:20])
        raise value.error(f'no {shown(name)}; it has {there or "nothing"}')
    return fields[name]


def _numbers(value: Value, size: int, limit: float = np.inf) -> FloatArray:
    """``size`` finite numbers from a list or a list of rows."""
    rows = [entry.items() if isinstance(entry.content, list) else [entry] for entry in value.items()]
    numbers = [entry.number(-limit, limit) for row in rows for entry in row]
    if len(numbers) != size:
        raise value.error(f'{len(numbers)} numbers, not {size}')
    return np.array(numbers)


def _rigid(value: Value) -> FloatArray:
    """A rigid transform (4, 4) from 16 numbers, nested or not."""
    T = _numbers(value, 16, LARGEST_COORDINATE).reshape(4, 4)
    if not is_rigid(T):
        raise value.error('no rigid transform')
    return T


def _size(value: Value) -> int:
    return value.integer(1, _LONGEST_SIDE)


def _resolution(entry: Value) -> tuple[int, int]:
    value = _needed(entry, 'resolution')
    sides = value.items()
    if len(sides) != 2:
        raise value.error('not width and height')
    return _size(sides[0]), _size(sides[1])


def _pinhole(entry: Value) -> FloatArray:
    fx, fy, cx, cy = _numbers(_needed(entry, 'intrinsics'), 4)
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def _lens(entry: Value, width: int, height: int, K: FloatArray, model: str, coefficients: str) -> Camera:
    """Camera of ``entry``; ``model`` and ``coefficients`` are the names of its fields for the distortion."""
    fields = entry.mapping()
    if model in fields and coefficients not in fields:
        # Under another file's name for them the lens would pass for one without distortion.
        raise entry.error(f'a {model} without {coefficients}; a lens without distortion has []')
    name = fields[model].text() if model in fields else 'plumb_bob'
    D = fields[coefficients].items() if coefficients in fields else []
    distortion = np.array([value.number() for value in D])
    try:
        return require_usable(Camera(width, height, K, name, distortion))
    except InputError as error:
        raise entry.error(str(error)) from None


def _offset(fields: Mapping[str, Value], name: str) -> float:
    return fields[name].number(-LARGEST_OFFSET_S, LARGEST_OFFSET_S) if name in fields else 0.0


def _noise(section: Value | None) -> dict[str, float]:
    if section is None:
        return {}
    fields = section.mapping()
    return {name: fields[name].number(0.0, _LARGEST_NOISE[name]) for name in NOISE_NAMES if name in fields}
