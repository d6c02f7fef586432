"""What motion leaves unknown of camera poses.

All corners of a frame are displaced alike by what the detector's lag is not: a delay of the image, along its velocity,
and as the mean square of the delay, along its acceleration. No residual shows that, and no covariance of single
corners: it is an error of the pose, as large for many markers as for one, and the same for many frames.
"""

import numpy as np

from thermal_fiducial.core.error_model import delay_of_pose, SystematicErrors
from thermal_fiducial.core.geometry.reprojection import difference
from thermal_fiducial.core.types import FloatArray, SECOND_NS

# Poses farther apart than this say nothing of the velocity [s].
_STALE_S = 0.15


class CameraMotion:
    """Velocity of the camera and its change, from poses of successive frames."""

    def __init__(self) -> None:
        self._stamp_ns = 0
        self._T_map_camera: FloatArray | None = None
        self._velocity: FloatArray | None = None

    def delay_covariance(self, stamp_ns: int, T_map_camera: FloatArray, errors: SystematicErrors) -> FloatArray:
        """Covariance (6, 6), ROS convention, that the motion up to this pose adds to it."""
        dt = (stamp_ns - self._stamp_ns) / SECOND_NS
        velocity, covariance = None, np.zeros((6, 6))
        if self._T_map_camera is not None and 0.0 < dt < _STALE_S:
            velocity = difference(T_map_camera, self._T_map_camera) / dt
            acceleration = np.zeros(6) if self._velocity is None else (velocity - self._velocity) / dt
            covariance = delay_of_pose(velocity, acceleration, errors)
        self._stamp_ns, self._T_map_camera, self._velocity = stamp_ns, T_map_camera, velocity
        return covariance
