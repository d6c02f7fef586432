"""Node ``pose_ekf``: IMU and camera poses to the robot's pose and odometry, one for every IMU message."""

from collections import deque
import re
import sys
from typing import Any

from geometry_msgs.msg import Pose, PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import Odometry as OdometryMessage
from nav_msgs.msg import Path
from sensor_msgs.msg import Imu, TimeReference
from std_srvs.srv import Trigger

from thermal_fiducial.config import PoseEkfConfig
from thermal_fiducial.core.filter.innovations import INNOVATIONS, innovations_text
from thermal_fiducial.core.filter.pose_ekf import PoseEkf
from thermal_fiducial.core.measurements import CameraPose, in_moved_map, Odometry
from thermal_fiducial.core.types import FloatArray
from thermal_fiducial.ros import convert, qos
from thermal_fiducial.ros.bridge import FlightControllerBridge
from thermal_fiducial.ros.node import ERROR, OK, StageNode, WARN
from thermal_fiducial.ros.run import run
from thermal_fiducial.ros.transforms import TransformBroadcaster

_PATH_STEP_NS = 200_000_000
_PATH_LENGTH = 3000
#: Corrections of the map that a late pose may have to follow.
_CORRECTIONS = 10


class PoseEkfNode(StageNode[PoseEkfConfig]):
    """The filter behind topics."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__('pose_ekf', PoseEkfConfig, **kwargs)
        self.realtime_priority = self.config.realtime_priority
        self.filter = PoseEkf(self.config)
        #: what is published of each IMU message: one message that is filled anew, seen as two
        self._message = convert.odometry_frames(self.config.map_frame, self.config.base_frame)
        self._pose_message = PoseWithCovarianceStamped(header=self._message.header, pose=self._message.pose)
        self._path: deque[tuple[int, Pose]] = deque(maxlen=_PATH_LENGTH)
        self._last_refusal = ''
        #: how often the pose has jumped: fresh starts and corrections of the map
        self._jumps = 0
        self._resets: int | None = None
        #: stamps of the poses whose innovations were told
        self._told: set[int] = set()
        self._corrections: deque[tuple[int, FloatArray]] = deque(maxlen=_CORRECTIONS)
        self._pose = self.advertise(PoseWithCovarianceStamped, 'pose', qos.IMU_RATE_RESULT)
        self._odometry = self.advertise(OdometryMessage, 'odometry', qos.IMU_RATE_RESULT)
        self._camera_clock = self.advertise(TimeReference, 'camera_clock', qos.RESULT)
        self._path_output = self.advertise(Path, 'path')
        if self.config.smoothing_time > 0.0:
            self._smooth_odometry = self.advertise(OdometryMessage, 'odometry_smooth', qos.IMU_RATE_RESULT)
        self._bridge = FlightControllerBridge(self, self.config, self.fault)
        self._transforms = TransformBroadcaster(self, self.config, self.fault) if self.config.publish_tf else None
        self.subscribe(Imu, 'imu/data', self._on_imu, qos.IMU_INPUT)
        self.subscribe(PoseWithCovarianceStamped, 'camera_pose', self._on_camera_pose, qos.RESULT)
        self.subscribe(TransformStamped, 'map_correction', self._on_map_correction, qos.RESULT)
        self.serve(Trigger, '~/reset', self._on_reset)

    def configure(self, config: PoseEkfConfig) -> None:
        """Take over the live parameters of ``config``."""
        super().configure(config)
        self.filter.configure(config)

    def _on_imu(self, message: Imu) -> None:
        odometry = self.filter.add_imu(convert.imu_sample(message))
        self._count_jumps()
        if odometry is None:
            return
        convert.fill_odometry(self._message, odometry)
        lost = self.filter.lost
        if self.config.publish_lost or not lost:
            self._pose.send(self._pose_message)
        self._odometry.send(self._message)
        smooth = self.filter.smooth
        if self._transforms is not None and not lost:
            self._transforms.send(odometry, smooth)
        if smooth is not None:
            convert.fill_odometry(self._message, smooth)
            self._smooth_odometry.send(self._message)
        if not lost:
            self._bridge.send(smooth or odometry, self._jumps)
        self._extend_path(odometry)

    def _count_jumps(self) -> None:
        resets = None if self.filter.state is None else self.filter.resets
        self._jumps += resets is not None and resets != self._resets
        self._resets = resets

    def _on_camera_pose(self, message: PoseWithCovarianceStamped) -> None:
        update = self.filter.add_pose(self._in_present_map(convert.camera_pose(message)))
        self._last_refusal = '' if update.accepted or update.pending else update.reason
        if (offset := self.filter.camera_time_offset) is not None:
            self._camera_clock.send(convert.clock_reference(update.stamp_ns, offset))

    def _on_map_correction(self, message: TransformStamped) -> None:
        correction = convert.correction_of(message)
        self._corrections.append(correction)
        self.filter.move_map(correction[1])
        self._jumps += 1

    def _in_present_map(self, pose: CameraPose) -> CameraPose:
        """A pose that a correction overtook, moved like the map."""
        window = self.config.max_delay * 1e9
        for stamp_ns, T_new_old in self._corrections:
            if 0 <= stamp_ns - pose.stamp_ns <= window:
                pose = in_moved_map(pose, T_new_old)
        return pose

    def _extend_path(self, odometry: Odometry) -> None:
        if not self._path or not 0 <= odometry.stamp_ns - self._path[-1][0] < _PATH_STEP_NS:
            self._path.append((odometry.stamp_ns, convert.pose(odometry.T_map_body)))

    def _on_reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self.filter.reset()
        self._path.clear()
        response.success, response.message = True, 'waiting for the first camera_pose'
        return response

    def diagnose(self, stamp_ns: int) -> None:
        """Publish the diagnostics and, while someone listens, the path."""
        super().diagnose(stamp_ns)
        if self._path and self._path_output.listeners:
            self._path_output.send(convert.path(self._path, convert.header(self._path[-1][0], self.config.map_frame)))

    def state(self) -> tuple[bytes, str]:
        """What the filter says of itself, and why it refused the last pose."""
        status = self.filter.status
        level = ERROR if self.filter.lost else OK if status == 'tracking' else WARN
        if self._last_refusal and not self.filter.lost:
            return WARN, f'{status}; pose {self._last_refusal}'
        return level, status

    def headline(self) -> str:
        """What the filter does, without numbers."""
        return re.split(r'[:\d]', self.filter.status)[0].removesuffix(' for ')

    def figures(self) -> dict[str, object]:
        """The filter in numbers."""
        numbers: dict[str, object] = {name: f'{value:.6g}' for name, value in self.filter.diagnostics().items()}
        return numbers | {'lost': self.filter.lost, 'jumps': self._jumps, INNOVATIONS: self._innovations()}

    def _innovations(self) -> str:
        """Those of the poses since the last time."""
        decided = self.filter.decided
        text = innovations_text(update for stamp, update in decided.items() if stamp not in self._told)
        self._told = set(decided)
        return text


def main() -> int:
    """Run the node."""
    return run(PoseEkfNode)


if __name__ == '__main__':
    sys.exit(main())
