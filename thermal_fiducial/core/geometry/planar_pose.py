"""Pose of a marker, and of the camera from all markers of a frame, with covariances.

A square seen in one image has two poses that explain its corners almost equally well. Both are computed in closed
form and each is then polished by Levenberg-Marquardt on the re-projection error in the distorted image, weighted with
the corner covariances. Covariances are ``inv(J^T W J)`` with every cross term, in the ROS convention: translation,
then rotation, in the parent frame.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from thermal_fiducial.core.geometry import se3
from thermal_fiducial.core.geometry.camera import Camera, ImagePoints
from thermal_fiducial.core.geometry.ippe import ippe_square, marker_corners
from thermal_fiducial.core.geometry.reprojection import whitening
from thermal_fiducial.core.geometry.rigid_fit import covariances, evaluate, fit, Images
from thermal_fiducial.core.types import BoolArray, FloatArray, IntArray
from thermal_fiducial.errors import InputError

__all__ = [
    'CameraFit',
    'JointPose',
    'PlanarPoses',
    'choose_branches',
    'ippe_square',
    'marker_corners',
    'planar_poses',
    'solve_camera_pose',
    'solve_marker_poses',
]

#: Mahalanobis distance of a corner (99 % of a chi-square of two degrees of freedom) beyond which it loses weight.
INLIER = 3.0
# Two branches whose chi-squares differ by less than this factor are ambiguous: then the prediction decides.
_AMBIGUOUS_RATIO = 4.0


@dataclass(frozen=True, slots=True)
class PlanarPoses:
    """Both poses of N markers in the camera; the better one of each first."""

    #: (N, 2, 4, 4)
    T_camera_marker: FloatArray
    #: (N, 2, 6, 6) information matrices, ROS convention, in the camera frame
    information: FloatArray
    #: (N, 2) re-projection error, rms over the four corners (length of the 2-vector) [px]; inf: no pose found
    rms_px: FloatArray
    #: (N, 2) weighted squared errors: with honest corner covariances, chi-square of two degrees of freedom
    chi2: FloatArray

    @property
    def covariances(self) -> FloatArray:
        """(N, 2, 6, 6) of the poses [m, rad]."""
        return covariances(self.information)

    def ambiguous(self, ratio: float = 10.0) -> BoolArray:
        """Of which markers (N,) the image allows the other branch.

        Its squared error is below ``ratio`` times the first one's, or of 2, which is what the errors of corners with
        honest covariances come to.
        """
        return np.asarray(self.chi2[:, 1] <= ratio * np.maximum(self.chi2[:, 0], 2.0))

    def swapped(self, which: BoolArray) -> 'PlanarPoses':
        """The other branch of the markers ``which`` (N,) first."""
        return self.ordered(np.stack([which, ~which], axis=1).astype(np.intp))

    def ordered(self, branches: IntArray) -> 'PlanarPoses':
        """Those of the branches (N, 2) that come first and second."""
        rows = np.arange(len(branches))[:, None]
        arrays = self.T_camera_marker, self.information, self.rms_px, self.chi2
        return PlanarPoses(*(array[rows, branches] for array in arrays))


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


def solve_marker_poses(
    corners_px: FloatArray, corner_covs: FloatArray, sizes: FloatArray, camera: Camera
) -> PlanarPoses:
    """Both poses of N markers.

    Parameters
    ----------
    corners_px : (N, 4, 2) in the raw image, in the order of :func:`marker_corners`
    corner_covs : (N, 4, 2, 2) [px^2]
    sizes : (N,) sides [m]
    """
    return planar_poses(ImagePoints.at(corners_px, camera), corner_covs, sizes)


def planar_poses(corners: ImagePoints, corner_covs: FloatArray, sizes: FloatArray) -> PlanarPoses:
    """:func:`solve_marker_poses` of corners (N, 4) that are known in both coordinates."""
    images = Images.of(corners, whitening(corner_covs)).repeated(2)
    points = np.repeat(sizes[:, None, None] * marker_corners(1.0), 2, axis=0)
    starts = ippe_square(corners.x, sizes).reshape(-1, 4, 4)
    T, cost, information = fit(starts, points, images, alternatives=2)
    residuals = images.residuals(T, points)[..., None]
    facing = np.sum(T[:, :3, 2] * T[:, :3, 3], axis=-1) < 0.0
    chi2 = np.sum((images.whitening @ residuals) ** 2, axis=(-3, -2, -1))
    chi2 = np.where(np.isfinite(cost) & np.isfinite(chi2) & facing, chi2, np.inf).reshape(-1, 2)
    residuals_px = corners.J[:, None] @ residuals.reshape(-1, 2, 4, 2, 1)
    rms = np.where(np.isfinite(chi2), np.sqrt(0.25 * np.sum(residuals_px**2, axis=(-3, -2, -1))), np.inf)
    poses = PlanarPoses(T.reshape(-1, 2, 4, 4), information.reshape(-1, 2, 6, 6), rms, chi2)
    first = (chi2[:, 1] < chi2[:, 0]).astype(np.intp)
    second = np.where(np.isfinite(chi2).all(axis=1), 1 - first, first)
    return poses.ordered(np.stack([first, second], axis=1))


def choose_branches(
    poses: PlanarPoses,
    corners: ImagePoints,
    corner_covs: FloatArray,
    in_map: list[tuple[FloatArray, float] | None],
    T_camera_map: FloatArray | None = None,
) -> PlanarPoses:
    """The poses of a frame's markers with the likelier branch first.

    What decides between branches that the image allows is the attitude of the camera. Where several known markers are
    in view, it is that of the branch, or of the prediction, that explains all of them best; else the predicted one.

    Parameters
    ----------
    poses : of N markers
    corners, corner_covs : (N, 4), (N, 4, 2, 2) [px^2]
    in_map : N times T_map_marker (4, 4) and side [m], or None for a marker of unknown pose
    T_camera_map : (4, 4) predicted
    """
    known = np.array([k for k, entry in enumerate(in_map) if entry is not None], dtype=np.intp)
    ambiguous = poses.ambiguous()
    if not ambiguous[known].any():
        return poses
    T_map_marker = np.stack([entry[0] for entry in in_map if entry is not None])
    if len(known) > 1:
        starts = (poses.T_camera_marker[known] @ se3.inverse(T_map_marker)[:, None]).reshape(-1, 4, 4)
        if T_camera_map is not None:
            starts = np.concatenate([starts, T_camera_map[None]])
        sizes = np.array([entry[1] for entry in in_map if entry is not None])
        squares = se3.apply(T_map_marker, sizes[:, None, None] * marker_corners(1.0))
        images = Images.of(corners.only(known), whitening(corner_covs[known])).joined()
        T_camera_map = starts[np.argmin(evaluate(starts, squares.reshape(1, -1, 3), images, INLIER)[0])]
    if T_camera_map is None:
        return poses
    # The larger the trace of R_1^T R_2, the smaller the angle between two rotations.
    expected = T_camera_map[:3, :3] @ T_map_marker[:, :3, :3]
    likeness = np.sum(poses.T_camera_marker[known, :, :3, :3] * expected[:, None], axis=(-1, -2))
    nearer = np.zeros(len(ambiguous), dtype=bool)
    nearer[known] = likeness[:, 1] > likeness[:, 0]
    return poses.swapped(nearer & ambiguous)


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
    if len(corners) == 0:
        raise InputError('no markers to compute a camera pose from')
    fitted = CameraFit(
        corners, np.asarray(covs, dtype=np.float64), np.asarray(corners_in_map, dtype=np.float64), camera
    )
    weights = None if weights is None else np.asarray(weights, dtype=np.float64)
    starts = np.zeros((0, 4, 4)) if initial is None else initial[None]
    if compete or initial is None:
        starts = np.concatenate([starts, fitted.from_single_markers(weights)])
    T, chi2, information = fitted.solve(starts, weights)
    best = _likeliest(chi2, 8 * len(corners) - 6, initial is not None)
    residuals = corners - camera.project(se3.apply(se3.inverse(T[best]), fitted.squares.reshape(-1, 3))).reshape(
        -1, 4, 2
    )
    squared = np.sum(residuals**2, axis=-1)
    if not (np.isfinite(chi2[best]) and np.isfinite(squared).all()):
        raise InputError(f'no camera pose explains the {len(corners)} markers')
    covariance = _of_camera(covariances(information[best]), T[best], fitted.middle)
    return JointPose(T[best], covariance, residuals, float(np.sqrt(squared.mean())), float(chi2[best]))


class CameraFit:
    """What all fits of the camera to one frame's N markers of known pose have in common.

    Parameters
    ----------
    corners : (N, 4, 2) [px] in the raw image
    covs : (N, 4, 2, 2) [px^2]
    squares : (N, 4, 3) [m] corners in the map, in the order of :func:`marker_corners`
    """

    def __init__(self, corners: FloatArray, covs: FloatArray, squares: FloatArray, camera: Camera) -> None:
        self.squares = squares
        #: (3,) between the markers: turned about it, translation and rotation hardly depend on each other
        self.middle: FloatArray = squares.mean(axis=(0, 1))
        self._T_map_middle = se3.transform(np.eye(3), self.middle)
        self._points = (squares - self.middle).reshape(1, -1, 3)
        self._corners = ImagePoints.at(corners.reshape(1, -1, 2), camera)
        self._whitening = whitening(covs)

    def solve(
        self, T_map_camera: FloatArray, weights: FloatArray | None = None, inlier: float = INLIER
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Camera poses from starts (B, 4, 4), of which the best is wanted.

        Parameters
        ----------
        weights : (N,) factors on the information of each marker; default 1
        inlier : Mahalanobis distance up to which errors are squared; beyond, their influence falls to nothing

        Returns
        -------
        T_map_camera (B, 4, 4), robust chi squares (B,), and information (B, 6, 6) of the map in the camera, turned
        about the middle of the markers.
        """
        starts, images = se3.inverse(T_map_camera) @ self._T_map_middle, self._images(weights)
        T_camera_middle, chi2, information = fit(starts, self._points, images, inlier, alternatives=len(starts))
        return self._T_map_middle @ se3.inverse(T_camera_middle), chi2, information

    def from_single_markers(self, weights: FloatArray | None) -> FloatArray:
        """T_map_camera (2, 4, 4): those two of the markers' poses that explain all markers best."""
        others = _camera_starts(self._corners.x.reshape(-1, 4, 2), self.squares)
        cost = evaluate(others @ self._T_map_middle, self._points, self._images(weights), INLIER)[0]
        return np.asarray(se3.inverse(others[np.argsort(cost)[:2]]))

    def _images(self, weights: FloatArray | None) -> Images:
        W = self._whitening if weights is None else self._whitening * np.sqrt(weights)[:, None, None, None]
        return Images.of(self._corners, W.reshape(1, -1, 2, 2))


def _likeliest(chi2: FloatArray, freedom: int, predicted: bool) -> int:
    """Of poses of chi-squares (B,): the best, but the first, if that is ``predicted`` and not clearly worse."""
    best = int(np.argmin(chi2))
    return 0 if predicted and chi2[0] <= _AMBIGUOUS_RATIO * max(chi2[best], freedom) else best


def _camera_starts(normalised: FloatArray, squares: FloatArray) -> FloatArray:
    """T_camera_map (2 N, 4, 4) from both poses of each square (N, 4, 3) [m] of normalised corners (N, 4, 2)."""
    right, up = squares[:, 1] - squares[:, 0], squares[:, 0] - squares[:, 3]
    sizes = np.linalg.norm(right, axis=-1)
    x, y = right / sizes[:, None], up / np.linalg.norm(up, axis=-1, keepdims=True)
    T_map_square = se3.transform(np.stack([x, y, np.cross(x, y)], axis=-1), squares.mean(axis=1))
    return (ippe_square(normalised, sizes) @ se3.inverse(T_map_square)[:, None]).reshape(-1, 4, 4)


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
