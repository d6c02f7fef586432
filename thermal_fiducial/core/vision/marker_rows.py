"""Rows of the ``markers`` topic."""

import numpy as np

from thermal_fiducial.core import geometry
from thermal_fiducial.core.corners import RefinedCorners
from thermal_fiducial.core.measurements import CORNER_COVARIANCE_FIELDS, CORNER_FIELDS, MARKER_DTYPE, Markers
from thermal_fiducial.core.pose import PlanarPose
from thermal_fiducial.core.types import FloatArray, IntArray

_POSE = ('x', 'y', 'z', 'qx', 'qy', 'qz', 'qw')
_ALTERNATIVE = ('ax', 'ay', 'az', 'aqx', 'aqy', 'aqz', 'aqw')


def marker_rows(ids: IntArray, refined: RefinedCorners, poses: list[PlanarPose]) -> Markers:
    """Rows of N markers by rising ID, without those that have no pose."""
    rows = np.zeros(len(ids), dtype=MARKER_DTYPE)
    rows['id'] = ids
    _fill(rows, CORNER_FIELDS, refined.corners_px.reshape(-1, 8))
    covariances = refined.covariances
    terms = np.stack([covariances[..., 0, 0], covariances[..., 0, 1], covariances[..., 1, 1]], axis=-1)
    _fill(rows, CORNER_COVARIANCE_FIELDS, terms.reshape(-1, 12))
    rows['sigma_px'] = np.sqrt(0.5 * np.trace(covariances, axis1=-2, axis2=-1).mean(axis=-1))
    rows['contrast_counts'] = refined.contrast
    _fill(rows, _POSE, _pose_fields(np.stack([pose.T_camera_marker for pose in poses])))
    _fill(rows, _ALTERNATIVE, _pose_fields(np.stack([pose.T_alternative for pose in poses])))
    rows['rms_px'] = [pose.rms_px for pose in poses]
    rows['arms_px'] = [pose.alternative_rms_px for pose in poses]
    return np.sort(rows[np.isfinite(rows['rms_px'])], order='id')


def _pose_fields(T: FloatArray) -> FloatArray:
    return np.concatenate([T[:, :3, 3], geometry.quaternion_from_rotation(T[:, :3, :3])], axis=-1)


def _fill(rows: Markers, names: tuple[str, ...], values: FloatArray) -> None:
    for column, name in enumerate(names):
        rows[name] = values[:, column]
