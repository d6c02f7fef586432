"""Markers as a camera sees them: re-projected corners, with derivatives, quadrilaterals in an image, thick plates.

Poses are displaced as by :func:`thermal_fiducial.core.geometry.se3.retract`, in the map frame. With
``p_camera = R' (R_m c + t_m - t)`` for a corner ``c`` of the marker,
``dp_camera = R' (dt_m - [R_m c]x dr_m - dt + [R_m c + t_m - t]x dr)``.
"""

from typing import TypeVar

import numpy as np
import numpy.typing as npt

from thermal_fiducial.core.geometry.camera import Camera, ImagePoints
from thermal_fiducial.core.geometry.se3 import apply, inverse, skew
from thermal_fiducial.core.types import Float32Array, FloatArray, TINY

#: Numbers in either precision.
Real = TypeVar('Real', FloatArray, Float32Array)

#: Corners of a marker of side 2, clockwise from its top-left.
_UNIT_CORNERS = np.array([[-1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, -1.0, 0.0]])
# Of a corner of a quadrilateral, the next and the opposite one.
_NEXT, _OPPOSITE = np.array([1, 2, 3, 0]), np.array([2, 3, 0, 1])


def interaction(x: FloatArray, depth: FloatArray) -> FloatArray:
    """Derivative (..., 2, 6) of the velocity of normalised points (..., 2) at ``depth`` (...) [m] by the twist.

    The image motion of a rigid scene for a camera with twist (v, omega) (F. Chaumette, S. Hutchinson, "Visual servo
    control I", 2006, eq. 11).
    """
    a, b, inverse = x[..., 0], x[..., 1], 1.0 / depth
    J = np.zeros((*x.shape, 6))
    J[..., 0, 0] = J[..., 1, 1] = -inverse
    J[..., 2] = x * inverse[..., None]
    J[..., 0, 3], J[..., 1, 3] = a * b, 1.0 + b * b
    J[..., 0, 4], J[..., 1, 4] = -1.0 - a * a, -J[..., 0, 3]
    J[..., 0, 5], J[..., 1, 5] = b, -a
    return J


def marker_corners(sizes: npt.ArrayLike) -> FloatArray:
    """Corners (..., 4, 3) [m] of markers of ``sizes`` (...) in their own frames, clockwise from the top-left."""
    return np.asarray(0.5 * np.asarray(sizes, dtype=np.float64)[..., None, None] * _UNIT_CORNERS)


def corners_in_map(T_map_marker: FloatArray, sizes: npt.ArrayLike) -> FloatArray:
    """Corners (..., 4, 3) [m] in the map of markers with poses (..., 4, 4) and ``sizes`` (...)."""
    return apply(T_map_marker, marker_corners(sizes))


def reproject(camera: Camera, T_map_camera: FloatArray, points: FloatArray) -> FloatArray:
    """Pixels (..., 4, 2) of corners ``points`` (..., 4, 3) in the map, for cameras (..., 4, 4); NaN: unseen."""
    relative = points - T_map_camera[..., None, :3, 3]
    return camera.project(relative @ T_map_camera[..., :3, :3])


def linearise(
    camera: Camera, T_map_camera: FloatArray, T_map_marker: FloatArray, sizes: npt.ArrayLike
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Pixels of the corners of markers, and their derivatives with respect to both poses.

    Parameters
    ----------
    T_map_camera, T_map_marker : (n, 4, 4), one pair a view
    sizes : (n,) [m]

    Returns
    -------
    uv (n, 4, 2), J_camera (n, 8, 6), J_marker (n, 8, 6) [px/m, px/rad], rows u0 v0 u1 v1 ...
    """
    n = len(T_map_camera)
    R_camera_map = T_map_camera[:, :3, :3].swapaxes(-1, -2)[:, None]
    arms = marker_corners(sizes) @ T_map_marker[:, :3, :3].swapaxes(-1, -2)
    points = arms + (T_map_marker[:, :3, 3] - T_map_camera[:, :3, 3])[:, None]
    uv, projection = camera.project_jacobian((R_camera_map @ points[..., None])[..., 0])
    J = projection @ R_camera_map
    J_marker = np.concatenate([J, -J @ skew(arms)], axis=-1).reshape(n, 8, 6)
    J_camera = np.concatenate([-J, J @ skew(points)], axis=-1).reshape(n, 8, 6)
    return uv, J_camera, J_marker


def whitening(covariances: FloatArray) -> FloatArray:
    """Matrices (..., 2, 2) that make residuals of ``covariances`` (..., 2, 2) unit white: inverse Cholesky factors."""
    a, b, c = covariances[..., 0, 0], covariances[..., 0, 1], covariances[..., 1, 1]
    root = np.sqrt(a)
    rest = np.sqrt(c - b * b / a)
    W = np.zeros_like(covariances)
    W[..., 0, 0] = 1.0 / root
    W[..., 1, 0] = -b / (a * rest)
    W[..., 1, 1] = 1.0 / rest
    return W


def bilinear(a: FloatArray, b: FloatArray) -> FloatArray:
    """Weights (..., 4, P) of a square's corners in its points at shares a, b (..., P)."""
    return np.stack([(1.0 - a) * (1.0 - b), a * (1.0 - b), a * b, (1.0 - a) * b], axis=-2)


def seen_between(c: FloatArray, weights: Real) -> Real:
    """Points (2, Q, P) that have ``weights`` (4, P) in a square, of its views with corners (Q, 4, 2).

    In the precision of the weights.

    In homogeneous coordinates, which leave straight what is straight, they are the same means of the corners (the
    projective map of the unit square: P. Heckbert, "Fundamentals of texture mapping and image warping", 1989).
    """
    corners = np.empty((3, *c.shape[:2]))
    corners[2] = perspective(c)
    np.multiply(c.transpose(2, 0, 1), corners[2], out=corners[:2])
    corners = corners.astype(weights.dtype, copy=False)
    points = corners @ weights
    points[:2] /= points[2]
    return points[:2]


def squared_sides(quads: FloatArray) -> FloatArray:
    """Squared lengths (Q, 4) of the sides of quadrilaterals (Q, 4, 2), from each corner to the next."""
    to_next = quads.take(_NEXT, axis=1) - quads
    return np.asarray((to_next * to_next).sum(axis=-1))


def sides_px(quads: FloatArray) -> FloatArray:
    """Mean sides (Q,) of quadrilaterals (Q, 4, 2)."""
    return np.asarray(np.sqrt(squared_sides(quads)).mean(axis=1))


def narrow_sides(quads: FloatArray) -> FloatArray:
    """Narrowest sides (Q,) of quadrilaterals (Q, 4, 2)."""
    return np.asarray(np.sqrt(squared_sides(quads).min(axis=1)))


def widths(quads: FloatArray) -> FloatArray:
    """Widths (Q,) of quadrilaterals (Q, 4, 2): their areas over their longest sides.

    Of a square that is turned away about its diagonal all sides stay long, and the opposite ones come near.
    """
    return np.asarray(areas(quads) / np.sqrt(squared_sides(quads).max(axis=1) + TINY))


def areas(quads: FloatArray) -> FloatArray:
    """Areas (Q,) of quadrilaterals (Q, 4, 2)."""
    (u, v), (w, z) = (quads[:, 2] - quads[:, 0]).T, (quads[:, 3] - quads[:, 1]).T
    return np.asarray(0.5 * np.abs(u * z - v * w))


def diagonals(quads: FloatArray) -> FloatArray:
    """Lengths (Q,) of the diagonals of quadrilaterals (Q, 4, 2) from their first corners."""
    return np.asarray(np.linalg.norm(quads[:, 2] - quads[:, 0], axis=-1))


def grown(quads: FloatArray, factor: float | FloatArray) -> FloatArray:
    """Quadrilaterals (Q, 4, 2) scaled about their centres by a ``factor``, one for all or (Q, 1, 1)."""
    middle = quads.mean(axis=1, keepdims=True)
    return np.asarray(middle + factor * (quads - middle))


def perspective(c: FloatArray) -> FloatArray:
    """Depths (Q, 4) of the corners of squares by their views (Q, 4, 2), up to a factor; equal from in front.

    The diagonals of a square halve each other, so the depth of a corner is proportional to the area of the triangle of
    the other three.
    """
    to_next = c.take(_NEXT, axis=1) - c
    a, b = to_next.take(_NEXT, axis=1), to_next.take(_OPPOSITE, axis=1)
    triangle = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    triangle[np.abs(triangle) < TINY] = TINY
    return np.asarray(triangle)


def corners_of_faces(
    points: ImagePoints, T_camera_marker: FloatArray, sizes: FloatArray, thickness: float
) -> ImagePoints:
    """Corners of the faces of N markers in plates of some thickness.

    From the side, outlines are larger than faces, and those of holes smaller: the cut sides of a plate are as cold as
    its face, and where the camera sees one, the outline ends at the back edge instead of the front edge. Seen through
    the camera's centre, back edges lie on the plane of the face, parallel to the front edges: the outline of a square
    is a rectangle there.

    Parameters
    ----------
    points : (N, 4) corners of the outlines
    T_camera_marker : (N, 4, 4) poses by these outlines; those that are not finite change nothing
    sizes : (N,) sides of the faces [m]
    thickness : of all plates [m]
    """
    faces = marker_corners(sizes)
    outlines = outlines_on_faces(faces, np.sign(faces[..., :2]), inverse(T_camera_marker)[:, :3, 3], thickness)
    face, outline = (apply(T_camera_marker, edges) for edges in (faces, outlines))
    wider = outline[..., :2] / outline[..., 2:] - face[..., :2] / face[..., 2:]
    beyond_px = (points.J @ wider[..., None])[..., 0]
    return points.at_pixels(points.px - np.where(np.isfinite(beyond_px), beyond_px, 0.0))


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
