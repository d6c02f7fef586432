"""The pose on /tf (parameter ``publish_tf``, needs tf2_ros)."""

from collections.abc import Callable
import importlib
from typing import Any

from thermal_fiducial.config import PoseEkfConfig
from thermal_fiducial.core.geometry.se3 import camera_in_body, inverse
from thermal_fiducial.core.measurements import Odometry
from thermal_fiducial.ros.base.counting import CountingNode
from thermal_fiducial.ros.frames.robot_frames import RobotFrames
from thermal_fiducial.ros.messages import convert


class TransformBroadcaster:
    """Broadcasts map to robot, and once robot to camera; nothing without tf2_ros.

    With ``odom_frame``, as in REP-105: odom to robot is the smooth output, map to odom the difference to the estimate.

    Parameters
    ----------
    node : for the publishers
    config : frames, pose of the camera
    frames : source of the camera's pose; one from TF is not broadcast again
    fault : called with a message if tf2_ros is missing
    """

    def __init__(
        self, node: CountingNode, config: PoseEkfConfig, frames: RobotFrames, fault: Callable[[str], None]
    ) -> None:
        self._config, self._frames = config, frames
        self._broadcaster: Any = None
        try:
            tf2_ros = importlib.import_module('tf2_ros')
        except ImportError:
            fault('parameter publish_tf: tf2_ros is not installed')
            return
        self._broadcaster = tf2_ros.TransformBroadcaster(node)
        self._static: Any = tf2_ros.StaticTransformBroadcaster(node)

    def send(self, odometry: Odometry, smooth: Odometry | None) -> None:
        """Broadcast the robot's pose, with ``odom_frame`` split into map to odom and odom to robot."""
        if self._broadcaster is None:
            return
        if self._static is not None and self._frames.parameters_hold:
            self._send_camera()
        config, stamp, T_map_body = self._config, odometry.stamp_ns, odometry.T_map_body
        if not config.odom_frame or smooth is None:
            self._broadcaster.sendTransform(
                convert.transform_message(T_map_body, stamp, config.map_frame, config.base_frame)
            )
            return
        T_odom_body = smooth.T_map_body
        T_map_odom = T_map_body @ inverse(T_odom_body)
        self._broadcaster.sendTransform(
            [
                convert.transform_message(T_map_odom, stamp, config.map_frame, config.odom_frame),
                convert.transform_message(T_odom_body, stamp, config.odom_frame, config.base_frame),
            ]
        )

    def _send_camera(self) -> None:
        """Broadcast robot to camera, once: /tf_static is latched."""
        config = self._config
        T_body_camera = camera_in_body(config)
        self._static.sendTransform(convert.transform_message(T_body_camera, 0, config.base_frame, config.camera_frame))
        self._static = None
