"""Pose of a marker, and of the camera from all markers of a frame, with covariances.

A square seen in one image has two poses that explain its corners almost equally well. Both are computed in closed
form and each is then polished by Levenberg-Marquardt on the re-projection error in the distorted image, weighted with
the corner covariances. Covariances are ``inv(J^T W J)`` with every cross term, in the ROS convention: translation,
then rotation, in the parent frame.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from thermal_fiducial.core import geometry
from thermal_fiducial.core.adjustment.ippe import ippe_square, marker_corners
from thermal_fiducial.core.adjustment.reprojection import whitening
from thermal_fiducial.core.adjustment.rigid_fit import covariances, evaluate, fit, Images
from thermal_fiducial.core.camera import Camera
from thermal_fiducial.core.types import FloatArray
from thermal_fiducial.errors import InputError

__all__ = [
    'JointPose',
    'PlanarPose',
    'choose_branch',
    'choose_branches',
    'ippe_square',
    'marker_corners',
    'solve_camera_pose',
    'solve_marker_pose',
    'solve_marker_poses',
]

# Mahalanobis distance of a corner (99 % of a chi-square of two degrees of freedom) beyond which it loses weight.
_INLIER = 3.0
# Two branches whose chi-squares differ by less than this factor are ambiguous: then the prediction decides.
_AMBIGUOUS_RATIO = 4.0


@dataclass(frozen=True, slots=True)
class PlanarPose:
    """Both poses of one marker in the camera; the better one first."""

    #: (4, 4)
    T_camera_marker: FloatArray
    #: (6, 6), ROS convention, in the camera frame [m, rad]
    covariance: FloatArray
    #: re-projection error, rms over the four corners (length of the 2-vector) [px]; inf: no pose found
    rms_px: float
    #: (4, 4) the other branch; the same pose where both branches meet
    T_alternative: FloatArray
    alternative_rms_px: float
    #: (6, 6) of the other branch
    alternative_covariance: FloatArray
    #: weighted squared errors of both: with honest corner covariances, chi-square of two degrees of freedom
    chi2: float
    alternative_chi2: float

    def ambiguous(self, ratio: float = 10.0) -> bool:
        """Whether the image allows the other branch: its squared error is below ``ratio`` times this one's, or of 2.

        2 is what the errors of corners with honest covariances come to.
        """
        return bool(self.alternative_chi2 <= ratio * max(self.chi2, 2.0))

    def swapped(self) -> 'PlanarPose':
        """The other branch first."""
        return PlanarPose(
            self.T_alternative,
            self.alternative_covariance,
            self.alternative_rms_px,
            self.T_camera_marker,
            self.rms_px,
            self.covariance,
            self.alternative_chi2,
            self.chi2,
        )


@dataclass(frozen=True, slots=True)
class JointPose:
    """The camera in the map from all corners of a frame."""

    #: (4, 4)
    T_map_camera: FloatArray
    #: (6, 6), ROS convention, in the map [m, rad]
    covariance: FloatArray
    #: (N, 4, 2) measured minus predicted
    residuals_px: FloatArray
    #: rms over all corners (length of the 2-vector)
    rms_px: float
    #: robust weighted squared error; with honest covariances, chi-square of 8 N - 6 degrees of freedom
    chi2: float


def solve_marker_pose(corners_px: npt.ArrayLike, corner_cov: npt.ArrayLike, size: float, camera: Camera) -> PlanarPose:
    """Both poses of one marker.

    Parameters
    ----------
    corners_px : (4, 2) in the raw image, in the order of :func:`marker_corners`
    corner_cov : (4, 2, 2) [px^2]
    size : side [m]

    Raises
    ------
    InputError
        Corners from which no pose in front of the camera follows.
    """
    corners = np.asarray(corners_px, dtype=np.float64)[None]
    pose = solve_marker_poses(corners, np.asarray(corner_cov, dtype=np.float64)[None], np.array([size]), camera)[0]
    if not np.isfinite(pose.rms_px):
        raise InputError(f'no pose of a marker follows from the corners {corners[0].tolist()}')
    return pose


def solve_marker_poses(
    corners_px: FloatArray, corner_covs: FloatArray, sizes: FloatArray, camera: Camera
) -> list[PlanarPose]:
    """Both poses of N markers: (N, 4, 2), (N, 4, 2, 2), (N,); where there is none, ``rms_px`` is inf."""
    count = len(corners_px)
    W = whitening(corner_covs)
    images = Images.of(corners_px, W, camera)
    points = np.repeat(sizes[:, None, None] * marker_corners(1.0), 2, axis=0)
    T, cost, information = fit(
        ippe_square(images.normalised, sizes).reshape(2 * count, 4, 4), points, images.repeated(2)
    )
    residuals = np.repeat(corners_px, 2, axis=0) - camera.project(geometry.apply(T, points))
    rms = np.sqrt(0.25 * np.sum(residuals**2, axis=(-2, -1)))
    chi2 = np.sum((np.repeat(W, 2, axis=0) @ residuals[..., None]) ** 2, axis=(-3, -2, -1))
    facing = np.sum(T[:, :3, 2] * T[:, :3, 3], axis=-1) < 0.0
    rms = np.where(np.isfinite(cost) & np.isfinite(chi2) & facing, rms, np.inf)
    covariance = covariances(information)
    poses = []
    for first in range(0, 2 * count, 2):
        a, b = first, first + 1
        if not np.isfinite(rms[a]) or (np.isfinite(rms[b]) and chi2[b] < chi2[a]):
            a, b = b, a
        if not np.isfinite(rms[b]):
            b = a
        poses.append(
            PlanarPose(T[a], covariance[a], float(rms[a]), T[b], float(rms[b]), covariance[b], chi2[a], chi2[b])
        )
    return poses


def choose_branch(pose: PlanarPose, T_camera_marker_expected: FloatArray, ratio: float = 10.0) -> PlanarPose:
    """``pose`` with that branch first whose rotation is closer to the expected one.

    The expectation (from other markers of the frame, or the filter) decides only between branches that the image
    allows: :meth:`PlanarPose.ambiguous`.
    """
    if not pose.ambiguous(ratio):
        return pose
    # The smaller the angle between two rotations, the larger the trace of R_1^T R_2.
    R = T_camera_marker_expected[:3, :3]
    nearer = np.sum(pose.T_alternative[:3, :3] * R) > np.sum(pose.T_camera_marker[:3, :3] * R)
    return pose.swapped() if nearer else pose


def choose_branches(
    poses: list[PlanarPose],
    corners_px: FloatArray,
    corner_covs: FloatArray,
    in_map: list[tuple[FloatArray, float] | None],
    camera: Camera,
    T_camera_map: FloatArray | None = None,
) -> list[PlanarPose]:
    """The poses of a frame's markers with the likelier branch first.

    What decides between branches that the image allows is the pose of the camera: jointly from all known markers in
    view where there are several, else the predicted one, if any.

    Parameters
    ----------
    poses : of N markers
    corners_px, corner_covs : (N, 4, 2), (N, 4, 2, 2)
    in_map : N times T_map_marker (4, 4) and side [m], or None for a marker of unknown pose
    T_camera_map : (4, 4) predicted
    """
    known = [k for k, entry in enumerate(in_map) if entry is not None]
    if not any(poses[k].ambiguous() for k in known):
        return poses
    T_map_marker = {k: entry[0] for k, entry in enumerate(in_map) if entry is not None}
    if len(known) > 1:
        squares = [geometry.apply(entry[0], marker_corners(entry[1])) for entry in in_map if entry is not None]
        initial = None if T_camera_map is None else geometry.inverse(T_camera_map)
        try:
            joint = solve_camera_pose(corners_px[known], corner_covs[known], np.stack(squares), camera, initial)
            T_camera_map = geometry.inverse(joint.T_map_camera)
        except InputError:
            # No camera sees them all like this: the prediction is what is left.
            pass
    if T_camera_map is None:
        return poses
    return [
        choose_branch(pose, T_camera_map @ T_map_marker[k]) if k in T_map_marker else pose
        for k, pose in enumerate(poses)
    ]


def solve_camera_pose(
    corners: npt.ArrayLike,
    covs: npt.ArrayLike,
    corners_in_map: npt.ArrayLike,
    camera: Camera,
    initial: FloatArray | None = None,
    weights: npt.ArrayLike | None = None,
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
    corners_in_map : (N, 4, 3) [m] squares, in the order of :func:`marker_corners`
    initial : (4, 4) predicted T_map_camera
    weights : (N,) factors on the information of each marker; default 1
    compete : False: ``initial`` is good, nothing else need be tried

    Raises
    ------
    InputError
        No markers, or no pose that sees them.
    """
    corners = np.asarray(corners, dtype=np.float64)
    squares = np.asarray(corners_in_map, dtype=np.float64)
    if len(corners) == 0:
        raise InputError('no markers to compute a camera pose from')
    W = whitening(np.asarray(covs, dtype=np.float64))
    if weights is not None:
        W = W * np.sqrt(np.asarray(weights, dtype=np.float64))[:, None, None, None]
    images = Images.of(corners.reshape(1, -1, 2), W.reshape(1, -1, 2, 2), camera)
    # Turned about their middle, translation and rotation of the points hardly depend on each other.
    middle = geometry.transform(np.eye(3), squares.mean(axis=(0, 1)))
    points = (squares - middle[:3, 3]).reshape(1, -1, 3)
    starts = np.empty((0, 4, 4)) if initial is None else np.asarray(initial, dtype=np.float64)[None]
    starts = geometry.inverse(starts) @ middle
    if compete or initial is None:
        others = _camera_starts(images.normalised.reshape(corners.shape), squares) @ middle
        cost = evaluate(others, points, images, _INLIER)[0]
        starts = np.concatenate([starts, others[np.argsort(cost)[:2]]])
    T_camera_middle, chi2, information = fit(starts, points, images, _INLIER)
    best = int(np.argmin(chi2))
    if initial is not None and chi2[0] <= _AMBIGUOUS_RATIO * max(chi2[best], 8.0 * len(corners) - 6.0):
        best = 0
    T_map_camera = middle @ geometry.inverse(T_camera_middle[best])
    residuals = corners - camera.project(geometry.apply(T_camera_middle[best], points).reshape(squares.shape))
    squared = np.sum(residuals**2, axis=-1)
    if not (np.isfinite(chi2[best]) and np.isfinite(squared).all()):
        raise InputError(f'no camera pose explains the {len(corners)} markers')
    return JointPose(
        T_map_camera,
        _of_camera(covariances(information[best]), T_camera_middle[best]),
        residuals,
        float(np.sqrt(squared.mean())),
        float(chi2[best]),
    )


def _camera_starts(normalised: FloatArray, squares: FloatArray) -> FloatArray:
    """T_camera_map (2 N, 4, 4) from both poses of each square (N, 4, 3) [m] of normalised corners (N, 4, 2)."""
    right, up = squares[:, 1] - squares[:, 0], squares[:, 0] - squares[:, 3]
    sizes = np.linalg.norm(right, axis=-1)
    x, y = right / sizes[:, None], up / np.linalg.norm(up, axis=-1, keepdims=True)
    T_map_square = geometry.transform(np.stack([x, y, np.cross(x, y)], axis=-1), squares.mean(axis=1))
    return (ippe_square(normalised, sizes) @ geometry.inverse(T_map_square)[:, None]).reshape(-1, 4, 4)


def _of_camera(covariance: FloatArray, T_camera_body: FloatArray) -> FloatArray:
    """Covariance (6, 6) of the camera in the body, in the body's axes, from that of the body in the camera.

    With ``t -> t + d`` and ``R -> exp(w) R`` of the body, the camera, at ``-R^T t``, moves by ``R^T (t x w' - d)``,
    w' = -w, and turns by ``-R^T w``.
    """
    R_t = T_camera_body[:3, :3].T
    A = np.zeros((6, 6))
    A[:3, :3] = A[3:, 3:] = -R_t
    A[:3, 3:] = -R_t @ geometry.skew(T_camera_body[:3, 3])
    with np.errstate(invalid='ignore'):
        return np.asarray(A @ covariance @ A.T)
