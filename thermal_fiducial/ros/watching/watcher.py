"""Subscribes to the topics of the running nodes and to /diagnostics, and feeds a :class:`LiveStatus`."""

from collections.abc import Callable, Sequence
import math
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
import numpy as np
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2

from thermal_fiducial.core.types import SECOND_NS
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.images import stamp_to_ns
from thermal_fiducial.ros.base import qos
from thermal_fiducial.ros.messages import clouds
from thermal_fiducial.ros.watching.live_status import LiveStatus
from thermal_fiducial.ros.watching.observer import observer


class Watcher:
    """Subscriptions that feed a :class:`LiveStatus`.

    Parameters
    ----------
    node : its topics are relative, so that remaps and namespaces apply
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self.status = LiveStatus(node.get_namespace())
        for kind, topic, take, profile in (
            (Odometry, 'odometry', self._on_odometry, qos.IMU_INPUT),
            (PoseWithCovarianceStamped, 'camera_pose', self._on_camera_pose, qos.IMU_INPUT),
            (PointCloud2, 'markers', self._on_markers, qos.IMU_INPUT),
            (DiagnosticArray, '/diagnostics', self._on_diagnostics, qos.IMU_INPUT),
        ):
            node.create_subscription(kind, topic, take, profile)

    def _age(self, head: Any) -> float:
        return (self._node.get_clock().now().nanoseconds - stamp_to_ns(head.stamp)) / SECOND_NS

    def _on_odometry(self, message: Odometry) -> None:
        variances = np.asarray(message.pose.covariance).reshape(6, 6).diagonal()
        sigma_m, sigma_rad = (math.sqrt(max(float(part.sum()), 0.0)) for part in (variances[:3], variances[3:]))
        self.status.odometry(time.monotonic(), self._age(message.header), sigma_m, math.degrees(sigma_rad))

    def _on_camera_pose(self, message: PoseWithCovarianceStamped) -> None:
        self.status.camera_pose(time.monotonic(), self._age(message.header))

    def _on_markers(self, message: PointCloud2) -> None:
        try:
            ids = clouds.markers(message)['id'].tolist()
        except InputError:
            return  # the mapper refuses it too and reports the reason in its diagnostics
        self.status.markers(time.monotonic(), ids)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            level = status.level[0] if isinstance(status.level, bytes) else int(status.level)
            figures = {item.key: item.value for item in status.values}
            self.status.diagnostic(time.monotonic(), status.name, level, status.message, figures)


def watch(
    show: Callable[[LiveStatus], bool],
    period: float,
    ros_arguments: Sequence[str] = (),
    domain_id: int | None = None,
) -> None:
    """Call ``show`` with the live status every ``period`` [s] until it returns True.

    Parameters
    ----------
    ros_arguments : as after ``--ros-args``

    Raises
    ------
    InputError
        Arguments that ROS cannot read.
    """
    with observer('watch', ros_arguments, domain_id) as (node, executor):
        watcher = Watcher(node)
        due = time.monotonic() + period
        while True:
            executor.spin_once(timeout_sec=max(0.0, min(due - time.monotonic(), 0.1)))
            if time.monotonic() >= due:
                due += period
                if show(watcher.status):
                    return
