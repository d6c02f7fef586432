"""Sub-pixel corners on raw counts."""

from dataclasses import dataclass

import cv2
import numpy as np

from thermal_fiducial.core.types import Float32Array, FloatArray


@dataclass(frozen=True, slots=True)
class RefinedCorners:
    """Corners of N markers.

    Parameters
    ----------
    corners_px : (N, 4, 2)
    covariances : (N, 4, 2, 2) [px^2]
    contrast : (N,) white minus black [counts]
    """

    corners_px: FloatArray
    covariances: FloatArray
    contrast: FloatArray


def refine_corners(image: Float32Array, corners_px: FloatArray) -> RefinedCorners:
    """Corners (N, 4, 2) refined on ``image`` (height, width) [counts]."""
    count = len(corners_px)
    low, high = np.percentile(image[::4, ::4], (0.5, 99.5))
    gray = np.clip((image - low) * (255.0 / max(high - low, 1.0)), 0, 255).astype(np.uint8)
    points = corners_px.reshape(-1, 1, 2).astype(np.float32)
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 30, 0.01)
    refined = cv2.cornerSubPix(gray, points, (3, 3), (-1, -1), criteria).reshape(count, 4, 2).astype(np.float64)
    centre = refined.mean(axis=1, keepdims=True)
    inside = (centre + 0.92 * (refined - centre)).reshape(-1, 2)
    outside = (centre + 1.08 * (refined - centre)).reshape(-1, 2)
    contrast = (_nearest(image, outside) - _nearest(image, inside)).reshape(count, 4).mean(axis=1)
    covariance = np.broadcast_to(0.15**2 * np.eye(2), (count, 4, 2, 2))
    return RefinedCorners(refined, covariance, contrast)


def _nearest(image: Float32Array, points: FloatArray) -> FloatArray:
    u = np.clip(np.rint(points[:, 0]).astype(int), 0, image.shape[1] - 1)
    v = np.clip(np.rint(points[:, 1]).astype(int), 0, image.shape[0] - 1)
    return np.asarray(image[v, u], dtype=np.float64)
