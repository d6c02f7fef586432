"""The calibration from a file, published with each frame."""

from sensor_msgs.msg import CameraInfo
from std_msgs.msg import Header

from thermal_fiducial.config import Tau2CameraConfig, ThermalSourceConfig
from thermal_fiducial.files.camera_info import load_camera
from thermal_fiducial.ros.base import qos
from thermal_fiducial.ros.base.node import StageNode
from thermal_fiducial.ros.messages import convert


class CalibrationOutput:
    """Publishes ``thermal/camera_info`` if the parameter ``calibration_file`` of ``node`` names a calibration."""

    def __init__(self, node: StageNode[Tau2CameraConfig] | StageNode[ThermalSourceConfig]) -> None:
        file = node.config.calibration_file
        self._camera = node.attempt(lambda: load_camera(file), None) if file else None
        self._output = node.advertise(CameraInfo, 'thermal/camera_info', qos.IMAGE_OUTPUT) if file else None

    def send(self, head: Header) -> None:
        """Publish the calibration, if there is one, for the frame with the header ``head``."""
        if self._camera is not None and self._output is not None:
            self._output.send(convert.camera_info(self._camera, head))
