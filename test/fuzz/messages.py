"""Mutated messages for the nodes, and a good flight after every few of them."""

from collections import Counter
from collections.abc import Callable, Iterator
from copy import deepcopy
from pathlib import Path
from random import Random
import tempfile
from typing import Any
import warnings

import cv2
from geometry_msgs.msg import PoseWithCovarianceStamped
import numpy as np
from rclpy.context import Context
from rclpy.serialization import serialize_message
from sensor_msgs.msg import CompressedImage, Image, TimeReference
from std_msgs.msg import String
from support import small_bag
from support.direct_graph import DirectGraph
from support.messages import FRAME_NS, frames, imu, IMU_NS, info, odometry, pose, START

from fuzz.findings import Finding, timed
from fuzz.mutations import mutate_message
from thermal_fiducial.core.measurements import Odometry as State
from thermal_fiducial.errors import INTERNAL_ERROR
from thermal_fiducial.files.marker_map import load_map
from thermal_fiducial.nodes.aruco_detector import ArucoDetector
from thermal_fiducial.nodes.landing_target import LandingTarget
from thermal_fiducial.nodes.marker_mapper import MarkerMapperNode
from thermal_fiducial.nodes.pose_ekf import PoseEkfNode
from thermal_fiducial.nodes.tau2_camera import Tau2Camera
from thermal_fiducial.replay.domain import own_domain
from thermal_fiducial.ros.messages import convert

#: After so many mutated messages a good flight must give good poses ...
AT_ONCE = 50
#: ... within this [s]: as many good poses as bear out a pose that jumps far, see ``reset_after``.
PATIENCE = 15.0
#: The robot at rest is known to the floor of made-up poses [m].
GOOD = 0.05
#: More pictures of this the nodes need not see until they find the camera in one of them.
_PICTURES = 100
#: Longest line that an input is refused with: it goes to the console of a pilot.
_LONGEST_LINE = 1000
#: Markers in the map.
MAPPED = (0, 1, 2, 3)
#: What the filter publishes for every sample of the IMU, and in thirty milliseconds of them.
_OUTPUTS, _SAMPLES = ('/pose', '/odometry'), 6
#: Pictures for a camera front end of their own, which reads no others.
_COMPRESSED = '/packed/thermal/image_raw/compressed'
#: Topic to how often it is mutated: images take long.
_TOPICS = {
    '/imu/data': 10,
    '/camera_pose': 10,
    '/camera_pose/map_error': 3,
    '/markers': 5,
    '/odometry': 5,
    '/map_correction': 2,
    '/camera_clock': 2,
    '/thermal/camera_info': 2,
    '/marker_map': 2,
    '/thermal/image_raw': 1,
    _COMPRESSED: 1,
    '/thermal/image': 1,
    '/robot_description': 1,
}
#: Of a robot whose camera it does not know: whatever is changed in it, the camera stays where it is.
_URDF = """<robot name="drone"><link name="base_link"/><link name="imu"/><link name="tau2"/>
  <joint name="imu" type="fixed"><parent link="base_link"/><child link="imu"/><origin xyz="0 0 0.05"/></joint>
  <joint name="mount" type="fixed"><parent link="imu"/><child link="tau2"/><origin rpy="-1.6 0 -1.6"/></joint>
</robot>"""


class Nodes:
    """The nodes of a flight at rest, with a landing pad, fed with mutated messages."""

    def __init__(self, context: Context, folder: Path) -> None:
        self._graph = DirectGraph(context)
        self._samples = 0
        self._latest: np.ndarray | None = None
        self._located: np.ndarray | None = None
        self._published: Counter[str] = Counter()
        self.not_finite: list[str] = []
        self._map_file = small_bag.side_files(folder, ids=MAPPED)[0]
        camera = {name: small_bag.PARAMETERS[name] for name in ('camera_position', 'camera_orientation')}
        self._graph.start(Tau2Camera)
        self._graph.start(Tau2Camera, namespace='packed', image_transport='compressed')
        self._graph.start(ArucoDetector, **small_bag.PARAMETERS)
        self._graph.start(MarkerMapperNode, **small_bag.PARAMETERS, map_file=str(self._map_file), mode='mapping')
        self._graph.start(PoseEkfNode, **camera, bridge_rate=50.0)
        self._graph.start(LandingTarget, **camera, landing_pad=[MAPPED[0]])
        self._graph.listen('/pose', self._on_pose)
        self._graph.listen('/camera_pose', self._on_camera_pose)
        for topic in ('/pose', '/odometry', '/bridge/odometry', '/camera_pose', '/camera_clock', '/landing_target'):
            self._graph.listen(topic, lambda message, topic=topic: self._check(topic, message))
        self._good = _good_messages(self._graph)
        self._noise = np.random.default_rng(4)
        self._picture = small_bag.frame(np.eye(4), self._noise)

    def _on_pose(self, message: PoseWithCovarianceStamped) -> None:
        self._latest = np.array([message.pose.pose.position.x, message.pose.pose.position.y])

    def _on_camera_pose(self, message: PoseWithCovarianceStamped) -> None:
        self._located = convert.transform_of(message.pose.pose)

    def _check(self, topic: str, message: Any) -> None:
        """Whatever the nodes publish themselves is finite."""
        self._published[topic] += 1
        if not all(np.isfinite(value).all() for value in _numbers(message)):
            self.not_finite.append(topic)

    def send_mutated(self, rng: Random) -> str:
        """Send one; its topic."""
        topic = rng.choices(list(_TOPICS), list(_TOPICS.values()))[0]
        message = mutate_message(deepcopy(rng.choice(self._good[topic])), rng)
        # What no encoding can carry never arrives.
        self._graph.send_encoded(topic, type(message), serialize_message(message))
        return topic

    def internal_errors(self) -> list[str]:
        """Refusals for reasons that nobody foresaw since the last call."""
        found = [line for line in self._refusals() if INTERNAL_ERROR in line]
        self.forget()
        return found

    def long_lines(self) -> list[str]:
        """Refusals since the last call that are no line for a console."""
        return [repr(line[:100]) for line in self._refusals() if not line.isprintable() or len(line) > _LONGEST_LINE]

    def _refusals(self) -> list[str]:
        return [node.last_refusal for node in self._graph.nodes.values()]

    def forget(self) -> None:
        """Forget all refusals until now."""
        for node in self._graph.nodes.values():
            node.refuse('')

    def good_flight(self) -> str:
        """Fly until the pose is good; why it is not, in the end, or what does not come with it."""
        good = 0
        for _ in range(round(PATIENCE / 0.03)):
            self._latest = None
            self._published.clear()
            self._thirty_milliseconds()
            good = good + 1 if self._latest is not None and np.abs(self._latest).max() < GOOD else 0
            if good == 10:
                missing = [topic for topic in _OUTPUTS if self._published[topic] != _SAMPLES]
                return f'{_SAMPLES} samples of the IMU, but {dict(self._published)}' if missing else self._look()
        return self._graph.nodes['pose_ekf'].headline()

    def _look(self) -> str:
        """Show pictures until the camera is found in one; why it is not, in the end."""
        for _ in range(_PICTURES):
            self._thirty_milliseconds()
            stamp, self._located = START + self._samples * IMU_NS, None
            self._graph.send('/thermal/camera_info', info())
            # No camera gives the same picture twice.
            picture = self._picture + self._noise.integers(0, 4, self._picture.shape, dtype=np.uint16)
            self._graph.send('/thermal/image_raw', convert.image(picture, convert.header(stamp, 'camera')))
            if self._located is not None and np.abs(self._located - small_bag.T_BODY_CAMERA).max() < GOOD:
                return ''
        stages = ('tau2_camera', 'aruco_detector', 'marker_mapper')
        return '; '.join(f'{name}: {self._graph.nodes[name].state()[1]}' for name in stages)

    def losses(self) -> list[str]:
        """Markers that are missing from the map."""
        left = set(MAPPED) - set(self._graph.nodes['marker_mapper'].mapper.map.markers)
        return [f'markers {sorted(left)} are no longer in the map'] if left else []

    def _thirty_milliseconds(self) -> None:
        for _ in range(_SAMPLES):
            self._graph.send('/imu/data', imu(self._samples))
            self._samples += 1
        self._graph.send('/camera_pose', pose(self._samples - 4))

    def close(self) -> list[str]:
        """End the nodes; what is missing from the map that they leave."""
        self._graph.nodes['marker_mapper'].close()
        self._graph.close()
        left = set(MAPPED) - set(load_map(self._map_file, small_bag.SIZE).markers)
        return [f'markers {sorted(left)} are not in the map that was saved'] if left else []


def _numbers(message: Any) -> Iterator[Any]:
    for name in message.get_fields_and_field_types():
        held = getattr(message, name)
        if hasattr(held, 'get_fields_and_field_types'):
            yield from _numbers(held)
        elif isinstance(held, (float, np.ndarray)):
            yield held


def _good_messages(graph: DirectGraph) -> dict[str, list[Any]]:
    """Of each topic a few as the nodes get them."""
    found: dict[str, list[Any]] = {topic: [] for topic in _TOPICS}
    graph.listen('/markers', lambda message: found['/markers'].append(deepcopy(message)))
    graph.listen('/marker_map', lambda message: found['/marker_map'].append(deepcopy(message)))
    graph.send('/thermal/camera_info', info())
    for message in frames(3):
        graph.send('/thermal/image_raw', message)
        found['/thermal/image_raw'].append(message)
    found[_COMPRESSED] = [_compressed(message) for message in found['/thermal/image_raw']]
    state = State(START, np.eye(4), np.zeros(3), np.zeros(3), 1e-6 * np.eye(6), 1e-6 * np.eye(6))
    found['/thermal/image'] = found['/thermal/image_raw']
    found['/thermal/camera_info'] = [info()]
    found['/imu/data'] = [imu(k) for k in range(5)]
    found['/camera_pose'] = [pose(k) for k in range(5)]
    found['/camera_pose/map_error'] = [pose(k) for k in range(5)]
    found['/robot_description'] = [String(data=_URDF)]
    found['/odometry'] = [odometry(state)]
    found['/map_correction'] = [convert.transform_message(np.eye(4), START, 'map', 'map_before')]
    clock = convert.header(START + FRAME_NS, 'camera')
    found['/camera_clock'] = [
        TimeReference(header=clock, time_ref=convert.header(START + IMU_NS, '').stamp, source='camera')
    ]
    missing = [topic for topic, messages in found.items() if not messages]
    assert not missing, missing
    return found


def _compressed(image: Image) -> CompressedImage:
    """A picture as image_transport compresses it."""
    pixels = np.frombuffer(image.data, np.uint16).reshape(image.height, image.width)
    data = cv2.imencode('.png', pixels, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()
    return CompressedImage(header=image.header, format='mono16; png compressed mono16', data=data)


def run(numbers: range, begin: Callable[[str, int], None]) -> list[Finding]:
    """Findings of inputs ``numbers``; ``begin`` is called before each."""
    findings: list[Finding] = []
    context = Context()
    # Another process that does the same would receive what is published here.
    with own_domain() as domain, tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        # A number that overflows behind the door should not have come through it.
        warnings.simplefilter('error', RuntimeWarning)
        context.init(args=['--ros-args', '--log-level', 'FATAL'], domain_id=domain)
        nodes = Nodes(context, Path(folder))
        nodes.good_flight()
        for number in numbers:
            begin('messages', number)
            with timed('messages', number, findings):
                topic = nodes.send_mutated(Random(number))
            findings += [Finding('messages', number, 'not one line', line) for line in nodes.long_lines()]
            findings += [Finding('messages', number, 'internal error', line) for line in nodes.internal_errors()]
            findings += [Finding('messages', number, 'not finite', f'{bad} after {topic}') for bad in nodes.not_finite]
            nodes.not_finite.clear()
            findings += [Finding('messages', number, 'lost', f'{loss} after {topic}') for loss in nodes.losses()]
            if (number + 1) % AT_ONCE == 0 and (reason := nodes.good_flight()):
                findings.append(Finding('messages', number, 'poisoned', reason))
        findings += [Finding('messages', numbers[-1], 'lost', loss) for loss in nodes.close()]
        context.try_shutdown()
    return findings
