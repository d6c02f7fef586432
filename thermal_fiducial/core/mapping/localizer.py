"""The camera from frame to frame: localization with what it has learned of corners, motion and attitude."""

import numpy as np

from thermal_fiducial.core.error_model import SystematicErrors
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.mapping.corner_bias import CornerBias
from thermal_fiducial.core.mapping.localization import locate
from thermal_fiducial.core.mapping.located import Located, Refusal, Sight
from thermal_fiducial.core.mapping.motion import CameraMotion
from thermal_fiducial.core.measurements import CameraPose
from thermal_fiducial.core.types import FloatArray

#: A pose of the past decides between alternative poses for this long [ns].
CONTINUITY_NS = 300_000_000


class Localizer:
    """Locates frames in succession in one map."""

    def __init__(self) -> None:
        self._bias = CornerBias(SystematicErrors())
        self._motion = CameraMotion()
        #: the last pose that nothing contradicted
        self.last: CameraPose | None = None

    @property
    def corner_bias_px(self) -> float:
        """Systematic error of the corners, as learned so far [px]."""
        return self._bias.px

    def map_changed(self) -> None:
        """Poses of now and of before belong to different maps: their difference is no motion."""
        self._motion = CameraMotion()

    def locate(
        self,
        stamp_ns: int,
        sight: Sight,
        running_errors: FloatArray,
        camera: Camera,
        expected: FloatArray | None,
        errors: SystematicErrors,
    ) -> Located | Refusal:
        """Where the camera is.

        Parameters
        ----------
        running_errors : (N,) re-projection error of each marker so far [px]
        expected : (4, 4) T_map_camera by the odometry, if there is any
        """
        last = self.last
        if expected is None and last is not None and 0 < stamp_ns - last.stamp_ns < CONTINUITY_NS:
            expected = last.T_map_camera
        location = locate(sight, running_errors, camera, expected, errors)
        if isinstance(location, Refusal):
            return location
        ids = np.array([marker.id for marker in sight.markers])
        self._bias.add(stamp_ns, ids, location.seen.residuals, location.errors.visible)
        delay = self._motion.delay_covariance(stamp_ns, location.T_map_camera, errors)
        systematic = location.errors.systematic + delay
        covariance = location.errors.white + systematic
        used = tuple(ids.tolist())
        return Located(
            location, CameraPose(stamp_ns, location.T_map_camera, covariance, systematic, used, location.rms_px)
        )
