"""Corners as OpenCV sees them: each by itself, from the gradients around it.

What has gone through a camera's display processing (8 bits, gain control, deblurring) no longer has edges of a known
shape or straight lines under a calibration that need not exist; there the local corner is the common definition. It
lies a few tenths of a pixel inside that of the sides' lines, because blur rounds corners.
"""

from dataclasses import replace

import cv2
import numpy as np

from thermal_fiducial.core.detection.corners.refinement import RefinedCorners
from thermal_fiducial.core.types import Float32Array

_LARGEST_WINDOW = 5
_WINDOW_IN_CELLS = 0.3
_STOP = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 0.001)
# Deviation of such a corner on thermal frames [px], and the step beyond which it has left its corner, in cells.
_DEVIATION = 0.18
_LOST_CELLS = 0.4


def local_corners(image: Float32Array, refined: RefinedCorners, cells: int) -> RefinedCorners:
    """Corners (N, 4, 2) by ``cv2.cornerSubPix``; those that it carries away stay."""
    corners = refined.corners_px.copy()
    for index, start in enumerate(refined.corners_px):
        cell = np.linalg.norm(start[2] - start[0]) / (np.sqrt(2.0) * cells)
        window = int(np.clip(round(_WINDOW_IN_CELLS * cell), 1, _LARGEST_WINDOW))
        points = start.astype(np.float32).reshape(-1, 1, 2)
        found = cv2.cornerSubPix(image, points, (window, window), (-1, -1), _STOP).reshape(4, 2).astype(np.float64)
        near = np.abs(found - start).max(axis=1) < max(1.0, _LOST_CELLS * cell)
        corners[index, near] = found[near]
    return replace(refined, corners_px=corners, covariances=refined.covariances + _DEVIATION**2 * np.eye(2))
