"""Rows of the ``markers`` topic."""

import numpy as np

from thermal_fiducial.core.geometry import se3
from thermal_fiducial.core.geometry.planar_pose import PlanarPoses
from thermal_fiducial.core.measurements import MARKER_DTYPE, Markers
from thermal_fiducial.core.types import FloatArray, IntArray

# All fields have four bytes: a row is a row of a table of numbers as well.
_COLUMN = {name: column for column, name in enumerate(MARKER_DTYPE.names or ())}
_NUMBER = np.dtype('<f4')


def _between(first: str, last: str) -> slice:
    return slice(_COLUMN[first], _COLUMN[last] + 1)


_CORNERS, _COVARIANCES = _between('u0', 'v3'), _between('c0uu', 'c3vv')
_POSITION, _ORIENTATION = _between('x', 'z'), _between('qx', 'qw')
_OTHER_POSITION, _OTHER_ORIENTATION = _between('ax', 'az'), _between('aqx', 'aqw')


def marker_rows(
    ids: IntArray,
    corners_px: FloatArray,
    covariances: FloatArray,
    poses: PlanarPoses,
    contrast: FloatArray | None = None,
) -> Markers:
    """Rows of N markers by rising ID, without those that have no pose.

    Parameters
    ----------
    ids : (N,)
    corners_px, covariances : (N, 4, 2) [px], (N, 4, 2, 2) [px^2]
    contrast : (N,) [counts], where it is known
    """
    rows = np.zeros(len(ids), dtype=MARKER_DTYPE)
    table = rows.view(_NUMBER).reshape(-1, len(_COLUMN))
    table[:, _CORNERS] = corners_px.reshape(-1, 8)
    terms = covariances.reshape(-1, 4, 4)[..., [0, 1, 3]]
    table[:, _COVARIANCES] = terms.reshape(-1, 12)
    rows['sigma_px'] = np.sqrt(0.125 * (terms[..., 0] + terms[..., 2]).sum(axis=1))
    if contrast is not None:
        rows['contrast_counts'] = contrast
    positions = poses.T_camera_marker[..., :3, 3]
    orientations = se3.quaternion_from_rotation(poses.T_camera_marker[..., :3, :3])
    table[:, _POSITION], table[:, _OTHER_POSITION] = positions[:, 0], positions[:, 1]
    table[:, _ORIENTATION], table[:, _OTHER_ORIENTATION] = orientations[:, 0], orientations[:, 1]
    rows['rms_px'], rows['arms_px'] = poses.rms_px[:, 0], poses.rms_px[:, 1]
    rows['id'] = ids
    usable = np.flatnonzero(np.isfinite(poses.rms_px[:, 0]))
    return np.asarray(rows[usable[np.argsort(ids[usable], kind='stable')]])
