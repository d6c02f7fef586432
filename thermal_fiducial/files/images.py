"""Pixels of ``sensor_msgs/msg/Image``, from rclpy or from a bag."""

from typing import Any

import numpy as np
import numpy.typing as npt

from thermal_fiducial.core.types import Counts, Gray
from thermal_fiducial.errors import InputError

#: Bytes a pixel of the encodings that a thermal camera may have.
ENCODINGS = {'mono8': 1, '8UC1': 1, 'mono16': 2, '16UC1': 2}


def image_to_array(message: Any) -> Counts | Gray:
    """Pixels (H, W) in native byte order without row padding, a view where that is possible.

    Parameters
    ----------
    message : anything with the fields of sensor_msgs/msg/Image

    Raises
    ------
    InputError
        An encoding other than 8 or 16 bit mono, or sizes that don't fit the data.
    """
    itemsize = ENCODINGS.get(message.encoding)
    if itemsize is None:
        raise InputError(f'image of encoding {message.encoding!r}, not one of {", ".join(ENCODINGS)}')
    height, width, step = int(message.height), int(message.width), int(message.step)
    needed = step * (height - 1) + width * itemsize
    if not (height > 0 and width > 0 and step >= width * itemsize and len(message.data) >= needed):
        raise InputError(
            f'image {width}x{height} {message.encoding} with row step {step} needs {max(needed, 0)} bytes, '
            f'has {len(message.data)}'
        )
    kind = 'u1' if itemsize == 1 else '>u2' if message.is_bigendian else '<u2'
    pixels: npt.NDArray[Any] = np.ndarray((height, width), kind, message.data, strides=(step, itemsize))
    if itemsize == 1:
        return np.ascontiguousarray(pixels, dtype=np.uint8)
    return np.ascontiguousarray(pixels, dtype=np.uint16)


def stamp_to_ns(stamp: Any) -> int:
    """Integer nanoseconds of a builtin_interfaces/msg/Time."""
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)
