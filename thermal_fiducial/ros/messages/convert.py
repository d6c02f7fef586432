"""Conversion between ROS messages and numpy: the only module that knows both.

Messages validate nothing, so inputs are checked here, and outputs are converted to the exact type
(``float(...)``): a numpy scalar or an int in a float field would be published as garbage.
"""

from array import array
from collections.abc import Mapping
from typing import Any, TYPE_CHECKING

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import (
    Point,
    Pose,
    Quaternion,
    TransformStamped,
    Vector3,
)
import numpy as np
import numpy.typing as npt
from sensor_msgs.msg import CameraInfo, Image, TimeReference
from std_msgs.msg import Header

from thermal_fiducial.core.geometry.se3 import quaternion_from_rotation, transform_from_quaternion
from thermal_fiducial.core.map_limits import LARGEST_COORDINATE
from thermal_fiducial.core.types import FloatArray, SECOND_NS
from thermal_fiducial.errors import InputError

# Re-exported: bags are also read without ROS.
from thermal_fiducial.files.records import camera as camera
from thermal_fiducial.files.records import checked_stamp as checked_stamp
from thermal_fiducial.files.records import imu_sample as imu_sample
from thermal_fiducial.files.records import stamp_ns as stamp_ns

if TYPE_CHECKING:
    from thermal_fiducial.core.geometry.camera import Camera

#: Keys of the filter's diagnostics: topics of its odometry, and of that for a flight controller (empty without one).
ODOMETRY_TOPIC, BRIDGE_TOPIC = 'odometry on', 'flight controller on'
#: Largest deviation of a quaternion's norm from 1.
NORM_TOLERANCE = 0.1

# --- stamps, headers, poses ---------------------------------------------------------------------------


def clock_reference(camera_stamp_ns: int, offset: float) -> TimeReference:
    """The instant of a frame in both clocks, for t_imu = t_camera + ``offset`` [s]."""
    imu_stamp_ns = camera_stamp_ns + round(offset * SECOND_NS)
    return TimeReference(header=header(imu_stamp_ns, ''), time_ref=header(camera_stamp_ns, '').stamp, source='camera')


def header(stamp: int, frame_id: str) -> Header:
    """Header with a stamp in nanoseconds."""
    seconds, nanoseconds = divmod(int(stamp), SECOND_NS)
    return Header(stamp=Time(sec=seconds, nanosec=nanoseconds), frame_id=frame_id)


def pose(T: FloatArray) -> Pose:
    """Pose message of T_a_b (4, 4)."""
    x, y, z = T[:3, 3].tolist()
    qx, qy, qz, qw = quaternion_from_rotation(T[:3, :3]).tolist()
    return Pose(position=Point(x=x, y=y, z=z), orientation=Quaternion(x=qx, y=qy, z=qz, w=qw))


def pose_of_row(row: Any) -> Pose:
    """Pose message of a row with fields x y z qx qy qz qw."""
    x, y, z, qx, qy, qz, qw = (float(row[name]) for name in ('x', 'y', 'z', 'qx', 'qy', 'qz', 'qw'))
    return Pose(position=Point(x=x, y=y, z=z), orientation=Quaternion(x=qx, y=qy, z=qz, w=qw))


def transform_of(message: Pose, what: str = 'pose') -> FloatArray:
    """T_a_b (4, 4) of a pose message.

    Raises
    ------
    InputError
        A value that is not finite or out of bounds, or a quaternion without unit norm.
    """
    p, q = message.position, message.orientation
    return transform_of_values(np.array([p.x, p.y, p.z, q.x, q.y, q.z, q.w]), what)


def transform_of_values(values: FloatArray, what: str = 'pose') -> FloatArray:
    """:func:`transform_of` of positions and quaternions x y z w (..., 7)."""
    position, quaternion = values[..., :3], values[..., 3:]
    # Before the norm: squares of what is far from one overflow.
    sound = np.isfinite(values).all() and np.abs(quaternion).max() < 2.0
    if not sound or np.abs(np.sqrt((quaternion * quaternion).sum(axis=-1)) - 1.0).max() > NORM_TOLERANCE:
        raise InputError(f'{what} that is not finite or has no unit quaternion')
    if not np.abs(position).max() < LARGEST_COORDINATE:
        raise InputError(f'{what} {np.abs(position).max():.3g} m away')
    return transform_from_quaternion(position, quaternion)


# --- images -------------------------------------------------------------------------------------------


def image(pixels: npt.NDArray[Any], head: Header) -> Image:
    """Image message: (H, W) uint16 as mono16, (H, W) uint8 as mono8, (H, W, 3) uint8 as bgr8."""
    encoding = 'bgr8' if pixels.ndim == 3 else 'mono16' if pixels.dtype == np.uint16 else 'mono8'
    message = Image(header=head, height=pixels.shape[0], width=pixels.shape[1], encoding=encoding)
    message.is_bigendian = 0
    message.step = pixels[0].nbytes
    message.data = data_bytes(pixels)
    return message


def data_bytes(values: npt.NDArray[Any]) -> 'array[int]':
    """The data as ``array('B')``, the only type that a message setter accepts without a loop over the bytes."""
    data = array('B')
    data.frombytes(np.ascontiguousarray(values).view(np.uint8).data if values.size else b'')
    return data


def camera_info(calibration: 'Camera', head: Header) -> CameraInfo:
    """camera_info message of a camera."""
    K = calibration.K
    message = CameraInfo(header=head, width=calibration.width, height=calibration.height)
    message.distortion_model = calibration.model
    message.d = calibration.D.tolist()
    message.k = K.flatten()
    message.r = np.eye(3).ravel()
    message.p = np.hstack([K, np.zeros((3, 1))]).ravel()
    return message


# --- estimates ----------------------------------------------------------------------------------------


def vector(v: FloatArray) -> Vector3:
    """Vector3 of (3,)."""
    x, y, z = v.tolist()
    return Vector3(x=x, y=y, z=z)


def transform_message(T_a_b: FloatArray, stamp: int, a: str, b: str) -> TransformStamped:
    """Transform message of T_a_b (4, 4)."""
    message = TransformStamped(header=header(stamp, a), child_frame_id=b)
    message.transform.translation = vector(T_a_b[:3, 3])
    message.transform.rotation = pose(T_a_b).orientation
    return message


def correction_of(message: TransformStamped) -> tuple[int, FloatArray]:
    """Stamp [ns] and T_new_old (4, 4) of a ``map_correction``.

    It maps coordinates of poses up to the stamp to those of later poses.

    Raises
    ------
    InputError
        A value that is not finite, or a quaternion without unit norm.
    """
    return stamp_ns(message.header.stamp), transform_of_message(message, 'map_correction')


def transform_of_message(message: TransformStamped, what: str) -> FloatArray:
    """T_a_b (4, 4) of a transform message.

    Raises
    ------
    InputError
        As :func:`transform_of`.
    """
    p = message.transform.translation
    return transform_of(Pose(position=Point(x=p.x, y=p.y, z=p.z), orientation=message.transform.rotation), what)


def diagnostics(name: str, level: bytes, message: str, values: Mapping[str, object], stamp: int) -> DiagnosticArray:
    """DiagnosticArray with one status and its key-value pairs."""
    status = DiagnosticStatus(level=level, name=name, message=message, hardware_id='thermal_fiducial')
    status.values = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
    return DiagnosticArray(header=header(stamp, ''), status=[status])
