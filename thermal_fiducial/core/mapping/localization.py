"""The camera in the map from all known markers of a frame jointly: steps 3 to 6 of Algorithm 1.

S. Khattak, C. Papachristos, K. Alexis, "Marker based thermal-inertial localization for aerial robots in obscurant
filled environments", ISVC 2018.
"""

from dataclasses import dataclass, replace
import math

import numpy as np

from thermal_fiducial.core.error_model import (
    block_diagonal,
    covariance_by_draws,
    covariance_of_one_error,
    decision_weights,
    diagonal_blocks,
    drawn_sum,
    independent_sum,
    map_weights,
    noise_factor,
    survey_for_weights,
    SystematicErrors,
)
from thermal_fiducial.core.geometry.camera import Camera, inverse_2x2
from thermal_fiducial.core.geometry.planar_pose import CameraFit, INLIER
from thermal_fiducial.core.geometry.reprojection import difference, retract
from thermal_fiducial.core.geometry.se3 import inverse, rotation_angle
from thermal_fiducial.core.lens_errors import LensErrors
from thermal_fiducial.core.mapping.located import Location, Refusal, Reprojected, Sight
from thermal_fiducial.core.mapping.marker_views import SAME_POSE, Viewpoint
from thermal_fiducial.core.measurements import CameraPose
from thermal_fiducial.core.types import FloatArray, TINY

#: Difference of chi square that rules out the worse of two poses, or of two markers: odds of e^-10.
DECISIVE = 20.0
#: Extent of the markers in view [rad] beyond which perspective resolves the planar ambiguity.
WIDE = np.deg2rad(25.0)
# Share of the largest weight from which on a marker counts for the extent of the markers in view.
_HEAVY = 0.3
# Largest number of markers that give initial poses, the largest ones; all take part in their ranking.
_PROPOSERS = 4
# Most Gauss-Newton steps of a pose, and the square of the last one, in its standard deviations by the corners' noise.
_MOST_STEPS, _SMALL_STEP = 5, 0.01
# Standard deviation of a rotation beyond which nothing is known of it, and its linearisation means nothing [rad].
_NOTHING_KNOWN = 1.0


def locate(
    stamp_ns: int, sight: Sight, camera: Camera, prior: CameraPose | None, model: SystematicErrors
) -> Location | Refusal:
    """Camera pose from N known markers.

    Parameters
    ----------
    sight : the markers and their corners
    prior : the camera by odometry or by the last frame, which resolves the planar ambiguity; or None

    Returns
    -------
    The location, or the reason for which there is none.
    """
    fit = CameraFit(sight.observed.corners, sight.observed.covariances, sight.points, camera)
    hypotheses = _hypotheses(sight, None if prior is None else prior.T_map_camera)
    if not len(hypotheses):
        return Refusal('no usable pose of any known marker')
    hypotheses = hypotheses[np.argsort(fit.costs(hypotheses), kind='stable')]
    kind = _SurveyedFit if sight.surveyed.any() else _JointFit
    frame = kind(stamp_ns, sight, camera, model, fit)
    # Steps 3 and 4: the pose from all markers jointly, weighted by the map.
    by_map = frame.map_weights(hypotheses[0])
    T = fit.solve(hypotheses[:1], by_map)[0][0]
    reprojection = sight.reprojected(camera, T)
    shown = np.isfinite(reprojection.errors_px)
    if not shown.all():
        # A marker that the camera could not show is not where the map has it. The others give the pose, if most are.
        if 2 * np.count_nonzero(shown) > len(shown):
            return locate(stamp_ns, sight.only(shown), camera, prior, model)
        return Refusal(f'no camera pose explains {names(sight)}')
    # Steps 5 and 6: refined with the weights of their errors.
    found = frame.refined(T, reprojection, frame.weights(reprojection, by_map))
    if found is None:
        return Refusal(f'the pose from {names(sight)} is not determined')
    other = frame.alternative(found, hypotheses)
    if other is None:
        return found
    return _either(frame, found, other, prior) if other.is_minimum else _widened(found, other)


@dataclass(frozen=True)
class _Alternative:
    """Another pose that the corners of a frame do not rule out."""

    #: (4, 4)
    T_map_camera: FloatArray
    #: by how much its chi square is larger, with the bias of the corners expected
    excess: float
    #: whether it is a solution of its own
    is_minimum: bool


def _widened(found: Location, other: _Alternative) -> Location:
    """A location whose covariance has what another pose adds that is likelier than by the covariance.

    Where the two planar poses merge, chi square hardly grows from one to the other; to first order it grows with the
    square of the distance.
    """
    apart, covariance = difference(other.T_map_camera, found.pose.T_map_camera), found.pose.covariance
    expected = float(apart @ np.linalg.solve(covariance, apart))
    share = max(math.exp(-0.5 * other.excess) - math.exp(-0.5 * expected), 0.0)
    return _with_spread(found, covariance_of_one_error(apart, math.sqrt(share)))


def _with_spread(found: Location, spread: FloatArray) -> Location:
    """A location that may be another one, at a covariance that is larger by ``spread`` (6, 6)."""
    pose = replace(found.pose, covariance=found.pose.covariance + spread)
    return replace(found, pose=pose, noise=found.noise + spread, settled=False)


def _either(frame: '_JointFit', found: Location, other: _Alternative, prior: CameraPose | None) -> Location | Refusal:
    """The likelier of two poses that the corners allow, by the prior, by its odds uncertain; refuse without one."""
    T = other.T_map_camera
    second = frame.refined(T, frame.sight.reprojected(frame.camera, T), found.weights)
    # One that hardly fits at all ends anywhere.
    if second is None or second.rotation_std > _NOTHING_KNOWN:
        return found
    if prior is not None:
        excess = other.excess + _cost_of_turn(second.pose, prior) - _cost_of_turn(found.pose, prior)
        likelier, less_likely = (found, second) if excess > 0.0 else (second, found)
        if abs(excess) > DECISIVE:
            return likelier
        apart = difference(less_likely.pose.T_map_camera, likelier.pose.T_map_camera)
        return _with_spread(
            likelier, covariance_of_one_error(apart, math.sqrt(1.0 / (1.0 + math.exp(0.5 * abs(excess)))))
        )
    chi2 = frame.fit.costs(np.stack([found.pose.T_map_camera, second.pose.T_map_camera]))
    chi2 *= decision_weights(frame.sight.noise_px, frame.model).min()
    both = Viewpoint.either(found.viewpoint, second.viewpoint, chi2)
    return Refusal(f'planar ambiguity of {names(frame.sight)} unsettled', both)


def _cost_of_turn(pose: CameraPose, prior: CameraPose) -> float:
    """Minus twice the logarithm of the likelihood of a camera's attitude by an independent one."""
    turn = difference(pose.T_map_camera, prior.T_map_camera)[3:]
    covariance = pose.covariance[3:, 3:] + prior.covariance[3:, 3:]
    return float(turn @ np.linalg.solve(covariance, turn) + np.linalg.slogdet(covariance)[1])


@dataclass(frozen=True)
class _JointFit:
    """The known markers of a frame, and the fit of the camera to them."""

    stamp_ns: int
    sight: Sight
    camera: Camera
    model: SystematicErrors
    fit: CameraFit

    def weights(self, reprojection: Reprojected, by_map: FloatArray) -> FloatArray:
        """Weights (N,) of the markers ``by_map`` (N,) and by their errors."""
        return np.asarray(by_map * marker_weights(reprojection.errors_px, self.sight.noise_px, self.model))

    def refined(self, T_map_camera: FloatArray, reprojection: Reprojected, weights: FloatArray) -> Location | None:
        """Gauss-Newton steps from a pose (4, 4) near the solution, with ``weights`` (N,) of the markers.

        The linearisation of the last step, in corners, map and scale, gives the covariances. None if the markers do not
        determine the pose.
        """
        n = len(weights)
        for remaining in reversed(range(_MOST_STEPS)):
            J = reprojection.J_camera.reshape(-1, 6)
            weighted, chi2 = self._weighted(reprojection, weights)
            information = J.T @ weighted
            try:
                gains = np.linalg.inv(information) @ weighted.T
            except np.linalg.LinAlgError:
                return None
            step = gains @ reprojection.residuals.ravel()
            if remaining == 0 or step @ information @ step < _SMALL_STEP:
                break
            T_map_camera = retract(T_map_camera, step)
            reprojection = self.sight.reprojected(self.camera, T_map_camera)
            if not np.all(np.isfinite(reprojection.residuals)):
                return None
        after = replace(reprojection, residuals=reprojection.residuals - (J @ step).reshape(n, 4, 2))
        return self._location(T_map_camera, step, gains, chi2, after, weights)

    def _weighted(self, reprojection: Reprojected, weights: FloatArray) -> tuple[FloatArray, float]:
        """The Jacobian (8 N, 6) times the robust information of the corners, and chi square of their residuals."""
        n, residuals = len(weights), reprojection.residuals[..., None]
        information = inverse_2x2(self.sight.observed.covariances) * weights[:, None, None, None]
        squared = (residuals * (information @ residuals)).sum(axis=(-2, -1))
        robust = np.maximum(squared / INLIER**2, 1.0)[..., None, None]
        weighted = information / robust @ reprojection.J_camera.reshape(n, 4, 2, 6)
        return np.asarray(weighted.reshape(8 * n, 6)), float(squared.sum())

    def _location(
        self,
        T_map_camera: FloatArray,
        step: FloatArray,
        gains: FloatArray,
        chi2: float,
        reprojection: Reprojected,
        weights: FloatArray,
    ) -> Location | None:
        """The pose (4, 4) corrected by ``step`` (6,), with its covariance; None if that is not finite.

        The covariance is the sum of white corner noise, scaled up to the residuals, of errors of the map's markers, and
        of systematic errors of corners and scale by the error model.

        Parameters
        ----------
        gains : (6, 8 N) derivative of the pose by the corners' coordinates [1/px]
        chi2 : of the residuals
        """
        n, sight, model = len(weights), self.sight, self.model
        by_corner = np.swapaxes(gains.reshape(6, 4 * n, 2), 0, 1)
        white = independent_sum(by_corner, sight.observed.covariances.reshape(-1, 2, 2))
        white *= noise_factor(chi2, 8 * n - 6)
        lens = LensErrors(sight.observed.corners, self.camera, model)
        arms = sight.points - sight.T_map_marker[:, None, :3, 3]
        grown = gains @ (reprojection.J_marker.reshape(n, 4, 2, 6)[..., :3] @ arms[..., None]).ravel()
        map_gains = -np.swapaxes(gains.reshape(6, n, 8), 0, 1) @ reprojection.J_marker
        # Sides of the markers and distances in the map have the same scale error.
        of_scale = np.einsum('nij,nj->i', map_gains[:, :, :3], sight.scale_arms) - grown
        # A longer focal length moves all corners away from the principal point.
        of_focal = gains @ (sight.observed.corners - self.camera.principal_point).ravel()
        of_scales = np.stack([model.marker_size_std * of_scale, model.focal_length_std * of_focal], axis=-1)
        of_map = of_scales @ of_scales.T
        if np.any(sight.map_covariances):
            of_map += covariance_by_draws(drawn_sum(map_gains, sight.draws))
        covariance = white + lens.covariance(by_corner) + of_map
        if not np.all(np.isfinite(covariance)):
            return None
        ids, rms_px = tuple(sight.observed.ids.tolist()), math.sqrt(reprojection.errors_px @ reprojection.errors_px / n)
        T = retract(T_map_camera, step)
        pose = CameraPose(self.stamp_ns, T, covariance, of_map, ids, rms_px)
        linear_std = math.sqrt(covariance[3:, 3:].trace())
        return Location(pose, sight, reprojection, weights, map_gains, lens, white, of_scales, by_corner, linear_std)

    def alternative(self, found: Location, hypotheses: FloatArray) -> _Alternative | None:
        """The second solution of the planar ambiguity; where it merges with the first, the likeliest pose far from it.

        None if the corners rule it out.
        """
        T = found.pose.T_map_camera
        apart = rotation_angle(T[:3, :3].T @ hypotheses[:, :3, :3]) > SAME_POSE
        heavy = found.weights >= _HEAVY * found.weights.max()
        extent = np.ptp(self.sight.observed.corners[heavy], axis=(0, 1)) / self.camera.focal_px
        if math.hypot(*extent) > WIDE or not np.any(apart):
            return None
        starts, weights = hypotheses[apart], found.weights * decision_weights(self.sight.noise_px, self.model)
        (T, other), chi2, _ = self.fit.solve(np.stack([T, starts[0]]), weights, inlier=np.inf)
        scale = noise_factor(float(chi2[0]), 8 * len(weights) - 6)
        if rotation_angle(T[:3, :3].T @ other[:3, :3]) > SAME_POSE:
            excess = float(chi2[1] - chi2[0]) / scale
            return None if excess > DECISIVE else _Alternative(other, excess, is_minimum=True)
        turns = rotation_angle(T[:3, :3].T @ starts[:, :3, :3])
        excesses = np.maximum(self.fit.costs(starts, weights, inlier=np.inf) - chi2[0], 0.0) / scale
        far = int(np.argmax(turns**2 * np.exp(-0.5 * excesses)))
        return None if excesses[far] > DECISIVE else _Alternative(starts[far], float(excesses[far]), is_minimum=False)

    def map_weights(self, T_map_camera: FloatArray) -> FloatArray:
        """Weights (N,) of the markers by their covariances in the map."""
        sight = self.sight
        if not sight.map_covariances.any():
            return np.ones(len(sight.sizes))
        variances = np.diagonal(sight.map_covariances, axis1=-2, axis2=-1)
        # A third of the variance is along each axis; a corner is 0.7 sides from the centre.
        apart = variances[:, :3].sum(axis=-1) / 3.0 + sight.sizes**2 * variances[:, 3:].sum(axis=-1) / 9.0
        distances = np.linalg.norm(sight.T_map_marker[:, :3, 3] - T_map_camera[:3, 3], axis=-1)
        return map_weights(sight.noise_px, self.camera.focal_px * np.sqrt(apart) / distances, self.model)


class _SurveyedFit(_JointFit):
    """The fit of a frame with surveyed markers, of which the error of each moves its corners together.

    With corners that count as independent, an error of the distance between two markers tilts the camera.
    """

    def weights(self, reprojection: Reprojected, by_map: FloatArray) -> FloatArray:
        """As of any fit, but errors of the survey are expected, and have joint weights."""
        sight = self.sight
        of_survey = np.diagonal(self._of_survey(reprojection), axis1=1, axis2=2).mean(axis=1)
        by_errors = marker_weights(reprojection.errors_px, np.sqrt(sight.noise_px**2 + of_survey), self.model)
        return np.asarray(np.where(sight.surveyed, 1.0, by_map) * by_errors)

    def alternative(self, found: Location, hypotheses: FloatArray) -> _Alternative | None:
        """As of any fit; it compares corners that count as independent."""
        by_map = np.where(self.sight.surveyed, self.map_weights(found.pose.T_map_camera), 1.0)
        return super().alternative(replace(found, weights=by_map * found.weights), hypotheses)

    def _weighted(self, reprojection: Reprojected, weights: FloatArray) -> tuple[FloatArray, float]:
        """As of any fit; a corner is an outlier by what the others of its marker leave of it."""
        residuals, of_corners = reprojection.residuals.reshape(-1, 8, 1), self.sight.observed.covariances
        of_survey = survey_for_weights(self._of_survey(reprojection), self.sight.noise_px, self.model)
        information = weights[:, None, None] * np.linalg.inv(of_survey + block_diagonal(of_corners))
        weighted = information @ residuals
        pulls, of_each = weighted.reshape(-1, 4, 2, 1), diagonal_blocks(information)
        squared = (pulls * (inverse_2x2(of_each) @ pulls)).sum(axis=(-2, -1))
        chi2, outlying = float((residuals * weighted).sum()), squared > INLIER**2
        if outlying.any():
            excess = np.where(outlying, squared / INLIER**2, 1.0)[..., None, None]
            information = weights[:, None, None] * np.linalg.inv(of_survey + block_diagonal(of_corners * excess))
        return np.asarray((information @ reprojection.J_camera).reshape(-1, 6)), chi2

    def _of_survey(self, reprojection: Reprojected) -> FloatArray:
        """Covariances (N, 8, 8) [px^2] of the corners by errors of the survey: zero of the other markers."""
        J = np.where(self.sight.surveyed[:, None, None], reprojection.J_marker, 0.0)
        return np.asarray(J @ self.sight.map_covariances @ J.swapaxes(-1, -2))


def marker_weights(errors_px: FloatArray, noise_px: FloatArray, model: SystematicErrors) -> FloatArray:
    """Step 5 of Algorithm 1: weights (N,) of markers by their re-projection errors, rms [px].

    That is the expected variance, of noise and bias of the corners, over the present one, at most 1. Both coordinates
    of a corner make its error.

    Parameters
    ----------
    noise_px : (N,) standard deviation of a coordinate of the corners, by noise and survey
    """
    expected = 2.0 * (noise_px**2 + model.corner_px**2)
    return np.asarray(np.minimum(1.0, expected / np.maximum(errors_px**2, TINY)))


def _hypotheses(sight: Sight, prior: FloatArray | None) -> FloatArray:
    """Initial camera poses (H, 4, 4): both planar poses of the largest markers and the prior."""
    largest = np.argsort(-np.ptp(sight.observed.corners, axis=1).sum(axis=-1), kind='stable')[:_PROPOSERS]
    poses = (sight.T_map_marker[largest, None] @ inverse(sight.observed.branches[largest])).reshape(-1, 4, 4)
    poses = poses[np.isfinite(poses).all(axis=(1, 2))]
    return np.asarray(poses if prior is None else np.concatenate([poses, prior[None]]))


def names(sight: Sight) -> str:
    """The markers of a frame, in words."""
    ids = sight.observed.ids.tolist()
    return f'marker {ids[0]}' if len(ids) == 1 else 'markers ' + ', '.join(str(i) for i in ids)
