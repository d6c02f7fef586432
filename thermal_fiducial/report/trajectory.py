"""Trajectories of the report."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from thermal_fiducial.core.geometry.se3 import transform_from_quaternion
from thermal_fiducial.core.types import BoolArray, FloatArray, IntArray, SECOND_NS
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.bag_checks import SINGLE_FILES
from thermal_fiducial.files.bags import BagReader, TRUTH_TOPIC
from thermal_fiducial.files.trajectory_file import load_tum


@dataclass(frozen=True)
class Trajectory:
    """Poses at increasing stamps.

    Parameters
    ----------
    stamps_ns : (N,) int64, strictly increasing
    T_map_body : (N, 4, 4)
    """

    stamps_ns: IntArray
    T_map_body: FloatArray

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @property
    def positions(self) -> FloatArray:
        """(N, 3) [m]."""
        return self.T_map_body[:, :3, 3]

    def take(self, index: IntArray | BoolArray) -> 'Trajectory':
        """The poses at ``index``."""
        return Trajectory(self.stamps_ns[index], self.T_map_body[index])

    def delayed(self, delay_ns: int) -> 'Trajectory':
        """The same poses at later stamps."""
        return Trajectory(self.stamps_ns + delay_ns, self.T_map_body)


def ordered(stamps_ns: IntArray, positions: FloatArray, quaternions: FloatArray) -> Trajectory:
    """Trajectory of poses with non-decreasing stamps; of several poses at one stamp, the first is kept."""
    first = np.ones(len(stamps_ns), np.bool_)
    first[1:] = np.diff(stamps_ns) > 0
    return Trajectory(stamps_ns[first], transform_from_quaternion(positions[first], quaternions[first]))


def read_tum(path: Path) -> Trajectory:
    """Trajectory of a TUM file, which may be empty.

    Raises
    ------
    InputError
        Unreadable or broken.
    """
    if path.is_file() and not path.stat().st_size:
        return ordered(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 4)))
    return ordered(*load_tum(path))


def read_truth(path: Path) -> Trajectory:
    """Ground truth from a TUM file, or from topic ``ground_truth/odometry`` of a bag.

    Raises
    ------
    InputError
        Neither, or a bag without that topic.
    """
    if not path.exists():
        raise InputError(f'{path}: no such ground truth (a TUM file or a bag)')
    if path.is_file() and path.suffix not in SINGLE_FILES:
        return read_tum(path)
    with BagReader(path) as bag:
        bag.require({TRUTH_TOPIC: 'nav_msgs/msg/Odometry'})
        rows = [_pose_row(item.message) for item in bag.messages([TRUTH_TOPIC])]
    rows.sort()
    values = np.array([row[1:] for row in rows])
    if not np.all(np.isfinite(values)) or np.any(np.linalg.norm(values[:, 3:], axis=1) < 0.5):
        raise InputError(f'{path}: ground truth with poses that are none')
    return ordered(np.array([row[0] for row in rows], dtype=np.int64), values[:, :3], values[:, 3:])


def _pose_row(message: object) -> tuple[int, ...]:
    stamp = message.header.stamp  # type: ignore[attr-defined]
    p, q = message.pose.pose.position, message.pose.pose.orientation  # type: ignore[attr-defined]
    return (stamp.sec * SECOND_NS + stamp.nanosec, p.x, p.y, p.z, q.x, q.y, q.z, q.w)
