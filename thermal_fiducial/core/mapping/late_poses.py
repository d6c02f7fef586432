"""Poses of frames that arrive after the map has moved: in the map that their stamp stands for."""

import numpy as np

from thermal_fiducial.core.geometry.se3 import inverse
from thermal_fiducial.core.measurements import CameraPose, in_moved_map, LATEST_NS
from thermal_fiducial.core.types import FloatArray


class LatePoses:
    """Knows when the map has moved last, and how."""

    def __init__(self) -> None:
        #: stamp of the newest frame so far
        self.newest_ns = 0
        self._moved_ns = 0
        self._T_new_old: FloatArray = np.eye(4)

    def add(self, stamp_ns: int) -> None:
        """Take in the stamp of a frame; one of long before is that of a clock that was set back."""
        self.newest_ns = max(stamp_ns, self.newest_ns) if stamp_ns >= self.newest_ns - LATEST_NS else stamp_ns

    def moved(self, T_new_old: FloatArray) -> None:
        """The map has moved by (4, 4), after the newest frame."""
        self._moved_ns, self._T_new_old = self.newest_ns, T_new_old

    def as_of_its_stamp(self, pose: CameraPose) -> CameraPose:
        """``pose``, found in the map of now, in the map of its stamp."""
        if 0 <= self._moved_ns - pose.stamp_ns <= LATEST_NS:
            return in_moved_map(pose, inverse(self._T_new_old))
        return pose
