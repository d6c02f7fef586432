"""A filter that restarts in flight: the last pose before serves to reject implausible poses at initialisation."""

from dataclasses import dataclass

import numpy as np

from thermal_fiducial.core.geometry.se3 import inverse
from thermal_fiducial.core.measurements import CameraPose
from thermal_fiducial.core.types import FloatArray, SECOND_NS

#: Longest time [s] for which the last pose still limits where the robot can be.
HINT_SECONDS = 10.0
#: Largest distance of the robot from its last pose: a constant [m] and a speed [m/s].
_NEAR, _SPEED = 0.5, 3.0
#: Poses in a row that contradict the hint until it is dropped: a second at 30 Hz.
_PROOF = 30


@dataclass(frozen=True)
class LastPose:
    """The last pose of a filter before it ended, and its clock offset."""

    stamp_ns: int
    #: (4, 4)
    T_map_body: FloatArray
    #: t_imu - t_camera [s]; None: not known
    camera_time_offset: float | None


class RestartHint:
    """Keeps the wrong branch of a planar pose, or a duplicated marker, from initialising a restarted filter.

    Parameters
    ----------
    last : state before the restart
    T_body_camera : (4, 4)
    """

    def __init__(self, last: LastPose, T_body_camera: FloatArray) -> None:
        self._last = last
        self._T_camera_body = inverse(T_body_camera)
        self._contradictions = 0

    def contradiction(self, pose: CameraPose) -> float:
        """Distance [m] of an implausibly far pose from the last one; 0 if the pose is plausible."""
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
