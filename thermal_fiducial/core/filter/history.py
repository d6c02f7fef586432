"""The latest IMU samples and poses, and what is known at each: poses come late, and in any order.

The belief at a sample is a function of the samples and poses up to it, ordered by time, never of the order in which
they came, but for the few samples after a pose that show its motion: a pose that comes late goes where it belongs, and
everything after it is computed again, at the cost of one inertial step a sample.
"""

from bisect import bisect_left, bisect_right, insort
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from thermal_fiducial.core.filter.recovery import Belief, Hypothesis
from thermal_fiducial.core.filter.update import MotionAtPose
from thermal_fiducial.core.measurements import CameraPose, in_moved_map
from thermal_fiducial.core.types import FloatArray

_SECOND_NS = 1_000_000_000
#: Farther than this [ns] an estimated clock offset never goes: the history is searched from there.
_LARGEST_OFFSET_NS = 200_000_000
#: Samples of so long [s] before and after a pose show its motion, if they have come: the noise of one would not.
_MOTION_SECONDS = 0.05


@dataclass(slots=True)
class Node:
    """An IMU sample (6,), the densities (6,) of the noise of the step that ends with it, and the belief there."""

    stamp_ns: int
    imu: FloatArray
    densities: FloatArray
    belief: Belief


@dataclass(frozen=True, slots=True)
class Instant:
    """Where a pose lies between two samples: ``time_ns`` in the clock of the IMU, and the sample (6,) there."""

    time_ns: int
    imu: FloatArray
    index: int


class History:
    """Samples, poses, and beliefs, kept for so many ``seconds``."""

    def __init__(self, seconds: float, offset_ns: int) -> None:
        self._kept_ns = round(seconds * _SECOND_NS)
        self._offset_ns = offset_ns
        self.nodes: list[Node] = []
        self.poses: list[CameraPose] = []

    def append(self, node: Node) -> None:
        """Add the newest sample; forget what no pose may reach any more."""
        self.nodes.append(node)
        horizon = node.stamp_ns - self._kept_ns
        # In blocks, as deleting from a list's head moves the rest.
        if self.nodes[len(self.nodes) // 2].stamp_ns < horizon:
            del self.nodes[: self.index_at(horizon)]
            oldest = self.nodes[0].stamp_ns - self._offset_ns - _LARGEST_OFFSET_NS
            del self.poses[: bisect_left(self.poses, oldest, key=_stamp)]

    def insert(self, pose: CameraPose) -> int:
        """Add a pose; the first node whose belief it may change."""
        insort(self.poses, pose, key=_stamp)
        return self._first_reached(pose)

    def _first_reached(self, pose: CameraPose) -> int:
        index = len(self.nodes)
        while index > 1 and self._reaches(pose, index - 1):
            index -= 1
        return index

    def discard(self, stamps_ns: Iterable[int]) -> int:
        """Forget poses by their stamps; the first node whose belief that may change."""
        stamps = set(stamps_ns)
        wrong = [pose for pose in self.poses if pose.stamp_ns in stamps]
        self.poses = [pose for pose in self.poses if pose.stamp_ns not in stamps]
        return min((self._first_reached(pose) for pose in wrong), default=len(self.nodes))

    def _reaches(self, pose: CameraPose, index: int) -> bool:
        belief = self.nodes[index - 1].belief
        hypotheses: list[Hypothesis | None] = [h for h in (belief.main, belief.alternative) if h]
        return any(self.due_ns(pose, h) <= self.nodes[index].stamp_ns for h in hypotheses or [None])

    def holds(self, stamp_ns: int) -> bool:
        """Whether there is a pose of this stamp."""
        place = bisect_left(self.poses, stamp_ns, key=_stamp)
        return place < len(self.poses) and self.poses[place].stamp_ns == stamp_ns

    def due_ns(self, pose: CameraPose, hypothesis: Hypothesis | None) -> int:
        """Instant of a pose in the clock of the IMU by a hypothesis's estimate of the offset."""
        offset = hypothesis.prediction.state.time_offset if hypothesis else 0.0
        return pose.stamp_ns + self._offset_ns + round(offset * _SECOND_NS)

    def next_pose(self, seen_ns: int, hypothesis: Hypothesis | None, until_ns: int) -> CameraPose | None:
        """The first pose after the stamp ``seen_ns`` that is due until an instant."""
        place = bisect_right(self.poses, seen_ns, key=_stamp)
        if place == len(self.poses) or self.due_ns(self.poses[place], hypothesis) > until_ns:
            return None
        return self.poses[place]

    def instant(self, index: int, time_ns: int) -> Instant:
        """An instant in the step that ends with node ``index``; before it, its beginning."""
        before, after = self.nodes[index - 1], self.nodes[index]
        time_ns = max(time_ns, before.stamp_ns)
        share = (time_ns - before.stamp_ns) / (after.stamp_ns - before.stamp_ns)
        return Instant(time_ns, before.imu + share * (after.imu - before.imu), index)

    def window(self, instant: Instant, seconds: float) -> FloatArray:
        """Samples (N, 6) of the last ``seconds`` up to an instant, the last one at it."""
        first = self.index_at(instant.time_ns - round(seconds * _SECOND_NS))
        return np.array([*(node.imu for node in self.nodes[first : instant.index]), instant.imu])

    def motion(self, instant: Instant, hypothesis: Hypothesis) -> MotionAtPose:
        """The motion at the instant of a pose, from the samples around it that have come."""
        nodes, index = self.nodes, instant.index
        before, after = nodes[index - 1 : index + 1]
        seconds = (after.stamp_ns - before.stamp_ns) / _SECOND_NS
        each_side = max(min(round(_MOTION_SECONDS / seconds), len(nodes) - index, index), 1)
        samples = np.array([node.imu for node in nodes[index - each_side : index + each_side]])
        since_pose = (instant.time_ns - hypothesis.accepted_ns) / _SECOND_NS
        return MotionAtPose(
            imu=samples.mean(axis=0),
            rate_variance=float(after.densities[0]) ** 2 / (seconds * len(samples)),
            velocity_variance=float(after.densities[3]) ** 2 * since_pose,
            turning=float(np.linalg.norm(after.imu[:3] - before.imu[:3])) / seconds,
        )

    def index_at(self, stamp_ns: int) -> int:
        """First node at ``stamp_ns`` or later."""
        return bisect_left(self.nodes, stamp_ns, key=_node_stamp)

    def move_map(self, T_new_old: FloatArray) -> None:
        """Move beliefs and poses with the map, T_new = T_new_old @ T_old."""
        for node in self.nodes:
            node.belief = node.belief.in_moved_map(T_new_old)
        self.poses = [in_moved_map(pose, T_new_old) for pose in self.poses]


_stamp: Callable[[CameraPose], int] = lambda pose: pose.stamp_ns  # noqa: E731
_node_stamp: Callable[[Node], int] = lambda node: node.stamp_ns  # noqa: E731
