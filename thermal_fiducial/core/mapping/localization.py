"""The camera in the map from all known markers of a frame jointly: steps 3 to 6 of Algorithm 1.

S. Khattak, C. Papachristos, K. Alexis, "Marker based thermal-inertial localization for aerial robots in obscurant
filled environments", ISVC 2018.
"""

from dataclasses import replace

import numpy as np

from thermal_fiducial.core.error_model import (
    corners_of_pose,
    correlated_sum,
    INCONSISTENT_PX,
    map_of_pose,
    map_weights,
    scale_of_pose,
    SystematicErrors,
    visible_share,
    with_corner_errors,
)
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.geometry.planar_pose import solve_camera_pose
from thermal_fiducial.core.geometry.reprojection import (
    corners_of,
    difference,
    fit_pose,
    linearise,
    reproject,
    whitening,
)
from thermal_fiducial.core.geometry.se3 import inverse, rotation_angle
from thermal_fiducial.core.mapping.located import Location, PoseErrors, Refusal, Sight
from thermal_fiducial.core.types import FloatArray
from thermal_fiducial.errors import InputError

#: Difference of chi square that refutes the worse of two poses: odds of e^-10.
DECISIVE = 20.0
#: Poses nearer to each other than this [rad] are one pose whose covariance covers both.
SAME_POSE = np.deg2rad(2.0)
#: Markers that fill more of the view than this [rad] show perspective: their pose has no alternative.
WIDE = np.deg2rad(25.0)
# Re-projection error at which a hypothesis stops getting worse [px]: single-marker poses are rough.
_HYPOTHESIS_PX = 3.0
# Markers that propose hypotheses: with many in view the largest are precise enough, and the rest only votes.
_PROPOSERS = 6


def locate(
    sight: Sight, running_errors: FloatArray, camera: Camera, prior: FloatArray | None, model: SystematicErrors
) -> Location | Refusal:
    """Camera pose from N known markers.

    Parameters
    ----------
    sight : the markers and their corners
    running_errors : (N,) running rms re-projection error of each [px]
    prior : (4, 4) roughly expected T_map_camera, decides between alternative poses; or None

    Returns
    -------
    The location, or why there is none.
    """
    hypotheses = _hypotheses(sight, camera, prior)
    if not len(hypotheses):
        return Refusal('no usable pose of any known marker')
    try:
        T, weights = _joint_pose(sight, running_errors, camera, hypotheses[0], model)
    except InputError:
        return Refusal(f'no camera pose explains {_names(sight)}')
    other = _alternative(sight, weights, camera, T, hypotheses, model)
    spread = np.zeros((6, 6))
    if other is not None:
        if rotation_angle(T[:3, :3].T @ other[:3, :3]) < SAME_POSE:
            apart = difference(other, T)
            spread = np.outer(apart, apart)
        elif prior is None:
            poses = np.stack([T, other])
            each = [pose_errors(sight, weights, camera, pose, model) for pose in poses]
            covariances = np.stack([errors.white + errors.systematic for errors in each])
            return Refusal(f'planar ambiguity of {_names(sight)} unsettled', poses, covariances)
        elif _distance(other, prior) < _distance(T, prior):
            T = other
    errors = pose_errors(sight, weights, camera, T, model)
    if not (np.all(np.isfinite(errors.white)) and np.all(np.isfinite(errors.systematic))):
        return Refusal(f'the pose from {_names(sight)} is not determined')
    errors = replace(errors, systematic=errors.systematic + spread, relative=errors.relative + spread)
    return Location(T, errors, weights, sight.corners - reproject(camera, T, sight.points))


def _joint_pose(
    sight: Sight, running_errors: FloatArray, camera: Camera, start: FloatArray, model: SystematicErrors
) -> tuple[FloatArray, FloatArray]:
    """Steps 3 to 6: the pose (4, 4) from all markers jointly, weighted with (N,) by map and errors, and refined."""
    by_map = _map_weights(sight, start, camera, model)
    first = solve_camera_pose(sight.corners, sight.covariances, sight.points, camera, start, by_map, compete=False)
    weights = by_map * marker_weights(_errors_px(first.residuals_px), running_errors, model)
    T = first.T_map_camera
    if np.any(weights < by_map):
        T = solve_camera_pose(
            sight.corners, sight.covariances, sight.points, camera, T, weights, compete=False
        ).T_map_camera
    return T, weights


def marker_weights(errors: FloatArray, running_errors: FloatArray, model: SystematicErrors) -> FloatArray:
    """Step 5 of Algorithm 1: weights (N,) from the present and the running re-projection error of each marker [px].

    A marker whose error is that of its neighbours, or below what corners can be trusted to anyway, weighs 1; a worse
    one as its inverse square, which is what its error's variance deserves.
    """
    combined = 0.5 * (errors**2 + np.where(running_errors > 0.0, running_errors, errors) ** 2)
    reference = max(float(np.median(combined)), model.decision_px**2)
    return np.asarray(np.minimum(1.0, reference / np.maximum(combined, 1e-12)))


def pose_errors(
    sight: Sight, weights: FloatArray, camera: Camera, T_map_camera: FloatArray, model: SystematicErrors
) -> PoseErrors:
    """What a camera pose is uncertain by that was estimated with ``weights`` (N,) of the markers.

    The estimate is linear in corners, map and scale near its optimum: noise of the corners goes in as white, at least
    as large as the residuals say; errors of the map's markers with unknown correlations; errors of corners and scale
    as the error model has them.
    """
    n = len(sight.markers)
    T = np.broadcast_to(T_map_camera, (n, 4, 4))
    uv, J_camera, J_marker = linearise(camera, T, sight.T_map_marker, sight.sizes)
    blocks, of_marker = J_camera.reshape(n, 4, 2, 6), J_marker.reshape(n, 4, 2, 6)
    information = np.linalg.inv(sight.covariances) * weights[:, None, None, None]
    weighted = information @ blocks
    A = np.sum(np.moveaxis(blocks, -1, -2) @ weighted, axis=(0, 1))
    try:
        gains = np.linalg.inv(A) @ np.moveaxis(weighted, -1, -2)
    except np.linalg.LinAlgError:
        nothing = np.full((6, 6), np.nan)
        return PoseErrors(nothing, nothing, nothing)
    white = np.sum(gains @ sight.covariances @ np.moveaxis(gains, -1, -2), axis=(0, 1))
    residuals = (sight.corners - uv)[..., None]
    chi2 = float(np.sum(residuals * (information @ residuals)))
    white *= max(1.0, chi2 / max(8 * n - 6, 1))
    map_gains = -np.sum(gains @ of_marker, axis=1)
    at = sight.corners.reshape(-1, 2)
    corners = corners_of_pose(gains.reshape(4 * n, 6, 2), at, camera.width, model)
    visible = visible_share(J_camera.reshape(-1, 2, 6), at, camera.width, model)
    arms = corners_of(sight.sizes) @ np.swapaxes(sight.T_map_marker[:, :3, :3], -1, -2)
    scale = scale_of_pose(np.sum(gains @ (of_marker[..., :3] @ arms[..., None]), axis=(0, 1))[:, 0], model)
    of_map = map_of_pose(map_gains, sight.map_covariances, sight.T_map_marker[:, :3, 3], T_map_camera[:3, 3])
    relative = white + correlated_sum(map_gains, sight.relative_covariances)
    return PoseErrors(white, of_map + corners + scale, relative, visible)


def _hypotheses(sight: Sight, camera: Camera, prior: FloatArray | None) -> FloatArray:
    """Camera poses (H, 4, 4) from either branch of each of the largest markers and from the prior, the best first."""
    largest = np.argsort(-np.sum(np.ptp(sight.corners, axis=1), axis=-1), kind='stable')[:_PROPOSERS]
    branches = sight.branches[largest].reshape(-1, 4, 4)
    poses = np.repeat(sight.T_map_marker[largest], 2, axis=0) @ inverse(branches)
    poses = poses[np.all(np.isfinite(poses), axis=(1, 2))]
    if prior is not None:
        poses = np.concatenate([poses, prior[None]])
    uv = reproject(camera, poses[:, None], sight.points)
    squared = np.sum((uv - sight.corners) ** 2, axis=(-2, -1)) / 4.0
    squared = np.where(np.isfinite(squared), squared, 1e12)
    cost = np.sum(np.log1p(squared / _HYPOTHESIS_PX**2), axis=-1)
    return np.asarray(poses[np.argsort(cost, kind='stable')])


def _map_weights(sight: Sight, T_map_camera: FloatArray, camera: Camera, model: SystematicErrors) -> FloatArray:
    """Weights (N,) of the markers by how well the map knows each."""
    if not np.any(sight.map_covariances):
        return np.ones(len(sight.markers))
    T = np.broadcast_to(T_map_camera, (len(sight.markers), 4, 4))
    _, _, J = linearise(camera, T, sight.T_map_marker, sight.sizes)
    pixels = np.sqrt(np.nan_to_num(np.einsum('nij,njk,nik->n', J, sight.map_covariances, J) / 8.0))
    noise = np.sqrt(np.trace(sight.covariances, axis1=-2, axis2=-1).mean(axis=-1) / 2.0)
    return map_weights(pixels, noise, model)


def _alternative(
    sight: Sight, weights: FloatArray, camera: Camera, T: FloatArray, hypotheses: FloatArray, model: SystematicErrors
) -> FloatArray | None:
    """Another pose (4, 4) that the corners do not refute; None when there is none."""
    apart = rotation_angle(T[:3, :3].T @ hypotheses[:, :3, :3]) > SAME_POSE
    if not np.any(apart) or _extent(sight, camera) > WIDE:
        return None
    n = len(sight.markers)
    W = whitening(with_corner_errors(sight.covariances, model)) * np.sqrt(weights)[:, None, None, None]

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


def reprojection_errors(sight: Sight, camera: Camera, T_map_camera: FloatArray) -> FloatArray:
    """Rms error (N,) [px] of each marker; that of one behind the camera is the image's width."""
    residuals = sight.corners - reproject(camera, T_map_camera, sight.points)
    squared = np.mean(np.sum(residuals**2, axis=-1), axis=-1)
    return np.sqrt(np.where(np.isfinite(squared), squared, float(camera.width) ** 2))


def expected_errors(sight: Sight, location: Location, camera: Camera) -> FloatArray:
    """Rms error (N,) [px] that the noise, the pose and the map's own uncertainty explain."""
    n = len(sight.markers)
    T = np.broadcast_to(location.T_map_camera, (n, 4, 4))
    _, J_camera, J_marker = linearise(camera, T, sight.T_map_marker, sight.sizes)
    noise = np.trace(sight.covariances, axis1=-2, axis2=-1).sum(axis=-1)
    pose = np.sum(J_camera @ location.covariance * J_camera, axis=(1, 2))
    marker = np.sum(J_marker @ sight.map_covariances * J_marker, axis=(1, 2))
    variance = 0.25 * (noise + pose + marker)
    return np.asarray(np.sqrt(np.nan_to_num(variance) + INCONSISTENT_PX**2))
