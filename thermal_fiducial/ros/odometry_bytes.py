"""Odometry straight from the bytes of its message, as a node gets them: a message made of them first takes longer.

The encoding is that of ROS 2 (Object Management Group, "DDS Interoperability Wire Protocol", plain CDR,
little-endian): four bytes that say so, then the fields one after the other, each aligned to its own size.
"""

import struct

import numpy as np

from thermal_fiducial.core.measurements import Odometry
from thermal_fiducial.errors import InputError
from thermal_fiducial.ros import convert

_HEADER = 4
_STAMP, _LENGTH, _NUMBERS = struct.Struct('<iI'), struct.Struct('<I'), np.dtype('<f8')
# Position, quaternion, their covariance, velocity, turn rate, their covariance.
_COUNT = 7 + 36 + 6 + 36


def stamp_ns(message: bytes) -> int:
    """Stamp of the header of a message."""
    seconds, nanoseconds = _STAMP.unpack_from(message, _HEADER)
    return 10**9 * int(seconds) + int(nanoseconds)


def odometry(message: bytes) -> Odometry:
    """State of the robot.

    Raises
    ------
    InputError
        A value that is not finite, or a quaternion that is none.
    """
    place = _HEADER + _STAMP.size
    for _ in ('frame_id', 'child_frame_id'):
        place = _aligned(place, _LENGTH.size)
        place += _LENGTH.size + int(_LENGTH.unpack_from(message, place)[0])
    numbers = np.frombuffer(message, _NUMBERS, _COUNT, _aligned(place, _NUMBERS.itemsize)).astype(np.float64)
    if not np.isfinite(numbers).all():
        raise InputError('odometry that is not finite')
    return Odometry(
        stamp_ns(message),
        convert.transform_of_values(numbers[:7]),
        numbers[43:46],
        numbers[46:49],
        numbers[7:43].reshape(6, 6),
        numbers[49:].reshape(6, 6),
    )


def _aligned(place: int, size: int) -> int:
    """The next place that is a multiple of a size, counted from behind the header."""
    return place + -(place - _HEADER) % size
