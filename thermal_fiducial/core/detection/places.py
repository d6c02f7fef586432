"""Where the corners of markers are that were found: their depths in the camera."""

import numpy as np

from thermal_fiducial.core.detection.frame import Frame, Places
from thermal_fiducial.core.detection.ids import pairs
from thermal_fiducial.core.detection.search import Found
from thermal_fiducial.core.geometry.camera import ImagePoints
from thermal_fiducial.core.geometry.planar_pose import ippe_square, marker_corners
from thermal_fiducial.core.types import FloatArray, IntArray

# Corners of a marker of side 1 in its plane.
_FACE = marker_corners(1.0)[:, :2]


def places_of(frame: Frame, found: Found, sizes: FloatArray, *known: tuple[IntArray, FloatArray]) -> Places:
    """Where markers of sides (N,) [m] are: of those that are ``known``, by ID, the corners' depths (K, 4) [m].

    The others may be tilted wrongly: seen obliquely and approached, such a marker would be blurred across instead of
    along.
    """
    at = ImagePoints.at(found.corners_px, frame.camera)
    depth = depths(ippe_square(at.x, sizes)[:, 0], sizes)
    for ids, depth_of_known in known:
        one, other = pairs(ids, found.ids)
        depth[other] = depth_of_known[one]
    return Places.of(at, depth)


def depths(T_camera_marker: FloatArray, sizes: FloatArray) -> FloatArray:
    """Depths (N, 4) [m] of the corners of markers."""
    depth = T_camera_marker[:, 2, 3, None] + sizes[:, None] * (T_camera_marker[:, 2, :2] @ _FACE.T)
    return np.fmax(np.where(np.isfinite(depth), depth, 1.0), 0.1)
