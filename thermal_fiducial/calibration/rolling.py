"""Information of a frame's corners on the read-out time.

Row v is sampled at ``stamp + readout_time (v / (height - 1) - 1/2)``. While the camera moves with the twist tau (map
frame, as pose errors are), a corner at the share s of the read-out appears at ``u + J s tau readout_time``. With the
frame's pose eliminated, the moments below are sufficient statistics of the read-out time, for any twist.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from thermal_fiducial.calibration.joint_pose import solve_camera_pose
from thermal_fiducial.core.error_model import DRAWS, SystematicErrors
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.geometry.reprojection import corners_in_map, linearise, whitening
from thermal_fiducial.core.lens_errors import LensErrors
from thermal_fiducial.core.measurements import CameraPose
from thermal_fiducial.core.types import FloatArray

# Mahalanobis distance of a corner beyond which it loses weight, as in the solution of the pose.
_INLIER = 3.0
# Errors that all frames of a recording have in common.
_ERRORS = SystematicErrors()


@dataclass(frozen=True)
class RowMoments:
    """Sums over the whitened corners of a frame, or of N frames with a leading dimension.

    Parameters
    ----------
    cross : (6, 6) J' S J, with S the shares of the read-out, -1/2 in the first row and 1/2 in the last
    square : (6, 6) J' S S J
    residual : (6,) J' S rho, with rho the residuals of the corners
    """

    cross: FloatArray
    square: FloatArray
    residual: FloatArray

    @staticmethod
    def stacked(moments: Sequence['RowMoments']) -> 'RowMoments':
        """The moments of N frames, stacked."""
        parts = zip(*((m.cross, m.square, m.residual) for m in moments), strict=True)
        return RowMoments(*(np.stack(part) for part in parts))


@dataclass(frozen=True)
class FrameCorners:
    """Detections of mapped markers in a frame.

    Parameters
    ----------
    stamp_ns : by the camera's clock
    corners_px, covariances : (N, 4, 2), (N, 4, 2, 2) in the raw image, with rolling-shutter displacement
    T_map_marker, sizes : (N, 4, 4), (N,)
    """

    stamp_ns: int
    corners_px: FloatArray
    covariances: FloatArray
    T_map_marker: FloatArray
    sizes: FloatArray

    @property
    def points(self) -> FloatArray:
        """Corners (N, 4, 3) in the map [m]."""
        return corners_in_map(self.T_map_marker, self.sizes)

    def solved(
        self, camera: Camera, shift: FloatArray | None = None, initial: FloatArray | None = None
    ) -> 'SolvedFrame':
        """Pose of the camera, from the corners moved by ``shift`` (N, 4, 2) [px].

        Raises
        ------
        InputError
            No camera pose fits the corners.
        """
        corners = self.corners_px if shift is None else self.corners_px + shift
        pose = solve_camera_pose(corners, self.covariances, self.points, camera, initial)
        T_map_camera, covariance = pose.T_map_camera, pose.covariance
        moments, off = self._moments(camera, T_map_camera, corners)
        by_size = np.zeros((6, 1))
        by_size[:3, 0] = _ERRORS.marker_size_std * (T_map_camera[:3, 3] - self.T_map_marker[:, :3, 3].mean(axis=0))
        systematic = np.concatenate([covariance @ off, by_size], axis=1)
        fitted = CameraPose(self.stamp_ns, T_map_camera, covariance, rms_px=pose.rms_px)
        return SolvedFrame(self, fitted, moments, systematic)

    def _moments(self, camera: Camera, T_map_camera: FloatArray, corners: FloatArray) -> tuple[RowMoments, FloatArray]:
        """The moments, and the sums (6, K) J' off over the corners, off by :func:`corner_errors`."""
        count = len(corners)
        poses = np.broadcast_to(T_map_camera, (count, 4, 4))
        predicted, J, _ = linearise(camera, poses, self.T_map_marker, self.sizes)
        W = whitening(self.covariances)
        rho = (W @ (corners - predicted)[..., None])[..., 0].reshape(-1, 2)
        weight = np.minimum(1.0, _INLIER / np.maximum(np.linalg.norm(rho, axis=1), 1e-12))
        J = (W @ J.reshape(count, 4, 2, 6)).reshape(-1, 2, 6) * weight[:, None, None]
        moved = J * camera.readout_shares(self.corners_px[..., 1]).reshape(-1, 1, 1)
        moments = RowMoments(
            np.einsum('nij,nik->jk', J, moved),
            np.einsum('nij,nik->jk', moved, moved),
            np.einsum('nij,ni->j', moved, rho * weight[:, None]),
        )
        off = (W @ corner_errors(self.corners_px, camera)).reshape(-1, 2, DRAWS) * weight[:, None, None]
        return moments, np.einsum('nij,nik->jk', J, off)


def corner_errors(corners: FloatArray, camera: Camera) -> FloatArray:
    """Errors (N, 4, 2, K) [px] of corners (N, 4, 2) whose sum of squares is the variance by lens and focal length."""
    return np.asarray(LensErrors(corners, camera, _ERRORS).drawn() / np.sqrt(DRAWS))


@dataclass(frozen=True)
class SolvedFrame:
    """Corners with the pose of the camera that fits them best, and their moments about it."""

    corners: FrameCorners
    pose: CameraPose
    rows: RowMoments
    #: (6, K) errors of the pose by a standard deviation of each systematic error: of lens, focal length, sides
    systematic: FloatArray
