"""Extrinsics of camera and IMU on the robot: from TF, else from a URDF, else from the parameters."""

from collections.abc import Callable
import importlib
from typing import Any

from geometry_msgs.msg import TransformStamped
import numpy as np
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from std_msgs.msg import String

from thermal_fiducial.core.geometry.plausibility import doubt_of_place
from thermal_fiducial.core.geometry.se3 import camera_in_body, inverse, quaternion_from_rotation, rotation_angle
from thermal_fiducial.core.types import FloatArray
from thermal_fiducial.errors import InputError
from thermal_fiducial.ros.base import qos
from thermal_fiducial.ros.base.node import StageNode
from thermal_fiducial.ros.frames.frame_tree import fixed_joints, FrameTree
from thermal_fiducial.ros.messages import convert

_PARAMETERS, _URDF, _TF = 'the parameters', 'robot_description', '/tf_static'
#: Ascending precedence of the sources.
_RANKS = (_PARAMETERS, _URDF, _TF)
#: Wait for TF and URDF [s] before the parameters are reported as in use; both are latched and arrive within 1 s.
_PATIENCE = 2.0
#: Tolerance for equal poses, above the rounding of texts and quaternions [m, rad].
_SAME = 1e-6
#: Largest distance of the robot frame from the IMU [m]: the range of the parameter ``camera_position``.
_FARTHEST = 10.0
#: Longest name of a frame that is printed [characters].
_LONGEST_NAME = 100


class RobotFrames:
    """Subscribes to ``/tf_static`` and ``robot_description``, and configures the node with the poses found there.

    Create it after the node's main input; its subscriptions keep it alive.

    Parameters
    ----------
    node : its config has ``extrinsics``, ``base_frame``, ``camera_frame`` and the camera's pose
    on_moved : called after the node was configured with another pose of the camera
    """

    def __init__(self, node: StageNode[Any], on_moved: Callable[[], None] | None = None) -> None:
        self._node, self._on_moved = node, on_moved
        self._trees = {_URDF: FrameTree(), _TF: FrameTree()}
        self._imu_frame = ''
        # That the source has another pose now than the one in use; empty if it has not.
        self._moved = ''
        #: source of the camera's pose
        self.source = _PARAMETERS
        #: whether the wait for TF and URDF is over
        self.decided = not node.live
        #: pose (4, 4) of the robot frame in the IMU frame; None: they are identical
        self.T_imu_base: FloatArray | None = None
        if node.config.extrinsics == 'parameters':
            self.decided = True
            self._say()
            self._name_doubt()
            return
        node.subscribe(String, 'robot_description', self._on_description, qos.LATCHED)
        try:
            message = importlib.import_module('tf2_msgs.msg').TFMessage
        except ImportError:
            pass  # tf2_msgs is not installed: no TF
        else:
            node.subscribe(message, '/tf_static', self._on_static, qos.STATIC_TF)
        if node.live:
            clock = Clock(clock_type=ClockType.STEADY_TIME)
            self._timer = node.create_timer(_PATIENCE, self._give_up, clock=clock)
        else:
            self._name_doubt()

    @property
    def parameters_hold(self) -> bool:
        """Whether the wait is over and the parameters are the source."""
        return self.decided and self.source == _PARAMETERS

    @property
    def doubt(self) -> str:
        """That nothing says where the camera is, or two poses, or that the IMU's frame is unknown there; else empty."""
        if self._moved:
            return self._moved
        frame, base = self._imu_frame, self._node.config.base_frame
        if self.parameters_hold:
            return doubt_of_place('camera_position', self._node.config.camera_position)
        if not self.decided or not frame or self._is_on_robot(frame):
            return ''
        return f'IMU in frame {frame[:_LONGEST_NAME]!r}, not connected with {base} by {self.source}: taken for {base}'

    def note_imu_frame(self, frame: str) -> None:
        """Use the frame of an IMU message as the IMU frame, if TF or the URDF know it; a later one is only reported."""
        frame = frame.lstrip('/')
        if frame == self._imu_frame:
            return
        if self.source != _PARAMETERS and self._is_on_robot(self._imu_frame):
            text = f'IMU in frame {frame[:_LONGEST_NAME]!r}: ignored until the node is restarted'
            self._node.console.event('imu', text)
            return
        self._imu_frame = frame
        self._look()

    def _is_on_robot(self, frame: str) -> bool:
        return self._trees[self.source].between(frame, self._node.config.base_frame) is not None

    def _on_description(self, message: String) -> None:
        prefix = self._node.frame_prefix
        for parent, child, T_parent_child in fixed_joints(message.data):
            self._trees[_URDF].add(prefix + parent, prefix + child, T_parent_child)
        self._look()

    def _on_static(self, message: Any) -> None:
        for item in message.transforms:
            # One by one: a message may hold all static frames of a site, not only those of the robot.
            self._node.guard(self._add, item)
        self._look()

    def _add(self, item: TransformStamped) -> None:
        T_parent_child = convert.transform_of_message(item, f'/tf_static: {item.child_frame_id}')
        # Names of ROS 1 begin with a slash, which tf2 ignores.
        parent, child = item.header.frame_id.lstrip('/'), item.child_frame_id.lstrip('/')
        self._trees[_TF].add(parent, child, T_parent_child)

    def _look(self) -> None:
        """Adopt the pose of the best source; a later change by the same source is only reported."""
        for source in (_TF, _URDF):
            config, tree = self._node.config, self._trees[source]
            T_imu_base = tree.between(self._imu_frame, config.base_frame)
            if T_imu_base is not None and _same(T_imu_base, np.eye(4)):
                T_imu_base = None
            body = config.base_frame if T_imu_base is None else self._imu_frame
            T_body_camera = tree.between(body, config.camera_frame)
            if T_body_camera is None or _RANKS.index(source) < _RANKS.index(self.source):
                continue
            moved = not _same(T_body_camera, camera_in_body(config))
            # The IMU's frame may become known late; then the filter begins anew.
            begins = source != self.source or (self.T_imu_base is None and T_imu_base is not None)
            if not begins and (moved or not _same(T_imu_base, self.T_imu_base)):
                what = 'camera' if moved else 'IMU'
                ignored = 'ignored until the node is restarted; two robots need prefix_frames'
                self._moved = f'{source} has moved the {what} on the robot: {ignored}'
                break
            self._moved = ''
            self._take(source, T_body_camera, T_imu_base, moved=moved)
            break
        self._name_doubt()

    def _name_doubt(self) -> None:
        if self.doubt:
            self._node.console.event('frames', self.doubt)

    def _take(self, source: str, T_body_camera: FloatArray, T_imu_base: FloatArray | None, *, moved: bool) -> None:
        if T_imu_base is not None and not np.abs(T_imu_base[:3, 3]).max() < _FARTHEST:
            raise InputError(f'{source} has the robot {np.abs(T_imu_base[:3, 3]).max():.3g} m from its IMU')
        apart = inverse(camera_in_body(self._node.config)) @ T_body_camera
        if moved:
            orientation = quaternion_from_rotation(T_body_camera[:3, :3])
            self._node.derive(
                camera_position=tuple(T_body_camera[:3, 3].tolist()), camera_orientation=tuple(orientation.tolist())
            )
        new = source != self.source
        self.source, self.T_imu_base = source, T_imu_base
        if moved:
            angle_deg = np.degrees(rotation_angle(apart[:3, :3]))
            self._say(f', {np.linalg.norm(apart[:3, 3]):.3f} m and {angle_deg:.2f} deg from the previous pose')
            self._node.configure(self._node.config)
            if self._on_moved is not None:
                self._on_moved()
        elif new:
            self._say()

    def _give_up(self) -> None:
        self._timer.cancel()
        self.decided = True
        if self.source == _PARAMETERS:
            self._say()
        self._name_doubt()

    def _say(self, remark: str = '') -> None:
        config = self._node.config
        frame = self._imu_frame if self.T_imu_base is not None else config.base_frame
        line = f'camera on the robot ({config.camera_frame} in {frame}): from {self.source}{remark}'
        self._node.get_logger().info(line)


def _same(T: FloatArray | None, other: FloatArray | None) -> bool:
    if T is None or other is None:
        return T is other
    return bool(np.allclose(T, other, rtol=0.0, atol=_SAME))
