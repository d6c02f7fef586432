"""Output of the mapper: the camera pose of each frame, fused with that of a second camera if there is one."""

from dataclasses import replace
import math

from geometry_msgs.msg import PoseWithCovarianceStamped
from sensor_msgs.msg import PointCloud2

from thermal_fiducial.config import MarkerMapperConfig
from thermal_fiducial.core.error_model import covariance_of_mount
from thermal_fiducial.core.geometry.plausibility import doubt_of_place
from thermal_fiducial.core.geometry.se3 import camera_in_body
from thermal_fiducial.core.mapping.mapper import MarkerMapper
from thermal_fiducial.core.mapping.second_camera import SecondCamera
from thermal_fiducial.core.measurements import CameraPose
from thermal_fiducial.ros.base import qos
from thermal_fiducial.ros.camera_nodes.camera_node import CameraStageNode
from thermal_fiducial.ros.camera_nodes.latest_calibration import LatestCalibration
from thermal_fiducial.ros.frames.map_corrections import LatePoses
from thermal_fiducial.ros.messages import clouds
from thermal_fiducial.ros.messages.message_bytes import PoseBytes


class CameraPoses:
    """Publishes ``camera_pose``, and separately the part of its covariance that is due to the map's error.

    A second camera (parameter ``second_camera``) is located in the map of ``mapper`` but never changes it: markers
    enter the map, and go into quarantine, by what the first camera sees.
    """

    def __init__(self, node: CameraStageNode[MarkerMapperConfig], mapper: MarkerMapper) -> None:
        self._node, self._mapper = node, mapper
        #: transforms poses into the map as of their stamps
        self.late = LatePoses()
        self._output = node.advertise(PoseWithCovarianceStamped, 'camera_pose')
        self._map_error = node.advertise(PoseWithCovarianceStamped, 'camera_pose/map_error')
        self._bytes = PoseBytes(node.config.map_frame)
        self._config = node.config
        self._calibration = LatestCalibration(node, node.config.second_camera)
        self._second: SecondCamera | None = None
        self._locator: MarkerMapper | None = None
        #: why the last frame of the second camera gave no pose, in words
        self._reason = ''
        name = node.config.second_camera
        if name:
            doubt = doubt_of_place('second_camera_position', node.config.second_camera_position)
            node.remark(filter(None, [doubt]))
            self._second = _second_of(node.config)
            self._locator = MarkerMapper(_alone(node.config), mapper.map)
            node.subscribe_newest(PointCloud2, f'{name}/markers', self._on_second, qos.RESULT, raw=True)
            self._calibration.follow(f'{name}/thermal/camera_info')

    def configure(self) -> None:
        """Apply dynamic parameters; only a camera that has moved on the robot makes the clocks' difference unknown."""
        before, self._config = self._config, self._node.config
        if self._locator is not None:
            self._locator.configure(_alone(self._config))
            if _places(self._config) != _places(before):
                self._second = _second_of(self._config)

    def forget(self) -> None:
        """Drop what waits in a map that was replaced."""
        if self._second is not None:
            self._second.forget()

    def send(self, stamp_ns: int, pose: CameraPose | None) -> None:
        """Publish the pose of a frame of the first camera, if it has one, in the map as of its stamp."""
        self.late.add(stamp_ns)
        if pose is not None:
            self._publish(pose if self._second is None else self._second.with_second(pose, self._node.odometry))

    def _publish(self, pose: CameraPose) -> None:
        pose = self.late.as_of_its_stamp(pose)
        self._bytes.fill(pose.stamp_ns, pose.T_map_camera)
        # Before the pose, so that a subscriber of both has the map's error when the pose arrives.
        self._map_error.send(self._bytes.of(pose.map_covariance))
        self._output.send(self._bytes.of(pose.covariance))

    def _on_second(self, message: bytes) -> None:
        camera = self._calibration.camera()
        if self._second is None or self._locator is None:
            return
        self._locator.use_map_of(self._mapper)
        result = self._locator.process(*clouds.stamped_markers(message), camera, self._node.odometry)
        self._reason = '' if result.pose is not None else result.reason
        alone = None if result.pose is None else self._second.add_second(result.pose, self._node.odometry)
        if alone is not None:
            self._publish(alone)

    @property
    def doubts(self) -> str:
        """Rolling shutters that are not as declared, of both cameras; none by a map that is contradicted."""
        if self._mapper.doubt_of_map:
            # By such a map nothing is known of the time.
            return ''
        doubts = [self._mapper.readout.doubt]
        if self._locator is not None and (doubt := self._locator.readout.doubt):
            doubts.append(f'{self._config.second_camera}: {doubt}')
        return '; '.join(filter(None, doubts))

    def figures(self) -> dict[str, object]:
        """Counters of the second camera's poses, why the last frame gave none, and the difference of the clocks."""
        second = self._second
        if second is None:
            return {}
        words: dict[str, object] = {'joined': second.joined, 'alone': second.alone, 'contradicted': second.contradicted}
        clock = f'{1e3 * second.clock.seconds:.1f} +- {1e3 * math.sqrt(second.clock.variance):.1f}'
        more = {'no pose': self._reason, 'clock [ms]': clock}
        return {f'second camera: {word}': figure for word, figure in (words | more).items()}


def _places(config: MarkerMapperConfig) -> tuple[tuple[float, ...], ...]:
    """Position and orientation of both cameras on the robot."""
    second = config.second_camera_position, config.second_camera_orientation
    return config.camera_position, config.camera_orientation, *second


def _second_of(config: MarkerMapperConfig) -> SecondCamera:
    first, second = camera_in_body(config), camera_in_body(_alone(config))
    mounts = covariance_of_mount(config.extrinsics_position_std, config.extrinsics_orientation_std)
    return SecondCamera(first, second, mounts, config.time_offset_std, config.time_offset_random_walk)


def _alone(config: MarkerMapperConfig) -> MarkerMapperConfig:
    """Parameters of the mapper that localizes the second camera in a frozen map."""
    return replace(
        config,
        mode='localization',
        camera_position=config.second_camera_position,
        camera_orientation=config.second_camera_orientation,
    )
