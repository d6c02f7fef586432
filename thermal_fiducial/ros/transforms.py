"""The pose on /tf, where tf2_ros is installed and it is asked for."""

from collections.abc import Callable
import importlib
from typing import Any

from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped

from thermal_fiducial.core.types import FloatArray
from thermal_fiducial.ros import convert
from thermal_fiducial.ros.node import CountingNode


class TransformBroadcaster:
    """Broadcasts the robot in the map, and once the camera on the robot; nothing where tf2_ros is missing.

    Parameters
    ----------
    node : that broadcasts
    base_frame, camera_frame : names
    T_body_camera : (4, 4)
    fault : told in words that tf2_ros is missing
    """

    def __init__(
        self,
        node: CountingNode,
        base_frame: str,
        camera_frame: str,
        T_body_camera: FloatArray,
        fault: Callable[[str], None],
    ) -> None:
        self._base_frame = base_frame
        self._broadcaster: Any = None
        try:
            tf2_ros = importlib.import_module('tf2_ros')
        except ImportError:
            fault('parameter publish_tf: tf2_ros is not installed')
            return
        self._broadcaster = tf2_ros.TransformBroadcaster(node)
        self._static = tf2_ros.StaticTransformBroadcaster(node)
        self._static.sendTransform(convert.transform_message(T_body_camera, 0, base_frame, camera_frame))

    def send(self, message: PoseWithCovarianceStamped) -> None:
        """Broadcast the pose of the robot in the header's frame."""
        if self._broadcaster is None:
            return
        pose = message.pose.pose
        transform = TransformStamped(header=message.header, child_frame_id=self._base_frame)
        p = pose.position
        transform.transform.translation.x, transform.transform.translation.y = p.x, p.y
        transform.transform.translation.z = p.z
        transform.transform.rotation = pose.orientation
        self._broadcaster.sendTransform(transform)
