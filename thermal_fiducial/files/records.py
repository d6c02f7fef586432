"""Validated records from messages of rclpy or a bag."""

from collections.abc import Sequence
import math
from typing import Any, TYPE_CHECKING

import numpy as np

from thermal_fiducial.core.geometry.plausibility import require_usable
from thermal_fiducial.core.measurements import ImuSample
from thermal_fiducial.core.types import SECOND_NS
from thermal_fiducial.errors import InputError

if TYPE_CHECKING:
    from thermal_fiducial.core.geometry.camera import Camera

# Limits [rad/s, m/s^2]: seven times the widest gyroscope range, four times the widest accelerometer range.
_FASTEST_TURN, _LARGEST_FORCE = 500.0, 8000.0


def stamp_ns(stamp: Any) -> int:
    """Integer nanoseconds of a stamp message.

    Raises
    ------
    InputError
        A time before 1970, or 1e9 nanoseconds or more.
    """
    return checked_stamp(int(stamp.sec), int(stamp.nanosec))


def checked_stamp(seconds: int, nanoseconds: int) -> int:
    """:func:`stamp_ns` of its two numbers."""
    if seconds < 0 or nanoseconds >= SECOND_NS:
        raise InputError(f'stamp of {seconds} s and {nanoseconds} ns')
    return seconds * SECOND_NS + nanoseconds


def camera(message: Any) -> 'Camera':
    """Camera model of a camera_info message.

    Parameters
    ----------
    message : anything with the fields of sensor_msgs/msg/CameraInfo

    Raises
    ------
    InputError
        No calibration, impossible values, an unknown model, or a binned or cropped image.
    """
    # Imported here, as it imports OpenCV: the filter needs only IMU samples, and restarts faster without it.
    from thermal_fiducial.core.geometry.camera import Camera

    # Some drivers write the whole image for the region of interest, which means the same as zeros (sensor_msgs).
    whole = (message.roi.width, message.roi.height) in ((0, 0), (message.width, message.height))
    if max(message.binning_x, message.binning_y) > 1 or not whole:
        raise InputError('camera_info of a binned or cropped image')
    model = message.distortion_model or 'plumb_bob'
    try:
        K, D = np.array(message.k).reshape(3, 3), np.array(message.d)
        return require_usable(Camera(int(message.width), int(message.height), K, model, D))
    except InputError as error:
        raise InputError(f'camera_info: {error}') from None


def is_imu_reading(turn: Sequence[float], force: Sequence[float]) -> bool:
    """Whether the values are within the limits of an IMU [rad/s, m/s^2]."""
    # Plain floats: for six values numpy takes three times as long. NaN fails the comparisons.
    return all(abs(x) <= _FASTEST_TURN for x in turn) and all(abs(x) <= _LARGEST_FORCE for x in force)


def imu_sample(message: Any) -> ImuSample:
    """One IMU measurement.

    Parameters
    ----------
    message : anything with the fields of sensor_msgs/msg/Imu

    Raises
    ------
    InputError
        A value that is not finite or beyond any IMU, or a measurement that the driver marks as missing
        (REP-145).
    """
    w, a = message.angular_velocity, message.linear_acceleration
    missing = message.angular_velocity_covariance[0] == -1.0 or message.linear_acceleration_covariance[0] == -1.0
    return checked_imu_sample(stamp_ns(message.header.stamp), (w.x, w.y, w.z), (a.x, a.y, a.z), missing=bool(missing))


def checked_imu_sample(stamp: int, turn: Sequence[float], force: Sequence[float], *, missing: bool) -> ImuSample:
    """:func:`imu_sample` of its numbers; ``missing``: the driver marks a measurement as missing."""
    if not is_imu_reading(turn, force):
        finite = all(math.isfinite(x) for x in (*turn, *force))
        raise InputError('IMU message beyond what any IMU measures' if finite else 'IMU message that is not finite')
    if missing:
        raise InputError('IMU message without angular velocity or without acceleration')
    return ImuSample(stamp, np.array(turn), np.array(force))
