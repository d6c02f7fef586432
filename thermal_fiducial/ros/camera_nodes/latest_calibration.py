"""The calibration of a camera as its driver repeats it, mostly with each frame."""

from typing import Any

from sensor_msgs.msg import CameraInfo

from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.geometry.plausibility import doubt_of_resolution
from thermal_fiducial.errors import InputError
from thermal_fiducial.ros.base.node import StageNode
from thermal_fiducial.ros.messages import convert, message_bytes


class LatestCalibration:
    """The last valid ``camera_info`` of a topic.

    Parameters
    ----------
    node : warns of doubtful calibrations and changes
    name : of the second camera; empty: the first
    """

    def __init__(self, node: StageNode[Any], name: str = '') -> None:
        self._node = node
        self._what = f'camera_info of {name}' if name else 'camera_info'
        self._camera: Camera | None = None
        self._message = b''
        #: of the calibration, among the remarks of the node; empty without one
        self._doubt = ''
        #: number of different calibrations received
        self.count = 0

    def camera(self) -> Camera:
        """The calibration.

        Raises
        ------
        InputError
            None has been received yet.
        """
        if self._camera is None:
            raise InputError(f'no {self._what}')
        return self._camera

    def take(self, message: bytes) -> None:
        """Validate a serialised ``camera_info`` if it differs from the last one."""
        if message[message_bytes.BEHIND_STAMP :] == self._message:
            return
        camera = convert.camera(message_bytes.read(message, CameraInfo, 'camera_info'))
        self._message = message[message_bytes.BEHIND_STAMP :]
        if self._camera is not None and camera.matches(self._camera):
            return
        self._camera = camera
        self.count += 1
        if self._doubt:
            self._node.remarks.remove(self._doubt)
        self._doubt = doubt_of_resolution(camera)
        if self._doubt:
            self._node.remarks.append(self._doubt)
        changed = f'{self._what} has changed: the new calibration is used from here on' if self.count > 1 else ''
        if news := '; '.join(filter(None, [changed, self._doubt])):
            # Two drivers of one camera change it with each frame.
            self._node.console.event(self._what, news)
