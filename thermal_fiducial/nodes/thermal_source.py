"""Node ``thermal_source``: raw frames of a thermal camera with capture stamps."""

import sys
from typing import Any

from sensor_msgs.msg import Image

from thermal_fiducial.cameras.capture import Capture
from thermal_fiducial.cameras.choice import longest_silence, make_source, unused_parameters
from thermal_fiducial.cameras.source import CapturedFrame
from thermal_fiducial.config import ThermalSourceConfig
from thermal_fiducial.ros.base import qos
from thermal_fiducial.ros.base.node import ERROR, OK, StageNode
from thermal_fiducial.ros.camera_nodes.calibration_output import CalibrationOutput
from thermal_fiducial.ros.messages import convert
from thermal_fiducial.ros.process.run import run


class ThermalSource(StageNode[ThermalSourceConfig]):
    """Publishes a camera's counts and calibration from a reader thread, without delay by the executor."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__('thermal_source', ThermalSourceConfig, **kwargs)
        config = self.config
        self.remark(unused_parameters(config))
        self._calibration = CalibrationOutput(self)
        self._image = self.advertise(Image, 'thermal/image_raw', qos.IMAGE_OUTPUT)
        self._source = self.attempt(lambda: make_source(config), None)
        self._capture: Capture | None = None
        if self._source is not None:
            self._capture = Capture(self._source, self.on_frame, self._on_change, stalled=longest_silence(config))

    def on_frame(self, frame: CapturedFrame) -> None:
        """Publish a frame; called by the reader thread."""
        self.guard(self._publish, frame)

    def _publish(self, frame: CapturedFrame) -> None:
        head = convert.header(frame.stamp_ns, self.config.frame_id)
        self._calibration.send(head)
        self._image.send(convert.image(frame.counts, head))

    def _on_change(self, trouble: str) -> None:
        if trouble:
            self.get_logger().warning(trouble)
        elif self._source is not None:
            self.get_logger().info(f'{self._source.name}: receiving frames')

    def state(self) -> tuple[bytes, str]:
        """Why there are no frames."""
        trouble = self._capture.trouble if self._capture is not None else ''
        return (ERROR, trouble) if trouble else (OK, 'ok')

    def figures(self) -> dict[str, object]:
        """Damaged frames by reason, number of reconnections."""
        events = {} if self._source is None else dict(self._source.events)
        return {'reconnections': self._capture.reconnections if self._capture else 0, **events}

    def close(self) -> None:
        """Release the camera."""
        if self._capture is not None:
            self._capture.close()
        super().close()


def main() -> int:
    """Run the node."""
    return run(ThermalSource)


if __name__ == '__main__':
    sys.exit(main())
