"""Node ``pose_ekf``: IMU and camera poses to the robot's pose and odometry, one for every IMU message."""

import sys
from typing import Any

from geometry_msgs.msg import PoseWithCovarianceStamped
from std_srvs.srv import Trigger

from thermal_fiducial.config import PoseEkfConfig
from thermal_fiducial.core.filter.ekf import PoseEkf
from thermal_fiducial.core.types import FloatArray
from thermal_fiducial.ros.base import qos
from thermal_fiducial.ros.base.node import StageNode
from thermal_fiducial.ros.filter_node.filter_memory import FilterMemory
from thermal_fiducial.ros.filter_node.filter_outputs import FilterOutputs
from thermal_fiducial.ros.filter_node.filter_status import FilterStatus
from thermal_fiducial.ros.filter_node.imu_queue import ImuQueue
from thermal_fiducial.ros.frames.map_corrections import MapCorrections
from thermal_fiducial.ros.frames.robot_frames import RobotFrames
from thermal_fiducial.ros.messages import message_bytes
from thermal_fiducial.ros.process.run import run


class PoseEkfNode(StageNode[PoseEkfConfig]):
    """Topics and services of the filter."""

    stage = 3

    def __init__(self, **kwargs: Any) -> None:
        super().__init__('pose_ekf', PoseEkfConfig, **kwargs)
        self._memory = FilterMemory(self)
        self.filter = PoseEkf(self.config)
        self._imu = ImuQueue(self, self._on_imu, self.filter.keep_imu)
        self._status = FilterStatus(self.filter, self._imu, self.console)
        self._corrections = MapCorrections()
        self.subscribe(PoseWithCovarianceStamped, 'camera_pose', self._on_camera_pose, qos.RESULT, raw=True)
        self._corrections.follow(self, self._on_map_moved)
        self._frames = RobotFrames(self, lambda: self.filter.reset('the pose of the camera on the robot has changed'))
        self._outputs = FilterOutputs(self, self.config, self.fault, self._frames)
        self.serve(Trigger, '~/reset', self._on_reset)

    def configure(self, config: PoseEkfConfig) -> None:
        """Apply the dynamic parameters of ``config``."""
        super().configure(config)
        self.filter.configure(config)

    def _on_imu(self, message: bytes) -> None:
        sample = message_bytes.imu_sample(message)
        self._frames.note_imu_frame(message_bytes.frame_id(message))
        odometry = self.filter.add_imu(sample)
        self._status.after_imu(sample.stamp_ns)
        self._outputs.send(odometry, lost=self.filter.lost, jumps=self._status.jumps)

    def _on_camera_pose(self, message: bytes) -> None:
        self.take_waiting()
        self._imu.measure()
        pose = self._corrections.in_present_map(message_bytes.camera_pose(message, self.config.map_frame))
        update = self.filter.add_pose(pose)
        self._status.after_pose(update)
        self._outputs.send_clock(update.stamp_ns, self.filter.camera_time_offset)

    def _on_map_moved(self, T_new_old: FloatArray) -> None:
        self.filter.move_map(T_new_old)
        self._outputs.clear_path()
        self._status.jumps += 1

    def _on_reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self.filter.reset()
        self._outputs.clear_path()
        response.success, response.message = True, 'waiting for the first camera_pose'
        return response

    def diagnose(self, stamp_ns: int) -> None:
        """Publish the diagnostics and, while someone listens, the path."""
        self._imu.begin_period()
        super().diagnose(stamp_ns)
        self._outputs.send_path()
        self._memory.save(self.filter)

    def state(self) -> tuple[bytes, str]:
        """Level and message: status of the filter, reason of the last refusal, delay, unknown frame of the IMU."""
        return self._status.state(self._frames.doubt)

    def headline(self) -> str:
        """Status of the filter without numbers."""
        return self._status.headline()

    def figures(self) -> dict[str, object]:
        """Key-value pairs of the filter for the diagnostics."""
        return self._status.figures() | self._outputs.figures()


def main() -> int:
    """Run the node."""
    return run(PoseEkfNode)


if __name__ == '__main__':
    sys.exit(main())
