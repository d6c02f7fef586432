"""Base of detector and mapper: the camera calibration, and the filter's odometry as a motion prior."""

from collections.abc import Sequence
from typing import Any, TypeVar

from nav_msgs.msg import Odometry as OdometryMessage
from sensor_msgs.msg import TimeReference

from thermal_fiducial.config import ArucoDetectorConfig, MarkerMapperConfig
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.measurements import Odometry
from thermal_fiducial.core.motion_prior import MotionPrior
from thermal_fiducial.errors import InputError
from thermal_fiducial.ros.base import qos
from thermal_fiducial.ros.base.node import StageNode
from thermal_fiducial.ros.camera_nodes.latest_calibration import LatestCalibration
from thermal_fiducial.ros.frames.robot_frames import RobotFrames
from thermal_fiducial.ros.messages import message_bytes

CameraConfig = TypeVar('CameraConfig', bound=ArucoDetectorConfig | MarkerMapperConfig)


class CameraStageNode(StageNode[CameraConfig]):
    """A stage node that subscribes to ``thermal/camera_info`` (keeping the last valid one) and ``odometry``."""

    def __init__(self, name: str, kind: type[CameraConfig], **kwargs: Any) -> None:
        super().__init__(name, kind, **kwargs)
        self._calibration = LatestCalibration(self)
        #: the filter's latest states
        self.odometry = MotionPrior(self.config.camera_time_offset, self._read_odometry)

    def subscribe_to_camera_and_filter(self) -> None:
        """Subscribe to what is known of the camera, and to odometry and clock of the filter.

        Call it after subscribing to the node's main input.
        """
        self._calibration.follow('thermal/camera_info')
        self.subscribe_lazily(OdometryMessage, 'odometry', self._on_odometry, qos.IMU_INPUT)
        RobotFrames(self)
        # One for each pose of a camera: that there are none is for the filter to say.
        self.subscribe_lazily(TimeReference, 'camera_clock', self._on_camera_clock, qos.RESULT).regular = False

    def camera(self) -> Camera:
        """The calibration.

        Raises
        ------
        InputError
            None has been received yet.
        """
        return self._calibration.camera()

    def figures(self) -> dict[str, object]:
        """Number of different calibrations received."""
        return {'calibrations': self._calibration.count}

    def _on_odometry(self, message: bytes) -> None:
        """Keep odometry serialised: only the few states that a frame needs are decoded."""
        self.odometry.add(message_bytes.stamp_ns(message), message)

    def _read_odometry(self, messages: Sequence[bytes]) -> list[Odometry]:
        """Decode odometry; invalid messages are refused, and the frame is processed without prior."""
        try:
            return message_bytes.odometry(messages)
        except InputError as error:
            if len(messages) > 1:
                return [state for message in messages for state in self._read_odometry([message])]
            self.refuse(str(error))
            return []

    def _on_camera_clock(self, message: bytes) -> None:
        self.odometry.set_clock_offset(message_bytes.clock_offset(message))
