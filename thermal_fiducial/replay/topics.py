"""Played and recorded topics with message types and QoS, by the stage at which the bag enters."""

from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Protocol, TypeAlias

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseArray, PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import Odometry
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, Imu, PointCloud2
from visualization_msgs.msg import MarkerArray

from thermal_fiducial.config import NODES, OF_CAMERA
from thermal_fiducial.files.bags import (
    BagMessage,
    CAMERA_INFO_TOPIC,
    CAMERA_POSE_TOPIC,
    COMPRESSED_TOPIC,
    IMAGE_TOPIC,
    IMU_TOPIC,
    MAP_ERROR_TOPIC,
    MARKERS_TOPIC,
)
from thermal_fiducial.ros.base import qos

TopicTypes: TypeAlias = dict[str, tuple[type, Any]]


class Playable(Protocol):
    """A source of messages with the interface of a bag."""

    @property
    def start_ns(self) -> int:
        """Stamp of the first message."""

    def messages(self, topics: Iterable[str] | None = None) -> Iterator[BagMessage]:
        """The messages on ``topics`` in their order."""


PLAYED: TopicTypes = {
    IMAGE_TOPIC: (Image, qos.IMAGE_OUTPUT),
    COMPRESSED_TOPIC: (CompressedImage, qos.IMAGE_OUTPUT),
    CAMERA_INFO_TOPIC: (CameraInfo, qos.RESULT),
    MARKERS_TOPIC: (PointCloud2, qos.RESULT),
    MAP_ERROR_TOPIC: (PoseWithCovarianceStamped, qos.RESULT),
    CAMERA_POSE_TOPIC: (PoseWithCovarianceStamped, qos.RESULT),
    IMU_TOPIC: (Imu, qos.IMU_RATE_RESULT),
}
_RESULTS: dict[str, TopicTypes] = {
    'tau2_camera': {},
    'aruco_detector': {MARKERS_TOPIC: (PointCloud2, qos.RESULT), 'marker_poses': (PoseArray, qos.RESULT)},
    'marker_mapper': {
        MAP_ERROR_TOPIC: (PoseWithCovarianceStamped, qos.RESULT),
        CAMERA_POSE_TOPIC: (PoseWithCovarianceStamped, qos.RESULT),
        'marker_map': (PointCloud2, qos.LATCHED),
        'map_correction': (TransformStamped, qos.RESULT),
        'marker_map/markers': (MarkerArray, qos.LATCHED),
    },
    'pose_ekf': {
        'pose': (PoseWithCovarianceStamped, qos.IMU_RATE_RESULT),
        'odometry': (Odometry, qos.IMU_RATE_RESULT),
    },
}
_DIAGNOSTICS: TopicTypes = {'/diagnostics': (DiagnosticArray, qos.IMU_RATE_RESULT)}
_CALIBRATION: TopicTypes = {CAMERA_INFO_TOPIC: (CameraInfo, qos.RESULT)}
_IMAGES: TopicTypes = {'thermal/image': (Image, qos.IMAGE_OUTPUT)}


@dataclass(frozen=True)
class Entry:
    """Stage at which a bag enters the chain of nodes.

    Parameters
    ----------
    topic : main input of the first node
    skipped : number of nodes whose outputs the bag provides
    needs_calibration : whether a running node subscribes to ``thermal/camera_info``
    also : optional topics, played if the bag has them
    """

    topic: str
    skipped: int
    needs_calibration: bool = True
    also: tuple[str, ...] = ()

    @property
    def nodes(self) -> tuple[str, ...]:
        """The nodes to run, in order of the stages."""
        return tuple(NODES)[self.skipped :]

    def nodes_of_second(self, name: str) -> tuple[str, ...]:
        """The nodes to run for a second camera ``name``: those before the mapper."""
        return tuple(f'{name}/{node}' for node in self.nodes if node in OF_CAMERA)

    def played(self, *, calibration_from_file: bool) -> TopicTypes:
        """Required topics of the bag."""
        always = {topic: PLAYED[topic] for topic in (self.topic, IMU_TOPIC)}
        return always | self._of_camera(calibration_from_file=calibration_from_file)

    def played_of_second(self, name: str, *, calibration_from_file: bool) -> TopicTypes:
        """Required topics of a second camera ``name``."""
        own = self._of_camera(calibration_from_file=calibration_from_file)
        return {f'{name}/{topic}': played for topic, played in own.items()}

    def _of_camera(self, *, calibration_from_file: bool) -> TopicTypes:
        topics = [self.topic]
        # Only the first node publishes a calibration from a file.
        if self.needs_calibration and not (calibration_from_file and self.skipped == 0):
            topics.append(CAMERA_INFO_TOPIC)
        return {topic: PLAYED[topic] for topic in topics}

    def recorded_of_second(self, name: str, *, calibration_from_file: bool) -> TopicTypes:
        """Topics of a second camera ``name`` to record: its markers, and the calibration if its node publishes it."""
        topics = {MARKERS_TOPIC: PLAYED[MARKERS_TOPIC]} | (_CALIBRATION if calibration_from_file else {})
        return {f'{name}/{topic}': recorded for topic, recorded in topics.items()}

    def recorded(self, *, calibration_from_file: bool, images: bool) -> TopicTypes:
        """Topics to record: outputs of the nodes, or the bag's in their place; images only on request."""
        topics = {name: entry for node in self.nodes for name, entry in _RESULTS[node].items()}
        if self.skipped:
            return {self.topic: PLAYED[self.topic]} | topics | _DIAGNOSTICS
        return topics | _DIAGNOSTICS | (_CALIBRATION if calibration_from_file else {}) | (_IMAGES if images else {})


#: Entries by name, the earliest stage first.
ENTRIES = {
    'images': Entry(IMAGE_TOPIC, 0),
    'compressed': Entry(COMPRESSED_TOPIC, 0),
    'markers': Entry(MARKERS_TOPIC, 2),
    'poses': Entry(CAMERA_POSE_TOPIC, 3, needs_calibration=False, also=(MAP_ERROR_TOPIC,)),
}


def entry_of(topics: Collection[str]) -> Entry:
    """The earliest entry for a bag with ``topics``; if there is none, that of images, for the error message."""
    return next((entry for entry in ENTRIES.values() if entry.topic in topics), ENTRIES['images'])


def type_name(kind: Any) -> str:
    """ROS name of a message class, e.g. ``sensor_msgs/msg/Image``."""
    return f'{kind.__module__.split(".")[0]}/msg/{kind.__name__}'
