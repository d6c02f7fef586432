"""A bundle adjustment that shares nothing with the one under test: scipy's rotations, derivatives by differences, one
large sparse system, plain least squares."""

import numpy as np
from scipy.sparse import coo_array, diags
from scipy.sparse.linalg import spsolve
from scipy.spatial.transform import Rotation

_CORNERS = np.array([[-0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [0.5, -0.5, 0.0], [-0.5, -0.5, 0.0]])
_STEP = 1e-6


def _moved(T, d):
    """Poses (n, 4, 4) turned and shifted by d (n, 6) in their parent frame."""
    result = T.copy()
    result[:, :3, :3] = Rotation.from_rotvec(d[:, 3:]).as_matrix() @ T[:, :3, :3]
    result[:, :3, 3] += d[:, :3]
    return result


def _pixels(K, T_map_camera, T_map_marker, size):
    points = np.einsum('nij,kj->nki', T_map_marker[:, :3, :3], size * _CORNERS) + T_map_marker[:, None, :3, 3]
    p = np.einsum('nji,nkj->nki', T_map_camera[:, :3, :3], points - T_map_camera[:, None, :3, 3])
    return p[..., :2] / p[..., 2:] * [K[0, 0], K[1, 1]] + K[:2, 2]


def _derivatives(K, C, M, size):
    """Of the pixels (n, 8) with respect to the camera's and the marker's pose: (n, 8, 6) each, central differences."""
    J = np.empty((2, len(C), 8, 6))
    for axis in range(6):
        d = np.zeros((len(C), 6))
        d[:, axis] = _STEP
        camera = _pixels(K, _moved(C, d), M, size) - _pixels(K, _moved(C, -d), M, size)
        marker = _pixels(K, C, _moved(M, d), size) - _pixels(K, C, _moved(M, -d), size)
        J[0, :, :, axis], J[1, :, :, axis] = (side.reshape(-1, 8) / (2.0 * _STEP) for side in (camera, marker))
    return J


def adjust(K, size, views, cameras, markers, held, steps=30):
    """Least squares over all poses.

    Parameters
    ----------
    K : (3, 3) of a camera without distortion
    views : list of (frame, marker ID, corners (4, 2))
    cameras, markers : frame to T_map_camera, marker ID to T_map_marker: the start
    held : marker ID that stays

    Returns
    -------
    Marker ID to T_map_marker, and the rms re-projection error [px].
    """
    frames, ids = sorted(cameras), sorted(markers)
    f = np.array([frames.index(frame) for frame, _, _ in views])
    m = np.array([ids.index(key) for _, key, _ in views])
    uv = np.array([corners for _, _, corners in views])
    C, M = np.stack([cameras[k] for k in frames]), np.stack([markers[k] for k in ids])
    free = np.ones(len(ids))
    free[ids.index(held)] = 0.0
    n, nodes, damping, cost = len(views), len(frames) + len(ids), 1e-3, np.inf
    row = np.broadcast_to(8 * np.arange(n)[:, None, None] + np.arange(8)[:, None], (n, 8, 6))
    column = np.stack(
        [np.broadcast_to(6 * k[:, None, None] + np.arange(6), (n, 8, 6)) for k in (f, len(frames) + m)]
    ).ravel()
    for _ in range(steps):
        r = (uv - _pixels(K, C[f], M[m], size)).reshape(n, 8)
        blocks = _derivatives(K, C[f], M[m], size)
        blocks[1] *= free[m][:, None, None]
        J = coo_array((blocks.ravel(), (np.tile(row.ravel(), 2), column)), shape=(8 * n, 6 * nodes)).tocsc()
        H = (J.T @ J).tocsc()
        previous, cost = cost, float(np.sum(r * r))
        if abs(previous - cost) < 1e-9 * cost:
            break
        damped = (H + diags(damping * H.diagonal() + 1e-9)).tocsc()
        step = spsolve(damped, J.T @ r.ravel()).reshape(-1, 6)
        damping *= 0.1
        C, M = _moved(C, step[: len(frames)]), _moved(M, step[len(frames) :])
    return dict(zip(ids, M, strict=True)), float(np.sqrt(cost / (4 * n)))
