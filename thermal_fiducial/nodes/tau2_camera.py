"""Node ``tau2_camera``: raw thermal frames to clean counts."""

from collections import Counter
import sys
from typing import Any

import numpy as np
from sensor_msgs.msg import CompressedImage, Image

from thermal_fiducial.config import Tau2CameraConfig
from thermal_fiducial.core.imaging.eight_bit_view import EightBitView
from thermal_fiducial.core.imaging.frame_cleaner import FrameCleaner, FROZEN
from thermal_fiducial.core.types import Counts, Gray
from thermal_fiducial.files.bad_pixel_list import load_bad_pixels
from thermal_fiducial.files.images import image_to_array
from thermal_fiducial.ros.base import qos
from thermal_fiducial.ros.base.node import OK, StageNode, WARN
from thermal_fiducial.ros.camera_nodes.calibration_output import CalibrationOutput
from thermal_fiducial.ros.messages import convert, message_bytes
from thermal_fiducial.ros.process.run import run


class Tau2Camera(StageNode[Tau2CameraConfig]):
    """Removes telemetry, replaces bad pixels, drops shutter and frozen frames, publishes a calibration from a file."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__('tau2_camera', Tau2CameraConfig, **kwargs)
        config = self.config
        file = config.bad_pixel_file
        bad_pixels = self.attempt(lambda: load_bad_pixels(file), None) if file else None
        self.cleaner = FrameCleaner(config, bad_pixels)
        self.view = EightBitView(config)
        self._calibration = CalibrationOutput(self)
        self._image = self.advertise(Image, 'thermal/image', qos.IMAGE_OUTPUT)
        self._image_mono8 = self.advertise(Image, 'thermal/image_mono8', qos.IMAGE_OUTPUT)
        self._withheld: Counter[str] = Counter()
        self._late = self._sent_before = 0
        self._reason = ''
        self._displayed = False
        if config.image_transport == 'compressed':
            # image_transport's convention: a suffix to the remapped raw topic.
            topic = self.resolve_topic_name('thermal/image_raw') + '/compressed'
            self.subscribe(CompressedImage, topic, self._on_compressed, qos.CAMERA_INPUT)
        else:
            self.subscribe(Image, 'thermal/image_raw', self._on_image, qos.CAMERA_INPUT, raw=True)

    def configure(self, config: Tau2CameraConfig) -> None:
        """Apply dynamic parameters."""
        super().configure(config)
        self.cleaner.config = self.view.config = config

    def _on_image(self, message: bytes) -> None:
        image = message_bytes.image(message)
        self._take_in(image.stamp_ns, image_to_array(image))

    def _on_compressed(self, message: CompressedImage) -> None:
        self._take_in(convert.stamp_ns(message.header.stamp), image_to_array(message))

    def _take_in(self, stamp: int, pixels: Counts | Gray) -> None:
        self._displayed = pixels.dtype == np.uint8
        frame = self.cleaner.process(stamp, pixels)
        self._reason = frame.reason
        self._late += frame.late
        if frame.counts is None:
            self._withheld[frame.reason] += 1
            return
        head = convert.header(stamp, self.config.frame_id)
        self._calibration.send(head)
        self._image.send(convert.image(frame.counts, head))
        if self._image_mono8.listeners:
            self._image_mono8.send(convert.image(self.view(frame.counts), head))

    def state(self) -> tuple[bytes, str]:
        """Why the last frame was dropped, and faults of the published frames."""
        if self._reason and not (self._reason == FROZEN and self.cleaner.repeating):
            return WARN, self._reason
        if self._displayed:
            return OK, 'ok, but 8-bit images: raw counts give corners ten times as accurate'
        return OK, 'ok'

    def headline(self) -> str:
        """Message if the image has been frozen for longer than a shutter event, which is over within a second."""
        sent_before, self._sent_before = self._sent_before, self._image.count
        return f'camera stalled: {self._reason}' if self._reason and self._image.count == sent_before else ''

    def figures(self) -> dict[str, object]:
        """Dropped frames by reason, frames out of order, number of bad pixels."""
        withheld: dict[str, object] = {f'withheld: {reason}': count for reason, count in self._withheld.items()}
        return withheld | {'late': self._late, 'bad pixels': len(self.cleaner.bad_pixels)}


def main() -> int:
    """Run the node."""
    return run(Tau2Camera)


if __name__ == '__main__':
    sys.exit(main())
