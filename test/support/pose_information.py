"""What the corners of markers say of their poses."""

import numpy as np

from thermal_fiducial.core.geometry.reprojection import linearise, whitening


def information_of_poses(camera, T_camera_marker, covariances, size):
    """Information (N, 6, 6) of poses (N, 4, 4) of markers by corners with ``covariances`` (N, 4, 2, 2) [px^2]."""
    n = len(T_camera_marker)
    _, _, J = linearise(camera, np.broadcast_to(np.eye(4), (n, 4, 4)), T_camera_marker, np.full(n, size))
    J = (whitening(covariances) @ J.reshape(n, 4, 2, 6)).reshape(n, 8, 6)
    return J.swapaxes(1, 2) @ J
