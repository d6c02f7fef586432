"""Markers of a frame as messages of other packages, and on /tf.

``aruco_opencv`` (aruco_opencv_msgs/ArucoDetection), ``apriltag`` (apriltag_msgs/AprilTagDetectionArray) and ``vision``
(vision_msgs/Detection3DArray), each only if its package is installed.
"""

from collections.abc import Callable
import importlib
from typing import Any

import cv2
from geometry_msgs.msg import TransformStamped, Vector3
import numpy as np
from std_msgs.msg import Header

from thermal_fiducial.config import ArucoDetectorConfig
from thermal_fiducial.core.measurements import corners_px, Markers
from thermal_fiducial.ros.base.node import StageNode
from thermal_fiducial.ros.messages import convert
from thermal_fiducial.ros.messages.annotations import image_annotations

#: Value of the parameter ``detections`` to package and message.
KINDS = {
    'aruco_opencv': ('aruco_opencv_msgs', 'ArucoDetection'),
    'apriltag': ('apriltag_msgs', 'AprilTagDetectionArray'),
    'vision': ('vision_msgs', 'Detection3DArray'),
}
# AprilTag's corners start at the lower left, counter-clockwise, in a square from -1 to 1 with y down.
_APRILTAG_ORDER = [3, 2, 1, 0]
_APRILTAG_SQUARE = np.array([[-1.0, 1.0], [1.0, 1.0], [1.0, -1.0], [-1.0, -1.0]], np.float32)
_THICKNESS = 0.01


class OtherDetections:
    """Optional outputs of the detector beside ``markers``.

    Parameters
    ----------
    node : the detector's node; its frame prefix applies to the markers' frames
    fault : called with a message if a configured output is unavailable
    """

    def __init__(self, node: StageNode[Any], config: ArucoDetectorConfig, fault: Callable[[str], None]) -> None:
        self._config, self._prefix = config, node.frame_prefix
        self._messages: Any = None
        self._broadcaster: Any = None
        if config.detections:
            package, name = KINDS[config.detections]
            try:
                self._messages = importlib.import_module(f'{package}.msg')
            except ImportError:
                fault(f'parameter detections: {package} is not installed')
            else:
                self._output = node.advertise(getattr(self._messages, name), 'detections')
        self._foxglove: Any = None
        if config.image_annotations:
            try:
                self._foxglove = importlib.import_module('foxglove_msgs.msg')
            except ImportError:
                fault('parameter image_annotations: foxglove_msgs is not installed; thermal/image_markers is the same')
            else:
                self._annotations = node.advertise(self._foxglove.ImageAnnotations, 'thermal/image_annotations')
        if config.publish_marker_tf:
            try:
                self._broadcaster = importlib.import_module('tf2_ros').TransformBroadcaster(node)
            except ImportError:
                fault('parameter publish_marker_tf: tf2_ros is not installed')

    def send(self, markers: Markers, head: Header, size: Callable[[int], float]) -> None:
        """Publish the markers of a frame, also when there are none; ``size``: side of a marker by its ID [m]."""
        if self._messages is not None:
            self._output.send(self._message(markers, head, size))
        if self._foxglove is not None and self._annotations.listeners:
            self._annotations.send(image_annotations(self._foxglove, markers, head))
        if self._broadcaster is not None and len(markers):
            self._broadcaster.sendTransform([_transform(row, head, self._prefix) for row in markers])

    def _message(self, markers: Markers, head: Header, size: Callable[[int], float]) -> Any:
        if self._config.detections == 'aruco_opencv':
            return aruco_opencv(self._messages, markers, head)
        if self._config.detections == 'apriltag':
            return apriltag(self._messages, markers, head, self._config.dictionary)
        return vision(self._messages, markers, head, [size(int(row['id'])) for row in markers])


def aruco_opencv(messages: Any, markers: Markers, head: Header) -> Any:
    """aruco_opencv_msgs/ArucoDetection, with the same marker frame: x right, y up, z out of the face."""
    result = messages.ArucoDetection()
    result.header = head
    for row in markers:
        marker = messages.MarkerPose()
        marker.marker_id, marker.pose = int(row['id']), convert.pose_of_row(row)
        result.markers.append(marker)
    return result


def apriltag(messages: Any, markers: Markers, head: Header, family: str) -> Any:
    """apriltag_msgs/AprilTagDetectionArray; ``decision_margin`` is the contrast [counts]."""
    result = messages.AprilTagDetectionArray()
    result.header = head
    for row, corners in zip(markers, corners_px(markers), strict=True):
        tag = messages.AprilTagDetection()
        tag.family, tag.id, tag.hamming = family, int(row['id']), 0
        tag.decision_margin = float(row['contrast_counts'])
        H = cv2.getPerspectiveTransform(_APRILTAG_SQUARE, corners[_APRILTAG_ORDER].astype(np.float32))
        tag.homography[:] = H.ravel().tolist()
        tag.centre.x, tag.centre.y = (float(value) for value in H[:2, 2])
        for place, index in enumerate(_APRILTAG_ORDER):
            tag.corners[place].x, tag.corners[place].y = (float(value) for value in corners[index])
        result.detections.append(tag)
    return result


def vision(messages: Any, markers: Markers, head: Header, sides: list[float]) -> Any:
    """vision_msgs/Detection3DArray; the class is the ID, the box the black square of ``sides`` [m]."""
    result = messages.Detection3DArray()
    result.header = head
    for row, side in zip(markers, sides, strict=True):
        detection, hypothesis = messages.Detection3D(), messages.ObjectHypothesisWithPose()
        hypothesis.hypothesis.class_id, hypothesis.hypothesis.score = str(row['id']), 1.0
        hypothesis.pose.pose = detection.bbox.center = convert.pose_of_row(row)
        detection.bbox.size = Vector3(x=side, y=side, z=_THICKNESS)
        detection.header, detection.id = head, str(row['id'])
        detection.results.append(hypothesis)
        result.detections.append(detection)
    return result


def _transform(row: Any, head: Header, prefix: str) -> TransformStamped:
    place = convert.pose_of_row(row)
    transform = TransformStamped(header=head, child_frame_id=f'{prefix}marker_{row["id"]}')
    p = place.position
    transform.transform.translation = Vector3(x=p.x, y=p.y, z=p.z)
    transform.transform.rotation = place.orientation
    return transform
