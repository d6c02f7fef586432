"""Between ROS messages and numpy: the only module that knows both.

Messages check nothing, so what comes in is checked here and what goes out is converted to the exact type
(``float(...)``): a numpy scalar or an int in a float field would be published as garbage.
"""

from array import array
from collections.abc import Iterable, Mapping
from typing import Any

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import (
    Point,
    Pose,
    PoseArray,
    PoseStamped,
    PoseWithCovarianceStamped,
    Quaternion,
    TransformStamped,
    Vector3,
)
from nav_msgs.msg import Odometry as OdometryMessage
from nav_msgs.msg import Path
import numpy as np
import numpy.typing as npt
from sensor_msgs.msg import CameraInfo, Image, Imu, PointCloud2, PointField, TimeReference
from std_msgs.msg import Header

from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.geometry.se3 import quaternion_from_rotation, transform_from_quaternion
from thermal_fiducial.core.measurements import (
    CameraPose,
    CORNER_COVARIANCE_FIELDS,
    corner_covariances,
    corners_px,
    ImuSample,
    MAP_DTYPE,
    MARKER_DTYPE,
    Markers,
    Odometry,
)
from thermal_fiducial.core.types import FloatArray
from thermal_fiducial.errors import InputError

_POINT_TYPES = {
    PointField.INT8: 'i1',
    PointField.UINT8: 'u1',
    PointField.INT16: 'i2',
    PointField.UINT16: 'u2',
    PointField.INT32: 'i4',
    PointField.UINT32: 'u4',
    PointField.FLOAT32: 'f4',
    PointField.FLOAT64: 'f8',
}
_POINT_CODES = {code: datatype for datatype, code in _POINT_TYPES.items()}

# --- stamps, headers, poses ---------------------------------------------------------------------------


def stamp_ns(stamp: Time) -> int:
    """Integer nanoseconds of a stamp."""
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def clock_reference(camera_stamp_ns: int, offset: float) -> TimeReference:
    """The instant of a frame in both clocks, for t_imu = t_camera + ``offset`` [s]."""
    imu_stamp_ns = camera_stamp_ns + round(offset * 1e9)
    return TimeReference(header=header(imu_stamp_ns, ''), time_ref=header(camera_stamp_ns, '').stamp, source='camera')


def clock_offset(message: TimeReference) -> float:
    """What :func:`clock_reference` says [s]."""
    return (stamp_ns(message.header.stamp) - stamp_ns(message.time_ref)) * 1e-9


def header(stamp: int, frame_id: str) -> Header:
    """Header with a stamp in nanoseconds."""
    seconds, nanoseconds = divmod(int(stamp), 1_000_000_000)
    return Header(stamp=Time(sec=seconds, nanosec=nanoseconds), frame_id=frame_id)


def pose(T: FloatArray) -> Pose:
    """Pose message of T_a_b (4, 4)."""
    x, y, z = T[:3, 3].tolist()
    qx, qy, qz, qw = quaternion_from_rotation(T[:3, :3]).tolist()
    return Pose(position=Point(x=x, y=y, z=z), orientation=Quaternion(x=qx, y=qy, z=qz, w=qw))


def transform_of(message: Pose) -> FloatArray:
    """T_a_b (4, 4) of a pose message.

    Raises
    ------
    InputError
        A value that is not finite, or a quaternion that is none.
    """
    p, q = message.position, message.orientation
    return transform_of_values(np.array([p.x, p.y, p.z, q.x, q.y, q.z, q.w]))


def transform_of_values(values: FloatArray) -> FloatArray:
    """:func:`transform_of` of position and quaternion x y z w (7,)."""
    if not (np.all(np.isfinite(values)) and 0.9 < np.linalg.norm(values[3:]) < 1.1):
        raise InputError('pose that is not finite or has no unit quaternion')
    return transform_from_quaternion(values[:3], values[3:])


def _matrix(message: Any, size: int) -> FloatArray:
    covariance = np.array(message, dtype=np.float64).reshape(size, size)
    if not np.all(np.isfinite(covariance)):
        raise InputError('covariance that is not finite')
    return covariance


# --- images -------------------------------------------------------------------------------------------


def image(pixels: npt.NDArray[Any], head: Header) -> Image:
    """Image message of (H, W) uint16 as mono16, (H, W) uint8 as mono8, (H, W, 3) uint8 as bgr8."""
    encoding = 'bgr8' if pixels.ndim == 3 else 'mono16' if pixels.dtype == np.uint16 else 'mono8'
    message = Image(header=head, height=pixels.shape[0], width=pixels.shape[1], encoding=encoding)
    message.is_bigendian = 0
    message.step = pixels.strides[0] if pixels.flags.c_contiguous else pixels[0].nbytes
    message.data = _bytes(pixels)
    return message


def _bytes(values: npt.NDArray[Any]) -> 'array[int]':
    """The one type that a message takes without looping over its bytes."""
    data = array('B')
    data.frombytes(np.ascontiguousarray(values).view(np.uint8).data if values.size else b'')
    return data


def camera(message: CameraInfo) -> Camera:
    """Intrinsics of a camera_info message.

    Raises
    ------
    InputError
        No calibration in it, an unknown model, or a binned or cropped image.
    """
    if max(message.binning_x, message.binning_y) > 1 or message.roi.width or message.roi.height:
        raise InputError('camera_info of a binned or cropped image')
    model = message.distortion_model or 'plumb_bob'
    try:
        return Camera(
            int(message.width), int(message.height), np.array(message.k).reshape(3, 3), model, np.array(message.d)
        )
    except InputError as error:
        raise InputError(f'camera_info: {error}') from None


def camera_info(calibration: Camera, head: Header) -> CameraInfo:
    """camera_info message of a camera."""
    K = calibration.K
    message = CameraInfo(header=head, width=calibration.width, height=calibration.height)
    message.distortion_model = calibration.model
    message.d = calibration.D.tolist()
    message.k = K.ravel()
    message.r = np.eye(3).ravel()
    message.p = np.hstack([K, np.zeros((3, 1))]).ravel()
    return message


# --- rows as clouds -----------------------------------------------------------------------------------


def cloud(rows: npt.NDArray[Any], head: Header) -> PointCloud2:
    """PointCloud2 with one point a row of a structured array, fields as in its dtype."""
    layout: Mapping[str, Any] = rows.dtype.fields or {}
    return PointCloud2(
        header=head,
        height=1,
        width=len(rows),
        fields=[
            PointField(name=name, offset=layout[name][1], datatype=_POINT_CODES[layout[name][0].str[1:]], count=1)
            for name in rows.dtype.names or ()
        ],
        is_bigendian=False,
        point_step=rows.dtype.itemsize,
        row_step=rows.dtype.itemsize * len(rows),
        data=_bytes(rows),
        is_dense=True,
    )


def cloud_rows(message: PointCloud2, dtype: 'np.dtype[Any]', optional: Iterable[str] = ()) -> npt.NDArray[Any]:
    """Rows (N,) of ``dtype`` of a cloud, its fields looked up by name; missing ``optional`` ones are 0.

    Raises
    ------
    InputError
        A missing field, or sizes that don't fit the data.
    """
    fields = {field.name: field for field in message.fields}
    names = [name for name in dtype.names or () if name in fields]
    missing = set(dtype.names or ()) - set(names) - set(optional)
    if missing:
        raise InputError(f'cloud without field {", ".join(sorted(missing))}')
    count = int(message.width) * int(message.height)
    source = _source_dtype(message, [fields[name] for name in names])
    if message.row_step != message.point_step * message.width or len(message.data) < count * message.point_step:
        raise InputError(f'cloud of {count} points of {message.point_step} bytes has {len(message.data)} bytes')
    result = np.zeros(count, dtype)
    if count:
        points = np.frombuffer(message.data, source, count)
        for name in names:
            result[name] = points[name]
    return result


def _source_dtype(message: PointCloud2, fields: list[PointField]) -> 'np.dtype[Any]':
    order = '>' if message.is_bigendian else '<'
    try:
        return np.dtype(
            {
                'names': [field.name for field in fields],
                'formats': [order + _POINT_TYPES[field.datatype] for field in fields],
                'offsets': [field.offset for field in fields],
                'itemsize': message.point_step,
            }
        )
    except (KeyError, ValueError):
        raise InputError(f'cloud with fields outside its points of {message.point_step} bytes') from None


def markers(message: PointCloud2) -> Markers:
    """Rows of :data:`MARKER_DTYPE`; corner covariances from ``sigma_px`` where the cloud has none.

    Raises
    ------
    InputError
        A missing field, sizes that don't fit, or corners that are not finite.
    """
    rows = cloud_rows(message, MARKER_DTYPE, optional=CORNER_COVARIANCE_FIELDS)
    if not {field.name for field in message.fields}.issuperset(CORNER_COVARIANCE_FIELDS):
        for corner in range(4):
            rows[f'c{corner}uu'] = rows[f'c{corner}vv'] = rows['sigma_px'] ** 2
    if not (np.all(np.isfinite(corners_px(rows))) and np.all(np.isfinite(corner_covariances(rows)))):
        raise InputError('markers with corners that are not finite')
    return rows


def marker_poses(rows: Markers, head: Header) -> PoseArray:
    """The markers in the camera, for display."""
    fields = zip(*(rows[name].tolist() for name in ('x', 'y', 'z', 'qx', 'qy', 'qz', 'qw')), strict=True)
    return PoseArray(
        header=head,
        poses=[
            Pose(position=Point(x=x, y=y, z=z), orientation=Quaternion(x=qx, y=qy, z=qz, w=qw))
            for x, y, z, qx, qy, qz, qw in fields
        ],
    )


def map_poses(message: PointCloud2) -> dict[int, tuple[FloatArray, float]]:
    """ID to T_map_marker (4, 4) and side [m] of the trusted markers of a ``marker_map`` cloud.

    Raises
    ------
    InputError
        A missing field, or sizes that don't fit.
    """
    rows = cloud_rows(message, MAP_DTYPE)
    rows = rows[rows['trusted'] != 0]
    T = transform_from_quaternion(
        np.stack([rows[name] for name in 'xyz'], axis=-1),
        np.stack([rows[name] for name in ('qx', 'qy', 'qz', 'qw')], axis=-1),
    )
    return {int(row['id']): (T_map_marker, float(row['size'])) for row, T_map_marker in zip(rows, T, strict=True)}


# --- estimates ----------------------------------------------------------------------------------------


def imu_sample(message: Imu) -> ImuSample:
    """One IMU measurement.

    Raises
    ------
    InputError
        A value that is not finite, or a measurement that the driver marks as not there (REP-145).
    """
    w, a = message.angular_velocity, message.linear_acceleration
    angular_velocity, linear_acceleration = np.array([w.x, w.y, w.z]), np.array([a.x, a.y, a.z])
    if not (np.isfinite(angular_velocity.sum()) and np.isfinite(linear_acceleration.sum())):
        raise InputError('IMU message that is not finite')
    if message.angular_velocity_covariance[0] == -1.0 or message.linear_acceleration_covariance[0] == -1.0:
        raise InputError('IMU message without angular velocity or without acceleration')
    return ImuSample(stamp_ns(message.header.stamp), angular_velocity, linear_acceleration)


def pose_with_covariance(T: FloatArray, covariance: FloatArray, head: Header) -> PoseWithCovarianceStamped:
    """PoseWithCovarianceStamped of T_a_b (4, 4) and its covariance (6, 6) in the ROS convention."""
    message = PoseWithCovarianceStamped(header=head)
    message.pose.pose = pose(T)
    message.pose.covariance[:] = covariance.ravel()
    return message


def camera_pose(message: PoseWithCovarianceStamped) -> CameraPose:
    """The camera in the map.

    Raises
    ------
    InputError
        A pose or covariance that is not finite, or a quaternion that is none.
    """
    T_map_camera = transform_of(message.pose.pose)
    return CameraPose(stamp_ns(message.header.stamp), T_map_camera, _matrix(message.pose.covariance, 6))


def odometry_frames(frame_id: str, child_frame_id: str) -> OdometryMessage:
    """Odometry message with the pose in ``frame_id`` and the twist in ``child_frame_id``, both to be filled in."""
    message = OdometryMessage(child_frame_id=child_frame_id)
    message.header.frame_id = frame_id
    return message


def fill_odometry(message: OdometryMessage, odometry: Odometry) -> None:
    """Set everything of ``message`` but its frames: at the rate of an IMU, making messages anew counts."""
    stamp = message.header.stamp
    stamp.sec, stamp.nanosec = divmod(int(odometry.stamp_ns), 1_000_000_000)
    place, twist = message.pose.pose, message.twist.twist
    position, orientation = place.position, place.orientation
    position.x, position.y, position.z = odometry.T_map_body[:3, 3].tolist()
    orientation.x, orientation.y, orientation.z, orientation.w = quaternion_from_rotation(
        odometry.T_map_body[:3, :3]
    ).tolist()
    message.pose.covariance[:] = odometry.pose_covariance.ravel()
    twist.linear.x, twist.linear.y, twist.linear.z = odometry.velocity_body.tolist()
    twist.angular.x, twist.angular.y, twist.angular.z = odometry.angular_velocity_body.tolist()
    message.twist.covariance[:] = odometry.twist_covariance.ravel()


def odometry(message: OdometryMessage) -> Odometry:
    """State of the robot.

    Raises
    ------
    InputError
        A value that is not finite, or a quaternion that is none.
    """
    v, w = message.twist.twist.linear, message.twist.twist.angular
    return Odometry(
        stamp_ns(message.header.stamp),
        transform_of(message.pose.pose),
        np.array([v.x, v.y, v.z]),
        np.array([w.x, w.y, w.z]),
        _matrix(message.pose.covariance, 6),
        _matrix(message.twist.covariance, 6),
    )


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

    It moves coordinates of the map as poses up to the stamp have them to those of poses after it.

    Raises
    ------
    InputError
        A value that is not finite, or a quaternion that is none.
    """
    p = message.transform.translation
    place = Pose(position=Point(x=p.x, y=p.y, z=p.z), orientation=message.transform.rotation)
    return stamp_ns(message.header.stamp), transform_of(place)


def path(poses: Iterable[tuple[int, Pose]], head: Header) -> Path:
    """Path through stamped poses, all in the header's frame."""
    return Path(
        header=head, poses=[PoseStamped(header=header(stamp, head.frame_id), pose=place) for stamp, place in poses]
    )


def diagnostics(name: str, level: bytes, message: str, values: Mapping[str, object], stamp: int) -> DiagnosticArray:
    """One status with its figures."""
    status = DiagnosticStatus(level=level, name=name, message=message, hardware_id='thermal_fiducial')
    status.values = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
    return DiagnosticArray(header=header(stamp, ''), status=[status])
