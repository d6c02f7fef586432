"""A rolling shutter whose rows are read over another time than ``readout_time`` says, found in flight by its frames.

The detector moves corners to the stamp by the declared time. If that is too short by d, a corner at the share s of the
rows, -1/2 in the first one and 1/2 in the last, stays displaced by d s times its velocity in the image. The pose of the
frame takes up a part of that; what it leaves, in all frames, shows d by least squares. Where the map is made in the
same flight, its adjustment has d among its unknowns, and knows better.
"""

from dataclasses import dataclass, replace
import math

import numpy as np

from thermal_fiducial.core.error_model import (
    covariance_of_one_error,
    drawn_sum,
    DRAWS,
    HIDDEN_OF_READOUT,
    noise_factor,
    READOUT_AS_DECLARED,
    READOUT_STD,
)
from thermal_fiducial.core.geometry.camera import Camera, ImagePoints
from thermal_fiducial.core.geometry.planar_pose import INLIER
from thermal_fiducial.core.geometry.reprojection import interaction, turn_of_pose, turned, whitening
from thermal_fiducial.core.mapping.located import Location
from thermal_fiducial.core.measurements import Observations
from thermal_fiducial.core.motion_prior import PredictedCamera
from thermal_fiducial.core.types import FloatArray, TINY

#: Standard deviations by which the time must be off before corners are corrected by it. In flights as declared it is up
#: to 2.7.
CONTRADICTS = 4.0
# And before residuals count as of it, not of an error of the lens.
_LIKELY = 1.0


@dataclass(frozen=True)
class FoundReadout:
    """What the readout time is declared too short by, and its standard deviation [s]."""

    seconds: float
    std: float

    @property
    def sigmas(self) -> float:
        """By how many standard deviations it contradicts the declaration."""
        return abs(self.seconds) / math.hypot(self.std, READOUT_AS_DECLARED)


class UndeclaredReadout:
    """What the readout time of a camera is declared too short by [s], as far as frames contradict the declaration."""

    def __init__(self) -> None:
        #: the time, negative if too much is declared, and its standard deviation; zero while nothing is contradicted
        self.seconds, self.std = 0.0, 0.0
        # The time while it is likely at least.
        self._likely = 0.0
        # Sums over frames: information, information times the time, and the variance of that by noise, and its joint
        # draws by errors of lens and map, which last as long as the flight.
        self._information, self._weighted, self._variance = 0.0, 0.0, 0.0
        self._common: FloatArray = np.zeros(DRAWS)
        # What the last adjustment of the map has found.
        self._by_map: FoundReadout | None = None

    def corrected(self, observed: Observations, camera: Camera, predicted: PredictedCamera | None) -> Observations:
        """The corners of N markers at the stamp, without what the time displaces them by in a camera in motion."""
        if predicted is None or self.seconds == 0.0:
            return observed
        rates, unsure = rates_of_rows(observed, camera, predicted)
        corners = observed.corners - self.seconds * rates
        return replace(observed, corners=corners, covariances=observed.covariances + self.seconds**2 * unsure)

    def claimed(self, location: Location, camera: Camera, predicted: PredictedCamera | None) -> Location:
        """The location, whose covariance has what is not known of the time."""
        if predicted is None or self.std == 0.0:
            return location
        moved = np.einsum('nij,nj->i', location.corner_gains, _rates(location, camera, predicted).reshape(-1, 2))
        return replace(location, pose=location.pose.widened(covariance_of_one_error(moved, self.std)))

    def explained(self, location: Location, camera: Camera, predicted: PredictedCamera | None) -> Location:
        """The location with residuals of lens and detector alone: without those by the most likely time."""
        fit, left = location.reprojection, self._likely - self.seconds
        if predicted is None or left == 0.0:
            return location
        residuals = fit.residuals - left * _rates(location, camera, predicted)
        return replace(location, reprojection=replace(fit, residuals=residuals))

    def add(self, location: Location, camera: Camera, predicted: PredictedCamera | None) -> None:
        """Update with the residuals of a frame that was corrected by the time as known so far."""
        if predicted is None or self._by_map is not None:
            return
        sight, fit = location.sight, location.reprojection
        W, shares = whitening(sight.observed.covariances), camera.readout_shares(sight.observed.corners[..., 1])
        residuals = (W @ fit.residuals[..., None])[..., 0]
        squared = (residuals * residuals).sum(axis=-1)
        roots = np.sqrt(location.weights[:, None] / np.maximum(squared / INLIER**2, 1.0))[..., None]
        J = roots[..., None] * W @ fit.J_camera.reshape(*squared.shape, 2, 6)
        Q = np.linalg.qr(J.reshape(-1, 6))[0]
        # Derivatives (8 N, 6) by a displacement in the time that the pose does not take up.
        left = _without(Q, (shares[..., None, None] * J).reshape(-1, 6))
        by_time, rest = left @ predicted.velocity, _without(Q, (roots * residuals).ravel())
        information, shown = float(by_time @ by_time), float(by_time @ rest)
        unsure = float(np.sum(left @ predicted.velocity_covariance(1.0) * left))
        chi2 = float(rest @ rest) - shown**2 / max(information, TINY)
        by_corners = (roots * (W.swapaxes(-1, -2) @ by_time.reshape(*squared.shape, 2, 1))[..., 0]).reshape(-1, 1, 2)
        by_map = by_corners.reshape(len(W), 1, 8) @ fit.J_marker
        common = location.lens.drawn_sum(by_corners)[0] - drawn_sum(by_map, sight.draws)[0]
        # A wrong velocity shows another time, by what it is unsure by.
        noise = information * (noise_factor(chi2, len(rest) - 7) + READOUT_STD**2 * unsure)
        weight = information / (noise + float(np.mean(common**2)) + TINY)
        self._information += weight * information
        self._weighted += weight * (shown + information * self.seconds)
        self._variance += weight**2 * noise
        self._common += weight * common
        self._judge()

    def adopt(self, found: FoundReadout | None) -> None:
        """Take over what an adjustment of the map has found, if anything; frames alone know less of it.

        They see the map as it is, and one that was made by displaced corners has taken up a part of the time.
        """
        if found is not None:
            self._by_map = found if found.sigmas > CONTRADICTS else None
            self._judge()

    def _judge(self) -> None:
        """Take the time over where it is beyond doubt."""
        found = self._by_map or self._by_frames()
        self._likely = found.seconds if found.sigmas > _LIKELY else 0.0
        self.seconds, self.std = 0.0, 0.0
        if found.sigmas > CONTRADICTS:
            self.seconds, self.std = found.seconds, math.hypot(found.std, HIDDEN_OF_READOUT * found.seconds)

    def _by_frames(self) -> FoundReadout:
        """The time by the sums over frames and its prior."""
        information = max(self._information, TINY)
        variance = (self._variance + float(np.mean(self._common**2))) / information**2
        share = READOUT_STD**2 / (READOUT_STD**2 + variance)
        return FoundReadout(share * self._weighted / information, math.sqrt(share * variance))

    @property
    def doubt(self) -> str:
        """Warning for diagnostics and console, with what to write; empty while nothing contradicts the declaration."""
        if self.seconds == 0.0:
            return ''
        off, std = 1e3 * abs(self.seconds), 1e3 * self.std
        more, add = ('more', 'add') if self.seconds > 0.0 else ('less', 'subtract')
        return f'rows are read over {off:.1f} +- {std:.1f} ms {more} than readout_time says: {add} {1e-3 * off:.4f}'


def rates_of_rows(observed: Observations, camera: Camera, predicted: PredictedCamera) -> tuple[FloatArray, FloatArray]:
    """Displacement (N, 4, 2) of the corners of N markers by each second of the time [px/s], and its covariances."""
    at, R = ImagePoints.at(observed.corners, camera), predicted.pose.T_map_camera[:3, :3]
    depth = np.repeat(observed.branches[:, :1, 2, 3], 4, axis=1)
    shares = camera.readout_shares(observed.corners[..., 1])[..., None, None]
    by_twist = shares * (at.J @ interaction(at.x, depth))
    moved = by_twist @ (turn_of_pose(R.T) @ predicted.velocity)
    return moved, by_twist @ turned(predicted.velocity_covariance(1.0), R.T) @ by_twist.swapaxes(-1, -2)


def _without(Q: FloatArray, errors: FloatArray) -> FloatArray:
    """``errors`` (n, ...) without their parts along the orthonormal directions ``Q`` (n, 6)."""
    return np.asarray(errors - Q @ (Q.T @ errors))


def _rates(location: Location, camera: Camera, predicted: PredictedCamera) -> FloatArray:
    """Displacement (N, 4, 2) of the corners of N located markers by each second of the time [px/s]."""
    shares = camera.readout_shares(location.sight.observed.corners[..., 1])
    moving = location.reprojection.J_camera @ predicted.velocity
    return np.asarray(shares[..., None] * moving.reshape(*shares.shape, 2))
