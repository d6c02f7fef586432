"""Quadrilaterals in the outlines of a mask: where markers may be."""

import cv2
import numpy as np

from thermal_fiducial.core.types import FloatArray, Gray

# The hull of an outline is simplified to within this share of its length: more than noise bends it, less than a side.
_STRAIGHT = 0.05
_CORNERS, _NEXT = 4, np.array([1, 2, 3, 0])


def find_quads(mask: Gray, min_side_px: float, hidden: FloatArray) -> FloatArray:
    """Convex quadrilaterals (Q, 4, 2) [px], clockwise, among the outlines in a mask, of its spots and of its holes.

    Parameters
    ----------
    mask : (height, width)
    min_side_px : shortest side
    hidden : (N, 4, 2) where not to look [px]
    """
    if len(hidden):
        mask = mask.copy()
        for quad in np.rint(hidden).astype(np.int32):
            cv2.fillConvexPoly(mask, quad, 0)
    outlines, _ = cv2.findContours(mask, cv2.RETR_LIST, cv2.CHAIN_APPROX_SIMPLE)
    shortest, longest = 3.2 * min_side_px, 2.0 * sum(mask.shape)
    quads = []
    for outline in outlines:
        if len(outline) < _CORNERS or not shortest <= cv2.arcLength(outline, True) <= longest:
            continue
        hull = cv2.convexHull(outline)
        simple = cv2.approxPolyDP(hull, _STRAIGHT * cv2.arcLength(hull, True), True)
        if len(simple) == _CORNERS:
            quads.append(simple[:, 0])
    if not quads:
        return np.zeros((0, 4, 2))
    found = np.array(quads, dtype=np.float64)
    span = found.take(_NEXT, axis=1) - found
    return _clockwise(found[((span * span).sum(axis=-1) >= min_side_px**2).all(axis=1)])


def _clockwise(quads: FloatArray) -> FloatArray:
    """Quadrilaterals in the order in which a clock's hand passes their corners, seen with v downward."""
    diagonal, other = quads[:, 2] - quads[:, 0], quads[:, 3] - quads[:, 1]
    turned = diagonal[:, 0] * other[:, 1] - diagonal[:, 1] * other[:, 0] < 0.0
    return np.where(turned[:, None, None], quads[:, ::-1], quads)
