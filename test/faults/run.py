"""A flight with a fault through the nodes: every pose that goes out, beside the truth."""

import atexit
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
import tempfile
from typing import Any

from nav_msgs.msg import Odometry
import numpy as np
from rclpy.context import Context
from sensor_msgs.msg import Imu
from support.direct_graph import DirectGraph

from faults.flight import Event, Recorded, Stream
from thermal_fiducial.core.geometry.se3 import so3_log, transform_from_quaternion
from thermal_fiducial.files.marker_map import save_map
from thermal_fiducial.nodes.aruco_detector import ArucoDetector
from thermal_fiducial.nodes.marker_mapper import MarkerMapperNode
from thermal_fiducial.nodes.pose_ekf import PoseEkfNode
from thermal_fiducial.nodes.tau2_camera import Tau2Camera
from thermal_fiducial.ros.messages import clouds, convert

#: Nodes by what they are fed with: the corners of the frames, or the frames.
BY_CORNERS = {'marker_mapper': MarkerMapperNode, 'pose_ekf': PoseEkfNode}
BY_PICTURES = {'tau2_camera': Tau2Camera, 'aruco_detector': ArucoDetector} | BY_CORNERS
BRIDGE_RATE = 50.0


@dataclass
class Output:
    """Poses that went out: (N,) [s] when, (N, 6) errors of position [m] and rotation [rad], (N,) squares in sigma."""

    times: list[float] = field(default_factory=list)
    errors: list[np.ndarray] = field(default_factory=list)
    squares: list[float] = field(default_factory=list)

    def add(self, time: float, T_true: np.ndarray, message: Any) -> None:
        """A pose with its covariance, as it was sent."""
        p, q = message.pose.pose.position, message.pose.pose.orientation
        T = transform_from_quaternion((p.x, p.y, p.z), (q.x, q.y, q.z, q.w))
        error = np.concatenate((T_true[:3, 3] - T[:3, 3], so3_log(T_true[:3, :3] @ T[:3, :3].T)))
        self.times.append(time)
        self.errors.append(error)
        covariance = np.reshape(message.pose.covariance, (6, 6))
        self.squares.append(float(error @ np.linalg.solve(covariance, error)))


@dataclass
class Flown:
    """What went out as the pose, and to the autopilot; when IMU samples came; why nothing went out at the end."""

    pose: Output = field(default_factory=Output)
    bridge: Output = field(default_factory=Output)
    statuses: list[tuple[float, str]] = field(default_factory=list)
    last_refusals: set[str] = field(default_factory=set)


class Simulation:
    """The nodes with a stream of events."""

    def __init__(self, graph: DirectGraph, flight: Recorded, kinds: Mapping[str, type], map_file: Path, mode: str):
        self._graph, self._flight, self._kinds = graph, flight, kinds
        position, orientation = flight.scenario.camera_position, flight.scenario.camera_orientation
        camera = {'camera_position': list(position), 'camera_orientation': list(orientation)}
        size = {'marker_size': flight.scenario.markers[0].size}
        self._parameters: dict[str, dict[str, Any]] = {
            'tau2_camera': {},
            'aruco_detector': size | camera,
            'marker_mapper': size | camera | {'map_file': str(map_file), 'mode': mode},
            'pose_ekf': camera | {'bridge_rate': BRIDGE_RATE},
        }
        self._now, self._sampled = 0.0, 0.0
        self.flown = Flown()
        graph.listen('/pose', lambda message: self._take(self.flown.pose, message))
        graph.listen('/bridge/odometry', lambda message: self._take(self.flown.bridge, message))
        for name in kinds:
            self._start(name)
        self._send_info()

    def _start(self, name: str) -> None:
        self._graph.start(self._kinds[name], **self._parameters[name])

    def _send_info(self) -> None:
        self._graph.send('/thermal/camera_info', convert.camera_info(self._flight.camera, convert.header(0, 'camera')))

    def _take(self, output: Output, message: Odometry) -> None:
        output.add(self._now, self._flight.truth(self._sampled), message)

    def play(self, stream: Stream) -> Flown:
        """Hand over the events one after another."""
        kills = [(when, name, back) for name, (when, back) in stream.kills.items()]
        returns: list[tuple[float, str]] = []
        for item in stream.events:
            self._now, self._sampled = item.time, item.sampled
            for entry in [entry for entry in kills if entry[0] <= item.time]:
                kills.remove(entry)
                self._graph.kill(entry[1])
                returns.append((entry[2], entry[1]))
            for back in [back for back in returns if back[0] <= item.time]:
                returns.remove(back)
                self._start(back[1])
            self._hand_over(item)
        return self.flown

    def _hand_over(self, item: Event) -> None:
        if item.is_imu:
            message = Imu(header=convert.header(item.stamp_ns, 'base_link'))
            message.angular_velocity = convert.vector(item.value[:3])
            message.linear_acceleration = convert.vector(item.value[3:])
            self._graph.send('/imu/data', message)
            self._note_status()
        elif item.value.dtype.names:
            self._graph.send('/markers', clouds.cloud(item.value, convert.header(item.stamp_ns, 'camera')))
        else:
            self._graph.send('/thermal/image_raw', convert.image(item.value, convert.header(item.stamp_ns, 'camera')))
        for node in self._graph.nodes.values():
            self.flown.last_refusals.add(node.last_refusal)

    def _note_status(self) -> None:
        node = self._graph.nodes.get('pose_ekf')
        words = 'killed' if node is None else node.headline()
        if not self.flown.statuses or self.flown.statuses[-1][1] != words:
            self.flown.statuses.append((self._now, words))


@cache
def _context() -> Context:
    """One for all flights of a process."""
    context = Context()
    context.init(args=['--ros-args', '--log-level', 'FATAL'])
    atexit.register(context.try_shutdown)
    return context


def fly(flight: Recorded, stream: Stream, marker_map=None, mode='localization') -> Flown:
    """What goes out when ``stream`` comes in, on the true map unless another is given."""
    pictures = any(item.value.ndim == 2 for item in stream.events)
    with tempfile.TemporaryDirectory() as folder:
        map_file = Path(folder) / 'map.yaml'
        save_map(map_file, marker_map or flight.marker_map)
        graph = DirectGraph(_context())
        try:
            return Simulation(graph, flight, BY_PICTURES if pictures else BY_CORNERS, map_file, mode).play(stream)
        finally:
            graph.close()
