"""Node ``landing_target``: pose of the landing pad, for an autopilot behind mavros."""

import sys
from typing import Any

from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
import numpy as np
from sensor_msgs.msg import PointCloud2

from thermal_fiducial.config import LandingTargetConfig
from thermal_fiducial.core.geometry.se3 import camera_in_body, inverse
from thermal_fiducial.core.measurements import Observations
from thermal_fiducial.core.types import FloatArray
from thermal_fiducial.ros.base import qos
from thermal_fiducial.ros.base.node import OK, StageNode, WARN
from thermal_fiducial.ros.frames.landing_pad import for_mavros, needs_no_map, pad_in_map, WaitingFrames, what_lacks
from thermal_fiducial.ros.frames.map_corrections import MapCorrections
from thermal_fiducial.ros.frames.robot_frames import RobotFrames
from thermal_fiducial.ros.messages import clouds, convert, message_bytes
from thermal_fiducial.ros.process.run import run


class LandingTarget(StageNode[LandingTargetConfig]):
    """Publishes the pad with the stamp of each frame that shows one of its markers."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__('landing_target', LandingTargetConfig, **kwargs)
        if not self.config.landing_pad:
            self.fault('parameter landing_pad: name the markers of the pad')
        self._T_map_pad: FloatArray | None = None
        self._lacking = 'the pad is not in the map'
        self._frames = WaitingFrames()
        self._in_view = False
        self._corrections = MapCorrections()
        self._target = self.advertise(PoseStamped, 'landing_target')
        self.subscribe(PointCloud2, 'markers', self._on_markers, qos.RESULT, raw=True)
        self.subscribe(PoseWithCovarianceStamped, 'camera_pose', self._on_camera_pose, qos.RESULT, raw=True)
        self._corrections.follow_moves(self)
        self.subscribe(PointCloud2, 'marker_map', self._on_map, qos.LATCHED).regular = False
        RobotFrames(self)

    def _on_map(self, message: PointCloud2) -> None:
        pad, (poses, quarantined) = self.config.landing_pad, clouds.map_poses(message)
        trusted = {key: pose for key, (pose, _) in poses.items() if key not in quarantined}
        self._T_map_pad, self._lacking = pad_in_map(trusted, pad), what_lacks(pad, poses, quarantined)

    def _on_markers(self, message: bytes) -> None:
        stamp, markers = clouds.stamped_markers(message)
        every = Observations.of(markers)
        seen = every.only(np.isin(every.ids, self.config.landing_pad))
        self._in_view = len(seen.ids) > 0
        if not self._in_view:
            return
        T_camera_pad, without_pose = seen.branches[0, 0], self._T_map_pad is None or self._frames.stalled
        alone = without_pose and needs_no_map(self.config) and bool(np.isfinite(T_camera_pad).all())
        if alone:
            self._send_in_body(stamp, T_camera_pad)
        if self._T_map_pad is not None:
            self._frames.add(stamp, sent=alone)

    def _on_camera_pose(self, message: bytes) -> None:
        pose = self._corrections.in_present_map(message_bytes.camera_pose(message, self.config.map_frame))
        if self._T_map_pad is None or not self._frames.take(pose.stamp_ns):
            return
        if self.config.landing_target_frame == 'body':
            self._send_in_body(pose.stamp_ns, inverse(pose.T_map_camera) @ self._T_map_pad)
        else:
            self._send(pose.stamp_ns, self.config.map_frame, self._T_map_pad)

    def _send_in_body(self, stamp: int, T_camera_pad: FloatArray) -> None:
        self._send(stamp, f'{self.config.base_frame}_rfu', for_mavros(camera_in_body(self.config) @ T_camera_pad))

    def _send(self, stamp: int, frame: str, T_frame_pad: FloatArray) -> None:
        self._target.send(PoseStamped(header=convert.header(stamp, frame), pose=convert.pose(T_frame_pad)))

    def state(self) -> tuple[bytes, str]:
        """Whether the pad is known and in view."""
        if self._T_map_pad is None and not needs_no_map(self.config):
            return WARN, self._lacking
        if not self._in_view:
            return OK, 'the pad is not in view'
        return (WARN, 'the pad is in view, but its frames have no camera_pose') if self._frames.stalled else (OK, 'ok')


def main() -> int:
    """Run the node."""
    return run(LandingTarget)


if __name__ == '__main__':
    sys.exit(main())
