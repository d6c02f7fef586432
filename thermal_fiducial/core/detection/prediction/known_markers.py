"""Markers found in a frame, and the markers of a map as predicted in the image of a camera."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np

from thermal_fiducial.core.detection.prediction.frame import LEAST_DEPTH, Places
from thermal_fiducial.core.geometry import se3
from thermal_fiducial.core.geometry.camera import Camera, ImagePoints
from thermal_fiducial.core.geometry.reprojection import corners_in_map, marker_corners, squared_sides
from thermal_fiducial.core.types import BoolArray, FloatArray, IntArray, Stacked

#: Distance from the image's border [px] below which an unrefined marker counts as possibly cut off.
CUT_OFF_PX = 2.0
#: Least distance of the centres of two markers, as a share of the larger one's diagonal.
TOGETHER = 0.35
# Least cosine between a marker's normal and the line of sight for it to be expected.
_MAX_TILT_COSINE = 0.2
# Corners of a marker of side 1 in its plane.
_FACE = marker_corners(1.0)[:, :2]
# A marker predicted with this margin inside the image counts as wholly visible [px].
_WHOLE_PX = 10.0


def among(ids: IntArray, others: IntArray) -> BoolArray:
    """Which of ``ids`` (N,) are among ``others`` (M,)."""
    return np.asarray((ids[:, None] == others).any(axis=1))


@dataclass(frozen=True, slots=True)
class ExpectedMarkers(Stacked):
    """Predictions of N markers.

    Parameters
    ----------
    ids : (N,)
    x : (N, 4, 2) normalised corners
    depth : (N, 4) of the corners [m]
    cnr : (N,) signed contrast-to-noise ratio of a pixel when last observed; 0 if never
    """

    ids: IntArray
    x: FloatArray
    depth: FloatArray
    cnr: FloatArray

    def places(self, camera: Camera) -> Places:
        """Where ``camera`` shows them at the stamp."""
        return Places.of(ImagePoints.seen_at(self.x, camera), self.depth)

    @staticmethod
    def none() -> 'ExpectedMarkers':
        """No markers."""
        return ExpectedMarkers(np.zeros(0, dtype=np.int64), np.zeros((0, 4, 2)), np.zeros((0, 4)), np.zeros(0))


@dataclass(frozen=True, slots=True)
class FoundMarkers(Stacked):
    """N markers found in a frame, not refined yet.

    Parameters
    ----------
    ids : (N,)
    places : at the frame's stamp, accurate to a pixel or two
    cnr : (N,) signed contrast-to-noise ratio of a pixel; negative where black is warmer than white
    expected : (N,) whether it was found near its prediction
    certain : (N,) whether its pattern was decoded at exactly this place with a clear margin
    """

    ids: IntArray
    places: Places
    cnr: FloatArray
    expected: BoolArray
    certain: BoolArray

    @staticmethod
    def none() -> 'FoundMarkers':
        """No markers."""
        x, J, no = np.zeros((0, 4, 2)), np.zeros((0, 4, 2, 2)), np.zeros(0, dtype=bool)
        places = Places(ImagePoints(x, x, J, J), np.zeros((0, 4)), np.zeros((0, 4, 2, 6)))
        return FoundMarkers(np.zeros(0, dtype=np.int64), places, np.zeros(0), no, no)


def depths(T_camera_marker: FloatArray, sizes: FloatArray) -> FloatArray:
    """Depths (N, 4) [m] of the corners of markers."""
    depth = T_camera_marker[:, 2, 3, None] + sizes[:, None] * (T_camera_marker[:, 2, :2] @ _FACE.T)
    return np.fmax(np.where(np.isfinite(depth), depth, 1.0), LEAST_DEPTH)


class KnownMarkers:
    """The markers of a map.

    Parameters
    ----------
    markers : ID to (T_map_marker, side [m])
    sizes : (M,) sides of all markers of the dictionary by ID, which those of the map replace [m]
    quarantined : IDs of the map that are not expected at their places
    """

    def __init__(
        self,
        markers: Mapping[int, tuple[FloatArray, float]],
        sizes: FloatArray,
        quarantined: Collection[int] = (),
    ) -> None:
        #: (L,) IDs of all markers in the map, ascending, and (K,) of those that are not in quarantine
        self.mapped = np.array(sorted(key for key in markers if 0 <= key < len(sizes)), dtype=np.int64)
        self.ids = self.mapped[~np.isin(self.mapped, list(quarantined))]
        #: (M,) sides [m] and (M, 4, 4) poses in the map, NaN if not expected, of all markers of the dictionary by ID
        self.sizes, self.T_map_marker = sizes.copy(), np.full((len(sizes), 4, 4), np.nan)
        for marker_id in self.mapped.tolist():
            self.T_map_marker[marker_id], self.sizes[marker_id] = markers[marker_id]
        self.T_map_marker[np.setdiff1d(self.mapped, self.ids)] = np.nan
        T_map_marker = self.T_map_marker[self.ids]
        corners = corners_in_map(T_map_marker, self.sizes[self.ids])
        self._corners_and_normals = np.concatenate([corners, T_map_marker[:, None, :3, 2]], axis=1)

    def expected(
        self, T_camera_map: FloatArray, camera: Camera, min_side_px: float, without: IntArray
    ) -> ExpectedMarkers:
        """Predictions of the markers wholly in view, facing the camera and large enough, except the IDs ``without``."""
        others = ~among(self.ids, without)
        if not others.any():
            return ExpectedMarkers.none()
        points, facing = self._in_camera(T_camera_map, others)
        corners = camera.project(points)
        large = (squared_sides(corners) >= min_side_px**2).all(axis=1)
        in_view = camera.contains(corners, CUT_OFF_PX).all(axis=1)
        visible = np.flatnonzero(in_view & large & facing)
        points = points[visible]
        x, depth = points[..., :2] / points[..., 2:], points[..., 2]
        return ExpectedMarkers(self.ids[others][visible], x, depth, np.zeros(len(visible)))

    def outlines(self, T_camera_map: FloatArray, camera: Camera) -> FloatArray:
        """Predicted corners (K, 4, 2) of ``ids`` [px]; NaN for markers that the camera cannot show."""
        points, facing = self._in_camera(T_camera_map, np.ones(len(self.ids), dtype=bool))
        corners = camera.project(points)
        corners[~facing] = np.nan
        return corners

    def _in_camera(self, T_camera_map: FloatArray, which: BoolArray) -> tuple[FloatArray, BoolArray]:
        """Corners (N, 4, 3) [m] in the camera of N of the K expected markers, and which of these face it."""
        rotated = self._corners_and_normals[which] @ T_camera_map[:3, :3].T
        points = rotated[:, :4] + T_camera_map[:3, 3]
        return points, _faces_camera(points.mean(axis=1), rotated[:, 4])

    def partially_visible(
        self, T_camera_map: FloatArray, camera: Camera, without: IntArray
    ) -> list[tuple[int, FloatArray, float]]:
        """ID, T_camera_marker (4, 4) and side [m] of markers that face the camera and are partially in view.

        Except the IDs ``without``.
        """
        T = T_camera_map @ self.T_map_marker[self.ids]
        points = se3.apply(T_camera_map, self._corners_and_normals[:, :4].reshape(-1, 3))
        corners = camera.project(points).reshape(-1, 4, 2)
        near = np.nan_to_num(corners, nan=-np.inf)
        low, high = near.min(axis=1), near.max(axis=1)
        inside = camera.contains(corners)
        overlap = inside.any(axis=1) | ((low < (camera.width, camera.height)) & (high > 0.0)).all(axis=1)
        whole = camera.contains(corners, _WHOLE_PX).all(axis=1)
        facing = _faces_camera(T[:, :3, 3], T[:, :3, 2])
        some = np.flatnonzero(facing & overlap & ~whole & ~among(self.ids, without))
        return list(zip(self.ids[some].tolist(), T[some], self.sizes[self.ids[some]].tolist(), strict=True))


def _faces_camera(centre: FloatArray, normal: FloatArray) -> BoolArray:
    """Which markers face the camera, at no more than the largest tilt: centres and normals (N, 3) in the camera."""
    distance = np.sqrt((centre * centre).sum(axis=1))
    return np.asarray((normal * centre).sum(axis=1) < -_MAX_TILT_COSINE * distance)
