"""Simulated messages, as objects of rosbags."""

from typing import Any

import numpy as np

from thermal_fiducial.core.types import FloatArray
from thermal_fiducial.files.rosbags_types import BODY_FRAME, CAMERA_FRAME, header, make, MAP_FRAME
from thermal_fiducial.sim.imu import ImuModel
from thermal_fiducial.sim.lens import Lens
from thermal_fiducial.sim.thermal_camera import SimFrame


def _vector(values: FloatArray, kind: str = 'Vector3') -> Any:
    return make(f'geometry_msgs/msg/{kind}', *values.tolist())


def image(frame: SimFrame, *, eight_bit: bool = False) -> Any:
    """A frame as little-endian mono16, or as mono8."""
    height, width = frame.counts.shape
    return make(
        'sensor_msgs/msg/Image',
        header=header(frame.stamp_ns, CAMERA_FRAME),
        height=height,
        width=width,
        encoding='mono8' if eight_bit else 'mono16',
        is_bigendian=0,
        step=width if eight_bit else 2 * width,
        data=np.ascontiguousarray(frame.counts, dtype='u1' if eight_bit else '<u2').view(np.uint8).ravel(),
    )


def camera_info(lens: Lens, stamp_ns: int) -> Any:
    """Calibration of the lens."""
    return make(
        'sensor_msgs/msg/CameraInfo',
        header=header(stamp_ns, CAMERA_FRAME),
        height=lens.height,
        width=lens.width,
        distortion_model=lens.model,
        d=np.array(lens.distortion),
        k=lens.matrix.ravel(),
        r=np.eye(3).ravel(),
        p=np.hstack([lens.matrix, np.zeros((3, 1))]).ravel(),
        binning_x=0,
        binning_y=0,
        roi=make('sensor_msgs/msg/RegionOfInterest', 0, 0, 0, 0, do_rectify=False),
    )


def imu(stamp_ns: int, angular_velocity: FloatArray, linear_acceleration: FloatArray, model: ImuModel) -> Any:
    """An IMU sample, without orientation, with the variances of its noise."""
    deviations = np.array([model.noise.gyroscope_noise_density, model.noise.accelerometer_noise_density])
    gyroscope, accelerometer = (np.eye(3).ravel() * variance for variance in deviations**2 * model.rate)
    return make(
        'sensor_msgs/msg/Imu',
        header=header(stamp_ns, BODY_FRAME),
        orientation=make('geometry_msgs/msg/Quaternion', 0.0, 0.0, 0.0, 1.0),
        orientation_covariance=np.array([-1.0] + [0.0] * 8),
        angular_velocity=_vector(angular_velocity),
        angular_velocity_covariance=gyroscope,
        linear_acceleration=_vector(linear_acceleration),
        linear_acceleration_covariance=accelerometer,
    )


def odometry(
    stamp_ns: int,
    position: FloatArray,
    quaternion: FloatArray,
    velocity_body: FloatArray,
    angular_velocity_body: FloatArray,
) -> Any:
    """The truth: pose of the body in ``map``, twist in the body's frame."""
    pose = make('geometry_msgs/msg/Pose', _vector(position, 'Point'), _vector(quaternion, 'Quaternion'))
    twist = make('geometry_msgs/msg/Twist', _vector(velocity_body), _vector(angular_velocity_body))
    return make(
        'nav_msgs/msg/Odometry',
        header=header(stamp_ns, MAP_FRAME),
        child_frame_id=BODY_FRAME,
        pose=make('geometry_msgs/msg/PoseWithCovariance', pose, np.zeros(36)),
        twist=make('geometry_msgs/msg/TwistWithCovariance', twist, np.zeros(36)),
    )
