"""Corner-level simulation of markers on a wall: what a detector with white corner noise would say."""

import numpy as np

from thermal_fiducial.core.error_model import SystematicErrors
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.geometry.planar_pose import solve_marker_poses
from thermal_fiducial.core.geometry.reprojection import corners_in_map, reproject
from thermal_fiducial.core.geometry.se3 import quaternion_from_rotation, screw_difference, skew, so3_exp, transform
from thermal_fiducial.core.lens_errors import LensErrors
from thermal_fiducial.core.measurements import CORNER_FIELDS, MARKER_DTYPE, Odometry

SIZE = 0.3
CAMERA = Camera(640, 512, np.array([[529.0, 0.0, 319.5], [0.0, 529.0, 255.5], [0.0, 0.0, 1.0]]))
#: What corners of a detector with white noise have of them.
NO_SYSTEMATIC_ERRORS = SystematicErrors(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
#: 30 frames a second, counted from 1 s.
FRAME_NS = 33_333_333
#: Standard deviations of the velocity [m/s] and of the turn rate [rad/s] of a filter.
TWIST_STD = 0.03, 0.01
#: Noise of corners that are read row by row [px].
NOISE_PX = 0.05
# A marker that hangs on the wall x = 0 and faces -x: its x to map -y, its y to map z.
_FACING = np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


def wall(rng, count=8, tilt=0.1):
    """T_map_marker by ID: two rows a metre apart, unevenly hung."""
    return {
        i: transform(
            so3_exp(tilt * rng.normal(size=3)) @ _FACING,
            [rng.uniform(-0.2, 0.2), (i % 4 - 1.5) * 1.0, 1.0 + (i // 4) * 1.0],
        )
        for i in range(count)
    }


def hung(rng, position, yaw, tilt=0.1):
    """T_map_marker of one unevenly hung, as on a wall x = const, at ``position``, both turned by ``yaw`` [rad]."""
    R = so3_exp([0.0, 0.0, yaw])
    return transform(R @ so3_exp(tilt * rng.normal(size=3)) @ _FACING, R @ position)


def look(position, target, roll=0.0):
    """T_map_camera (..., 4, 4) of cameras at ``position`` (..., 3) that look at ``target``."""
    z = np.asarray(target, dtype=float) - position
    z /= np.linalg.norm(z, axis=-1, keepdims=True)
    # The cross product of z and up.
    x = np.stack([z[..., 1], -z[..., 0], np.zeros(z.shape[:-1])], axis=-1)
    x /= np.linalg.norm(x, axis=-1, keepdims=True)
    y = (skew(z) @ x[..., None])[..., 0]
    return transform(np.stack([x, y, z], axis=-1) @ so3_exp(np.multiply.outer(roll, [0.0, 0.0, 1.0])), position)


def mirrored(T_map_marker, T_map_camera):
    """About the other pose of a marker that a camera sees alike: turned half round the line of sight and its normal."""
    sight = T_map_camera[:3, 3] - T_map_marker[:3, 3]
    half_turn = so3_exp(np.pi * sight / np.linalg.norm(sight))
    R = half_turn @ T_map_marker[:3, :3] @ so3_exp([0.0, 0.0, np.pi])
    return transform(R, T_map_marker[:3, 3])


def flight(t):
    """T_map_camera (..., 4, 4) of a slow flight in front of the wall at times ``t`` (...) [s]."""
    position = _vectors(-3.2 + 0.7 * np.sin(0.6 * t), 1.4 * np.sin(0.45 * t), 1.5 + 0.5 * np.sin(0.8 * t))
    return look(position, _vectors(0.0, 0.6 * np.sin(0.31 * t), 1.5 + 0.2 * np.sin(0.5 * t)), 0.1 * np.sin(0.7 * t))


def brisk(t):
    """T_map_camera (..., 4, 4) at times (...) [s]: 1 m/s, and turns of 1 rad/s."""
    T = look(_vectors(-3.2, 0.5 * np.sin(2.0 * t), 1.5 + 0.2 * np.sin(1.3 * t)), [0.0, 0.0, 1.5])
    turn = _vectors(0.15 * np.sin(3.1 * t), 0.35 * np.sin(2.7 * t + 1.0), 0.05 * np.sin(t))
    return T @ transform(so3_exp(turn), np.zeros(3))


def _vectors(x, y, z):
    vectors = np.empty((*np.shape(y), 3))
    vectors[..., 0], vectors[..., 1], vectors[..., 2] = x, y, z
    return vectors


def odometry(path, k, rng, twist_std=TWIST_STD):
    """The filter's at frame ``k``, as the camera is the body: the true pose, and a velocity that is unsure."""
    t, truth, stds = k / 30, path(k / 30), np.repeat(twist_std, 3)
    in_map = screw_difference(path(t + 1e-4), path(t - 1e-4)) / 2e-4
    twist = np.concatenate([in_map[:3] @ truth[:3, :3], in_map[3:] @ truth[:3, :3]]) + stds * rng.normal(size=6)
    of_pose = np.diag(np.repeat([0.01, 0.0025], 3) ** 2)
    return Odometry(stamp(k), truth, twist[:3], twist[3:], of_pose, np.diag(stds**2))


def read_row_by_row(path, t, poses, readout, rng, lens=None):
    """Markers of a frame at ``t`` [s] whose corners are where they are when their own rows are read."""
    ids, middle = np.array(sorted(poses)), (CAMERA.height - 1) / 2.0
    points = corners_in_map(np.stack([poses[key] for key in ids]), np.full(len(ids), SIZE))
    v = np.full((len(ids), 4), middle)
    for _ in range(4):
        instants = t + readout * (v / (CAMERA.height - 1) - 0.5)
        T = path(instants)
        away = (points - T[..., :3, 3])[..., None, :]
        px = CAMERA.project((away @ T[..., :3, :3])[..., 0, :])
        v = px[..., 1]
    if lens is not None:
        px = px + LensErrors(px, CAMERA, SystematicErrors()).drawn()[..., lens]
    seen = CAMERA.contains(px, 5.0).all(axis=-1)
    return rows(ids[seen], px[seen] + NOISE_PX * rng.normal(size=px[seen].shape), NOISE_PX)


def stamp(k):
    """Stamp of frame ``k`` [ns]."""
    return 1_000_000_000 + k * FRAME_NS


def see(T_map_camera, poses, sigma, rng, size=SIZE, camera=CAMERA):
    """Rows of the markers in view, with corner noise ``sigma`` [px] that the rows' covariances declare."""
    ids = np.array(sorted(poses))
    T = np.stack([poses[key] for key in ids])
    uv = reproject(camera, T_map_camera, corners_in_map(T, np.full(len(ids), size)))
    towards = T_map_camera[:3, 3] - T[:, :3, 3]
    facing = np.sum(T[:, :3, 2] * towards, axis=-1) > 0.2 * np.linalg.norm(towards, axis=-1)
    seen = np.all(camera.contains(uv, 5.0), axis=-1) & facing
    corners = uv[seen] + sigma * rng.normal(size=uv[seen].shape)
    # A noiseless corner still declares some covariance.
    return rows(ids[seen], corners, max(sigma, 1e-3), size, camera)


def rows(ids, corners, sigma, size=SIZE, camera=CAMERA):
    """Rows of MARKER_DTYPE of markers with ``corners`` (N, 4, 2)."""
    n = len(ids)
    result = np.zeros(n, MARKER_DTYPE)
    result['id'], result['sigma_px'] = ids, sigma
    for name, column in zip(CORNER_FIELDS, corners.reshape(n, 8).T, strict=True):
        result[name] = column
    covariances = np.broadcast_to(sigma**2 * np.eye(2), (n, 4, 2, 2))
    for c in range(4):
        result[f'c{c}uu'] = result[f'c{c}vv'] = sigma**2
    if n:
        poses = solve_marker_poses(corners, covariances, np.full(n, size), camera)
        _fill(result, '', poses.T_camera_marker[:, 0])
        _fill(result, 'a', poses.T_camera_marker[:, 1])
    return result


def _fill(result, prefix, T):
    q = quaternion_from_rotation(T[:, :3, :3])
    for name, column in zip('xyz', T[:, :3, 3].T, strict=True):
        result[prefix + name] = column
    for name, column in zip(('qx', 'qy', 'qz', 'qw'), q.T, strict=True):
        result[prefix + name] = column
