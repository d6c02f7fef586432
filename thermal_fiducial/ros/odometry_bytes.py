"""Odometry straight from the bytes of its message, as a node gets them: a message made of them first takes longer.

The encoding is that of ROS 2 (Object Management Group, "DDS Interoperability Wire Protocol", plain CDR,
little-endian): four bytes that say so, then the fields one after the other, each aligned to its own size.
"""

import struct

import numpy as np

from thermal_fiducial.core.geometry.plausibility import checked_covariance
from thermal_fiducial.core.measurements import Odometry
from thermal_fiducial.core.types import FloatArray
from thermal_fiducial.errors import InputError
from thermal_fiducial.ros import convert

_HEADER, _LITTLE_ENDIAN = 4, b'\x00\x01'
_STAMP, _LENGTH, _NUMBERS = struct.Struct('<iI'), struct.Struct('<I'), np.dtype('<f8')
_COUNT = 7 + 36 + 6 + 36
# Hundreds of messages are kept: numbers have 712 bytes, and nobody's frames have names of kilobytes.
_LONGEST = 8192
# Nothing that sees markers is faster [m/s, rad/s].
_FASTEST = 1000.0


def stamp_ns(message: bytes) -> int:
    """Stamp of the header of a message.

    Raises
    ------
    InputError
        Of another encoding, too short or too long, or with a stamp that is none.
    """
    if len(message) > _LONGEST:
        raise InputError(f'odometry of {len(message)} bytes')
    if len(message) < _HEADER + _STAMP.size or message[:2] != _LITTLE_ENDIAN:
        raise InputError('odometry of an encoding that is not known')
    return convert.checked_stamp(*_STAMP.unpack_from(message, _HEADER))


def odometry(message: bytes) -> Odometry:
    """State of the robot, for whoever can do without it.

    Raises
    ------
    InputError
        A value that is not finite or beyond the bounds, a quaternion or a covariance that is none.
    """
    stamp = stamp_ns(message)
    numbers = _numbers(message)
    twist = numbers[43:49]
    if not np.abs(twist).max() < _FASTEST:
        raise InputError('odometry with a twist that is not finite or beyond all bounds')
    covariances = np.stack([numbers[7:43], numbers[49:]]).reshape(2, 6, 6)
    covariances = checked_covariance(covariances, 'odometry with a covariance')
    T_map_body = convert.transform_of_values(numbers[:7], 'odometry')
    return Odometry(stamp, T_map_body, twist[:3], twist[3:], covariances[0], covariances[1])


def _numbers(message: bytes) -> FloatArray:
    """(85,) position, quaternion, their covariance, velocity, turn rate, their covariance."""
    try:
        place = _HEADER + _STAMP.size
        for _ in ('frame_id', 'child_frame_id'):
            place = _aligned(place, _LENGTH.size)
            place += _LENGTH.size + int(_LENGTH.unpack_from(message, place)[0])
        return np.frombuffer(message, _NUMBERS, _COUNT, _aligned(place, _NUMBERS.itemsize)).astype(np.float64)
    except (struct.error, ValueError):
        raise InputError(f'odometry of {len(message)} bytes is cut short') from None


def _aligned(place: int, size: int) -> int:
    """The next place that is a multiple of a size, counted from behind the header."""
    return place + -(place - _HEADER) % size
