"""Both poses of a square in closed form.

T. Collins, A. Bartoli, "Infinitesimal plane-based pose estimation", IJCV 2014; the homography of a square: P. Heckbert,
"Fundamentals of texture mapping and image warping", 1989. Unlike OpenCV's SOLVEPNP_IPPE_SQUARE this also holds for an
exactly front-parallel square.
"""

import numpy as np

from thermal_fiducial.core.types import FloatArray


def marker_corners(size: float) -> FloatArray:
    """Corners (4, 3) [m] in the marker frame, clockwise from the top-left, of a marker of side ``size``."""
    s = 0.5 * size
    return np.array([[-s, s, 0.0], [s, s, 0.0], [s, -s, 0.0], [-s, -s, 0.0]])


def ippe_square(normalised: FloatArray, sizes: FloatArray) -> FloatArray:
    """Both poses (N, 2, 4, 4) of squares from normalised image corners (N, 4, 2) and sides (N,) [m].

    Collins and Bartoli, section 4.1: with J the derivative of the homography at the square's centre, v the centre's
    image and R_v the rotation of the optical axis to it, ``J t_z = [I | -v] R_v R'`` leaves R' up to the sign of
    the tilt. Corners that have no homography, three of them on a line or NaN, give NaN.
    """
    with np.errstate(divide='ignore', invalid='ignore', over='ignore'):
        J, v = _homography_derivative(normalised, sizes)
        R_v = _axis_to(v)
        A = _solve2(R_v[:, :2, :2] - v[:, :, None] * R_v[:, 2:, :2], J)
        gram = np.swapaxes(A, -1, -2) @ A
        a, b, c = gram[:, 0, 0], gram[:, 0, 1], gram[:, 1, 1]
        gamma = np.sqrt(0.5 * (a + c + np.hypot(a - c, 2.0 * b)))[:, None]
        # R' has the columns (upper, +-tilt), of unit length and orthogonal, and their cross product.
        upper = A / gamma[..., None]
        h = 1.0 - gram[:, [0, 1], [0, 1]] / gamma**2
        tilt = np.sqrt(np.maximum(h, 0.0))
        tilt[:, 1] = np.copysign(tilt[:, 1], -b)
        R = np.empty((len(v), 2, 3, 3))
        R[:, :, :2, :2] = upper[:, None]
        R[:, 0, 2, :2], R[:, 1, 2, :2] = tilt, -tilt
        x, y = R[..., 0], R[..., 1]
        R[..., 2] = x[..., [1, 2, 0]] * y[..., [2, 0, 1]] - x[..., [2, 0, 1]] * y[..., [1, 2, 0]]
        poses = np.zeros((len(v), 2, 4, 4))
        poses[..., :3, :3] = R_v[:, None] @ R
        poses[..., :2, 3] = (v / gamma)[:, None]
        poses[..., 2, 3] = 1.0 / gamma
    poses[..., 3, 3] = 1.0
    return poses


def _homography_derivative(c: FloatArray, sizes: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Derivative (N, 2, 2) [1/m] at, and image (N, 2) of, the centre under the homography of a square to ``c``."""
    back, left = c[:, 1] - c[:, 2], c[:, 3] - c[:, 2]
    excess = c[:, 0] - c[:, 1] - left
    determinant = cross_in_plane(back, left)
    g, h = (cross_in_plane(excess, left) / determinant)[:, None], (cross_in_plane(back, excess) / determinant)[:, None]
    right, down = c[:, 1] - c[:, 0] + g * c[:, 1], c[:, 3] - c[:, 0] + h * c[:, 3]
    depth = 1.0 + 0.5 * (g + h)
    v = (c[:, 0] + 0.5 * (right + down)) / depth
    J = np.stack([right - g * v, h * v - down], axis=-1) / (depth * sizes[:, None])[..., None]
    return J, np.asarray(v)


def cross_in_plane(a: FloatArray, b: FloatArray) -> FloatArray:
    """Cross products (N,) of vectors (N, 2)."""
    return np.asarray(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])


def _axis_to(v: FloatArray) -> FloatArray:
    """Shortest rotations (N, 3, 3) of the optical axis to the directions (v, 1), v (N, 2)."""
    z = 1.0 / np.sqrt(1.0 + np.sum(v * v, axis=-1))[:, None]
    d = v * z
    R = np.empty((len(v), 3, 3))
    R[:, :2, :2] = np.eye(2) - d[:, :, None] * (d / (1.0 + z))[:, None, :]
    R[:, :2, 2], R[:, 2, :2], R[:, 2, 2] = d, -d, z[:, 0]
    return R


def _solve2(A: FloatArray, B: FloatArray) -> FloatArray:
    """Solutions (N, 2, 2) of ``A X == B``, not finite where A is singular."""
    adjugate = np.empty_like(A)
    adjugate[:, 0, 0], adjugate[:, 1, 1] = A[:, 1, 1], A[:, 0, 0]
    adjugate[:, 0, 1], adjugate[:, 1, 0] = -A[:, 0, 1], -A[:, 1, 0]
    determinant = A[:, 0, 0] * A[:, 1, 1] - A[:, 0, 1] * A[:, 1, 0]
    return np.asarray(adjugate @ B / determinant[:, None, None])
