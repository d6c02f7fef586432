"""Messages for bags written without ROS, as rosbags objects."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.geometry.se3 import quaternion_from_rotation
from thermal_fiducial.core.measurements import CameraPose, ImuSample, Markers
from thermal_fiducial.core.types import FloatArray
from thermal_fiducial.files.rosbags_types import BODY_FRAME, CAMERA_FRAME, header, make, MAP_FRAME

#: Datatype codes of sensor_msgs/msg/PointField for the dtypes of the rows.
_POINT_CODES = {'<f4': 7, '<u4': 6, '|u1': 2}
_NO_ORIENTATION = np.array([-1.0] + [0.0] * 8)


def _vector(values: FloatArray, kind: str = 'Vector3') -> Any:
    return make(f'geometry_msgs/msg/{kind}', *(float(value) for value in values))


def _pose(T: FloatArray) -> Any:
    quaternion = _vector(quaternion_from_rotation(T[:3, :3]), 'Quaternion')
    return make('geometry_msgs/msg/Pose', _vector(T[:3, 3], 'Point'), quaternion)


def imu(sample: ImuSample) -> Any:
    """sensor_msgs/msg/Imu without orientation; covariances are unknown."""
    return make(
        'sensor_msgs/msg/Imu',
        header=header(sample.stamp_ns, BODY_FRAME),
        orientation=make('geometry_msgs/msg/Quaternion', 0.0, 0.0, 0.0, 1.0),
        orientation_covariance=_NO_ORIENTATION,
        angular_velocity=_vector(sample.angular_velocity),
        angular_velocity_covariance=np.zeros(9),
        linear_acceleration=_vector(sample.linear_acceleration),
        linear_acceleration_covariance=np.zeros(9),
    )


def camera_info(stamp_ns: int, camera: Camera) -> Any:
    """sensor_msgs/msg/CameraInfo."""
    return make(
        'sensor_msgs/msg/CameraInfo',
        header=header(stamp_ns, CAMERA_FRAME),
        height=camera.height,
        width=camera.width,
        distortion_model=camera.model,
        d=camera.D,
        k=camera.K.ravel(),
        r=np.eye(3).ravel(),
        p=np.hstack([camera.K, np.zeros((3, 1))]).ravel(),
        binning_x=0,
        binning_y=0,
        roi=make('sensor_msgs/msg/RegionOfInterest', 0, 0, 0, 0, do_rectify=False),
    )


def image(stamp_ns: int, pixels: npt.NDArray[Any]) -> Any:
    """sensor_msgs/msg/Image of (H, W) uint8 as mono8 or uint16 as mono16."""
    height, width = pixels.shape
    wide = pixels.dtype.itemsize == 2
    return make(
        'sensor_msgs/msg/Image',
        header=header(stamp_ns, CAMERA_FRAME),
        height=height,
        width=width,
        encoding='mono16' if wide else 'mono8',
        is_bigendian=0,
        step=width * pixels.dtype.itemsize,
        data=np.ascontiguousarray(pixels, dtype='<u2' if wide else 'u1').view(np.uint8).ravel(),
    )


def markers(stamp_ns: int, rows: Markers) -> Any:
    """sensor_msgs/msg/PointCloud2 of rows of MARKER_DTYPE, as the detector publishes it."""
    layout: Mapping[str, Any] = rows.dtype.fields or {}
    fields = [
        make('sensor_msgs/msg/PointField', name, layout[name][1], _POINT_CODES[layout[name][0].str], 1)
        for name in rows.dtype.names or ()
    ]
    return make(
        'sensor_msgs/msg/PointCloud2',
        header=header(stamp_ns, CAMERA_FRAME),
        height=1,
        width=len(rows),
        fields=fields,
        is_bigendian=False,
        point_step=rows.dtype.itemsize,
        row_step=rows.dtype.itemsize * len(rows),
        data=np.frombuffer(rows.tobytes(), np.uint8),
        is_dense=True,
    )


def camera_pose(pose: CameraPose) -> Any:
    """geometry_msgs/msg/PoseWithCovarianceStamped."""
    place = make('geometry_msgs/msg/PoseWithCovariance', _pose(pose.T_map_camera), pose.covariance.ravel())
    return make('geometry_msgs/msg/PoseWithCovarianceStamped', header(pose.stamp_ns, MAP_FRAME), place)


def truth(stamp_ns: int, T_map_body: FloatArray) -> Any:
    """nav_msgs/msg/Odometry of a reference pose, without a twist."""
    twist = make('geometry_msgs/msg/Twist', _vector(np.zeros(3)), _vector(np.zeros(3)))
    return make(
        'nav_msgs/msg/Odometry',
        header=header(stamp_ns, MAP_FRAME),
        child_frame_id=BODY_FRAME,
        pose=make('geometry_msgs/msg/PoseWithCovariance', _pose(T_map_body), np.zeros(36)),
        twist=make('geometry_msgs/msg/TwistWithCovariance', twist, np.zeros(36)),
    )
