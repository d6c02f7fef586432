"""Markers of a frame: found, identified, their corners refined, both poses of each."""

from collections.abc import Mapping
from dataclasses import replace

import cv2
import numpy as np

from thermal_fiducial.config import ArucoDetectorConfig, size_overrides
from thermal_fiducial.core import geometry
from thermal_fiducial.core.camera import Camera
from thermal_fiducial.core.contrast import normalise
from thermal_fiducial.core.corners import grid_pattern, refine_corners, RefinedCorners
from thermal_fiducial.core.lag import markers_without_lag, MotionTracker, smear, SmearField, Twist, without_lag
from thermal_fiducial.core.measurements import (
    CORNER_COVARIANCE_FIELDS,
    CORNER_FIELDS,
    MARKER_DTYPE,
    Markers,
    Odometry,
)
from thermal_fiducial.core.opencv_aruco import ArucoSearch
from thermal_fiducial.core.patterns import marker_bits
from thermal_fiducial.core.pose import ippe_square, marker_corners, PlanarPose, solve_marker_poses
from thermal_fiducial.core.types import Counts, Float32Array, FloatArray, Gray, IntArray

# Smear by lag below which neither the search nor the shape of an edge changes [px].
_SMEAR_THAT_MATTERS_PX = 0.4
# Pixels round a marker that the refinement may look at.
_WINDOW_MARGIN_PX = 16


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
        self._pattern = grid_pattern(marker_bits(dictionary))
        T_body_camera = geometry.transform(
            geometry.rotation_from_quaternion(config.camera_orientation), config.camera_position
        )
        self._motion = MotionTracker(T_body_camera)
        self._field: SmearField | None = None
        self._depth = 3.0
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
        predicted = self._motion.predict(stamp_ns, odometry)
        image = counts.astype(np.float32)
        view = normalise(self._scene(image, camera, predicted), 1.5, 3.0)
        ids, corners = _unique(*self._search.find(view.gray))
        if len(ids) == 0:
            self._motion.remember(stamp_ns, predicted, ids, corners)
            return np.zeros(0, dtype=MARKER_DTYPE)
        refined = self._refined(stamp_ns, image, ids, corners, camera, predicted)
        return self._rows(ids, refined, camera)

    def _scene(self, image: Float32Array, camera: Camera, twist: Twist | None) -> Float32Array:
        """The frame as the search sees it, freed of lag where motion is fast enough to matter there."""
        if twist is None or self.config.bolometer_lag <= 0.0:
            return image
        if self._field is None or self._field.camera is not camera:
            self._field = SmearField(camera)
        coarse = self._field.at(twist, self._depth, self.config.bolometer_lag)
        if np.abs(coarse).max() < _SMEAR_THAT_MATTERS_PX:
            return image
        field = self._field.full(coarse)
        return without_lag(image, field[..., 0], field[..., 1])

    def _refined(
        self,
        stamp_ns: int,
        image: Float32Array,
        ids: IntArray,
        corners: FloatArray,
        camera: Camera,
        predicted: Twist | None,
    ) -> RefinedCorners:
        """Corners at the stamp: refined on the image freed of lag, by the twist that they themselves improve."""
        sizes = self._sizes_of(ids)
        before, step = self._pattern.before[ids], self._pattern.step[ids]
        tau = self.config.bolometer_lag
        x = camera.normalise(corners)
        depth = _corner_depths(x, sizes)
        self._depth = float(np.median(depth))
        twist = predicted
        for _ in range(2):
            scene, used = image, np.zeros_like(corners)
            if twist is not None:
                used, _ = smear(camera, x, depth, twist, tau)
                scene = markers_without_lag(image, corners, used, _WINDOW_MARGIN_PX)
            refined = refine_corners(scene, corners, camera, before, step, self.config.blur_px)
            x = camera.normalise(refined.corners_px)
            noise = np.sqrt(0.5 * np.trace(refined.covariances, axis1=-2, axis2=-1).mean(axis=-1)) / camera.focal_px
            twist = self._motion.correct(stamp_ns, predicted, ids, x, depth, noise)
            if twist is None:
                break
            better, spread = smear(camera, x, depth, twist, tau)
            change = better - used
            corners = refined.corners_px - change
            refined = replace(refined, corners_px=corners, covariances=refined.covariances + spread)
            if np.abs(change).max() < _SMEAR_THAT_MATTERS_PX:
                break
        self._motion.remember(stamp_ns, twist, ids, camera.normalise(refined.corners_px))
        return refined

    def _rows(self, ids: IntArray, refined: RefinedCorners, camera: Camera) -> Markers:
        sizes = self._sizes_of(ids)
        poses = solve_marker_poses(refined.corners_px, refined.covariances, sizes, camera)
        seen = np.array([np.isfinite(pose.rms_px) for pose in poses])
        rows: Markers = _marker_rows(ids, refined, poses)[seen]
        return np.sort(rows, order='id')

    def _sizes_of(self, ids: IntArray) -> FloatArray:
        return np.array([self.size(marker_id) for marker_id in ids.tolist()])

    def size(self, marker_id: int) -> float:
        """Side of a marker [m]: of the map, or of the overrides, or the common one."""
        if marker_id in self._map:
            return self._map[marker_id][1]
        return self._sizes.get(marker_id, self.config.marker_size)


def _corner_depths(x: FloatArray, sizes: FloatArray) -> FloatArray:
    """Depths (N, 4) [m] of normalised corners (N, 4, 2), roughly: of the first of both planar poses."""
    T = ippe_square(x, sizes)[:, 0]
    corners = geometry.apply(T, sizes[:, None, None] * marker_corners(1.0))
    return np.maximum(np.nan_to_num(corners[..., 2], nan=1.0), 0.1)


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
