"""Corrections of the map that a late pose still has to follow."""

from collections import deque

from thermal_fiducial.core.measurements import CameraPose, in_moved_map
from thermal_fiducial.core.types import FloatArray

#: Corrections that are remembered.
_REMEMBERED = 10


class MapCorrections:
    """Moves poses that a correction overtook; ``window`` [s]: older poses are of another clock."""

    def __init__(self, window: float) -> None:
        self._window_ns = window * 1e9
        self._corrections: deque[tuple[int, FloatArray]] = deque(maxlen=_REMEMBERED)

    def add(self, stamp_ns: int, T_new_old: FloatArray) -> None:
        """The map has moved by ``T_new_old`` (4, 4) after the frame of ``stamp_ns``."""
        self._corrections.append((stamp_ns, T_new_old))

    def in_present_map(self, pose: CameraPose) -> CameraPose:
        """``pose``, which was found in the map of its stamp, in the map of now."""
        for stamp_ns, T_new_old in self._corrections:
            if 0 <= stamp_ns - pose.stamp_ns <= self._window_ns:
                pose = in_moved_map(pose, T_new_old)
        return pose
