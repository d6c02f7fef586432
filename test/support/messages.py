"""Messages for the nodes, as rclpy has them: the frames, IMU samples and poses of :mod:`support.small_bag`."""

from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
import numpy as np
from sensor_msgs.msg import Imu

from support import small_bag
from thermal_fiducial.ros.messages import convert

START = small_bag.START_NS
FRAME_NS = 33_333_333
IMU_NS = 5_000_000


def frames(count):
    rng = np.random.default_rng(3)
    pictures = [small_bag.frame(small_bag.true_pose(k / 30), rng) for k in range(count)]
    return [convert.image(p, convert.header(START + k * FRAME_NS, 'camera')) for k, p in enumerate(pictures)]


def info(camera=small_bag.CAMERA):
    return convert.camera_info(camera, convert.header(START, 'camera'))


def imu(k, rate=(0.0, 0.0, 0.0), force=(0.0, 0.0, 9.80665)):
    message = Imu(header=convert.header(START + k * IMU_NS, 'base_link'))
    # No axis gives the same reading again and again: its last digit moves.
    moving = 1e-6 * np.sin(np.arange(6.0) + k)
    message.angular_velocity = convert.vector(np.array(rate) + moving[:3])
    message.linear_acceleration = convert.vector(np.array(force) + moving[3:])
    return message


def pose_with_covariance(T, covariance, head):
    """A camera pose, field by field: what the mapper writes as bytes."""
    message = PoseWithCovarianceStamped(header=head)
    message.pose.pose = convert.pose(T)
    message.pose.covariance[:] = covariance.ravel()
    return message


def pose(k, T=None):
    head = convert.header(START + k * IMU_NS, 'map')
    T_map_camera = small_bag.T_BODY_CAMERA if T is None else T
    return pose_with_covariance(T_map_camera, np.diag([1e-6] * 3 + [1e-7] * 3), head)


def odometry(state, frame_id='map', child_frame_id='base_link'):
    """The message of a state, field by field: what the filter writes as bytes."""
    message = Odometry(header=convert.header(state.stamp_ns, frame_id), child_frame_id=child_frame_id)
    message.pose.pose = convert.pose(state.T_map_body)
    message.pose.covariance[:] = state.pose_covariance.ravel()
    message.twist.twist.linear = convert.vector(state.velocity_body)
    message.twist.twist.angular = convert.vector(state.angular_velocity_body)
    message.twist.covariance[:] = state.twist_covariance.ravel()
    return message


def pose_of(odometry):
    """The pose alone of such a message."""
    return PoseWithCovarianceStamped(header=odometry.header, pose=odometry.pose)
