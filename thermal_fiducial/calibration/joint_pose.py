"""Camera pose from markers of known pose alone: without map errors, history or initial value."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from thermal_fiducial.core.geometry import se3
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.geometry.planar_pose import CameraFit, ippe_square
from thermal_fiducial.core.types import FloatArray
from thermal_fiducial.errors import InputError

# Two branches whose chi-squares differ by less than this factor are ambiguous: then the prediction decides.
_AMBIGUOUS_RATIO = 4.0
# Ratio of a parameter's variance to its variance with the others known, above which it counts as undetermined.
_UNKNOWN = 1e13


@dataclass(frozen=True, slots=True)
class JointPose:
    """The camera in the map from all corners of a frame."""

    #: (4, 4)
    T_map_camera: FloatArray
    #: (6, 6), ROS convention, in the map [m, rad]
    covariance: FloatArray
    #: rms over all corners (length of the 2-vector)
    rms_px: float


def solve_camera_pose(
    corners: npt.ArrayLike,
    covs: npt.ArrayLike,
    corners_in_map: npt.ArrayLike,
    camera: Camera,
    initial: FloatArray | None = None,
    compete: bool = True,
) -> JointPose:
    """Pose of the camera from N markers of known pose jointly.

    Both planar poses of every marker compete as the start (the one that explains all markers best wins), and so
    does ``initial``, which also wins a tie between the branches of a lone marker. The error is the squared Mahalanobis
    distance d of each corner up to c = 3, and ``c^2 (1 + 2 log(d / c))`` beyond, so that outliers lose all influence.

    Parameters
    ----------
    corners : (N, 4, 2) [px] in the raw image
    covs : (N, 4, 2, 2) [px^2]
    corners_in_map : (N, 4, 3) [m] squares, in the order of ``marker_corners``
    initial : (4, 4) predicted T_map_camera
    compete : False: ``initial`` is good, nothing else need be tried

    Raises
    ------
    InputError
        No markers, or no pose that sees them.
    """
    corners, squares = np.asarray(corners, dtype=np.float64), np.asarray(corners_in_map, dtype=np.float64)
    if len(corners) == 0:
        raise InputError('no markers to compute a camera pose from')
    fitted = CameraFit(corners, np.asarray(covs, dtype=np.float64), squares, camera)
    starts = np.zeros((0, 4, 4)) if initial is None else initial[None]
    if compete or initial is None:
        single = _single_markers(camera.normalise(corners), squares)
        starts = np.concatenate([starts, single[np.argsort(fitted.costs(single))[:2]]])
    T, chi2, information = fitted.solve(starts)
    best = _likeliest(chi2, 8 * len(corners) - 6, initial is not None)
    seen = camera.project(se3.apply(se3.inverse(T[best]), squares.reshape(-1, 3)))
    squared = np.sum((corners - seen.reshape(-1, 4, 2)) ** 2, axis=-1)
    if not (np.isfinite(chi2[best]) and np.isfinite(squared).all()):
        raise InputError(f'no camera pose explains the {len(corners)} markers')
    covariance = _of_camera(_covariance(information[best]), T[best], squares.mean(axis=(0, 1)))
    return JointPose(T[best], covariance, float(np.sqrt(squared.mean())))


def _likeliest(chi2: FloatArray, freedom: int, predicted: bool) -> int:
    """Index of the smallest of chi-squares (B,), or 0 if that is ``predicted`` and not clearly worse."""
    best = int(np.argmin(chi2))
    return 0 if predicted and chi2[0] <= _AMBIGUOUS_RATIO * max(chi2[best], freedom) else best


def _single_markers(normalised: FloatArray, squares: FloatArray) -> FloatArray:
    """T_map_camera (2 N, 4, 4) from both poses of each square (N, 4, 3) [m] of normalised corners (N, 4, 2)."""
    right, up = squares[:, 1] - squares[:, 0], squares[:, 0] - squares[:, 3]
    sizes = np.linalg.norm(right, axis=-1)
    x, y = right / sizes[:, None], up / np.linalg.norm(up, axis=-1, keepdims=True)
    T_map_square = se3.transform(np.stack([x, y, np.cross(x, y)], axis=-1), squares.mean(axis=1))
    return (T_map_square[:, None] @ se3.inverse(ippe_square(normalised, sizes))).reshape(-1, 4, 4)


def _covariance(information: FloatArray) -> FloatArray:
    """Covariance (6, 6); inf where some direction is undetermined, which a pseudo-inverse would hide."""
    scale = np.sqrt(np.maximum(np.diag(information), 1e-300))
    scale = np.outer(scale, scale)
    # The ridge is below the rounding of determined directions, and keeps undetermined ones from being singular.
    inflation = np.linalg.inv(information / scale + 1e-14 * np.eye(6))
    own = np.diag(inflation)
    known = np.all((own > 0.0) & (own < _UNKNOWN))
    return np.asarray(0.5 * (inflation + inflation.T) / scale if known else np.full((6, 6), np.inf))


def _of_camera(covariance: FloatArray, T_map_camera: FloatArray, middle: FloatArray) -> FloatArray:
    """Covariance (6, 6) of the camera in the map from that of the map in the camera, turned about its ``middle``.

    With ``t -> t + d`` and ``R -> exp(w) R`` of the map in the camera, the camera, at ``-R^T t`` from the middle, moves
    by ``R^T (t x w' - d)``, w' = -w, and turns by ``-R^T w``.
    """
    R = T_map_camera[:3, :3]
    A = np.zeros((6, 6))
    A[:3, :3] = A[3:, 3:] = -R
    A[:3, 3:] = -R @ se3.skew(R.T @ (middle - T_map_camera[:3, 3]))
    with np.errstate(invalid='ignore'):
        return np.asarray(A @ covariance @ A.T)
