"""Two known markers that contradict each other: odometry decides which of them has moved.

Of three markers one that has moved is an outlier of a robust fit. Of two either may have moved: the robust fit follows
one of them, now this and now that. What is unknown is discrete, which of them it is, and the camera as predicted by
odometry is the measurement that decides it.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from thermal_fiducial.core.error_model import INCONSISTENT_PX, of_single_error
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.geometry.reprojection import difference
from thermal_fiducial.core.mapping.localization import DECISIVE, names
from thermal_fiducial.core.mapping.located import error_std_px, Location, Refusal, Sight
from thermal_fiducial.core.mapping.trust import DISAGREEMENT
from thermal_fiducial.core.measurements import CameraPose
from thermal_fiducial.core.types import FloatArray


def are_two_that_contradict(location: Location) -> bool:
    """Whether the pose comes from two markers of which it does not fit at least one."""
    sight, seen = location.sight, location.seen
    if len(sight.markers) != 2:
        return False
    return bool(np.any(seen.errors_px > DISAGREEMENT * error_std_px(sight, seen, np.zeros((6, 6)))))


def settled(
    found: Location, camera: Camera, predicted: CameraPose, fit: Callable[[Sight], Location | Refusal]
) -> Location | Refusal:
    """The camera from the one of two contradicting markers that is where odometry predicts it.

    Where odometry does not decide, the pose is that of the marker nearer to the prediction, and may as well be that of
    the other: an error of the map.

    Parameters
    ----------
    found : the pose from both
    predicted : the camera by odometry, with its covariance
    fit : the pose from some of the markers
    """
    sight = found.sight
    apart = _distances(sight, camera, predicted)
    nearer = np.arange(2) == apart.argmin()
    if np.ptp(apart) > DECISIVE:
        return fit(sight.only(nearer))
    one, other = fit(sight.only(nearer)), fit(sight.only(~nearer))
    if isinstance(one, Refusal) or isinstance(other, Refusal):
        return contradicting(sight)
    spread = of_single_error(difference(other.pose.T_map_camera, one.pose.T_map_camera))
    pose = replace(
        found.pose,
        T_map_camera=one.pose.T_map_camera,
        covariance=one.pose.covariance + spread,
        map_covariance=one.pose.map_covariance + spread,
    )
    return replace(found, pose=pose)


def contradicting(sight: Sight) -> Refusal:
    """No pose from markers that contradict each other."""
    return Refusal(f'{names(sight)} contradict each other')


def _distances(sight: Sight, camera: Camera, predicted: CameraPose) -> FloatArray:
    """Squared Mahalanobis distances (N,), eight degrees of freedom, of N markers from where odometry predicts them."""
    seen = sight.reprojected(camera, predicted.T_map_camera)
    # A marker predicted behind the camera is not there.
    residuals = np.nan_to_num(seen.residuals, nan=float(camera.width)).reshape(-1, 8)
    of_camera = seen.J_camera @ predicted.covariance @ np.swapaxes(seen.J_camera, 1, 2)
    of_map = seen.J_marker @ sight.map_covariances @ np.swapaxes(seen.J_marker, 1, 2)
    own = (2.0 * sight.noise_px**2 + INCONSISTENT_PX**2)[:, None, None] * np.eye(8)
    weighted = np.linalg.solve(np.nan_to_num(of_camera + of_map) + own, residuals[..., None])[..., 0]
    return np.asarray((residuals * weighted).sum(axis=1))
