"""Rows of the ``markers`` topic as the mapper reads them."""

import numpy as np

from thermal_fiducial.core.geometry.se3 import transform_from_quaternion
from thermal_fiducial.core.measurements import columns, CORNER_COVARIANCE_FIELDS, corners_px, Markers
from thermal_fiducial.core.types import FloatArray


def usable(markers: Markers) -> Markers:
    """Rows with finite corners and covariances whose ID is there once: of two alike, nobody knows which is which."""
    ids, counts = np.unique(markers['id'], return_counts=True)
    twice = np.isin(markers['id'], ids[counts > 1])
    finite = np.all(np.isfinite(corners_px(markers)), axis=(1, 2))
    uu, uv, vv = np.moveaxis(columns(markers, CORNER_COVARIANCE_FIELDS).reshape(-1, 4, 3), -1, 0)
    sound = np.all((uu > 0.0) & (uu * vv > uv * uv), axis=1)
    return np.asarray(markers[~twice & finite & sound])


def marker_poses(rows: Markers, prefix: str) -> FloatArray:
    """T_camera_marker (N, 4, 4) of the rows' pose ('') or alternative pose ('a'), NaN where there is none."""
    q = columns(rows, tuple(f'{prefix}q{axis}' for axis in 'xyzw'))
    with np.errstate(invalid='ignore', divide='ignore'):
        return transform_from_quaternion(columns(rows, tuple(f'{prefix}{axis}' for axis in 'xyz')), q)
