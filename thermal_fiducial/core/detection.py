"""Markers of a frame: found, identified, their corners refined, both poses of each."""

from collections.abc import Mapping

import cv2
import numpy as np

from thermal_fiducial.config import ArucoDetectorConfig, size_overrides
from thermal_fiducial.core import geometry
from thermal_fiducial.core.camera import Camera
from thermal_fiducial.core.contrast import normalise
from thermal_fiducial.core.corners import refine_corners, RefinedCorners
from thermal_fiducial.core.measurements import (
    CORNER_COVARIANCE_FIELDS,
    CORNER_FIELDS,
    MARKER_DTYPE,
    Markers,
    Odometry,
)
from thermal_fiducial.core.opencv_aruco import ArucoSearch
from thermal_fiducial.core.pose import PlanarPose, solve_marker_poses
from thermal_fiducial.core.types import Counts, FloatArray, Gray, IntArray


class MarkerDetector:
    """Finds the markers of a dictionary in clean frames.

    Parameters
    ----------
    config : parameters
    dictionary : of the markers
    """

    def __init__(self, config: ArucoDetectorConfig, dictionary: cv2.aruco.Dictionary) -> None:
        self.config = config
        self._sizes = size_overrides(config.marker_size_overrides)
        self._search = ArucoSearch(dictionary, 23, 7.0, config.min_side_px, config.error_correction_rate)
        self._map: dict[int, tuple[FloatArray, float]] = {}

    def set_map(self, marker_map: Mapping[int, tuple[FloatArray, float]]) -> None:
        """Markers that are known: ID to (T_map_marker, side [m])."""
        self._map = dict(marker_map)

    def detect(self, stamp_ns: int, counts: Counts | Gray, camera: Camera, odometry: Odometry | None = None) -> Markers:
        """Markers of one frame, sorted by ID; an empty array when there are none.

        Parameters
        ----------
        stamp_ns : of the frame
        counts : (height, width), clean
        camera : its intrinsics
        odometry : the filter's latest state, where there is one
        """
        view = normalise(counts, 1.5, 3.0)
        ids, corners = self._search.find(view.gray)
        ids, corners = _unique(ids, corners)
        if len(ids) == 0:
            return np.zeros(0, dtype=MARKER_DTYPE)
        refined = refine_corners(view.counts, corners)
        return self._rows(ids, refined, camera)

    def _rows(self, ids: IntArray, refined: RefinedCorners, camera: Camera) -> Markers:
        sizes = np.array([self.size(marker_id) for marker_id in ids.tolist()])
        poses = solve_marker_poses(refined.corners_px, refined.covariances, sizes, camera)
        seen = np.array([np.isfinite(pose.rms_px) for pose in poses])
        rows: Markers = _marker_rows(ids, refined, poses)[seen]
        return np.sort(rows, order='id')

    def size(self, marker_id: int) -> float:
        """Side of a marker [m]: of the map, or of the overrides, or the common one."""
        if marker_id in self._map:
            return self._map[marker_id][1]
        return self._sizes.get(marker_id, self.config.marker_size)


def _unique(ids: IntArray, corners: FloatArray) -> tuple[IntArray, FloatArray]:
    """Without the IDs that appear more than once: one of them is a reflection, and nothing says which."""
    values, counts = np.unique(ids, return_counts=True)
    keep = np.isin(ids, values[counts == 1])
    return ids[keep], corners[keep]


def _marker_rows(ids: IntArray, refined: RefinedCorners, poses: list[PlanarPose]) -> Markers:
    rows = np.zeros(len(ids), dtype=MARKER_DTYPE)
    rows['id'] = ids
    _fill(rows, CORNER_FIELDS, refined.corners_px.reshape(-1, 8))
    covariances = refined.covariances
    terms = np.stack([covariances[..., 0, 0], covariances[..., 0, 1], covariances[..., 1, 1]], axis=-1)
    _fill(rows, CORNER_COVARIANCE_FIELDS, terms.reshape(-1, 12))
    rows['sigma_px'] = np.sqrt(0.5 * np.trace(covariances, axis1=-2, axis2=-1).mean(axis=-1))
    rows['contrast_counts'] = refined.contrast
    best = np.stack([pose.T_camera_marker for pose in poses])
    other = np.stack([pose.T_alternative for pose in poses])
    _fill(rows, ('x', 'y', 'z', 'qx', 'qy', 'qz', 'qw'), _pose_fields(best))
    _fill(rows, ('ax', 'ay', 'az', 'aqx', 'aqy', 'aqz', 'aqw'), _pose_fields(other))
    rows['rms_px'] = [pose.rms_px for pose in poses]
    rows['arms_px'] = [pose.alternative_rms_px for pose in poses]
    return rows


def _pose_fields(T: FloatArray) -> FloatArray:
    return np.concatenate([T[:, :3, 3], geometry.quaternion_from_rotation(T[:, :3, :3])], axis=-1)


def _fill(rows: Markers, names: tuple[str, ...], values: FloatArray) -> None:
    for column, name in enumerate(names):
        rows[name] = values[:, column]
