"""Node ``aruco_detector``: clean counts to markers with sub-pixel corners and poses."""

import sys
from typing import Any

from geometry_msgs.msg import PoseArray
import numpy as np
from sensor_msgs.msg import Image, PointCloud2

from thermal_fiducial.config import ArucoDetectorConfig, Tau2CameraConfig, unknown_markers
from thermal_fiducial.core.detection.detector import MarkerDetector
from thermal_fiducial.core.imaging.eight_bit_view import EightBitView
from thermal_fiducial.core.wording import number_of
from thermal_fiducial.files.dictionary import load_dictionary
from thermal_fiducial.files.images import image_to_array
from thermal_fiducial.ros.base import qos
from thermal_fiducial.ros.base.node import OK, WARN
from thermal_fiducial.ros.camera_nodes.camera_node import CameraStageNode
from thermal_fiducial.ros.camera_nodes.detections import OtherDetections
from thermal_fiducial.ros.camera_nodes.opencv import require_opencv
from thermal_fiducial.ros.camera_nodes.other_dictionaries import OtherDictionaries
from thermal_fiducial.ros.messages import clouds, convert, display, message_bytes
from thermal_fiducial.ros.process.run import run


class ArucoDetector(CameraStageNode[ArucoDetectorConfig]):
    """Detects markers; given the map and the filter's odometry it searches where they are predicted."""

    stage = 1

    def __init__(self, **kwargs: Any) -> None:
        require_opencv()
        super().__init__('aruco_detector', ArucoDetectorConfig, **kwargs)
        self.detector = self.attempt(self._make_detector, None)
        self._dictionaries = OtherDictionaries(self.config)
        self.view = EightBitView(Tau2CameraConfig())
        self._seen = 0
        self._markers = self.advertise(PointCloud2, 'markers')
        self._marker_poses = self.advertise(PoseArray, 'marker_poses')
        self._others = OtherDetections(self, self.config, self.fault)
        self._annotated = self.advertise(Image, 'thermal/image_markers', qos.IMAGE_OUTPUT)
        self._images = self.subscribe_newest(Image, 'thermal/image', self._on_image, qos.IMAGE_INPUT, raw=True)
        self.subscribe_to_camera_and_filter()
        self.subscribe(PointCloud2, 'marker_map', self._on_map, qos.LATCHED).regular = False

    def _make_detector(self) -> MarkerDetector | None:
        dictionary = load_dictionary(self.config.dictionary)
        self.remark(unknown_markers(self.config, len(dictionary.bits)))
        return MarkerDetector(self.config, dictionary)

    def configure(self, config: ArucoDetectorConfig) -> None:
        """Apply dynamic parameters."""
        super().configure(config)
        self._dictionaries.configure(config)
        if self.detector is not None:
            self.detector.configure(config)

    def _on_image(self, message: bytes) -> None:
        if self.detector is None:
            return
        image = message_bytes.image(message)
        counts, head = image_to_array(image), convert.header(image.stamp_ns, image.frame_id)
        markers = self.detector.detect(image.stamp_ns, counts, self.camera(), self.odometry)
        self._seen = len(markers)
        self._markers.send(clouds.MARKER_CLOUDS.message(markers, head))
        if self._marker_poses.listeners:
            self._marker_poses.send(clouds.marker_poses(markers, head))
        self._others.send(markers, head, self.detector.size)
        if self._annotated.listeners:
            gray = self.view(counts.astype(np.uint16, copy=False))
            self._annotated.send(convert.image(display.annotated(gray, markers), head))
        # If the camera's clock is known, the filter runs: earlier frames had markers of our dictionary.
        if self.odometry.clock_is_known:
            self._dictionaries.settle()
        self._dictionaries.look(image.stamp_ns, counts, self.camera(), any_seen=self._seen > 0)

    def _on_map(self, message: PointCloud2) -> None:
        if self.detector is not None:
            self.detector.set_map(*clouds.map_poses(message))

    def state(self) -> tuple[bytes, str]:
        """Number of markers in the last frame; another dictionary, blur, images skipped since the last call."""
        left = self._images.left_since()
        blurred = '' if self.detector is None else self.detector.focus.doubt
        doubts = [self._dictionaries.doubt, blurred, f'{left} older images skipped' if left else '']
        return WARN if any(doubts) else OK, '; '.join(filter(None, [number_of(self._seen, 'marker'), *doubts]))

    def headline(self) -> str:
        """That the markers in view are of another dictionary."""
        return self._dictionaries.doubt


def main() -> int:
    """Run the node."""
    return run(ArucoDetector)


if __name__ == '__main__':
    sys.exit(main())
