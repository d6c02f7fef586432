"""The fit of the camera to all known markers of a frame: its solution, its covariance, and the other solution."""

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
from thermal_fiducial.core.geometry.se3 import lever_arm, retract, screw_difference, screwed, turn_between
from thermal_fiducial.core.lens_errors import LensErrors
from thermal_fiducial.core.mapping.located import Location, Reprojected, Sight
from thermal_fiducial.core.mapping.marker_views import SAME_POSE
from thermal_fiducial.core.measurements import CameraPose, LATE, NOTHING_KNOWN, VAGUE
from thermal_fiducial.core.two_poses import DECISIVE
from thermal_fiducial.core.types import BoolArray, FloatArray, TINY

#: Extent of the markers in view [rad] beyond which perspective resolves the planar ambiguity.
WIDE = np.deg2rad(25.0)
# Share of the largest weight from which on a marker counts for the extent of the markers in view.
_HEAVY = 0.3
# Most Gauss-Newton steps of a pose, and the square of the last one, in its standard deviations.
_MOST_STEPS, _SMALL_STEP = 5, 0.01


@dataclass(frozen=True)
class Alternative:
    """Another pose that the corners of a frame do not rule out."""

    #: (4, 4)
    T_map_camera: FloatArray
    #: by how much its chi square is larger, with the bias of the corners expected
    excess: float
    #: whether it is a solution of its own
    is_minimum: bool


@dataclass(frozen=True)
class JointFit:
    """The known markers of a frame, and the fit of the camera to them."""

    stamp_ns: int
    sight: Sight
    camera: Camera
    errors: SystematicErrors
    fit: CameraFit

    def weights(self, reprojection: Reprojected, by_map: FloatArray) -> FloatArray:
        """Weights (N,) of the markers ``by_map`` (N,) and by their errors."""
        return np.asarray(by_map * marker_weights(reprojection.errors_px, self.sight.noise_px, self.errors))

    def refined(
        self, T_map_camera: FloatArray, reprojection: Reprojected, weights: FloatArray, noise: float | None = None
    ) -> Location | None:
        """Gauss-Newton steps from a pose (4, 4) near the solution, with ``weights`` (N,) of the markers.

        The linearisation of the last step, in corners, map and scale, gives the covariances. None if the markers do not
        determine the pose. The variance of the corners is scaled up by ``noise``; None: to the residuals.
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
            if step @ information @ step < _SMALL_STEP:
                break
            moved = retract(T_map_camera, step)
            there = self.sight.reprojected(self.camera, moved)
            # Markers that contradict each other may drive the last step, too, to where the camera shows none of them.
            if not np.all(np.isfinite(there.residuals)):
                return None
            if remaining > 0:
                T_map_camera, reprojection = moved, there
        after = replace(reprojection, residuals=reprojection.residuals - (J @ step).reshape(n, 4, 2))
        noise = noise_factor(chi2, 8 * n - 6) if noise is None else noise
        return self._location(T_map_camera, step, gains, noise, after, weights)

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
        noise: float,
        reprojection: Reprojected,
        weights: FloatArray,
    ) -> Location | None:
        """The pose (4, 4) corrected by ``step`` (6,), with its covariance; None if that is not finite.

        The covariance is the sum of white corner noise, scaled up by ``noise``, of errors of the map's markers, of
        systematic errors of corners and scale by the error model, and of what is not known of rows that are read late.

        Parameters
        ----------
        gains : (6, 8 N) derivative of the pose by the corners' coordinates [1/px]
        """
        n, sight, errors = len(weights), self.sight, self.errors
        by_corner = np.swapaxes(gains.reshape(6, 4 * n, 2), 0, 1)
        white = independent_sum(by_corner, sight.observed.covariances.reshape(-1, 2, 2))
        white *= noise
        lens = LensErrors(sight.observed.corners, self.camera, errors)
        arms = sight.points - sight.T_map_marker[:, None, :3, 3]
        grown = gains @ (reprojection.J_marker.reshape(n, 4, 2, 6)[..., :3] @ arms[..., None]).ravel()
        map_gains = -np.swapaxes(gains.reshape(6, n, 8), 0, 1) @ reprojection.J_marker
        # Sides of the markers and distances in the map have the same scale error.
        of_scale = np.einsum('nij,nj->i', map_gains[:, :, :3], sight.scale_arms) - grown
        of_sides = errors.marker_size_std * of_scale
        of_map = covariance_of_one_error(of_sides)
        if np.any(sight.map_covariances):
            of_map += covariance_by_draws(drawn_sum(map_gains, sight.draws))
        late = drawn_sum(by_corner, sight.observed.late_px.reshape(-1, 2, LATE))
        covariance = white + lens.covariance(by_corner) + of_map + late @ late.T
        if not np.all(np.isfinite(covariance)):
            return None
        # Part of the lens's covariance, and wrong for as long as the map is: no mean over poses removes it.
        map_covariance = of_map + covariance_of_one_error(gains @ lens.of_focal_length.ravel())
        ids, rms_px = tuple(sight.observed.ids.tolist()), math.sqrt(reprojection.errors_px @ reprojection.errors_px / n)
        T = retract(T_map_camera, step)
        pose = CameraPose(self.stamp_ns, T, covariance, map_covariance, ids, rms_px)
        return Location(pose, sight, reprojection, weights, map_gains, lens, noise, white, of_sides, by_corner)

    def decisive_weights(self, found: Location) -> FloatArray:
        """Weights (N,) of the markers against odometry: with the bias of corners, and residuals above their claims."""
        relative = (
            found.weights / found.weights.max() * decision_weights(self.sight.noise_px, self.sight.observed.readout_px)
        )
        _, chi2 = self._weighted(found.reprojection, relative)
        return np.asarray(relative / noise_factor(chi2, 8 * len(relative) - 6))

    def likeliest(self, start: FloatArray, prior: CameraPose, weights: FloatArray) -> tuple[float, FloatArray] | None:
        """The likeliest camera (4, 4) by corners and ``prior``, from a ``start`` (4, 4), and its cost, chi square.

        None if a marker gets behind the camera, or endlessly far away.
        """
        T, expected, information_there = start, prior.T_map_camera, np.linalg.inv(prior.covariance)
        for _ in range(_MOST_STEPS + 1):
            reprojection = self.sight.reprojected(self.camera, T)
            if not np.all(np.isfinite(reprojection.residuals)):
                return None
            J, apart = reprojection.J_camera.reshape(-1, 6), screw_difference(T, expected)
            weighted, chi2 = self._weighted(reprojection, weights)
            there = lever_arm(expected[:3, 3] - T[:3, 3])
            of_prior = there.T @ information_there
            information = J.T @ weighted + of_prior @ there
            try:
                step = np.linalg.solve(information, weighted.T @ reprojection.residuals.ravel() - of_prior @ apart)
            except np.linalg.LinAlgError:
                return None
            if step @ information @ step < _SMALL_STEP:
                break
            T = screwed(T, np.asarray(step))
        return chi2 + float(apart @ information_there @ apart), T

    def measured(self, T_map_camera: FloatArray, weights: FloatArray) -> Location | None:
        """What the corners say of a camera that is near (4, 4), linearised there.

        Nothing of displacements that they would show worse than ``VAGUE``: the claim is ``NOTHING_KNOWN`` there. None
        if a marker is behind the camera, or a covariance is not finite.
        """
        reprojection = self.sight.reprojected(self.camera, T_map_camera)
        if not np.all(np.isfinite(reprojection.residuals)):
            return None
        J = reprojection.J_camera.reshape(-1, 6)
        weighted, chi2 = self._weighted(reprojection, weights)
        # A shift counts as the turn by which it moves the markers in the image.
        distance = float(np.linalg.norm(self.sight.T_map_marker[:, :3, 3].mean(axis=0) - T_map_camera[:3, 3]))
        units: FloatArray = np.repeat((distance, 1.0), 3)
        values, axes = np.linalg.eigh(units[:, None] * (J.T @ weighted) * units)
        axes, shown = units[:, None] * axes, values > VAGUE**-2
        gains = (axes[:, shown] / values[shown]) @ axes[:, shown].T @ weighted.T
        step = gains @ reprojection.residuals.ravel()
        after = replace(reprojection, residuals=reprojection.residuals - (J @ step).reshape(-1, 4, 2))
        noise = noise_factor(chi2, 8 * len(weights) - 6)
        location = self._location(T_map_camera, np.zeros(6), gains, noise, after, weights)
        if location is None:
            return None
        unknown = NOTHING_KNOWN**2 * axes[:, ~shown] @ axes[:, ~shown].T
        return replace(location.moved(step, unknown), settled=bool(shown.all()))

    def alternative(self, found: Location, hypotheses: FloatArray) -> Alternative | None:
        """The second solution of the planar ambiguity; where none is found, the likeliest start far from the first.

        Both may have merged, or the search may have ended where no marker is seen right. None if the corners rule it
        out, or the markers would be smaller than a pixel from there.
        """
        heavy = found.weights >= _HEAVY * found.weights.max()
        extent = np.ptp(self.sight.observed.corners[heavy], axis=(0, 1)) / self.camera.focal_px
        if math.hypot(*extent) > WIDE:
            return None
        T = found.pose.T_map_camera
        apart = (turn_between(T, hypotheses) > SAME_POSE) & self._shown_from(hypotheses)
        if not np.any(apart):
            return None
        starts, weights = (
            hypotheses[apart],
            found.weights * decision_weights(self.sight.noise_px, self.sight.observed.readout_px),
        )
        (T, other), chi2, _ = self.fit.solve(np.stack([T, starts[0]]), weights, inlier=np.inf)
        scale = noise_factor(float(chi2[0]), 8 * len(weights) - 6)
        excess = float(chi2[1] - chi2[0]) / scale
        if turn_between(T, other) > SAME_POSE and excess <= DECISIVE and self._shown_from(other):
            return Alternative(other, excess, is_minimum=True)
        turns = turn_between(T, starts)
        excesses = np.maximum(self.fit.costs(starts, weights, inlier=np.inf) - chi2[0], 0.0) / scale
        far = int(np.argmax(turns**2 * np.exp(-0.5 * excesses)))
        return None if excesses[far] > DECISIVE else Alternative(starts[far], float(excesses[far]), is_minimum=False)

    def _shown_from(self, T_map_camera: FloatArray) -> BoolArray:
        """Whether cameras (..., 4, 4) show all markers larger than a pixel.

        Where corners are noisier than their marker is large, a pose endlessly far away fits them, too.
        """
        distances = np.linalg.norm(self.sight.T_map_marker[:, :3, 3] - T_map_camera[..., None, :3, 3], axis=-1)
        return np.asarray((distances < self.sight.sizes * self.camera.focal_px).all(axis=-1))

    def map_weights(self, T_map_camera: FloatArray) -> FloatArray:
        """Weights (N,) of the markers by their covariances in the map."""
        sight = self.sight
        if not sight.map_covariances.any():
            return np.ones(len(sight.sizes))
        variances = np.diagonal(sight.map_covariances, axis1=-2, axis2=-1)
        # A third of the variance is along each axis; a corner is 0.7 sides from the centre.
        apart = variances[:, :3].sum(axis=-1) / 3.0 + sight.sizes**2 * variances[:, 3:].sum(axis=-1) / 9.0
        distances = np.linalg.norm(sight.T_map_marker[:, :3, 3] - T_map_camera[:3, 3], axis=-1)
        return map_weights(sight.noise_px, self.camera.focal_px * np.sqrt(apart) / distances)


class SurveyedFit(JointFit):
    """The fit of a frame with surveyed markers, of which the error of each moves its corners together.

    With corners that count as independent, an error of the distance between two markers tilts the camera.
    """

    def weights(self, reprojection: Reprojected, by_map: FloatArray) -> FloatArray:
        """As of any fit, but errors of the survey are expected, and have joint weights."""
        sight = self.sight
        of_survey = np.diagonal(self._of_survey(reprojection), axis1=1, axis2=2).mean(axis=1)
        by_errors = marker_weights(reprojection.errors_px, np.sqrt(sight.noise_px**2 + of_survey), self.errors)
        return np.asarray(np.where(sight.surveyed, 1.0, by_map) * by_errors)

    def alternative(self, found: Location, hypotheses: FloatArray) -> Alternative | None:
        """As of any fit; it compares corners that count as independent."""
        by_map = np.where(self.sight.surveyed, self.map_weights(found.pose.T_map_camera), 1.0)
        return super().alternative(replace(found, weights=by_map * found.weights), hypotheses)

    def _weighted(self, reprojection: Reprojected, weights: FloatArray) -> tuple[FloatArray, float]:
        """As of any fit; a corner is an outlier by what the others of its marker leave of it."""
        residuals, of_corners = reprojection.residuals.reshape(-1, 8, 1), self.sight.observed.covariances
        of_survey = survey_for_weights(self._of_survey(reprojection), self.sight.noise_px, self.errors)
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


def marker_weights(errors_px: FloatArray, noise_px: FloatArray, errors: SystematicErrors) -> FloatArray:
    """Step 5 of Algorithm 1: weights (N,) of markers by their re-projection errors, rms [px].

    That is the expected variance, of noise and bias of the corners, over the present one, at most 1. Both coordinates
    of a corner make its error.

    Parameters
    ----------
    noise_px : (N,) standard deviation of a coordinate of the corners, by noise and survey
    """
    expected = 2.0 * (noise_px**2 + errors.likely_corner_px**2)
    return np.asarray(np.minimum(1.0, expected / np.maximum(errors_px**2, TINY)))
