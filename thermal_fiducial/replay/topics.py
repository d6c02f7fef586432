"""What a replay plays and what it records: topic to message type and quality of service."""

from typing import Any, TypeAlias

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseArray, PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import Odometry
from sensor_msgs.msg import CameraInfo, Image, Imu, PointCloud2
from visualization_msgs.msg import MarkerArray

from thermal_fiducial.files.bags import CAMERA_INFO_TOPIC, IMAGE_TOPIC, IMU_TOPIC
from thermal_fiducial.ros import qos

Topics: TypeAlias = dict[str, tuple[type, Any]]

PLAYED: Topics = {
    IMAGE_TOPIC: (Image, qos.IMAGE_OUTPUT),
    CAMERA_INFO_TOPIC: (CameraInfo, qos.RESULT),
    IMU_TOPIC: (Imu, qos.IMU_RATE_RESULT),
}
_RESULTS: Topics = {
    'markers': (PointCloud2, qos.RESULT),
    'marker_poses': (PoseArray, qos.RESULT),
    'camera_pose': (PoseWithCovarianceStamped, qos.RESULT),
    'marker_map': (PointCloud2, qos.LATCHED),
    'map_correction': (TransformStamped, qos.RESULT),
    'marker_map/markers': (MarkerArray, qos.LATCHED),
    'pose': (PoseWithCovarianceStamped, qos.IMU_RATE_RESULT),
    'odometry': (Odometry, qos.IMU_RATE_RESULT),
    '/diagnostics': (DiagnosticArray, qos.IMU_RATE_RESULT),
}
_CALIBRATION: Topics = {CAMERA_INFO_TOPIC: (CameraInfo, qos.RESULT)}
_IMAGES: Topics = {'thermal/image': (Image, qos.IMAGE_OUTPUT)}


def played_topics(*, calibration_from_file: bool) -> dict[str, str]:
    """Topic to message type of what a bag must have."""
    types = {IMAGE_TOPIC: 'sensor_msgs/msg/Image', IMU_TOPIC: 'sensor_msgs/msg/Imu'}
    return types if calibration_from_file else types | {CAMERA_INFO_TOPIC: 'sensor_msgs/msg/CameraInfo'}


def recorded_topics(*, calibration_from_file: bool, images: bool) -> Topics:
    """What the nodes publish; images only on request, as they are nearly those of the bag."""
    return _RESULTS | (_CALIBRATION if calibration_from_file else {}) | (_IMAGES if images else {})
