"""Outputs for a flight controller: decimated odometry, only while the pose is usable, in each autopilot's format.

mavros takes nav_msgs/Odometry (``odometry/out``) or PoseWithCovarianceStamped
(``vision_pose/pose_cov``) in ENU and FLU and converts; PX4 over uXRCE-DDS takes px4_msgs/VehicleOdometry in FRD.
"""

from collections.abc import Callable
import importlib
from typing import Any

from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry as OdometryMessage
import numpy as np

from thermal_fiducial.config import PoseEkfConfig
from thermal_fiducial.core.measurements import Odometry
from thermal_fiducial.core.types import FloatArray, SECOND_NS
from thermal_fiducial.ros.base import qos
from thermal_fiducial.ros.base.counting import CountingNode
from thermal_fiducial.ros.messages import convert
from thermal_fiducial.ros.messages.message_bytes import StateBytes

#: Turns forward-left-up axes into forward-right-down ones, and back.
FLU_TO_FRD = np.array([1.0, -1.0, -1.0])
PX4_TOPIC = 'fmu/in/vehicle_visual_odometry'


class FlightControllerBridge:
    """Outputs for a flight controller at ``bridge_rate``; none if it is 0.

    Parameters
    ----------
    node : the filter's node, which gets the publishers
    config : frames, rate
    fault : called with a message if a configured output is unavailable
    """

    def __init__(self, node: CountingNode, config: PoseEkfConfig, fault: Callable[[str], None]) -> None:
        self._period_ns = round(SECOND_NS / config.bridge_rate) if config.bridge_rate > 0.0 else 0
        self._due_ns = 0
        #: resolved name of the topic of its odometry; empty without one
        self.topic = ''
        self._px4: Any = None
        if not self._period_ns:
            return
        self._odometry = node.advertise(OdometryMessage, 'bridge/odometry')
        self.topic = self._odometry.topic
        self._pose = node.advertise(PoseWithCovarianceStamped, 'bridge/pose')
        if config.px4:
            try:
                self._px4 = importlib.import_module('px4_msgs.msg').VehicleOdometry
            except ImportError:
                fault('parameter px4: px4_msgs is not installed')
            else:
                self._px4_odometry = node.advertise(self._px4, PX4_TOPIC, qos.RESULT)

    def send(self, odometry: Odometry, written: StateBytes, resets: int) -> None:
        """Publish ``odometry`` if the next message is due.

        Parameters
        ----------
        written : the same state, serialised
        resets : number of jumps of this pose; PX4 applies a jump to its state when this counter changes
        """
        stamp = odometry.stamp_ns
        if not self._period_ns or self._due_ns - self._period_ns < stamp < self._due_ns:
            return
        # Due times advance by whole periods (exact mean rate); a gap or backward clock jump resets them.
        on_time = abs(stamp - self._due_ns) < self._period_ns
        self._due_ns = (self._due_ns if on_time else stamp) + self._period_ns
        self._odometry.send(written.odometry)
        self._pose.send(written.pose)
        if self._px4 is not None:
            self._px4_odometry.send(px4_odometry(self._px4, odometry, resets))


def px4_odometry(kind: Any, odometry: Odometry, resets: int) -> Any:
    """px4_msgs/VehicleOdometry (``kind``) of the robot's state.

    The pose is in pose_frame FRD (the map turned to z down, arbitrary heading), velocities are in the body frame.
    Quaternions are w x y z; variances are diagonals, that of the orientation in the body frame.
    """
    message = kind()
    # timestamp 0: PX4 fills in the arrival time. timestamp_sample is the time of measurement [us].
    message.timestamp = 0
    message.timestamp_sample = odometry.stamp_ns // 1000
    place = convert.pose(odometry.T_map_body)
    q = place.orientation
    R = odometry.T_map_body[:3, :3]
    message.pose_frame = kind.POSE_FRAME_FRD
    message.position = _float32(FLU_TO_FRD * odometry.T_map_body[:3, 3])
    message.q = _float32(np.array([q.w, q.x, -q.y, -q.z]))
    message.velocity_frame = kind.VELOCITY_FRAME_BODY_FRD
    message.velocity = _float32(FLU_TO_FRD * odometry.velocity_body)
    message.angular_velocity = _float32(FLU_TO_FRD * odometry.angular_velocity_body)
    covariance = odometry.pose_covariance
    message.position_variance = _float32(np.diag(covariance)[:3])
    message.orientation_variance = _float32(np.diag(R.T @ covariance[3:, 3:] @ R))
    message.velocity_variance = _float32(np.diag(odometry.twist_covariance)[:3])
    message.reset_counter = resets % 256
    message.quality = 100
    return message


def _float32(values: FloatArray) -> 'np.ndarray[Any, np.dtype[np.float32]]':
    return np.asarray(values, dtype=np.float32)
