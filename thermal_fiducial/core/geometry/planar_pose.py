"""Pose of a marker, and of the camera from all markers of a frame.

A square seen in one image has two poses that explain its corners almost equally well. Both are computed in closed
form and each is then polished by Levenberg-Marquardt on the re-projection error in the distorted image, weighted with
the corner covariances.
"""

from dataclasses import dataclass

import numpy as np

from thermal_fiducial.core.geometry import se3
from thermal_fiducial.core.geometry.camera import Camera, ImagePoints, inverse_2x2
from thermal_fiducial.core.geometry.reprojection import corners_in_map, marker_corners, perspective, whitening
from thermal_fiducial.core.geometry.rigid_fit import costs, evaluate, Images, minimise
from thermal_fiducial.core.types import BoolArray, FloatArray, IntArray, TINY

#: Mahalanobis distance of a corner (99 % of a chi-square of two degrees of freedom) beyond which it loses weight.
INLIER = 3.0
# Turn [rad] at which a step of a square's pose leaves as much of the cost as it takes away: less than of nineteen in
# twenty steps on rendered frames, whose median is 0.17 to 0.66.
_LINEAR_ANGLE = 0.1
# Ratio of the squared errors of a marker's two poses beyond which the image rules out the worse one.
_AMBIGUOUS = 10.0
# Step of the differences for the derivatives of outlines [px]: a millionth of a side, far above rounding.
_STEP_PX = 1e-4
_OF_EACH = np.eye(4)[:, None, :, None]


@dataclass(frozen=True, slots=True)
class PlanarPoses:
    """Both poses of N markers in the camera; the better one of each first."""

    #: (N, 2, 4, 4)
    T_camera_marker: FloatArray
    #: (N, 2) re-projection error, rms over the four corners (length of the 2-vector) [px]; inf: no pose found
    rms_px: FloatArray
    #: (N, 2) weighted squared errors: with consistent corner covariances, chi-square of two degrees of freedom
    chi2: FloatArray

    def ambiguous(self) -> BoolArray:
        """Markers (N,) of which the image allows the other branch.

        Its squared error is below ``_AMBIGUOUS`` times that of the first branch, or times 2 if that is larger, the
        expectation for consistent covariances.
        """
        return np.asarray(self.chi2[:, 1] <= _AMBIGUOUS * np.maximum(self.chi2[:, 0], 2.0))

    def ordered(self, branches: IntArray) -> 'PlanarPoses':
        """The poses with the branches in the order (N, 2)."""
        rows = np.arange(len(branches))[:, None]
        arrays = self.T_camera_marker, self.rms_px, self.chi2
        return PlanarPoses(*(array[rows, branches] for array in arrays))


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
    """:func:`solve_marker_poses` for corners (N, 4) given as image points."""
    twice = np.repeat(np.arange(len(sizes)), 2)
    once, points = Images.of(corners, whitening(corner_covs)), marker_corners(sizes[twice])
    images = Images(once.whitening[twice], once.target[twice])
    starts = ippe_square(corners.x, sizes).reshape(-1, 4, 4)
    T, cost, _ = minimise(starts, lambda T: evaluate(T, points, images), alternatives=2, linear_angle=_LINEAR_ANGLE)
    p = se3.apply(T, points)
    residuals = (corners.x[twice] - p[..., :2] / p[..., 2:])[..., None]
    chi2, squared_px = (((W @ residuals) ** 2).sum(axis=(1, 2, 3)) for W in (images.whitening, corners.J[twice]))
    facing = (T[:, :3, 2] * T[:, :3, 3]).sum(axis=-1) < 0.0
    found = np.isfinite(cost) & np.isfinite(chi2) & facing
    chi2, rms = (np.where(found, value, np.inf).reshape(-1, 2) for value in (chi2, np.sqrt(squared_px / 4.0)))
    poses = PlanarPoses(T.reshape(-1, 2, 4, 4), rms, chi2)
    first = (chi2[:, 1] < chi2[:, 0]).astype(np.intp)
    second = np.where(np.isfinite(chi2).all(axis=1), 1 - first, first)
    return poses.ordered(np.array([first, second]).T)


def choose_branches(
    poses: PlanarPoses,
    corners: ImagePoints,
    corner_covs: FloatArray,
    sizes: FloatArray,
    T_map_marker: FloatArray,
    T_camera_map: FloatArray | None = None,
) -> PlanarPoses:
    """The poses of a frame's markers with the likelier branch first.

    Between branches that the image allows, the attitude of the camera decides: with several known markers in view the
    one, of all branches and the prediction, that explains all of them best; else the predicted one.

    Parameters
    ----------
    poses : of N markers
    corners, corner_covs : (N, 4), (N, 4, 2, 2) [px^2]
    sizes : (N,) sides [m]
    T_map_marker : (N, 4, 4), NaN of markers that are not in the map
    T_camera_map : (4, 4) predicted
    """
    known = np.flatnonzero(np.isfinite(T_map_marker).all(axis=(1, 2)))
    ambiguous = poses.ambiguous()
    if not ambiguous[known].any():
        return poses
    T_map_marker = T_map_marker[known]
    if len(known) > 1:
        starts = (poses.T_camera_marker[known] @ se3.inverse(T_map_marker)[:, None]).reshape(-1, 4, 4)
        if T_camera_map is not None:
            starts = np.concatenate([starts, T_camera_map[None]])
        squares = corners_in_map(T_map_marker, sizes[known])
        images = Images.of(corners.only(known), whitening(corner_covs[known])).joined()
        T_camera_map = starts[np.argmin(costs(starts, squares.reshape(1, -1, 3), images, INLIER))]
    if T_camera_map is None:
        return poses
    # The larger the trace of R_1^T R_2, the smaller the angle between two rotations.
    expected = T_camera_map[:3, :3] @ T_map_marker[:, :3, :3]
    likeness = np.sum(poses.T_camera_marker[known, :, :3, :3] * expected[:, None], axis=(-1, -2))
    nearer = np.zeros(len(ambiguous), dtype=bool)
    nearer[known] = likeness[:, 1] > likeness[:, 0]
    swapped = (nearer & ambiguous).astype(np.intp)
    return poses.ordered(np.array([swapped, 1 - swapped]).T)


class CameraFit:
    """Fits of the camera to N markers of known pose in one frame; holds what all of them share.

    Parameters
    ----------
    corners : (N, 4, 2) [px] in the raw image
    covs : (N, 4, 2, 2) [px^2]
    squares : (N, 4, 3) [m] corners in the map, in the order of :func:`marker_corners`
    """

    def __init__(self, corners: FloatArray, covs: FloatArray, squares: FloatArray, camera: Camera) -> None:
        # Rotations about the centre of the markers: translation and rotation are then nearly uncorrelated.
        middle = squares.mean(axis=(0, 1))
        self._T_map_middle = se3.transform(np.eye(3), middle)
        self._points = (squares - middle).reshape(1, -1, 3)
        points = ImagePoints.at(corners.reshape(1, -1, 2), camera)
        self._images = Images.of(points, whitening(covs).reshape(1, -1, 2, 2))

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
        starts, images = se3.inverse(T_map_camera) @ self._T_map_middle, self._weighted(weights)
        T_camera_middle, chi2, information = minimise(
            starts, lambda T: evaluate(T, self._points, images, inlier), alternatives=len(starts)
        )
        return self._T_map_middle @ se3.inverse(T_camera_middle), chi2, information

    def costs(self, T_map_camera: FloatArray, weights: FloatArray | None = None, inlier: float = INLIER) -> FloatArray:
        """Robust chi squares (B,) at camera poses (B, 4, 4), inf where a marker would be behind the camera.

        ``weights`` and ``inlier`` as in :meth:`solve`.
        """
        T_camera_middle = se3.inverse(T_map_camera) @ self._T_map_middle
        return costs(T_camera_middle, self._points, self._weighted(weights), inlier)

    def _weighted(self, weights: FloatArray | None) -> Images:
        """The corners with factors (N,) on the information of each marker."""
        if weights is None:
            return self._images
        root = np.repeat(np.sqrt(weights), 4)[:, None]
        return Images(self._images.whitening * root[..., None], self._images.target * root)


def ippe_square(normalised: FloatArray, sizes: FloatArray) -> FloatArray:
    """Both poses (N, 2, 4, 4) of squares from normalised image corners (N, 4, 2) and sides (N,) [m], in closed form.

    T. Collins, A. Bartoli, "Infinitesimal plane-based pose estimation", IJCV 2014, section 4.1: with J the derivative
    of the homography at the square's centre, v the centre's image and R_v the rotation of the optical axis to it,
    ``J t_z = [I | -v] R_v R'`` leaves R' up to the sign of the tilt. Corners that have no homography, three of them on
    a line or NaN, give NaN. Unlike OpenCV's SOLVEPNP_IPPE_SQUARE this also holds for an exactly front-parallel square.
    """
    with np.errstate(divide='ignore', invalid='ignore', over='ignore'):
        J, v = _homography_derivative(normalised, sizes)
        R_v = _axis_to(v)
        A = inverse_2x2(R_v[:, :2, :2] - v[:, :, None] * R_v[:, 2:, :2]) @ J
        gram = A.swapaxes(-1, -2) @ A
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
    weight = perspective(c)[..., None]
    weight[np.abs(weight) <= TINY] = np.nan
    corners = np.concatenate([weight * c, weight], axis=-1)
    centre, right, up = 0.25 * corners.sum(axis=1), corners[:, 1] - corners[:, 0], corners[:, 0] - corners[:, 3]
    depth = centre[:, 2:]
    v = centre[:, :2] / depth
    along = np.stack([right, up], axis=-1)
    J = (along[:, :2] - v[..., None] * along[:, 2:]) / (depth * sizes[:, None])[..., None]
    return J, v


def _axis_to(v: FloatArray) -> FloatArray:
    """Shortest rotations (N, 3, 3) of the optical axis to the directions (v, 1), v (N, 2)."""
    z = 1.0 / np.sqrt(1.0 + (v * v).sum(axis=-1))[:, None]
    d = v * z
    R = np.empty((len(v), 3, 3))
    R[:, :2, :2] = np.eye(2) - d[:, :, None] * (d / (1.0 + z))[:, None, :]
    R[:, :2, 2], R[:, 2, :2], R[:, 2, 2] = d, -d, z[:, 0]
    return R


def squareness(x: FloatArray, inverse: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The two constraints of N outlines, 0 for squares, and their derivatives by the corners.

    Parameters
    ----------
    x, inverse : (N, 4, 2) normalised corners, and (N, 4, 2, 2) their derivatives by pixels

    Returns
    -------
    (N, 2, 1) cosine of the angle, and difference of the sides over their length; (N, 2, 8) [1/px]
    """
    # The outlines themselves, and with each coordinate of each corner displaced.
    steps = _STEP_PX * inverse.swapaxes(2, 3)[:, :, :, None] * _OF_EACH
    outlines = np.concatenate([x[:, None], x[:, None] + steps.reshape(-1, 8, 4, 2)], axis=1).reshape(-1, 4, 2)
    weight = perspective(outlines)[..., None]
    corners = np.concatenate([weight * outlines, weight], axis=-1)
    sides = corners[:, 1::2] - corners[:, :1]
    products = sides @ sides.swapaxes(1, 2)
    both, first, second = products[:, 0, 1], products[:, 0, 0], products[:, 1, 1]
    value = (np.array([2.0 * both, first - second]) / (first + second)).reshape(2, -1, 9).swapaxes(0, 1)
    return value[..., :1], (value[..., 1:] - value[..., :1]) / _STEP_PX
