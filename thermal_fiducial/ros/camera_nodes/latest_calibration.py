"""The calibration of a camera as its driver repeats it, mostly with each frame."""

from typing import Any

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.qos import DurabilityPolicy
from sensor_msgs.msg import CameraInfo

from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.geometry.plausibility import doubt_of_resolution
from thermal_fiducial.errors import InputError
from thermal_fiducial.ros.base import qos
from thermal_fiducial.ros.base.node import StageNode
from thermal_fiducial.ros.messages import convert, message_bytes

# Messages of one calibration after which an earlier one is no longer expected to come back: ten seconds at 30 Hz.
_SETTLED = 300
# Time between looks for a publisher that sends none, as it has sent its only one before this node was there [s].
_LOOK_S = 1.0


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
        # The calibration before, messages since then, and whether the two come in turns.
        self._before: Camera | None = None
        self._since, self._in_turns = 0, False
        #: of the calibration, among the remarks of the node; empty without one
        self._doubt = ''
        #: number of different calibrations received
        self.count = 0

    def follow(self, topic: str) -> None:
        """Subscribe to a topic, and where its publisher is latched and sent the only message before, to that too.

        Not at once as a latched subscription: it would match no driver that repeats its calibration.
        """
        node, take = self._node, self.take
        node.subscribe_lazily(CameraInfo, topic, take, qos.CAMERA_INPUT)
        if not node.live:
            return

        def look() -> None:
            publishers = [] if self._camera else node.get_publishers_info_by_topic(node.resolve_topic_name(topic))
            if any(each.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL for each in publishers):
                node.subscribe_lazily(CameraInfo, topic, take, qos.LATCHED).regular = False
                timer.cancel()
            elif self._camera:
                timer.cancel()

        timer = node.create_timer(_LOOK_S, look, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def camera(self) -> Camera:
        """The calibration.

        Raises
        ------
        InputError
            None has been received yet, or two come in turns: each would give every other frame another lens.
        """
        if self._camera is None:
            raise InputError(f'no {self._what}')
        if self._in_turns:
            what = 'two calibrations in turns, of two drivers, or of one beside calibration_file'
            raise InputError(f'{self._what}: {what}: give one of them another topic')
        return self._camera

    def take(self, message: bytes) -> None:
        """Validate a serialised ``camera_info`` if it differs from the last one."""
        self._since += 1
        self._in_turns &= self._since < _SETTLED
        if message[message_bytes.BEHIND_STAMP :] == self._message:
            return
        camera = convert.camera(message_bytes.read(message, CameraInfo, 'camera_info'))
        self._message = message[message_bytes.BEHIND_STAMP :]
        if self._camera is not None and camera.matches(self._camera):
            return
        self._in_turns |= self._before is not None and camera.matches(self._before) and self._since < _SETTLED
        self._before, self._camera, self._since = self._camera, camera, 0
        self.count += 1
        if self._doubt:
            self._node.remarks.remove(self._doubt)
        self._doubt = doubt_of_resolution(camera)
        if self._doubt:
            self._node.remarks.append(self._doubt)
        used = self.count > 1 and not self._in_turns
        changed = f'{self._what} has changed: the new calibration is used from here on' if used else ''
        if news := '; '.join(filter(None, [changed, self._doubt])):
            # Two drivers of one camera change it with each frame.
            self._node.console.event(self._what, news)
