"""Outlines of plates of some thickness, which seen from the side are larger than their faces, and holes smaller.

The cut sides of a plate are as cold as its face. Where the camera sees one, the outline ends at the back edge instead
of the front edge. Seen through the camera's centre, back edges lie on the plane of the face, parallel to the front
edges: the outline of a square is a rectangle there.
"""

import numpy as np

from thermal_fiducial.core.geometry.camera import ImagePoints
from thermal_fiducial.core.geometry.reprojection import marker_corners
from thermal_fiducial.core.geometry.se3 import apply, inverse
from thermal_fiducial.core.types import FloatArray


def corners_of_faces(at: ImagePoints, T_camera_marker: FloatArray, sizes: FloatArray, thickness: float) -> ImagePoints:
    """Corners of the faces of N markers.

    Parameters
    ----------
    at : (N, 4) corners of the outlines
    T_camera_marker : (N, 4, 4) poses by these outlines; those that are not finite change nothing
    sizes : (N,) sides of the faces [m]
    thickness : of all plates [m]
    """
    faces = marker_corners(sizes)
    outlines = outlines_on_faces(faces, np.sign(faces[..., :2]), inverse(T_camera_marker)[:, :3, 3], thickness)
    face, outline = (apply(T_camera_marker, points) for points in (faces, outlines))
    wider = outline[..., :2] / outline[..., 2:] - face[..., :2] / face[..., 2:]
    beyond_px = (at.J @ wider[..., None])[..., 0]
    return at.at_pixels(at.px - np.where(np.isfinite(beyond_px), beyond_px, 0.0))


def outlines_on_faces(edges: FloatArray, outward: FloatArray, camera: FloatArray, thickness: float) -> FloatArray:
    """Points (N, P, 3) on the outlines of what plates hide, on the planes of their faces, in their own frames.

    Parameters
    ----------
    edges : (N, P, 3) points on the edges of the faces, or corners of them [m]
    outward : (N, P or 1, 2) direction out of the plate along each axis, -1 or 1, 0 along an edge
    camera : (N or 1, 3) positions of the camera, in front of the faces
    """
    # The ray to a back edge at depth t crosses the plane of the face by the share t / (t + h) nearer to the camera.
    share = thickness / (thickness + camera[:, None, 2:])
    seen_from_side = np.maximum(outward * (camera[:, None, :2] - edges[..., :2]), 0.0)
    outlines = edges.copy()
    outlines[..., :2] += outward * share * seen_from_side
    return outlines
