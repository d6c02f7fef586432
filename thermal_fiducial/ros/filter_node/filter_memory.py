"""Restart after a crash in flight: the filter's last pose and clock offset, saved to a file once a second."""

from contextlib import suppress
import math
import os

from thermal_fiducial.config import PoseEkfConfig
from thermal_fiducial.core.filter.belief import PoseUpdate
from thermal_fiducial.core.filter.ekf import PoseEkf
from thermal_fiducial.core.filter.hypotheses import KNOWN_OFFSET_STD
from thermal_fiducial.core.filter.initialization import LastPose, RestartHint
from thermal_fiducial.core.geometry.se3 import camera_in_body
from thermal_fiducial.core.measurements import CameraPose
from thermal_fiducial.files.last_pose import recent_pose, save_last_pose
from thermal_fiducial.files.robot_folder import robot_folder
from thermal_fiducial.ros.base.node import StageNode


class FilterMemory:
    """Saves the filter's state, and uses the one that a crashed filter of the same name left; only in live nodes.

    Parameters
    ----------
    node : the filter's node, whose config takes over the saved clock offset
    """

    def __init__(self, node: StageNode[PoseEkfConfig]) -> None:
        self._node = node
        self._hint: RestartHint | None = None
        self._active = node.live and node.config.resume
        name = node.get_fully_qualified_name().strip('/').replace('/', '_')
        domain = os.environ.get('ROS_DOMAIN_ID', '0')
        self._path = robot_folder() / f'{name}_{domain}.json'
        node.completions.append(self._forget)
        last = recent_pose(self._path) if self._active else None
        if last is not None:
            self._take_up(last)

    def _take_up(self, last: LastPose) -> None:
        config = self._node.config
        self._hint = RestartHint(last, camera_in_body(config))
        place = ' '.join(f'{value:.2f}' for value in last.T_map_body[:3, 3])
        line = f'started again in flight: the last pose before, at {place} m, is a hint to the first poses'
        if (offset := last.camera_time_offset) is not None and config.estimate_time_offset:
            std = min(config.time_offset_std, KNOWN_OFFSET_STD)
            self._node.derive(camera_time_offset=offset, time_offset_std=std)
            line += f'; the clock offset of {1e3 * offset:.1f} ms is kept'
        self._node.get_logger().warning(line)

    def refusal(self, filter_: PoseEkf, pose: CameraPose) -> PoseUpdate | None:
        """The refusal of an initial pose that contradicts the saved one; None if it does not."""
        if self._hint is None or filter_.estimate is not None:
            return None
        distance = self._hint.contradiction(pose)
        reason = f'refused: {distance:.1f} m from the last pose before the restart'
        return PoseUpdate(pose.stamp_ns, False, reason, math.nan) if distance else None

    def save(self, filter_: PoseEkf, stamp_ns: int) -> None:
        """Save the state at the IMU's ``stamp_ns`` for a restart.

        Raises
        ------
        InputError
            The file cannot be written; raised once.
        """
        state = filter_.state
        if not self._active or filter_.lost or state is None:
            return
        self._active = False
        save_last_pose(self._path, LastPose(stamp_ns, state.T_map_body, filter_.camera_time_offset))
        self._active = True

    def _forget(self) -> None:
        """Delete the file at the end of a flight: the next start is not in flight."""
        if self._active:
            # On a disk that became read-only the file stays; its age soon invalidates it.
            with suppress(OSError):
                self._path.unlink(missing_ok=True)
