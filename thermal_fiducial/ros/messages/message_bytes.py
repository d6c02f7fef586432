"""Serialisation of messages at IMU rate without message objects, which take longer to make.

The encoding is that of ROS 2 (Object Management Group, "DDS Interoperability Wire Protocol", plain CDR,
little-endian): a header of four bytes, then the fields in order, each aligned to its own size.
"""

from collections.abc import Sequence
from dataclasses import dataclass
import struct
from typing import Any

import numpy as np
from rclpy.serialization import deserialize_message

from thermal_fiducial.core.geometry.plausibility import checked_covariance
from thermal_fiducial.core.geometry.se3 import quaternion_from_rotation
from thermal_fiducial.core.measurements import CameraPose, ImuSample, Odometry
from thermal_fiducial.core.motion_prior import FASTEST, LOST_M
from thermal_fiducial.core.types import FloatArray, SECOND_NS
from thermal_fiducial.errors import InputError
from thermal_fiducial.files import records
from thermal_fiducial.ros.messages import convert

_HEADER, _LITTLE_ENDIAN = 4, b'\x00\x01'
_STAMP, _LENGTH, _NUMBERS = struct.Struct('<iI'), struct.Struct('<I'), np.dtype('<f8')
#: Offset of the first string, ``frame_id``, behind the stamp.
BEHIND_STAMP = _HEADER + _STAMP.size
# Of an image: height, width, length of ``encoding``; ``step`` and length of the data.
_SIZES, _ROWS = struct.Struct('<III'), struct.Struct('<II')
# Position, quaternion, pose covariance; velocity, angular velocity, twist covariance.
_POSE, _ODOMETRY = 7 + 36, 7 + 36 + 6 + 36
# Where the variances of the position are in these.
_VARIANCES = [7, 14, 21]
# Orientation, angular velocity, specific force, each with its covariance.
_IMU = 4 + 9 + 3 + 9 + 3 + 9
# Longest message accepted [bytes], since hundreds are kept: the numbers take 712, the rest are names of frames.
_LONGEST = 8192


def read(message: bytes, kind: type, what: str) -> Any:
    """Deserialise a message of type ``kind``, for rare topics; ``what`` names it in errors.

    Raises
    ------
    InputError
        Bytes that are not a message of that type.
    """
    try:
        return deserialize_message(message, kind)
    except RuntimeError as error:
        raise InputError(f'{what} cannot be read: {error}') from None


def stamp_ns(message: bytes, what: str = 'odometry', longest: int = _LONGEST) -> int:
    """Stamp of a message's header [ns]; ``what`` names the message in errors.

    Raises
    ------
    InputError
        Another encoding, too short, longer than ``longest``, or an invalid stamp.
    """
    if len(message) > longest:
        raise InputError(f'{what} of {len(message)} bytes')
    if len(message) < BEHIND_STAMP or message[:2] != _LITTLE_ENDIAN:
        raise InputError(f'{what} of an encoding that is not known')
    return convert.checked_stamp(*_STAMP.unpack_from(message, _HEADER))


def odometry(messages: Sequence[bytes]) -> list[Odometry]:
    """States of N odometry messages: decoding N at once takes little longer than one.

    Those of a filter that has been lost for long are left out: they are no fault of the message, and say nothing.

    Raises
    ------
    InputError
        A value of any message is not finite or out of bounds, or a quaternion or covariance is invalid.
    """
    stamps = [stamp_ns(message) for message in messages]
    numbers = np.stack([_numbers(message, 2, _ODOMETRY, 'odometry') for message in messages]).astype(np.float64)
    covariances = np.stack([numbers[:, 7:43], numbers[:, 49:]], axis=1).reshape(-1, 2, 6, 6)
    covariances = checked_covariance(covariances, 'odometry with a covariance')
    known = np.flatnonzero(np.all(numbers[:, _VARIANCES] < LOST_M**2, axis=1))
    if not len(known):
        return []
    stamps, numbers, covariances = [stamps[index] for index in known], numbers[known], covariances[known]
    twists = numbers[:, 43:49]
    if not (np.abs(twists) < FASTEST).all():
        raise InputError('odometry with a twist that is not finite or beyond all bounds')
    T_map_body = convert.transform_of_values(numbers[:, :7], 'odometry')
    columns = zip(stamps, T_map_body, twists, covariances, strict=True)
    return [Odometry(stamp, T, twist[:3], twist[3:], pose, speed) for stamp, T, twist, (pose, speed) in columns]


def imu_sample(message: bytes) -> ImuSample:
    """One IMU measurement.

    Raises
    ------
    InputError
        As :func:`thermal_fiducial.files.records.imu_sample`, or an unknown encoding.
    """
    stamp = stamp_ns(message, 'IMU message')
    numbers = _numbers(message, 1, _IMU, 'IMU message').tolist()
    return records.checked_imu_sample(
        stamp, numbers[13:16], numbers[25:28], missing=numbers[16] == -1.0 or numbers[28] == -1.0
    )


def camera_pose(message: bytes, map_frame: str = '') -> CameraPose:
    """Camera pose in the map.

    Parameters
    ----------
    message : serialised
    map_frame : name of the map's frame, which that of the pose must have if it has one; empty: any

    Raises
    ------
    InputError
        Another encoding, a truncated message, an invalid pose or covariance, or another frame.
    """
    if map_frame and (frame := frame_id(message).lstrip('/')) not in ('', map_frame):
        raise InputError(f'camera_pose in frame {frame!r}, and not in that of the map: map_frame is {map_frame!r}')
    return _camera_pose(message, 'camera_pose', partial=False)


def map_error(message: bytes) -> CameraPose:
    """Camera pose with the covariance due to the map's error alone, which may be singular.

    Raises
    ------
    InputError
        As :func:`camera_pose`.
    """
    return _camera_pose(message, 'camera_pose/map_error', partial=True)


@dataclass(frozen=True, slots=True)
class ImageBytes:
    """A sensor_msgs/Image for ``files.images.image_to_array``; the pixels are not copied."""

    stamp_ns: int
    frame_id: str
    height: int
    width: int
    encoding: str
    is_bigendian: int
    step: int
    data: memoryview


def image(message: bytes) -> ImageBytes:
    """Image message without a copy of its pixels.

    Raises
    ------
    InputError
        Another encoding, or a truncated message.
    """
    what = 'image'
    stamp = stamp_ns(message, what, longest=len(message))
    try:
        place = behind_header(message)
        height, width, length = _SIZES.unpack_from(message, place)
        place += _SIZES.size + length
        encoding = message[place - length : place].rstrip(b'\x00').decode()
        is_bigendian = message[place]
        step, size = _ROWS.unpack_from(message, _aligned(place + 1, _LENGTH.size))
        begin = _aligned(place + 1, _LENGTH.size) + _ROWS.size
        data = memoryview(message)[begin : begin + size]
    except (struct.error, IndexError, UnicodeDecodeError):
        raise InputError(f'{what} of {len(message)} bytes is cut short') from None
    return ImageBytes(stamp, frame_id(message), height, width, encoding, is_bigendian, step, data)


def clock_offset(message: bytes) -> float:
    """Clock offset [s] of a :func:`thermal_fiducial.ros.messages.convert.clock_reference`.

    Raises
    ------
    InputError
        Cut short, or no stamp.
    """
    what = 'camera_clock'
    imu_stamp_ns = stamp_ns(message, what)
    try:
        camera_stamp = _STAMP.unpack_from(message, _aligned(_behind_names(message, 1), _LENGTH.size))
    except struct.error:
        raise InputError(f'{what} of {len(message)} bytes is cut short') from None
    return (imu_stamp_ns - convert.checked_stamp(*camera_stamp)) / SECOND_NS


def frame_id(message: bytes) -> str:
    """``frame_id`` of a message's header.

    Raises
    ------
    InputError
        A truncated message, or a name that is not UTF-8.
    """
    try:
        length = int(_LENGTH.unpack_from(message, BEHIND_STAMP)[0])
        begin = BEHIND_STAMP + _LENGTH.size
        return message[begin : begin + length].rstrip(b'\x00').decode()
    except (struct.error, UnicodeDecodeError):
        raise InputError('message with a frame_id that cannot be read') from None


def _camera_pose(message: bytes, what: str, *, partial: bool) -> CameraPose:
    """Pose of a geometry_msgs/PoseWithCovarianceStamped; ``partial``: the covariance may be singular."""
    stamp, numbers = stamp_ns(message, what), _numbers(message, 1, _POSE, what).astype(np.float64)
    T_map_camera = convert.transform_of_values(numbers[:7], what)
    covariance = checked_covariance(numbers[7:].reshape(6, 6), f'{what} with a covariance', partial=partial)
    return CameraPose(stamp, T_map_camera, covariance)


def _numbers(message: bytes, names: int, count: int, what: str) -> FloatArray:
    """``count`` float64 values that follow the stamp and ``names`` strings."""
    try:
        return np.frombuffer(message, _NUMBERS, count, _aligned(_behind_names(message, names), _NUMBERS.itemsize))
    except (struct.error, ValueError):
        raise InputError(f'{what} of {len(message)} bytes is cut short') from None


def _behind_names(message: bytes, names: int) -> int:
    """Offset behind the stamp and ``names`` strings; struct.error if the message is truncated."""
    place = BEHIND_STAMP
    for _ in range(names):
        place = _aligned(place, _LENGTH.size)
        place += _LENGTH.size + int(_LENGTH.unpack_from(message, place)[0])
    return place


def behind_header(message: bytes) -> int:
    """Offset of the first uint32 behind a message's header; struct.error if the message is truncated."""
    return _aligned(_behind_names(message, 1), _LENGTH.size)


def _aligned(place: int, size: int) -> int:
    """``place`` rounded up to a multiple of ``size``, counted from behind the encapsulation header."""
    return place + -(place - _HEADER) % size


class StateBytes:
    """The robot's state, serialised as nav_msgs/Odometry and geometry_msgs/PoseWithCovarianceStamped in own buffers."""

    def __init__(self, frame: str, child_frame: str) -> None:
        self._odometry, self._numbers = _blank((frame, child_frame), _ODOMETRY)
        self._pose, self._pose_numbers = _blank((frame,), _POSE)

    def fill(self, odometry: Odometry) -> None:
        """Write a state into the buffers."""
        numbers, stamp = self._numbers, divmod(int(odometry.stamp_ns), SECOND_NS)
        numbers[0:3] = odometry.T_map_body[:3, 3]
        numbers[3:7] = quaternion_from_rotation(odometry.T_map_body[:3, :3])
        numbers[7:43] = odometry.pose_covariance.ravel()
        numbers[43:46] = odometry.velocity_body
        numbers[46:49] = odometry.angular_velocity_body
        numbers[49:] = odometry.twist_covariance.ravel()
        self._pose_numbers[:] = numbers[:_POSE]
        for message in (self._odometry, self._pose):
            _STAMP.pack_into(message, _HEADER, *stamp)

    @property
    def odometry(self) -> bytes:
        """The state as nav_msgs/Odometry."""
        return bytes(self._odometry)

    @property
    def pose(self) -> bytes:
        """The pose as geometry_msgs/PoseWithCovarianceStamped."""
        return bytes(self._pose)


class PoseBytes:
    """A pose, serialised as geometry_msgs/PoseWithCovarianceStamped with varying covariances, in an own buffer."""

    def __init__(self, frame: str) -> None:
        self._pose, self._numbers = _blank((frame,), _POSE)

    def fill(self, stamp: int, T_frame_body: FloatArray) -> None:
        """Write a pose (4, 4) into the buffer."""
        self._numbers[0:3] = T_frame_body[:3, 3]
        self._numbers[3:7] = quaternion_from_rotation(T_frame_body[:3, :3])
        _STAMP.pack_into(self._pose, _HEADER, *divmod(int(stamp), SECOND_NS))

    def of(self, covariance: FloatArray) -> bytes:
        """The message of that pose with a covariance (6, 6)."""
        self._numbers[7:] = covariance.ravel()
        return bytes(self._pose)


def _blank(frames: tuple[str, ...], count: int) -> tuple[bytearray, FloatArray]:
    """Buffer of a message with the strings ``frames`` and ``count`` float64 zeros, and a view of the zeros."""
    message = bytearray(_LITTLE_ENDIAN + bytes(BEHIND_STAMP - len(_LITTLE_ENDIAN)))
    for frame in frames:
        name = frame.encode() + b'\x00'
        message += bytes(_aligned(len(message), _LENGTH.size) - len(message)) + _LENGTH.pack(len(name)) + name
    message += bytes(_aligned(len(message), _NUMBERS.itemsize) - len(message))
    begin = len(message)
    message += bytes(count * _NUMBERS.itemsize)
    return message, np.frombuffer(message, _NUMBERS, count, begin)
