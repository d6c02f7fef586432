"""The camera in the map from all known markers of a frame jointly: steps 3 to 6 of Algorithm 1.

S. Khattak, C. Papachristos, K. Alexis, "Marker based thermal-inertial localization for aerial robots in obscurant
filled environments", ISVC 2018.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.geometry.fitting import fit_pose
from thermal_fiducial.core.geometry.planar_pose import solve_camera_pose
from thermal_fiducial.core.geometry.reprojection import (
    corners_in_map,
    difference,
    linearise,
    reproject,
    shared_covariances,
    whitening,
)
from thermal_fiducial.core.geometry.se3 import inverse, rotation_angle
from thermal_fiducial.core.mapping.candidates import correlated_sum, SYSTEMATIC_PX
from thermal_fiducial.core.mapping.map_data import MapMarker
from thermal_fiducial.core.types import BoolArray, FloatArray
from thermal_fiducial.errors import InputError

#: Difference of chi square that refutes the worse of two poses: odds of e^-10.
DECISIVE = 20.0
#: Poses nearer to each other than this [rad] are one pose whose covariance covers both.
SAME_POSE = np.deg2rad(2.0)
#: Markers that fill more of the view than this [rad] show perspective: their pose has no rival.
WIDE = np.deg2rad(25.0)
# Re-projection error at which a hypothesis stops getting worse [px]: single-marker poses are rough.
_HYPOTHESIS_PX = 3.0
# Markers that propose hypotheses: with many in view the largest are precise enough, and the rest only votes.
_PROPOSERS = 6


@dataclass(frozen=True)
class Sight:
    """The known markers of one frame, N of them."""

    markers: list[MapMarker]
    #: (N, 4, 2) [px]
    corners: FloatArray
    #: (N, 4, 2, 2) [px^2]
    covariances: FloatArray
    #: (N, 2, 4, 4) both branches of T_camera_marker, NaN where there is none
    branches: FloatArray

    def select(self, chosen: BoolArray) -> 'Sight':
        """The chosen (N,) markers alone."""
        markers = [marker for marker, keep in zip(self.markers, chosen, strict=True) if keep]
        return Sight(markers, self.corners[chosen], self.covariances[chosen], self.branches[chosen])

    @cached_property
    def T_map_marker(self) -> FloatArray:
        """(N, 4, 4)."""
        return np.stack([marker.T_map_marker for marker in self.markers])

    @cached_property
    def sizes(self) -> FloatArray:
        """(N,) [m]."""
        return np.array([marker.size for marker in self.markers])

    @cached_property
    def map_covariances(self) -> FloatArray:
        """(N, 6, 6) of the markers' poses in the map."""
        return np.stack([marker.covariance for marker in self.markers])

    @cached_property
    def relative_covariances(self) -> FloatArray:
        """(N, 6, 6) the same without what the best-known one is uncertain by: the error that all of them share."""
        covariances = self.map_covariances
        best = covariances[np.argmin(np.trace(covariances, axis1=1, axis2=2))]
        return positive(covariances - best)


@dataclass(frozen=True)
class Location:
    """Where the camera is."""

    T_map_camera: FloatArray
    #: (6, 6), ROS convention, of the corners' noise and of the map
    covariance: FloatArray
    #: (6, 6) the same without the error that all markers in view share: how well it is placed among them
    relative_covariance: FloatArray
    #: (6, 6) the share of the map: an error that lasts as long as the same markers are in view
    map_covariance: FloatArray
    #: (N,) weights of the markers, 1 for one as good as the rest
    weights: FloatArray
    rms_px: float


@dataclass(frozen=True)
class Refusal:
    """Why nobody knows where the camera is, in words."""

    reason: str
    #: (2, 4, 4) the two poses of an unsettled ambiguity, where it is that, and (2, 6, 6) their covariances
    rivals: FloatArray | None = None
    covariances: FloatArray | None = None


def locate(sight: Sight, running_errors: FloatArray, camera: Camera, prior: FloatArray | None) -> Location | Refusal:
    """Camera pose from N known markers.

    Parameters
    ----------
    sight : the markers and their corners
    running_errors : (N,) running rms re-projection error of each [px]
    prior : (4, 4) roughly expected T_map_camera, decides between rival poses; or None

    Returns
    -------
    The location, or why there is none.
    """
    points = corners_in_map(sight.T_map_marker, sight.sizes)
    hypotheses = _hypotheses(sight, points, camera, prior)
    if not len(hypotheses):
        return Refusal('no usable pose of any known marker')
    # Step 3: the pose from all known markers jointly; step 4: the error of each; step 5: weights; step 6: refinement.
    covariances = _with_map_uncertainty(sight, hypotheses[0], camera)
    try:
        first = solve_camera_pose(sight.corners, covariances, points, camera, hypotheses[0], compete=False)
    except InputError:
        return Refusal(f'no camera pose explains {_names(sight)}')
    errors = _errors_px(first.residuals_px)
    weights = marker_weights(errors, running_errors)
    best = first
    if np.any(weights < 1.0):
        best = solve_camera_pose(sight.corners, covariances, points, camera, first.T_map_camera, weights, compete=False)
    T = best.T_map_camera
    spread = np.zeros((6, 6))
    rival = _rival(sight, covariances, weights, camera, T, hypotheses)
    if rival is not None:
        if rotation_angle(T[:3, :3].T @ rival[:3, :3]) < SAME_POSE:
            apart = difference(rival, T)
            spread = np.outer(apart, apart)
        elif prior is None:
            rivals = np.stack([T, rival])
            spreads = np.stack([pose_covariances(sight, covariances, weights, camera, pose)[0] for pose in rivals])
            return Refusal(f'planar ambiguity of {_names(sight)} unsettled', rivals, spreads)
        elif _distance(rival, prior) < _distance(T, prior):
            T = rival
    covariance, relative, from_map = pose_covariances(sight, covariances, weights, camera, T)
    if not np.all(np.isfinite(covariance)):
        return Refusal(f'the pose from {_names(sight)} is not determined')
    residuals = sight.corners - reproject(camera, T, points)
    rms = float(np.sqrt(np.mean(np.sum(residuals**2, axis=-1))))
    return Location(T, covariance + spread, relative + spread, from_map, weights, rms)


def marker_weights(errors: FloatArray, running_errors: FloatArray) -> FloatArray:
    """Step 5 of Algorithm 1: weights (N,) from the present and the running re-projection error of each marker [px].

    A marker whose error is that of its neighbours, or below what corners can be trusted to anyway, weighs 1; a worse
    one as its inverse square, which is what its error's variance deserves.
    """
    combined = 0.5 * (errors**2 + np.where(running_errors > 0.0, running_errors, errors) ** 2)
    reference = max(float(np.median(combined)), SYSTEMATIC_PX**2)
    return np.asarray(np.minimum(1.0, reference / np.maximum(combined, 1e-12)))


def pose_covariances(
    sight: Sight, covariances: FloatArray, weights: FloatArray, camera: Camera, T_map_camera: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Covariance (6, 6) of a camera pose that was estimated with ``weights`` and corner ``covariances`` (N, 4, 2, 2).

    The estimate is linear in the corners and in the map near its optimum: noise of the corners goes in as white, at
    least as large as the residuals say; errors of the map's markers go in with unknown correlations. The second
    covariance leaves out what the best-known marker in view is uncertain by, as the error that all of them share.
    """
    n = len(sight.markers)
    T = np.broadcast_to(T_map_camera, (n, 4, 4))
    uv, J_camera, J_marker = linearise(camera, T, sight.T_map_marker, sight.sizes)
    blocks = J_camera.reshape(n, 4, 2, 6)
    information = np.linalg.inv(covariances) * weights[:, None, None, None]
    weighted = information @ blocks
    A = np.sum(np.moveaxis(blocks, -1, -2) @ weighted, axis=(0, 1))
    try:
        A_inverse = np.linalg.inv(A)
    except np.linalg.LinAlgError:
        return np.full((6, 6), np.nan), np.full((6, 6), np.nan), np.full((6, 6), np.nan)
    gains = A_inverse @ np.moveaxis(weighted, -1, -2)
    noise = np.sum(gains @ sight.covariances @ np.moveaxis(gains, -1, -2), axis=(0, 1))
    residuals = (sight.corners - uv)[..., None]
    chi2 = float(np.sum(residuals * (information @ residuals)))
    noise *= max(1.0, chi2 / max(8 * n - 6, 1))
    map_gains = -np.sum(gains @ J_marker.reshape(n, 4, 2, 6), axis=1)
    whole, relative = sight.map_covariances, sight.relative_covariances
    from_map = correlated_sum(map_gains, whole)
    return noise + from_map, noise + correlated_sum(map_gains, relative), from_map


def positive(covariances: FloatArray) -> FloatArray:
    """The nearest covariances (..., 6, 6): negative variances become none."""
    values, vectors = np.linalg.eigh(0.5 * (covariances + np.swapaxes(covariances, -1, -2)))
    return np.asarray((vectors * np.maximum(values, 0.0)[..., None, :]) @ np.swapaxes(vectors, -1, -2))


def _hypotheses(sight: Sight, points: FloatArray, camera: Camera, prior: FloatArray | None) -> FloatArray:
    """Camera poses (H, 4, 4) from either branch of each of the largest markers and from the prior, the best first."""
    largest = np.argsort(-np.sum(np.ptp(sight.corners, axis=1), axis=-1), kind='stable')[:_PROPOSERS]
    branches = sight.branches[largest].reshape(-1, 4, 4)
    poses = np.repeat(sight.T_map_marker[largest], 2, axis=0) @ inverse(branches)
    poses = poses[np.all(np.isfinite(poses), axis=(1, 2))]
    if prior is not None:
        poses = np.concatenate([poses, prior[None]])
    uv = reproject(camera, poses[:, None], points)
    squared = np.sum((uv - sight.corners) ** 2, axis=(-2, -1)) / 4.0
    squared = np.where(np.isfinite(squared), squared, 1e12)
    cost = np.sum(np.log1p(squared / _HYPOTHESIS_PX**2), axis=-1)
    return np.asarray(poses[np.argsort(cost, kind='stable')])


def _with_map_uncertainty(sight: Sight, T_map_camera: FloatArray, camera: Camera) -> FloatArray:
    """Corner covariances (N, 4, 2, 2) to weight with: the noise, and what markers may be wrong by among each other.

    What all of them may be wrong by together moves the camera along, and says nothing for one pose against another.
    """
    relative = sight.relative_covariances
    if not np.any(relative):
        return sight.covariances
    T = np.broadcast_to(T_map_camera, (len(sight.markers), 4, 4))
    _, _, J = linearise(camera, T, sight.T_map_marker, sight.sizes)
    shared = np.nan_to_num(shared_covariances(J, relative))
    return np.asarray(sight.covariances + shared, dtype=np.float64)


def _rival(
    sight: Sight, covariances: FloatArray, weights: FloatArray, camera: Camera, T: FloatArray, hypotheses: FloatArray
) -> FloatArray | None:
    """Another pose (4, 4) that the corners do not refute; None when there is none."""
    apart = rotation_angle(T[:3, :3].T @ hypotheses[:, :3, :3]) > SAME_POSE
    if not np.any(apart) or _extent(sight, camera) > WIDE:
        return None
    n = len(sight.markers)
    W = whitening(covariances + SYSTEMATIC_PX**2 * np.eye(2)) * np.sqrt(weights)[:, None, None, None]

    def evaluate(T: FloatArray) -> tuple[FloatArray, FloatArray]:
        uv, J, _ = linearise(camera, np.broadcast_to(T, (n, 4, 4)), sight.T_map_marker, sight.sizes)
        return (W @ (sight.corners - uv)[..., None]).ravel(), (W @ J.reshape(n, 4, 2, 6)).reshape(-1, 6)

    r, _ = evaluate(T)
    chi2 = float(r @ r)
    other, chi2_other = fit_pose(hypotheses[apart][0], evaluate)
    refuted = chi2_other - chi2 > DECISIVE * max(1.0, chi2 / (8 * n - 6))
    return None if refuted or np.max(np.abs(other - T)) < 1e-6 else other


def _extent(sight: Sight, camera: Camera) -> float:
    """Angle that the markers fill of the view [rad]."""
    corners = sight.corners.reshape(-1, 2)
    low, high = corners.min(axis=0), corners.max(axis=0)
    return float(np.linalg.norm(high - low) / camera.focal_px)


def _errors_px(residuals: FloatArray) -> FloatArray:
    return np.asarray(np.sqrt(np.mean(np.sum(residuals**2, axis=-1), axis=-1)))


def _distance(T: FloatArray, prior: FloatArray) -> float:
    return float(rotation_angle(prior[:3, :3].T @ T[:3, :3]))


def _names(sight: Sight) -> str:
    ids = [marker.id for marker in sight.markers]
    return f'marker {ids[0]}' if len(ids) == 1 else 'markers ' + ', '.join(str(i) for i in ids)
