"""Subscribes to the outputs for a flight controller, on the remapped topics of the running filter."""

from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass, replace
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rclpy.exceptions import InvalidTopicNameException
from rclpy.node import Node
from rclpy.validate_topic_name import validate_topic_name
from sensor_msgs.msg import Imu

from thermal_fiducial.errors import InputError
from thermal_fiducial.ros.base import qos
from thermal_fiducial.ros.messages.convert import BRIDGE_TOPIC, ODOMETRY_TOPIC
from thermal_fiducial.ros.watching.observer import observer

_FILTER, _LANDING = 'pose_ekf', 'landing_target'
_ODOMETRY, _IMU, _POSE = 'nav_msgs/msg/Odometry', 'sensor_msgs/msg/Imu', 'geometry_msgs/msg/PoseStamped'
#: Message type for PX4 over uXRCE-DDS.
PX4_KIND = 'px4_msgs/msg/VehicleOdometry'
#: Odometry topics of the filter that are not for a flight controller.
_NOT_FOR_IT = ('odometry', 'odometry_smooth')
#: Timeout of the search for a filter, and time for which its diagnostics are awaited, one a second [s].
DISCOVERY_S, SAID_S = 5.0, 1.5


@dataclass(frozen=True)
class Topics:
    """Resolved topic names."""

    odometry: str
    imu: str
    landing: str
    #: topic for the autopilot: px4_msgs/VehicleOdometry for PX4 over uXRCE-DDS, else the same as ``odometry``
    autopilot: str
    #: name of the publishing node
    sender: str


@dataclass(frozen=True)
class Links:
    """Publishers and subscribers of the autopilot's topic, and the filter's last diagnostic."""

    topic: str
    #: publishers of the odometry, and subscribers of the autopilot's topic without this node
    senders: int
    receivers: int
    #: message of the filter's diagnostic if it is an error, else empty
    complaint: str


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
) -> Links:
    """Pass odometry (with its arrival time [ns]), IMU messages and landing targets to callbacks for ``seconds``.

    Parameters
    ----------
    topic : odometry to subscribe to; empty: the running filter's output for a flight controller, remapped or not
    announce : called with the topics once they are resolved
    ros_arguments : as after ``--ros-args``

    Raises
    ------
    InputError
        No topic can have that name, or there are several robots.
    """
    if topic:
        _require_name(topic)
    with observer('check_bridge', ros_arguments, domain_id) as (node, executor):
        said: dict[str, DiagnosticStatus] = {}
        node.create_subscription(DiagnosticArray, '/diagnostics', lambda array: _note(array, said), qos.RESULT)
        topics = Topics(*map(node.resolve_topic_name, astuple(_find(node, executor, topic, said))))
        announce(topics)
        node.create_subscription(
            Odometry, topics.odometry, lambda message: on_odometry(message, time.time_ns()), qos.IMU_INPUT
        )
        node.create_subscription(Imu, topics.imu, on_imu, qos.IMU_INPUT)
        node.create_subscription(PoseStamped, topics.landing, on_landing_target, qos.RESULT)
        _spin(executor, seconds, lambda: False)
        return _links(node, topics, said)


def _require_name(topic: str) -> None:
    try:
        validate_topic_name(topic)
    except InvalidTopicNameException:
        raise InputError(f'--topic {topic!r} is not the name of a topic') from None


def _find(node: Node, executor: Any, topic: str, said: dict[str, DiagnosticStatus]) -> Topics:
    """Topics of the filter in the graph; the default names if there is none.

    Parameters
    ----------
    said : node to its latest diagnostic, filled while the executor spins
    """
    found: dict[str, Topics] = {}

    def look() -> bool:
        every = {space: _topics_of_filter(node, space, said) for space in _namespaces(node, _FILTER)}
        found.update({space: topics for space, topics in every.items() if topics is not None})
        return bool(found)

    _spin(executor, DISCOVERY_S, look)
    # A second robot may be discovered later, and the filter says once a second what it publishes where.
    _spin(executor, SAID_S, lambda: False)
    look()
    ours = 'bridge/odometry'
    own = node.get_namespace()
    topics = _only(found, own) or Topics(ours, 'imu/data', _landing_topic(node, own), ours, _FILTER)
    return replace(topics, odometry=topic, autopilot=topic) if topic else topics


def _only(found: dict[str, Topics], own: str) -> Topics | None:
    """Topics of the robot in the namespace ``own``, or else of the only one below it; None if there is none.

    Raises
    ------
    InputError
        There are several.
    """
    if own in found or len(found) < 2:
        return found.get(own) or next(iter(found.values()), None)
    spaces = sorted(found)
    raise InputError(f'there are several robots, {", ".join(spaces)}: name one, as --ros-args -r __ns:={spaces[0]}')


def _topics_of_filter(node: Node, namespace: str, said: dict[str, DiagnosticStatus]) -> Topics | None:
    published = node.get_publisher_names_and_types_by_node(_FILTER, namespace)
    subscribed = node.get_subscriber_names_and_types_by_node(_FILTER, namespace)
    odometry = sorted(name for name, kinds in published if _ODOMETRY in kinds)
    imu = [name for name, kinds in subscribed if _IMU in kinds]
    if not (odometry and imu):
        return None
    base = namespace.rstrip('/')
    bridge = [name for name in odometry if name not in {f'{base}/{own}' for own in _NOT_FOR_IT}]
    status = said.get(f'{base}/{_FILTER}'.lstrip('/'), DiagnosticStatus())
    named = {item.key: item.value for item in status.values}
    # Remapped topics are known by the filter's own words only.
    sent = named.get(BRIDGE_TOPIC) or named.get(ODOMETRY_TOPIC) or (bridge or odometry)[0]
    px4 = [name for name, kinds in published if PX4_KIND in kinds]
    return Topics(sent, imu[0], _landing_topic(node, namespace), (px4 or [sent])[0], f'{base}/{_FILTER}')


def _landing_topic(node: Node, namespace: str) -> str:
    """Topic of the landing target of the robot in ``namespace``, remapped or not; the default name without one."""
    if namespace in _namespaces(node, _LANDING):
        for topic, kinds in node.get_publisher_names_and_types_by_node(_LANDING, namespace):
            if _POSE in kinds:
                return topic
    return f'{namespace.rstrip("/")}/{_LANDING}'


def _namespaces(node: Node, wanted: str) -> list[str]:
    """Namespaces of the nodes with a name, those of the present ``node`` or below: others are of other robots."""
    own = f'{node.get_namespace().rstrip("/")}/'
    every = node.get_node_names_and_namespaces()
    return [namespace for name, namespace in every if name == wanted and f'{namespace}/'.startswith(own)]


def _note(array: DiagnosticArray, said: dict[str, DiagnosticStatus]) -> None:
    said.update({status.name: status for status in array.status})


def _links(node: Node, topics: Topics, said: dict[str, DiagnosticStatus]) -> Links:
    receivers = node.count_subscribers(topics.autopilot)
    if topics.autopilot == topics.odometry:
        receivers -= 1
    status = said.get(topics.sender.lstrip('/'), DiagnosticStatus())
    complaint = status.message if status.level == DiagnosticStatus.ERROR else ''
    return Links(topics.autopilot, node.count_publishers(topics.odometry), receivers, complaint)


def _spin(executor: Any, seconds: float, done: Callable[[], bool]) -> None:
    end = time.monotonic() + seconds
    while not done() and (left := end - time.monotonic()) > 0.0:
        executor.spin_once(timeout_sec=min(left, 0.1))
