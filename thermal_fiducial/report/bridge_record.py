"""Outputs for a flight controller, with the IMU samples, as arrays: live or from a bag."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from thermal_fiducial.core.geometry.se3 import rotation_from_quaternion
from thermal_fiducial.core.types import FloatArray, IntArray
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.images import stamp_to_ns

#: Candidate topics of the odometry for a flight controller; the first existing one is used.
ODOMETRY_TOPICS = ('bridge/odometry', 'mavros/odometry/out', 'odometry')

LANDING_TOPIC = 'landing_target'


@dataclass(frozen=True)
class LandingRecord:
    """Messages of ``landing_target`` (N): stamps, positions (N, 3) [m], frame IDs."""

    stamps_ns: IntArray
    positions: FloatArray
    frames: tuple[str, ...]


_NO_LANDING = LandingRecord(np.zeros(0, np.int64), np.zeros((0, 3)), ())


@dataclass(frozen=True)
class BridgeRecord:
    """Odometry messages (N) and IMU samples (M).

    ``arrivals_ns``, ``imu_stamps_ns`` and ``stamps_ns`` are of comparable clocks; velocities are as in the messages,
    supposedly in the robot's frame.
    """

    stamps_ns: IntArray
    arrivals_ns: IntArray
    positions: FloatArray
    quaternions: FloatArray
    velocities: FloatArray
    rates: FloatArray
    covariances: FloatArray
    frames: tuple[tuple[str, str], ...]
    imu_stamps_ns: IntArray
    imu: FloatArray
    #: whether arrivals and stamps have the same clock
    live: bool = False
    landing: LandingRecord = _NO_LANDING

    @property
    def rotations(self) -> FloatArray:
        """(N, 3, 3) R_map_body; identity for an invalid quaternion."""
        valid = np.linalg.norm(self.quaternions, axis=1, keepdims=True) > 1e-6
        return rotation_from_quaternion(np.where(valid, self.quaternions, (0.0, 0.0, 0.0, 1.0)))


@dataclass
class BridgeRecorder:
    """Collects messages of rclpy or of a bag."""

    live: bool = False
    _odometry: list[tuple[Any, ...]] = field(default_factory=list)
    _imu: list[tuple[Any, ...]] = field(default_factory=list)
    _frames: set[tuple[str, str]] = field(default_factory=set)
    _landing: list[tuple[int, tuple[float, ...], str]] = field(default_factory=list)

    def odometry(self, message: Any, arrival_ns: int) -> None:
        """Take a nav_msgs/Odometry."""
        p, q = message.pose.pose.position, message.pose.pose.orientation
        v, w = message.twist.twist.linear, message.twist.twist.angular
        row = (p.x, p.y, p.z, q.x, q.y, q.z, q.w, v.x, v.y, v.z, w.x, w.y, w.z)
        self._odometry.append((stamp_to_ns(message.header.stamp), arrival_ns, row, tuple(message.pose.covariance)))
        self._frames.add((message.header.frame_id, message.child_frame_id))

    def imu(self, message: Any) -> None:
        """Take a sensor_msgs/Imu."""
        w, a = message.angular_velocity, message.linear_acceleration
        self._imu.append((stamp_to_ns(message.header.stamp), (w.x, w.y, w.z, a.x, a.y, a.z)))

    def landing_target(self, message: Any) -> None:
        """Take a geometry_msgs/PoseStamped."""
        p = message.pose.position
        self._landing.append((stamp_to_ns(message.header.stamp), (p.x, p.y, p.z), message.header.frame_id))

    def record(self) -> BridgeRecord:
        """The collected messages as arrays."""
        rows = np.array([entry[2] for entry in self._odometry], dtype=np.float64).reshape(-1, 13)
        return BridgeRecord(
            stamps_ns=np.array([entry[0] for entry in self._odometry], dtype=np.int64),
            arrivals_ns=np.array([entry[1] for entry in self._odometry], dtype=np.int64),
            positions=rows[:, :3],
            quaternions=rows[:, 3:7],
            velocities=rows[:, 7:10],
            rates=rows[:, 10:],
            covariances=np.array([entry[3] for entry in self._odometry], dtype=np.float64).reshape(-1, 6, 6),
            frames=tuple(sorted(self._frames)),
            imu_stamps_ns=np.array([entry[0] for entry in self._imu], dtype=np.int64),
            imu=np.array([entry[1] for entry in self._imu], dtype=np.float64).reshape(-1, 6),
            live=self.live,
            landing=LandingRecord(
                np.array([entry[0] for entry in self._landing], dtype=np.int64),
                np.array([entry[1] for entry in self._landing], dtype=np.float64).reshape(-1, 3),
                tuple(sorted({entry[2] for entry in self._landing})),
            ),
        )


def _namespace(odometry: str) -> str:
    """Namespace of the robot of an odometry, with a slash behind it; empty: none, or a topic of another name."""
    known = (name for name in ODOMETRY_TOPICS if f'/{odometry}'.endswith(f'/{name}'))
    return odometry.removesuffix(next(known, odometry))


def read_bridge(path: Path, topic: str = '', imu_bag: Path | None = None) -> BridgeRecord:
    """Record of a bag, or of the ``output`` of a run folder.

    Parameters
    ----------
    topic : of the odometry; empty: the first existing one of ``ODOMETRY_TOPICS``
    imu_bag : bag with the IMU, if ``path`` has none

    Raises
    ------
    InputError
        Unreadable, or no such topic.
    """
    # Imported here, since only recordings need it.
    from thermal_fiducial.files.bags import BagReader, IMU_TOPIC

    recorder = BridgeRecorder()
    with BagReader(path / 'output' if (path / 'output').is_dir() else path) as bag:
        wanted = [name for name in ([topic.strip('/')] if topic else ODOMETRY_TOPICS) if name in bag.topics]
        if not wanted:
            raise InputError(f'{path}: no topic {topic or " or ".join(ODOMETRY_TOPICS)}')
        bag.require({wanted[0]: 'nav_msgs/msg/Odometry'})
        landing = f'{_namespace(wanted[0])}{LANDING_TOPIC}'
        if bag.topics.get(landing) != 'geometry_msgs/msg/PoseStamped':
            landing = ''
        for message in bag.messages([wanted[0], IMU_TOPIC, landing]):
            if message.topic == IMU_TOPIC:
                recorder.imu(message.message)
            elif message.topic == landing:
                recorder.landing_target(message.message)
            else:
                recorder.odometry(message.message, message.stamp_ns)
    if imu_bag is not None:
        with BagReader(imu_bag) as bag:
            bag.require({IMU_TOPIC: 'sensor_msgs/msg/Imu'})
            for message in bag.messages([IMU_TOPIC]):
                recorder.imu(message.message)
    return recorder.record()
