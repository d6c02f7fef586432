"""Outputs of the filter: for every IMU message pose, odometry, bridge and TF; at a low rate the path."""

from collections.abc import Callable

from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry as OdometryMessage
from nav_msgs.msg import Path
from sensor_msgs.msg import TimeReference

from thermal_fiducial.config import PoseEkfConfig
from thermal_fiducial.core.filter.output import in_frame, SmoothOutput
from thermal_fiducial.core.measurements import Odometry
from thermal_fiducial.ros.base import qos
from thermal_fiducial.ros.base.counting import CountingNode
from thermal_fiducial.ros.filter_node.bridge import FlightControllerBridge
from thermal_fiducial.ros.frames.robot_frames import RobotFrames
from thermal_fiducial.ros.frames.transforms import TransformBroadcaster
from thermal_fiducial.ros.messages import convert
from thermal_fiducial.ros.messages.message_bytes import StateBytes
from thermal_fiducial.ros.messages.path_bytes import PathBytes


class FilterOutputs:
    """Publishers of the filter's node.

    Parameters
    ----------
    node : the filter's node
    config : frames, rates, optional outputs
    fault : called with a message if a configured output is unavailable
    frames : pose of the robot in the IMU frame
    """

    def __init__(
        self, node: CountingNode, config: PoseEkfConfig, fault: Callable[[str], None], frames: RobotFrames
    ) -> None:
        self._config, self._frames = config, frames
        self._state = StateBytes(config.map_frame, config.base_frame)
        self._path = PathBytes(config.map_frame)
        self._pose = node.advertise(PoseWithCovarianceStamped, 'pose', qos.IMU_RATE_RESULT)
        self._odometry = node.advertise(OdometryMessage, 'odometry', qos.IMU_RATE_RESULT)
        self._camera_clock = node.advertise(TimeReference, 'camera_clock')
        self._path_output = node.advertise(Path, 'path', qos.NEWEST_RESULT)
        self._smoother = SmoothOutput(config.smoothing_time) if config.smoothing_time > 0.0 else None
        if self._smoother is not None:
            self._smooth_odometry = node.advertise(OdometryMessage, 'odometry_smooth', qos.IMU_RATE_RESULT)
        self._bridge = FlightControllerBridge(node, config, fault)
        self._transforms = TransformBroadcaster(node, config, frames, fault) if config.publish_tf else None

    def send(self, odometry: Odometry | None, *, lost: bool, jumps: int) -> None:
        """Publish the state of the IMU frame after an IMU message, transformed to the robot's frame.

        Parameters
        ----------
        odometry : None: the filter has none
        lost : whether the pose is unfit to fly on
        jumps : number of jumps of the pose so far
        """
        smooth = odometry if self._smoother else None
        if self._smoother and odometry and not lost:
            smooth, jumps = self._smoother.follow(odometry), self._smoother.jumps
        elif self._smoother:
            self._smoother.begin_again()
        if odometry is None:
            return
        if (T_imu_base := self._frames.T_imu_base) is not None:
            odometry = in_frame(odometry, T_imu_base)
            smooth = None if smooth is None else in_frame(smooth, T_imu_base)
        self._state.fill(odometry)
        if self._config.publish_lost or not lost:
            self._pose.send(self._state.pose)
        self._odometry.send(self._state.odometry)
        if self._transforms is not None and not lost:
            self._transforms.send(odometry, smooth)
        if smooth is not None:
            self._state.fill(smooth)
            self._smooth_odometry.send(self._state.odometry)
        if not lost:
            # _state holds the smooth output if there is one, else the odometry.
            self._bridge.send(smooth or odometry, self._state, jumps)
        self._path.add(odometry.stamp_ns, odometry.T_map_body)

    def figures(self) -> dict[str, object]:
        """Key-value pairs for the diagnostics: topics that may be remapped, which the graph does not show."""
        return {convert.ODOMETRY_TOPIC: self._odometry.topic, convert.BRIDGE_TOPIC: self._bridge.topic}

    def send_clock(self, camera_stamp_ns: int, offset: float | None) -> None:
        """Publish the camera's clock offset [s] at the stamp of a frame, if it is known."""
        if offset is not None:
            self._camera_clock.send(convert.clock_reference(camera_stamp_ns, offset))

    def clear_path(self) -> None:
        """Start a new path after a discontinuity."""
        self._path.clear()

    def send_path(self) -> None:
        """Publish the path so far if it has subscribers."""
        if self._path_output.listeners and (path := self._path.message()):
            self._path_output.send(path)
