"""A filter that was started again in flight: its last pose from before is a hint to which poses may be right."""

from dataclasses import dataclass

import numpy as np

from thermal_fiducial.core.geometry.se3 import inverse
from thermal_fiducial.core.measurements import CameraPose
from thermal_fiducial.core.types import FloatArray, SECOND_NS

#: Older poses [s] say nothing any more of where the robot is.
HINT_SECONDS = 10.0
#: A robot under control may be this far from its last pose [m], and so much farther for each second since [m/s].
_NEAR, _SPEED = 0.5, 3.0
#: As many poses in a row that contradict the hint prove it wrong: a second at 30 Hz.
_PROOF = 30


@dataclass(frozen=True)
class LastPose:
    """What a filter knew last."""

    stamp_ns: int
    #: (4, 4)
    T_map_body: FloatArray
    #: t_imu - t_camera [s]; None: not known
    camera_time_offset: float | None


class RestartHint:
    """Keeps poses of a wrong planar branch, or of a marker of the same ID elsewhere, from starting the filter.

    Parameters
    ----------
    last : what was known before
    T_body_camera : (4, 4)
    """

    def __init__(self, last: LastPose, T_body_camera: FloatArray) -> None:
        self._last = last
        self._T_camera_body = inverse(T_body_camera)
        self._contradictions = 0

    def contradiction(self, pose: CameraPose) -> float:
        """Distance [m] from the last pose of one that cannot be right by it; 0 where it may be."""
        seconds = (pose.stamp_ns - self._last.stamp_ns) / SECOND_NS
        if not 0.0 <= seconds <= HINT_SECONDS or self._contradictions >= _PROOF:
            return 0.0
        position = (pose.T_map_camera @ self._T_camera_body)[:3, 3]
        distance = float(np.linalg.norm(position - self._last.T_map_body[:3, 3]))
        if distance <= _NEAR + _SPEED * seconds:
            self._contradictions = 0
            return 0.0
        self._contradictions += 1
        return distance
