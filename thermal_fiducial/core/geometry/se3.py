"""Rotations and rigid transforms, small displacements of poses, and what these are for other frames.

``T_a_b`` is 4x4 and maps coordinates in b to coordinates in a, ``p_a = T_a_b @ p_b``; inner names cancel.
Rotation vectors are in radians. All functions accept leading batch dimensions unless they say otherwise.

A displacement ``d`` (6,) of a pose is in the ROS convention of :mod:`thermal_fiducial.core.measurements`: x y z [m],
then the rotation about x y z [rad], both in the parent frame. Covariances of poses are those of such displacements.

Source of the closed forms: J. Sola, J. Deray, D. Atchuthan, "A micro Lie theory for state estimation in
robotics", 2018, appendices B and D.
"""

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from thermal_fiducial.core.types import FloatArray, TINY

# Below this angle [rad] the Taylor series is exact to double precision (the next term is angle^6 / 5040).
SMALL_ANGLE = 1e-2
#: (3, 9): vectors (..., 3) times this are their cross-product matrices, row by row.
SKEW = np.array(((0, 0, 0, 0, 0, -1, 0, 1, 0), (0, 0, 1, 0, 0, 0, -1, 0, 0), (0, -1, 0, 1, 0, 0, 0, 0, 0)), float)
_EYE = np.eye(3)


def skew(v: npt.ArrayLike) -> FloatArray:
    """Cross-product matrices (..., 3, 3) of vectors (..., 3): ``skew(v) @ w == cross(v, w)``."""
    v = np.asarray(v, dtype=np.float64)
    return np.asarray((v @ SKEW).reshape(*v.shape, 3))


def so3_exp(phi: npt.ArrayLike) -> FloatArray:
    """Rotation matrix (..., 3, 3) of rotation vectors (..., 3) [rad]."""
    phi = np.asarray(phi, dtype=np.float64)
    if phi.ndim == 1:
        # A single vector is many times faster without arrays.
        x, y, z = phi.tolist()
        half = max(0.5 * math.sqrt(x * x + y * y + z * z), TINY)
        s = math.sin(half) / half
        a, b = s * math.cos(half), 0.5 * s * s
        return np.array(
            [
                [1.0 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y],
                [b * x * y + a * z, 1.0 - b * (x * x + z * z), b * y * z - a * x],
                [b * x * z - a * y, b * y * z + a * x, 1.0 - b * (x * x + y * y)],
            ]
        )
    # sin(h) / h is 1 to the last digit at the smallest half angle that is divided by.
    half_angle = np.maximum(0.5 * np.sqrt((phi * phi).sum(axis=-1)), TINY)[..., None, None]
    sines = np.sin(half_angle) / half_angle
    K = (phi @ SKEW).reshape(*phi.shape, 3)
    return np.asarray(_EYE + (sines * np.cos(half_angle)) * K + (0.5 * sines * sines) * (K @ K))


def so3_log(R: npt.ArrayLike) -> FloatArray:
    """Rotation vector (..., 3) [rad] of rotation matrices (..., 3, 3), its norm at most pi."""
    q = quaternion_from_rotation(R)
    if q.ndim == 1:
        # A single matrix is many times faster without arrays.
        x, y, z, w = q.tolist()
        length = math.sqrt(x * x + y * y + z * z)
        factor = 2.0 if length < TINY else 2.0 * math.atan2(length, w) / length
        return np.array((factor * x, factor * y, factor * z))
    w, v = q[..., 3], q[..., :3]
    norm = np.linalg.norm(v, axis=-1)
    scale = np.where(norm < TINY, 2.0, 2.0 * np.arctan2(norm, w) / np.maximum(norm, TINY))
    return np.asarray(scale[..., None] * v)


def so3_left_jacobian(phi: FloatArray) -> FloatArray:
    """J_l (3, 3) with ``exp(phi + d) ~ exp(J_l d) exp(phi)``, of one rotation vector (3,) [rad] (Sola, eq. 145)."""
    squared = float(phi @ phi)
    if squared < SMALL_ANGLE**2:
        b = 1 / 2 - squared * (1 / 24 - squared / 720)
        c = 1 / 6 - squared * (1 / 120 - squared / 5040)
    else:
        angle = math.sqrt(squared)
        b = (1.0 - math.cos(angle)) / squared
        c = (angle - math.sin(angle)) / (angle * squared)
    K = skew(phi)
    return np.asarray(_EYE + b * K + c * (K @ K))


def so3_left_jacobian_inverse(phi: npt.ArrayLike) -> FloatArray:
    """Inverse (..., 3, 3) of J_l with ``exp(phi + d) ~ exp(J_l d) exp(phi)``, for norms below 2 pi (Sola, eq. 146)."""
    phi = np.asarray(phi, dtype=np.float64)
    squared = (phi * phi).sum(axis=-1)
    near = squared < SMALL_ANGLE**2
    a = np.sqrt(np.where(near, 1.0, squared))
    c = np.where(near, 1 / 12 + squared * (1 / 720 + squared / 30240), 1.0 / a**2 - 1.0 / (2.0 * a * np.tan(0.5 * a)))
    K = skew(phi)
    return np.asarray(_EYE - 0.5 * K + c[..., None, None] * (K @ K))


def transform(R: npt.ArrayLike, p: npt.ArrayLike) -> FloatArray:
    """T_a_b (..., 4, 4) of R_a_b (..., 3, 3) and the origin of b in a (..., 3), of either of them one or as many."""
    R = np.asarray(R, dtype=np.float64)
    p = np.asarray(p, dtype=np.float64)
    T = np.zeros((*max(R.shape[:-2], p.shape[:-1], key=len), 4, 4))
    T[..., :3, :3] = R
    T[..., :3, 3] = p
    T[..., 3, 3] = 1.0
    return T


def inverse(T: npt.ArrayLike) -> FloatArray:
    """T_b_a of T_a_b, (..., 4, 4)."""
    T = np.asarray(T, dtype=np.float64)
    R_transposed = T[..., :3, :3].swapaxes(-1, -2)
    return transform(R_transposed, -(R_transposed @ T[..., :3, 3:])[..., 0])


def apply(T: npt.ArrayLike, points: npt.ArrayLike) -> FloatArray:
    """Points (..., N, 3) in b moved to a by T_a_b (..., 4, 4)."""
    T = np.asarray(T, dtype=np.float64)
    points = np.asarray(points, dtype=np.float64)
    return np.asarray(points @ T[..., :3, :3].swapaxes(-1, -2) + T[..., None, :3, 3])


def rigid_alignment(target: npt.ArrayLike, source: npt.ArrayLike, weights: npt.ArrayLike | None = None) -> FloatArray:
    """T_target_source (..., 4, 4) with the least squares of ``target - T source``, points (N, 3).

    B. Horn, "Closed-form solution of absolute orientation using unit quaternions", 1987; here by singular values.

    Parameters
    ----------
    weights : (..., N) of the points, for as many alignments; all alike when left out
    """
    there, here = np.asarray(target, dtype=np.float64), np.asarray(source, dtype=np.float64)
    of_points = np.ones(len(there)) if weights is None else np.asarray(weights, dtype=np.float64)
    shares = of_points / of_points.sum(axis=-1, keepdims=True)
    # About the middle of all points: sums of large numbers would lose digits.
    middle_there, middle_here = there.mean(axis=0), here.mean(axis=0)
    there, here = there - middle_there, here - middle_here
    centre_there, centre_here = shares @ there, shares @ here
    products = (shares @ (there[:, :, None] * here[:, None]).reshape(-1, 9)).reshape(*shares.shape[:-1], 3, 3)
    U, _, Vt = np.linalg.svd(products - centre_there[..., :, None] * centre_here[..., None, :])
    # A rotation, and no reflection.
    U[..., 2] *= np.linalg.det(U @ Vt)[..., None]
    R = U @ Vt
    moved = (R @ (centre_here + middle_here)[..., None])[..., 0]
    return transform(R, centre_there + middle_there - moved)


def rotation_from_quaternion(q_xyzw: npt.ArrayLike) -> FloatArray:
    """Rotation matrix (..., 3, 3) of quaternions x y z w (..., 4); they are normalised first."""
    q = np.asarray(q_xyzw, dtype=np.float64)
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    v, w = q[..., :3], q[..., 3]
    K = skew(v)
    return np.asarray(_EYE + 2.0 * (w[..., None, None] * K + K @ K))


def quaternion_from_rotation(R: npt.ArrayLike) -> FloatArray:
    """Unit quaternion x y z w (..., 4) of rotation matrices (..., 3, 3), w never negative.

    Bar-Itzhack's choice among four expressions by the largest component, so it is accurate at any angle.
    """
    R = np.asarray(R, dtype=np.float64)
    if R.ndim == 2:
        # A single matrix is many times faster without arrays.
        listed = _quaternion_products(R.tolist())
        x, y, z, w = listed[max(range(4), key=lambda k: listed[k][k])]
        scale = (-1.0 if w < 0.0 else 1.0) / math.sqrt(x * x + y * y + z * z + w * w)
        return np.array([x * scale, y * scale, z * scale, w * scale])
    products = R.reshape(-1, 9) @ _PRODUCTS_OF_ENTRIES + _PRODUCTS_OF_NONE
    largest = products[:, ::5].argmax(axis=1)
    q = products.reshape(-1, 4, 4)[np.arange(len(largest)), largest]
    q *= np.copysign(1.0 / np.sqrt((q * q).sum(axis=1)), q[:, 3])[:, None]
    return np.asarray(q.reshape(*R.shape[:-2], 4))


def _quaternion_products(R: list[list[float]]) -> tuple[tuple[float, ...], ...]:
    """Four times the products of a quaternion x y z w with each of its components."""
    (a, b, c), (d, e, f), (g, h, i) = R
    return (
        (1 + a - e - i, b + d, c + g, h - f),
        (b + d, 1 - a + e - i, f + h, c - g),
        (c + g, f + h, 1 - a - e + i, d - b),
        (h - f, c - g, d - b, 1 + a + e + i),
    )


# The products grow linearly with the entries of the matrix, (9, 16), from the identity.
_PRODUCTS_OF_NONE = np.eye(4).ravel()
_PRODUCTS_OF_ENTRIES = np.array(
    [np.ravel(_quaternion_products(entry.tolist())) - _PRODUCTS_OF_NONE for entry in np.eye(9).reshape(9, 3, 3)]
)


def transform_from_quaternion(position: npt.ArrayLike, q_xyzw: npt.ArrayLike) -> FloatArray:
    """T_a_b (..., 4, 4) of a position (..., 3) [m] and a quaternion x y z w (..., 4)."""
    return transform(rotation_from_quaternion(q_xyzw), position)


def camera_in_body(config: Any) -> FloatArray:
    """T_body_camera (4, 4) of a config with ``camera_position`` and ``camera_orientation``."""
    return transform_from_quaternion(config.camera_position, config.camera_orientation)


def rotation_angle(R: npt.ArrayLike) -> FloatArray:
    """Angle (...) [rad] of rotation matrices (..., 3, 3)."""
    R = np.asarray(R, dtype=np.float64)
    # Twice the sine is the length of what makes R asymmetric, twice the cosine its trace less one.
    x, y, z = R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]
    trace = R[..., 0, 0] + R[..., 1, 1] + R[..., 2, 2]
    return np.asarray(np.arctan2(np.sqrt(x * x + y * y + z * z), trace - 1.0))


def turn_between(T: FloatArray, other: FloatArray) -> FloatArray:
    """Angle (...) [rad] by which poses ``other`` (..., 4, 4) are turned against one, ``T`` (4, 4)."""
    return rotation_angle(T[:3, :3].T @ other[..., :3, :3])


def retract(T: npt.ArrayLike, d: npt.ArrayLike) -> FloatArray:
    """Pose (..., 4, 4) moved by ``d`` (..., 6) in its parent frame: ``p + d[:3]``, ``exp(d[3:]) R``."""
    d = np.asarray(d, dtype=np.float64)
    moved = np.array(T, dtype=np.float64)
    moved[..., :3, :3] = so3_exp(d[..., 3:]) @ moved[..., :3, :3]
    moved[..., :3, 3] += d[..., :3]
    return moved


def difference(T: npt.ArrayLike, T_reference: npt.ArrayLike) -> FloatArray:
    """``d`` (..., 6) with ``T == retract(T_reference, d)``."""
    T, T_reference = np.asarray(T, dtype=np.float64), np.asarray(T_reference, dtype=np.float64)
    rotation = so3_log(T[..., :3, :3] @ T_reference[..., :3, :3].swapaxes(-1, -2))
    return np.concatenate([T[..., :3, 3] - T_reference[..., :3, 3], rotation], axis=-1)


def screwed(T: FloatArray, d: FloatArray) -> FloatArray:
    """Pose (..., 4, 4) moved by ``d`` (..., 6) along a screw: as by :func:`retract` to first order, but about an axis.

    The exponential of SE(3), in these coordinates.
    """
    moved = T.copy()
    moved[..., :3, :3] = so3_exp(d[..., 3:]) @ T[..., :3, :3]
    moved[..., :3, 3] += np.linalg.solve(so3_left_jacobian_inverse(d[..., 3:]), d[..., :3, None])[..., 0]
    return moved


def screw_difference(T: FloatArray, T_reference: FloatArray) -> FloatArray:
    """``d`` (6,) with ``T == screwed(T_reference, d)``."""
    rotation = so3_log(T[:3, :3] @ T_reference[:3, :3].T)
    return np.concatenate([so3_left_jacobian_inverse(rotation) @ (T[:3, 3] - T_reference[:3, 3]), rotation])


def lever_arm(arm: FloatArray) -> FloatArray:
    """Map (..., 6, 6) from a displacement ``d`` of a body to that of a point at ``arm`` (..., 3) from its origin."""
    J = np.zeros((*arm.shape[:-1], 6, 6))
    J[...] = np.eye(6)
    J[..., :3, 3:] = -skew(arm)
    return J


def turn_of_pose(R: FloatArray) -> FloatArray:
    """Map (6, 6) of a displacement of a pose, or a twist, by the rotation ``R`` (3, 3) of its axes."""
    turn = np.zeros((6, 6))
    turn[:3, :3] = turn[3:, 3:] = R
    return turn


def turned(covariance: FloatArray, R: FloatArray) -> FloatArray:
    """Covariance (6, 6) of a pose or twist, rotated by ``R`` (3, 3) into other axes."""
    turn = turn_of_pose(R)
    return np.asarray(turn @ covariance @ turn.T)


def twist_transfer(T_body_frame: FloatArray) -> FloatArray:
    """Map (6, 6) from the twist of a body to that of a frame at ``T_body_frame`` (4, 4) on it, each in its own axes."""
    R = T_body_frame[:3, :3].T
    transfer = np.zeros((6, 6))
    transfer[:3, :3] = transfer[3:, 3:] = R
    transfer[:3, 3:] = -R @ skew(T_body_frame[:3, 3])
    return transfer
