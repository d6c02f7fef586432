"""Markers that were found, and where their corners are: their depths in the camera."""

from dataclasses import dataclass

import numpy as np

from thermal_fiducial.core.detection.frame import Frame, Places
from thermal_fiducial.core.geometry.camera import ImagePoints
from thermal_fiducial.core.geometry.planar_pose import ippe_square, marker_corners
from thermal_fiducial.core.types import BoolArray, FloatArray, IntArray

# Corners of a marker of side 1 in its plane.
_FACE = marker_corners(1.0)[:, :2]


def among(ids: IntArray, others: IntArray) -> BoolArray:
    """Which of ``ids`` (N,) are among ``others`` (M,)."""
    return np.asarray((ids[:, None] == others).any(axis=1))


def pairs(ids: IntArray, others: IntArray) -> tuple[IntArray, IntArray]:
    """Places, in ``ids`` (N,) and in ``others`` (M,), of the IDs that both have."""
    first, second = np.nonzero(ids[:, None] == others)
    return first, second


@dataclass(frozen=True, slots=True)
class Found:
    """Markers that a search found.

    Parameters
    ----------
    ids : (N,)
    corners_px : (N, 4, 2) clockwise from the marker's top-left, to a pixel or two
    cnr : (N,) contrast-to-noise ratio of a pixel; negative where black is warmer than white
    expected : (N,) whether it was looked for where it was found
    """

    ids: IntArray
    corners_px: FloatArray
    cnr: FloatArray
    expected: BoolArray

    def only(self, keep: BoolArray | IntArray) -> 'Found':
        """Those of the markers ``keep``."""
        return Found(self.ids[keep], self.corners_px[keep], self.cnr[keep], self.expected[keep])

    @staticmethod
    def none() -> 'Found':
        """No markers."""
        return Found(np.zeros(0, dtype=np.int64), np.zeros((0, 4, 2)), np.zeros(0), np.zeros(0, dtype=bool))


def merged(first: Found, second: Found) -> Found:
    """All markers of ``first``, and those of ``second`` that it does not have and that lie elsewhere."""
    if len(second.ids) == 0:
        return first
    apart = np.linalg.norm(second.corners_px.mean(axis=1)[:, None] - first.corners_px.mean(axis=1), axis=-1)
    extent = np.linalg.norm(first.corners_px[:, 2] - first.corners_px[:, 0], axis=-1)
    new = ~among(second.ids, first.ids) & (apart > 0.35 * extent).all(axis=1)
    return Found(
        np.concatenate([first.ids, second.ids[new]]),
        np.concatenate([first.corners_px, second.corners_px[new]]),
        np.concatenate([first.cnr, second.cnr[new]]),
        np.concatenate([first.expected | among(first.ids, second.ids[second.expected]), second.expected[new]]),
    )


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
