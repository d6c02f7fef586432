"""The output of a mapper: the pose of the camera at each frame, or of a second one as the first's."""

from dataclasses import replace

from geometry_msgs.msg import PoseWithCovarianceStamped
from sensor_msgs.msg import CameraInfo, PointCloud2

from thermal_fiducial.config import MarkerMapperConfig
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.geometry.se3 import inverse, transform_from_quaternion
from thermal_fiducial.core.mapping.mapper import MarkerMapper
from thermal_fiducial.core.measurements import CameraPose, seen_from
from thermal_fiducial.errors import InputError
from thermal_fiducial.ros import clouds, convert, qos
from thermal_fiducial.ros.camera_node import CameraStageNode
from thermal_fiducial.ros.map_corrections import LatePoses
from thermal_fiducial.ros.message_bytes import PoseBytes

#: The second camera stands in when the first has had no pose for this long [ns].
_ALONE_NS = 120_000_000


class CameraPoses:
    """Publishes ``camera_pose`` for ``node``, and what of its covariance is the map's error.

    Where the first camera has had no pose for a while, the one that the parameter ``second_camera`` names stands in,
    with poses of the first: the filter has one camera. It is located in the map of ``mapper`` and never changes that.
    """

    def __init__(self, node: CameraStageNode[MarkerMapperConfig], mapper: MarkerMapper) -> None:
        self._node, self._mapper = node, mapper
        #: which map the poses are of
        self.late = LatePoses()
        self._output = node.advertise(PoseWithCovarianceStamped, 'camera_pose')
        self._map_error = node.advertise(PoseWithCovarianceStamped, 'camera_pose/map_error')
        self._bytes = PoseBytes(node.config.map_frame)
        self._second_camera: Camera | None = None
        #: stamp of the first camera's last pose, and how often the second stood in
        self._first_ns: int | None = None
        self._alone = 0
        name = node.config.second_camera
        self._second = MarkerMapper(_of_second(node.config), mapper.map)
        if name:
            node.subscribe_newest(PointCloud2, f'{name}/markers', self._on_second, qos.RESULT, raw=True)
            node.subscribe(CameraInfo, f'{name}/thermal/camera_info', self._on_camera_info, qos.CAMERA_INPUT)

    def configure(self) -> None:
        """Take over where the cameras are on the robot."""
        self._second.configure(_of_second(self._node.config))

    def send(self, stamp_ns: int, pose: CameraPose | None) -> None:
        """Publish the pose of a frame of the first camera, where there is one, in the map of its stamp."""
        self.late.add(stamp_ns)
        if pose is not None:
            self._first_ns = stamp_ns
            self._publish(pose)

    def _publish(self, pose: CameraPose) -> None:
        pose = self.late.as_of_its_stamp(pose)
        self._bytes.fill(pose.stamp_ns, pose.T_map_camera)
        # First what belongs to the pose: who uses both has it then.
        self._map_error.send(self._bytes.of(pose.map_covariance))
        self._output.send(self._bytes.of(pose.covariance))

    def _on_camera_info(self, message: CameraInfo) -> None:
        self._second_camera = convert.camera(message)

    def _on_second(self, message: bytes) -> None:
        config = self._node.config
        if self._second_camera is None:
            raise InputError(f'no camera_info of {config.second_camera}')
        self._second.map = self._mapper.map
        stamp, markers = clouds.stamped_markers(message)
        pose = self._second.process(stamp, markers, self._second_camera, self._node.odometry).pose
        if pose is not None and (self._first_ns is None or stamp - self._first_ns > _ALONE_NS):
            self._alone += 1
            first = transform_from_quaternion(config.camera_position, config.camera_orientation)
            second = transform_from_quaternion(config.second_camera_position, config.second_camera_orientation)
            self._publish(seen_from(pose, inverse(second) @ first))

    def figures(self) -> dict[str, object]:
        """How often the second camera stood in."""
        return {'second camera: alone': self._alone} if self._node.config.second_camera else {}


def _of_second(config: MarkerMapperConfig) -> MarkerMapperConfig:
    """Parameters of a mapper that locates the second camera, on a map that it leaves alone."""
    return replace(
        config,
        mode='localization',
        camera_position=config.second_camera_position,
        camera_orientation=config.second_camera_orientation,
    )
