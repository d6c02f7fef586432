"""A rolling shutter whose rows are read over another time than ``readout_time`` says, estimated in flight.

The detector moves corners to the stamp by the declared time. If that is too short by d, a corner at the share s of the
rows, -1/2 in the first one and 1/2 in the last, stays displaced by d s times its velocity in the image. The pose of the
frame takes up a part of that; what it leaves, in all frames, shows d by least squares. Where the map is made in the
same flight, its adjustment has d among its unknowns, and knows better. Poses always claim what is not known of it.
"""

from dataclasses import dataclass, replace
import math

import numpy as np

from thermal_fiducial.core.error_model import (
    covariance_of_one_error,
    drawn_sum,
    DRAWS,
    noise_factor,
    READOUT_AS_DECLARED,
    SQUARE_STD,
)
from thermal_fiducial.core.geometry.camera import Camera, ImagePoints, inverse_2x2
from thermal_fiducial.core.geometry.planar_pose import INLIER, squareness
from thermal_fiducial.core.geometry.reprojection import interaction, whitening
from thermal_fiducial.core.geometry.se3 import turn_of_pose
from thermal_fiducial.core.mapping.located import Location
from thermal_fiducial.core.measurements import Observations
from thermal_fiducial.core.motion_prior import PredictedCamera
from thermal_fiducial.core.types import FloatArray, TINY

# Standard deviations by which the time must be off to be named. In flights as declared it is up to 2.7.
_CONTRADICTS = 4.0


@dataclass(frozen=True)
class ReadoutEstimate:
    """What the readout time is declared too short by, negative if too much is declared."""

    #: the time and its standard deviation [s]
    seconds: float
    std: float

    @property
    def sigmas(self) -> float:
        """By how many standard deviations it contradicts the declaration."""
        return abs(self.seconds) / math.hypot(self.std, READOUT_AS_DECLARED)


class UndeclaredReadout:
    """What the readout time of a camera is declared too short by: its prior, and what frames and the map show of it."""

    def __init__(self, prior_std: float) -> None:
        """``prior_std`` : standard deviation of the prior [s]."""
        self.estimate = ReadoutEstimate(0.0, prior_std)
        self._prior_std = prior_std
        # Sums over frames: information, information times the time, and the variance of that by noise, and its joint
        # draws by errors of lens and map, which last as long as the flight.
        self._information, self._weighted, self._variance = 0.0, 0.0, 0.0
        self._common: FloatArray = np.zeros(DRAWS)
        self._is_by_map = False

    def with_readout_derivative(
        self, observed: Observations, camera: Camera, predicted: PredictedCamera | None
    ) -> Observations:
        """The observations with the derivative of their corners by what the camera moves in the readout.

        It is that of the detector's corners, not of the image's: rows that are read late bend the outline of a marker,
        and the detector pulls it towards a square as far as the noise of the corners allows (``as_squares``).
        """
        if predicted is None or self._prior_std == 0.0 or len(observed.ids) == 0:
            return observed
        points, R = ImagePoints.at(observed.corners, camera), predicted.pose.T_map_camera[:3, :3]
        depths = _depths(points.x, observed.branches[:, 0])
        J_camera = points.J @ interaction(points.x, depths) @ turn_of_pose(R.T)
        displaced = camera.readout_shares(observed.corners[..., 1])[..., None, None] * J_camera
        J = squareness(points.x, points.inverse)[1].reshape(-1, 2, 4, 2).swapaxes(1, 2)
        spread = observed.covariances @ J.swapaxes(-1, -2)
        information = inverse_2x2((J @ spread).sum(axis=1) + SQUARE_STD**2 * np.eye(2))
        pulled = information @ (J @ displaced).sum(axis=1)
        return replace(observed, by_readout=displaced - spread @ pulled[:, None])

    def corrected(self, observed: Observations, predicted: PredictedCamera | None) -> Observations:
        """The corners of N markers at the stamp, without what the time displaces them by in a camera in motion."""
        if predicted is None or self._prior_std == 0.0:
            return observed
        seconds, (rates, unsure) = self.estimate.seconds, rates_of_rows(observed, predicted)
        return replace(
            observed,
            corners=observed.corners - seconds * rates,
            covariances=observed.covariances + seconds**2 * unsure,
            readout_px=self.estimate.std * np.sqrt(np.mean(rates**2, axis=(1, 2))),
        )

    def claimed(self, location: Location, predicted: PredictedCamera | None) -> Location:
        """The location, whose covariance has what is not known of the time."""
        if predicted is None or self.estimate.std == 0.0:
            return location
        rates = (location.sight.observed.by_readout @ predicted.velocity).reshape(-1, 2)
        moved = np.einsum('nij,nj->i', location.corner_gains, rates)
        return replace(location, pose=location.pose.widened(covariance_of_one_error(moved, self.estimate.std)))

    def add(self, location: Location, predicted: PredictedCamera | None) -> None:
        """Update with the residuals of a frame that was corrected by the time as known so far."""
        if predicted is None or self._prior_std == 0.0 or self._is_by_map:
            return
        sight, fit = location.sight, location.reprojection
        W = whitening(sight.observed.covariances)
        residuals = (W @ fit.residuals[..., None])[..., 0]
        squared = (residuals * residuals).sum(axis=-1)
        roots = np.sqrt(location.weights[:, None] / np.maximum(squared / INLIER**2, 1.0))[..., None]
        W_robust = roots[..., None] * W
        Q = np.linalg.qr((W_robust @ fit.J_camera.reshape(*squared.shape, 2, 6)).reshape(-1, 6))[0]
        # Derivatives (8 N, 6) by a displacement in the time that the pose does not take up.
        left = _without(Q, (W_robust @ sight.observed.by_readout).reshape(-1, 6))
        by_time, rest = left @ predicted.velocity, _without(Q, (roots * residuals).ravel())
        information, shown = float(by_time @ by_time), float(by_time @ rest)
        unsure = float(np.sum(left @ predicted.velocity_covariance(1.0) * left))
        chi2 = float(rest @ rest) - shown**2 / max(information, TINY)
        by_corners = (roots * (W.swapaxes(-1, -2) @ by_time.reshape(*squared.shape, 2, 1))[..., 0]).reshape(-1, 1, 2)
        by_map = by_corners.reshape(len(W), 1, 8) @ fit.J_marker
        common = location.lens.drawn_sum(by_corners)[0] - drawn_sum(by_map, sight.draws)[0]
        # A wrong velocity shows another time, by what it is unsure by.
        noise = information * (noise_factor(chi2, len(rest) - 7) + self._prior_std**2 * unsure)
        weight = information / (noise + float(np.mean(common**2)) + TINY)
        self._information += weight * information
        self._weighted += weight * (shown + information * self.estimate.seconds)
        self._variance += weight**2 * noise
        self._common += weight * common
        self.estimate = self._by_frames()

    def adopt(self, by_map: ReadoutEstimate) -> None:
        """Take over the estimate of an adjustment of the map; frames alone know less.

        They see the map as it is, and one that was made by displaced corners has taken up a part of the time.
        """
        self.estimate, self._is_by_map = by_map, True

    def _by_frames(self) -> ReadoutEstimate:
        """The time by the sums over frames and its prior."""
        variance = self._variance + float(np.mean(self._common**2))
        by_prior = (self._information * self._prior_std) ** 2
        share = by_prior / max(by_prior + variance, TINY)
        seconds = share * self._weighted / max(self._information, TINY)
        return ReadoutEstimate(seconds, self._prior_std * math.sqrt(1.0 - share))

    @property
    def doubt(self) -> str:
        """Warning for diagnostics and console, with what to write; empty while nothing contradicts the declaration."""
        seconds = self.estimate.seconds
        if self.estimate.sigmas < _CONTRADICTS:
            return ''
        off, std = 1e3 * abs(seconds), 1e3 * self.estimate.std
        more, add = ('more', 'add') if seconds > 0.0 else ('less', 'subtract')
        return f'rows are read over {off:.1f} +- {std:.1f} ms {more} than readout_time says: {add} {1e-3 * off:.4f}'


def rates_of_rows(observed: Observations, predicted: PredictedCamera) -> tuple[FloatArray, FloatArray]:
    """Displacement (N, 4, 2) of the corners of N markers by each second of the time [px/s], and its covariances."""
    by_readout, unsure = observed.by_readout, predicted.velocity_covariance(1.0)
    return by_readout @ predicted.velocity, by_readout @ unsure @ by_readout.swapaxes(-1, -2)


def _depths(x: FloatArray, T_camera_marker: FloatArray) -> FloatArray:
    """Depths (N, 4) of normalised points (N, 4, 2) in the planes of markers (N, 4, 4); infinite without a pose."""
    normal, centre = T_camera_marker[:, None, :3, 2], T_camera_marker[:, None, :3, 3]
    along_rays = np.sum(x * normal[..., :2], axis=-1) + normal[..., 2]
    depths = np.sum(normal * centre, axis=-1) / along_rays
    return np.where(np.isfinite(depths), depths, np.inf)


def _without(Q: FloatArray, errors: FloatArray) -> FloatArray:
    """``errors`` (n, ...) without their parts along the orthonormal directions ``Q`` (n, 6)."""
    return np.asarray(errors - Q @ (Q.T @ errors))
