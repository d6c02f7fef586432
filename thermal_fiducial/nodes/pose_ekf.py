"""Node ``pose_ekf``: IMU and camera poses to the robot's pose and odometry, one for every IMU message."""

import sys
from typing import Any

from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from sensor_msgs.msg import Imu
from std_srvs.srv import Trigger

from thermal_fiducial.config import PoseEkfConfig
from thermal_fiducial.core.filter.ekf import PoseEkf
from thermal_fiducial.ros import convert, message_bytes, qos
from thermal_fiducial.ros.filter_memory import FilterMemory
from thermal_fiducial.ros.filter_outputs import FilterOutputs
from thermal_fiducial.ros.filter_status import FilterStatus
from thermal_fiducial.ros.map_corrections import MapCorrections
from thermal_fiducial.ros.node import ERROR, StageNode, WARN
from thermal_fiducial.ros.robot_frames import RobotFrames
from thermal_fiducial.ros.run import run

#: Queueing delay [s] above which IMU messages are processed as a batch, with one pose for the newest.
_QUEUE_S = 0.03
#: Delay of the output [s] above which a warning and an error is reported (autopilots: VISO_DELAY_MS).
_LATE_S, _TOO_LATE_S = 0.1, 0.25


class PoseEkfNode(StageNode[PoseEkfConfig]):
    """Topics and services of the filter."""

    stage = 3

    def __init__(self, **kwargs: Any) -> None:
        super().__init__('pose_ekf', PoseEkfConfig, **kwargs)
        self._memory = FilterMemory(self)
        self.filter = PoseEkf(self.config)
        self._status = FilterStatus(self.filter, self.console)
        self._corrections = MapCorrections(self.config.max_delay)
        self._imu = self.subscribe(Imu, 'imu/data', self._on_imu, qos.IMU_INPUT, raw=True)
        #: queueing delay of the latest IMU message, and the longest since the last diagnostics [s]
        self._waited = self._longest = 0.0
        #: the longest in the previous diagnostics period [s]
        self._behind = 0.0
        #: number of IMU messages without an output of their own
        self._without_pose = 0
        self.subscribe(PoseWithCovarianceStamped, 'camera_pose', self._on_camera_pose, qos.RESULT, raw=True)
        self.subscribe_lazily(PoseWithCovarianceStamped, 'camera_pose/map_error', self._on_map_error, qos.RESULT)
        self.subscribe(TransformStamped, 'map_correction', self._on_map_correction, qos.RESULT)
        self._frames = RobotFrames(self, self._mount)
        self._outputs = FilterOutputs(self, self.config, self.fault, self._frames)
        self.serve(Trigger, '~/reset', self._on_reset)

    def configure(self, config: PoseEkfConfig) -> None:
        """Apply the dynamic parameters of ``config``."""
        super().configure(config)
        self.filter.configure(config)

    def _mount(self) -> None:
        """Reset the filter after TF has changed the pose of the camera on the robot."""
        self.filter.configure(self.config)
        self.filter.reset('the camera is elsewhere on the robot')

    def _on_imu(self, message: bytes) -> None:
        if self._waited > _QUEUE_S:
            message = self._newest(message)
        self._frames.note_imu_frame(message_bytes.frame_id(message))
        sample = message_bytes.imu_sample(message)
        odometry = self.filter.add_imu(sample)
        self._status.after_imu(sample.stamp_ns)
        if odometry is not None:
            lost, jumps = self.filter.lost, self._status.jumps
            self._outputs.send(odometry, self.filter.smooth, lost=lost, jumps=jumps)

    def _newest(self, message: bytes) -> bytes:
        """The newest queued IMU message; older ones are buffered without output, to catch up."""
        for later in self._imu.waiting(qos.IMU_INPUT.depth):
            self.guard(self._keep, message)
            message = later
        self._waited = 0.0
        return message

    def _keep(self, message: bytes) -> None:
        self._without_pose += self.filter.keep_imu(message_bytes.imu_sample(message))

    def _on_camera_pose(self, message: bytes) -> None:
        self.take_waiting()
        if self.live:
            self._look_behind()
        pose = self._corrections.in_present_map(message_bytes.camera_pose(message))
        update = self._memory.refusal(self.filter, pose) or self.filter.add_pose(pose)
        self._status.after_pose(update)
        self._outputs.send_clock(update.stamp_ns, self.filter.camera_time_offset)

    def _on_map_error(self, message: bytes) -> None:
        self._corrections.note_error(message_bytes.map_error(message))

    def _on_map_correction(self, message: TransformStamped) -> None:
        stamp_ns, T_new_old = convert.correction_of(message)
        self._corrections.add(stamp_ns, T_new_old)
        self.filter.move_map(T_new_old)
        self._status.jumps += 1

    def _on_reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self.filter.reset()
        self._outputs.clear_path()
        response.success, response.message = True, 'waiting for the first camera_pose'
        return response

    def diagnose(self, stamp_ns: int) -> None:
        """Publish the diagnostics and, while someone listens, the path."""
        if self.live:
            self._look_behind()
        self._behind, self._longest = self._longest, 0.0
        super().diagnose(stamp_ns)
        self._outputs.send_path()
        self._memory.save(self.filter, self._outputs.stamp_ns)

    def _look_behind(self) -> None:
        """Process the next IMU message; its time in the queue is the delay of the output."""
        oldest = self._imu.take()
        if oldest is not None:
            message, self._waited = oldest
            self._longest = max(self._longest, self._waited)
            self.guard(self._on_imu, message)

    def state(self) -> tuple[bytes, str]:
        """Level and message: status of the filter, reason of the last refusal, delay."""
        level, words = self._status.state()
        if self._behind < _LATE_S:
            return level, words
        late = ERROR if self._behind > _TOO_LATE_S else WARN
        return max(level, late), f'{words}; no time: IMU messages wait for {self._behind:.2g} s'

    def headline(self) -> str:
        """Status of the filter without numbers."""
        words = self._status.headline()
        return words if self._behind < _LATE_S else f'{words}; no time: the pose comes late'

    def figures(self) -> dict[str, object]:
        """Key-value pairs of the filter for the diagnostics."""
        return self._status.figures() | {'IMU messages without a pose': self._without_pose}


def main() -> int:
    """Run the node."""
    return run(PoseEkfNode)


if __name__ == '__main__':
    sys.exit(main())
