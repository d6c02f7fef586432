"""What the mapper says of the map beside its poses: how it has moved, and how uncertain it is."""

from collections import deque
from dataclasses import replace

import numpy as np

from thermal_fiducial.core.error_model import positive
from thermal_fiducial.core.measurements import CameraPose, in_moved_map
from thermal_fiducial.core.types import FloatArray

#: Corrections, and errors of the map, that are remembered.
_REMEMBERED = 10
#: What stands for no variance: a share of the largest, and this [m^2, rad^2].
_NO_SHARE, _NO_VARIANCE = 1e-9, 1e-15


def with_variance_everywhere(covariance: FloatArray) -> FloatArray:
    """A covariance (6, 6) of errors of the map, which may have none in some directions, as one that can be checked."""
    largest = max(float(covariance.diagonal().max()), 0.0)
    return np.asarray(covariance + (_NO_SHARE * largest + _NO_VARIANCE) * np.eye(6))


class MapCorrections:
    """Poses in the map as it is now; ``window`` [s]: what is older is of another clock."""

    def __init__(self, window: float) -> None:
        self._window_ns = window * 1e9
        self._corrections: deque[tuple[int, FloatArray]] = deque(maxlen=_REMEMBERED)
        self._errors: deque[CameraPose] = deque(maxlen=_REMEMBERED)
        #: of the latest pose that had one
        self._error: CameraPose | None = None

    def add(self, stamp_ns: int, T_new_old: FloatArray) -> None:
        """The map has moved by ``T_new_old`` (4, 4) after the frame of ``stamp_ns``."""
        self._corrections.append((stamp_ns, T_new_old))

    def note_error(self, error: CameraPose) -> None:
        """The map's error has the covariance of ``error`` there."""
        self._errors.append(error)

    def in_present_map(self, pose: CameraPose) -> CameraPose:
        """``pose``, which was found in the map of its stamp, in the map of now, with what it has of the map's error."""
        self._error = next((error for error in self._errors if error.stamp_ns == pose.stamp_ns), self._error)
        error = self._error
        if error is not None and abs(pose.stamp_ns - error.stamp_ns) <= self._window_ns:
            # The map's error changes slowly: that of the frame before will do, as far as this pose claims as much.
            relative = positive(pose.covariance - error.covariance)
            pose = replace(pose, map_covariance=pose.covariance - relative)
        for stamp_ns, T_new_old in self._corrections:
            if 0 <= stamp_ns - pose.stamp_ns <= self._window_ns:
                pose = in_moved_map(pose, T_new_old)
        return pose
