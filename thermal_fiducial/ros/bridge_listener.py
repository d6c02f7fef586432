"""Listens to what a flight controller would get, on the topics that the running filter really has."""

from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass
import time
from typing import Any

from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rclpy.context import Context
from rclpy.node import Node
from sensor_msgs.msg import Imu

from thermal_fiducial.ros import qos
from thermal_fiducial.ros.run import initialise, make_executor

_FILTER, _LANDING = 'pose_ekf', 'landing_target'
_ODOMETRY, _IMU, _POSE = 'nav_msgs/msg/Odometry', 'sensor_msgs/msg/Imu', 'geometry_msgs/msg/PoseStamped'
#: What the filter publishes for others than a flight controller.
_NOT_FOR_IT = ('odometry', 'odometry_smooth')
#: How long a filter is looked for [s].
DISCOVERY_S = 5.0


@dataclass(frozen=True)
class Topics:
    """Names to listen to."""

    odometry: str
    imu: str
    landing: str


def listen(
    seconds: float,
    on_odometry: Callable[[Any, int], None],
    on_imu: Callable[[Any], None],
    on_landing_target: Callable[[Any], None],
    *,
    topic: str = '',
    announce: Callable[[Topics], None] = lambda topics: None,
    ros_arguments: Sequence[str] = (),
    domain_id: int | None = None,
) -> None:
    """Hand on odometry (with the time of arrival [ns]), IMU messages and landing targets for some seconds.

    Parameters
    ----------
    topic : of the odometry; empty: what the running filter sends to a flight controller, whatever it was remapped to
    announce : called with what is listened to
    ros_arguments : as after ``--ros-args``
    """
    context = Context()
    initialise(['--ros-args', *ros_arguments], context, domain_id)
    executor = make_executor(context)
    node = Node('check_bridge', context=context)
    try:
        executor.add_node(node)
        topics = Topics(*map(node.resolve_topic_name, astuple(_find(node, executor, topic))))
        announce(topics)
        node.create_subscription(
            Odometry, topics.odometry, lambda message: on_odometry(message, time.time_ns()), qos.IMU_INPUT
        )
        node.create_subscription(Imu, topics.imu, on_imu, qos.IMU_INPUT)
        node.create_subscription(PoseStamped, topics.landing, on_landing_target, qos.RESULT)
        _spin(executor, seconds, lambda: False)
    finally:
        executor.shutdown()
        node.destroy_node()
        context.try_shutdown()


def _find(node: Node, executor: Any, topic: str) -> Topics:
    """Topics of the filter in the graph; our own names where there is none."""
    found: list[Topics] = []

    def look() -> bool:
        for name, namespace in node.get_node_names_and_namespaces():
            if name == _FILTER and (topics := _topics_of_filter(node, namespace)) is not None:
                found.append(topics)
        return bool(found)

    _spin(executor, DISCOVERY_S, look)
    topics = found[0] if found else Topics('bridge/odometry', 'imu/data', _LANDING)
    return Topics(topic or topics.odometry, topics.imu, _landing_topic(node) or topics.landing)


def _topics_of_filter(node: Node, namespace: str) -> Topics | None:
    published = node.get_publisher_names_and_types_by_node(_FILTER, namespace)
    subscribed = node.get_subscriber_names_and_types_by_node(_FILTER, namespace)
    odometry = sorted(name for name, kinds in published if _ODOMETRY in kinds)
    imu = [name for name, kinds in subscribed if _IMU in kinds]
    if not (odometry and imu):
        return None
    base = namespace.rstrip('/')
    bridge = [name for name in odometry if name not in {f'{base}/{own}' for own in _NOT_FOR_IT}]
    return Topics((bridge or odometry)[0], imu[0], f'{base}/{_LANDING}')


def _landing_topic(node: Node) -> str:
    """What the node landing_target publishes, whatever it was remapped to; empty where there is none."""
    for name, namespace in node.get_node_names_and_namespaces():
        if name == _LANDING:
            published = node.get_publisher_names_and_types_by_node(name, namespace)
            return next((topic for topic, kinds in published if _POSE in kinds), '')
    return ''


def _spin(executor: Any, seconds: float, done: Callable[[], bool]) -> None:
    end = time.monotonic() + seconds
    while not done() and (left := end - time.monotonic()) > 0.0:
        executor.spin_once(timeout_sec=min(left, 0.1))
