"""Listens to what a flight controller would get."""

from collections.abc import Callable
import time
from typing import Any

from nav_msgs.msg import Odometry
from rclpy.context import Context
from rclpy.node import Node
from sensor_msgs.msg import Imu

from thermal_fiducial.ros import qos
from thermal_fiducial.ros.run import initialise, make_executor


def listen(
    topic: str,
    seconds: float,
    on_odometry: Callable[[Any, int], None],
    on_imu: Callable[[Any], None],
    domain_id: int | None = None,
) -> None:
    """Hand on the messages of ``topic`` (with the time of arrival [ns]) and of ``imu/data`` for some seconds."""
    context = Context()
    initialise(None, context, domain_id)
    executor = make_executor(context)
    node = Node('check_bridge', context=context)
    try:
        node.create_subscription(Odometry, topic, lambda message: on_odometry(message, time.time_ns()), qos.IMU_INPUT)
        node.create_subscription(Imu, 'imu/data', on_imu, qos.IMU_INPUT)
        executor.add_node(node)
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0.0:
            executor.spin_once(timeout_sec=min(left, 0.1))
    finally:
        executor.shutdown()
        node.destroy_node()
        context.try_shutdown()
