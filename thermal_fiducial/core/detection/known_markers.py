"""Markers of a frame that were found, and those of a map where a camera at a pose should see them."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from thermal_fiducial.core.detection.frame import Places
from thermal_fiducial.core.geometry import se3
from thermal_fiducial.core.geometry.camera import Camera, ImagePoints
from thermal_fiducial.core.geometry.reprojection import corners_in_map, marker_corners
from thermal_fiducial.core.types import BoolArray, FloatArray, IntArray, Stacked

#: Nearer to the border of the image than this a marker may be cut off, before its corners are refined [px].
CUT_OFF_PX = 2.0
#: Middles of two markers are no nearer than this share of the larger one's diagonal.
TOGETHER = 0.35
# A marker turned further from the camera than this shows too little to be expected.
_MAX_TILT_COSINE = 0.2
_NEXT = np.array([1, 2, 3, 0])
# Corners of a marker of side 1 in its plane.
_FACE = marker_corners(1.0)[:, :2]
# A marker predicted as far inside the image as this is not cut by its border [px].
_WHOLE_PX = 10.0


def among(ids: IntArray, others: IntArray) -> BoolArray:
    """Which of ``ids`` (N,) are among ``others`` (M,)."""
    return np.asarray((ids[:, None] == others).any(axis=1))


def pairs(ids: IntArray, others: IntArray) -> tuple[IntArray, IntArray]:
    """Places, in ``ids`` (N,) and in ``others`` (M,), of the IDs that both have."""
    first, second = np.nonzero(ids[:, None] == others)
    return first, second


@dataclass(frozen=True, slots=True)
class ExpectedMarkers(Stacked):
    """Where N markers should be.

    Parameters
    ----------
    ids : (N,)
    x : (N, 4, 2) normalised corners
    depth : (N, 4) of the corners [m]
    cnr : (N,) contrast-to-noise ratio of a pixel when they were last seen, 0 of others
    """

    ids: IntArray
    x: FloatArray
    depth: FloatArray
    cnr: FloatArray

    @staticmethod
    def none() -> 'ExpectedMarkers':
        """No markers."""
        return ExpectedMarkers(np.zeros(0, dtype=np.int64), np.zeros((0, 4, 2)), np.zeros((0, 4)), np.zeros(0))


@dataclass(frozen=True, slots=True)
class FoundMarkers(Stacked):
    """N markers that a frame shows.

    Parameters
    ----------
    ids : (N,)
    places : to a pixel or two, at the frame's stamp
    cnr : (N,) contrast-to-noise ratio of a pixel; negative where black is warmer than white
    expected : (N,) whether it was looked for where it was found
    certain : (N,) whether its pattern was read in this very place, beyond doubt
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

    def and_elsewhere(self, others: 'FoundMarkers') -> 'FoundMarkers':
        """These, and those of ``others`` that are not among them and that lie elsewhere."""
        if len(others.ids) == 0:
            return self
        apart = np.linalg.norm(others.places.at.px.mean(axis=1)[:, None] - self.places.at.px.mean(axis=1), axis=-1)
        extent = np.linalg.norm(self.places.at.px[:, 2] - self.places.at.px[:, 0], axis=-1)
        return self.joined(others.only(~among(others.ids, self.ids) & (apart > TOGETHER * extent).all(axis=1)))


def depths(T_camera_marker: FloatArray, sizes: FloatArray) -> FloatArray:
    """Depths (N, 4) [m] of the corners of markers."""
    depth = T_camera_marker[:, 2, 3, None] + sizes[:, None] * (T_camera_marker[:, 2, :2] @ _FACE.T)
    return np.fmax(np.where(np.isfinite(depth), depth, 1.0), 0.1)


class PartialMarkers(NamedTuple):
    """N markers that show a face and may be in view, but not wholly."""

    #: (N,)
    ids: IntArray
    #: (N, 4, 4)
    T_camera_marker: FloatArray
    #: (N,) sides [m]
    sizes: FloatArray


class KnownMarkers:
    """The markers of a map.

    Parameters
    ----------
    markers : ID to (T_map_marker, side [m])
    sizes : (M,) of all markers of the dictionary, by their IDs, if they are not in the map [m]
    """

    def __init__(self, markers: Mapping[int, tuple[FloatArray, float]], sizes: FloatArray) -> None:
        #: (K,) those that are known
        self.ids = np.array(sorted(key for key in markers if 0 <= key < len(sizes)), dtype=np.int64)
        #: (M,) sides [m] of all, and (M, 4, 4) their poses in the map, NaN where they are not in it
        self.sizes, self.T_map_marker = sizes.copy(), np.full((len(sizes), 4, 4), np.nan)
        for marker_id in self.ids.tolist():
            self.T_map_marker[marker_id], self.sizes[marker_id] = markers[marker_id]
        T_map_marker = self.T_map_marker[self.ids]
        corners = corners_in_map(T_map_marker, self.sizes[self.ids])
        self._corners_and_normals = np.concatenate([corners, T_map_marker[:, None, :3, 2]], axis=1)

    def expected(self, T_camera_map: FloatArray, camera: Camera, min_side_px: float) -> ExpectedMarkers:
        """Those that are wholly in view and show a face."""
        rotated = self._corners_and_normals @ T_camera_map[:3, :3].T
        points, normal = rotated[:, :4] + T_camera_map[:3, 3], rotated[:, 4]
        corners = camera.project(points)
        centre = points.mean(axis=1)
        facing = (normal * centre).sum(axis=1) < -_MAX_TILT_COSINE * np.sqrt((centre * centre).sum(axis=1))
        span = corners.take(_NEXT, axis=1) - corners
        large = ((span * span).sum(axis=-1) >= min_side_px**2).all(axis=1)
        seen = np.flatnonzero(camera.contains(corners, CUT_OFF_PX).all(axis=1) & facing & large)
        points = points[seen]
        return ExpectedMarkers(self.ids[seen], points[..., :2] / points[..., 2:], points[..., 2], np.zeros(len(seen)))

    def partially_visible(self, T_camera_map: FloatArray, camera: Camera, without: IntArray) -> PartialMarkers:
        """Those that show a face and may be partly in view, but for those of the IDs ``without``."""
        T = T_camera_map @ self.T_map_marker[self.ids]
        centre, normal = T[:, :3, 3], T[:, :3, 2]
        distance = np.sqrt(np.sum(centre * centre, axis=1))
        facing = np.sum(normal * centre, axis=1) < -_MAX_TILT_COSINE * distance
        corners = camera.project(se3.apply(T_camera_map, self._corners_and_normals[:, :4].reshape(-1, 3))).reshape(
            -1, 4, 2
        )
        near = np.nan_to_num(corners, nan=-np.inf)
        low, high = near.min(axis=1), near.max(axis=1)
        inside = camera.contains(corners)
        overlap = inside.any(axis=1) | ((low < (camera.width, camera.height)) & (high > 0.0)).all(axis=1)
        whole = camera.contains(corners, _WHOLE_PX).all(axis=1)
        some = np.flatnonzero(facing & overlap & ~whole & ~among(self.ids, without))
        return PartialMarkers(self.ids[some], T[some], self.sizes[self.ids[some]])
