"""The markers of a map, and where a camera at a pose should see them."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from thermal_fiducial.core.detection.found import among
from thermal_fiducial.core.geometry import se3
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.geometry.planar_pose import marker_corners
from thermal_fiducial.core.types import BoolArray, FloatArray, IntArray

# A marker turned further from the camera than this shows too little to be expected.
_MAX_TILT_COSINE = 0.2
_NEXT = np.array([1, 2, 3, 0])
# A marker predicted as far inside the image as this is not cut by its border [px].
_WHOLE_PX = 10.0


class ExpectedMarkers(NamedTuple):
    """Places of N markers in a frame."""

    #: (N,)
    ids: IntArray
    #: (N, 4, 2) in pixels, and normalised
    corners_px: FloatArray
    x: FloatArray
    #: (N, 4) of the corners [m]
    depth: FloatArray

    def only(self, keep: BoolArray | IntArray) -> 'ExpectedMarkers':
        """Those of the markers ``keep``."""
        return ExpectedMarkers(self.ids[keep], self.corners_px[keep], self.x[keep], self.depth[keep])

    def joined(self, others: 'ExpectedMarkers') -> 'ExpectedMarkers':
        """Those of ``others`` as well."""
        return ExpectedMarkers(
            np.concatenate([self.ids, others.ids]),
            np.concatenate([self.corners_px, others.corners_px]),
            np.concatenate([self.x, others.x]),
            np.concatenate([self.depth, others.depth]),
        )


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
    """

    def __init__(self, markers: Mapping[int, tuple[FloatArray, float]]) -> None:
        #: (M,)
        self.ids = np.array(sorted(markers), dtype=np.int64)
        self._entries = dict(markers)
        entries = [markers[marker_id] for marker_id in self.ids.tolist()]
        self._T_map_marker = T_map_marker = (
            np.stack([entry[0] for entry in entries]) if entries else np.zeros((0, 4, 4))
        )
        self._sizes = sizes = np.array([entry[1] for entry in entries])
        corners = se3.apply(T_map_marker, sizes[:, None, None] * marker_corners(1.0))
        self._corners_and_normals = np.concatenate([corners, T_map_marker[:, None, :3, 2]], axis=1)

    def expected(self, T_camera_map: FloatArray, camera: Camera, min_side_px: float) -> ExpectedMarkers:
        """Those that are wholly in view and show a face."""
        rotated = self._corners_and_normals @ T_camera_map[:3, :3].T
        points, normal = rotated[:, :4] + T_camera_map[:3, 3], rotated[:, 4]
        corners = camera.project(points)
        centre = 0.25 * points.sum(axis=1)
        facing = (normal * centre).sum(axis=1) < -_MAX_TILT_COSINE * np.sqrt((centre * centre).sum(axis=1))
        span = corners.take(_NEXT, axis=1) - corners
        large = ((span * span).sum(axis=-1) >= min_side_px**2).all(axis=1)
        seen = np.flatnonzero(camera.contains(corners, 2.0).all(axis=1) & facing & large)
        points = points[seen]
        return ExpectedMarkers(self.ids[seen], corners[seen], points[..., :2] / points[..., 2:], points[..., 2])

    def partially_visible(self, T_camera_map: FloatArray, camera: Camera, without: IntArray) -> PartialMarkers:
        """Those that show a face and may be partly in view, but for those of the IDs ``without``."""
        T = T_camera_map @ self._T_map_marker
        centre, normal = T[:, :3, 3], T[:, :3, 2]
        distance = np.sqrt(np.sum(centre * centre, axis=1))
        facing = np.sum(normal * centre, axis=1) < -_MAX_TILT_COSINE * distance
        corners = camera.project(se3.apply(T_camera_map, self._corners_and_normals[:, :4].reshape(-1, 3))).reshape(
            -1, 4, 2
        )
        near = np.nan_to_num(corners, nan=-1e9)
        low, high = near.min(axis=1), near.max(axis=1)
        inside = camera.contains(corners)
        overlap = inside.any(axis=1) | ((low < (camera.width, camera.height)) & (high > 0.0)).all(axis=1)
        whole = camera.contains(corners, _WHOLE_PX).all(axis=1)
        some = np.flatnonzero(facing & overlap & ~whole & ~among(self.ids, without))
        return PartialMarkers(self.ids[some], T[some], self._sizes[some])

    def entries(self, ids: IntArray) -> list[tuple[FloatArray, float] | None]:
        """T_map_marker (4, 4) and side [m] of each of the IDs (N,), None of those that are not among them."""
        return [self._entries.get(marker_id) for marker_id in ids.tolist()]


class MarkersOfMap(NamedTuple):
    """The markers of the map in a frame."""

    known: KnownMarkers
    #: where they should be; None: nothing says where
    expected: ExpectedMarkers | None


class MarkerSizes:
    """Sides of markers: of the map, or of the overrides, or the common one.

    Parameters
    ----------
    common, overrides : sides [m], of some by their IDs
    """

    def __init__(self, common: float, overrides: Mapping[int, float]) -> None:
        self._common, self._overrides = common, overrides

    def of(self, ids: IntArray, known: KnownMarkers) -> FloatArray:
        """Sides (N,) of markers ``ids`` (N,) [m]."""
        entries = zip(ids.tolist(), known.entries(ids), strict=True)
        return np.array(
            [self._overrides.get(key, self._common) if entry is None else entry[1] for key, entry in entries]
        )
