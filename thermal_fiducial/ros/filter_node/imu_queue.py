"""The queue of IMU messages of the filter's node: catching up after a delay, and reporting the delay."""

from collections.abc import Callable
import time

from sensor_msgs.msg import Imu

from thermal_fiducial.config import PoseEkfConfig
from thermal_fiducial.core.measurements import ImuSample
from thermal_fiducial.core.types import SECOND_NS
from thermal_fiducial.ros.base import qos
from thermal_fiducial.ros.base.node import ERROR, OK, StageNode, WARN
from thermal_fiducial.ros.messages import message_bytes

#: Queueing delay [s] above which all queued messages are processed at once, with one pose for the newest.
_CATCH_UP_S = 0.03
#: Delay of the output [s] above which a warning and an error is reported (autopilots: VISO_DELAY_MS).
_LATE_S, _TOO_LATE_S = 0.1, 0.25


class ImuQueue:
    """Subscribes to ``imu/data``, and measures how long messages wait; in live nodes only.

    Parameters
    ----------
    node : the filter's node
    process : called with each serialised message that shall have a pose
    keep : called with each sample that is not the newest; returns whether it could be used
    """

    def __init__(
        self, node: StageNode[PoseEkfConfig], process: Callable[[bytes], None], keep: Callable[[ImuSample], bool]
    ) -> None:
        self._node, self._process, self._keep = node, process, keep
        #: number of usable messages without a pose of their own
        self.without_pose = 0
        #: queueing delay of the message measured last, and the longest since the last diagnostics [s]
        self._delay = self._longest = 0.0
        #: the longest in the previous diagnostics period [s]
        self._reported = 0.0
        self._input = node.subscribe(Imu, 'imu/data', self._on_message, qos.IMU_INPUT, raw=True)

    def _on_message(self, message: bytes) -> None:
        if self._delay > _CATCH_UP_S:
            for later in self._input.waiting(qos.IMU_INPUT.depth):
                self._node.guard(self._keep_one, message)
                message = later
            self._delay = 0.0
        self._process(message)

    def _keep_one(self, message: bytes) -> None:
        self.without_pose += self._keep(message_bytes.imu_sample(message))

    def measure(self) -> None:
        """Process the oldest queued message; its time in the queue is the delay of the output."""
        oldest = self._input.take() if self._node.live else None
        if oldest is not None:
            message, info = oldest
            self._delay = (time.time_ns() - info['received_timestamp']) / SECOND_NS
            self._longest = max(self._longest, self._delay)
            self._node.guard(self._on_message, message)

    def begin_period(self) -> None:
        """Report the longest delay of the period that ends, and begin another one."""
        self.measure()
        self._reported, self._longest = self._longest, 0.0

    def level(self) -> bytes:
        """Diagnostic level of the delay."""
        level: bytes = OK if self._reported < _LATE_S else ERROR if self._reported > _TOO_LATE_S else WARN
        return level

    def complaint(self) -> str:
        """The delay in words; empty while poses come in time."""
        return '' if self.level() == OK else f'overloaded: IMU messages wait for {self._reported:.2g} s'

    def headline(self) -> str:
        """The delay in words, without numbers; empty while poses come in time."""
        return '' if self.level() == OK else 'overloaded: poses are late'
