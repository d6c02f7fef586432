"""Corner-level simulation of markers on a wall: what a detector with white corner noise would say."""

import numpy as np

from thermal_fiducial.core.error_model import SystematicErrors
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.geometry.planar_pose import solve_marker_poses
from thermal_fiducial.core.geometry.reprojection import corners_in_map, reproject
from thermal_fiducial.core.geometry.se3 import quaternion_from_rotation, so3_exp, transform
from thermal_fiducial.core.measurements import CORNER_FIELDS, MARKER_DTYPE

SIZE = 0.3
CAMERA = Camera(640, 512, np.array([[529.0, 0.0, 319.5], [0.0, 529.0, 255.5], [0.0, 0.0, 1.0]]))
#: What corners of a detector with white noise have of them.
NO_SYSTEMATIC_ERRORS = SystematicErrors(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
#: 30 frames a second, counted from 1 s.
FRAME_NS = 33_333_333
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
    """T_map_camera of a camera at ``position`` that looks at ``target``."""
    z = np.asarray(target, dtype=float) - position
    z /= np.linalg.norm(z)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    return transform(np.stack([x, np.cross(z, x), z], axis=-1) @ so3_exp([0.0, 0.0, roll]), position)


def mirrored(T_map_marker, T_map_camera):
    """About the other pose of a marker that a camera sees alike: turned half round the line of sight and its normal."""
    sight = T_map_camera[:3, 3] - T_map_marker[:3, 3]
    half_turn = so3_exp(np.pi * sight / np.linalg.norm(sight))
    R = half_turn @ T_map_marker[:3, :3] @ so3_exp([0.0, 0.0, np.pi])
    return transform(R, T_map_marker[:3, 3])


def flight(t):
    """T_map_camera of a slow flight in front of the wall at time ``t`` [s]."""
    position = [-3.2 + 0.7 * np.sin(0.6 * t), 1.4 * np.sin(0.45 * t), 1.5 + 0.5 * np.sin(0.8 * t)]
    return look(position, [0.0, 0.6 * np.sin(0.31 * t), 1.5 + 0.2 * np.sin(0.5 * t)], 0.1 * np.sin(0.7 * t))


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
