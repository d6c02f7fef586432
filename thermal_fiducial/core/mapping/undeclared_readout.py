"""A rolling shutter whose rows are read over another time than ``readout_time`` says, estimated in flight.

The detector moves corners to the stamp by the declared time. If that is too short by d, a corner at the share s of the
rows, -1/2 in the first one and 1/2 in the last, stays displaced by d s times its velocity in the image. The pose of the
frame takes up a part of that; what it leaves, in all frames, shows d by least squares. Where the map is made in the
same flight, its adjustment has d among its unknowns, and knows better. Poses, new markers and keyframes always claim
what is not known of it, by their corners.
"""

from dataclasses import dataclass, field, replace
import math

import numpy as np

from thermal_fiducial.core.error_model import (
    covariance_root,
    drawn_sum,
    DRAWS,
    noise_factor,
    READOUT_AS_DECLARED,
    SQUARE_STD,
    UNKNOWN_ACCELERATION,
    USUAL_RATE,
    USUAL_SPEED,
)
from thermal_fiducial.core.geometry.camera import Camera, ImagePoints, inverse_2x2
from thermal_fiducial.core.geometry.planar_pose import INLIER, squareness
from thermal_fiducial.core.geometry.reprojection import interaction, whitening
from thermal_fiducial.core.geometry.se3 import turn_of_pose
from thermal_fiducial.core.mapping.located import Location, not_taken_up
from thermal_fiducial.core.measurements import Observations
from thermal_fiducial.core.motion_prior import PredictedCamera
from thermal_fiducial.core.types import FloatArray, IntArray, SECOND_NS, TINY

# Standard deviations by which the time must be off to be named. In flights as declared it is up to 2.7.
_CONTRADICTS = 4.0


@dataclass(frozen=True)
class ReadoutEstimate:
    """What the readout time is declared too short by, negative if too much is declared."""

    #: the time and its standard deviation [s]
    seconds: float
    std: float


@dataclass(frozen=True)
class ImageMotion:
    """The corners of a frame, from which those of the next one have moved."""

    stamp_ns: int = 0
    #: (M,), and (M, 4, 2) [px]
    ids: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    corners: FloatArray = field(default_factory=lambda: np.zeros((0, 4, 2)))

    def until(self, stamp_ns: int, observed: Observations) -> tuple[FloatArray, FloatArray]:
        """Velocity (N, 4, 2) of the corners of N markers [px/s], and what that of the camera may be beside (N, 6).

        The mean velocity of the time between is that in its middle; since then the camera may have accelerated. Of a
        marker that was not in that frame, or too long ago, nothing is known but what robots usually do [m/s, rad/s].
        """
        seconds = (stamp_ns - self.stamp_ns) / SECOND_NS
        usual = np.repeat((USUAL_SPEED, USUAL_RATE), 3)
        accelerated = 0.5 * seconds * np.sqrt(UNKNOWN_ACCELERATION.diagonal())
        flow, unsure = np.zeros_like(observed.corners), np.tile(usual, (len(observed.ids), 1))
        if seconds > 0.0 and np.all(accelerated < usual):
            _, now, before = np.intersect1d(observed.ids, self.ids, return_indices=True)
            flow[now], unsure[now] = (observed.corners[now] - self.corners[before]) / seconds, accelerated
        return flow, unsure


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
        self._before = ImageMotion()

    def with_readout_derivative(
        self, stamp_ns: int, observed: Observations, camera: Camera, predicted: PredictedCamera | None
    ) -> Observations:
        """N markers with what displaces their corners where rows are read late, as the detector has them.

        Such rows bend the outline of a marker, and the detector pulls it towards a square as far as the noise of the
        corners allows (``as_squares``). Before the filter has its first pose the velocity is that of the corners since
        the frame before: the first frames would choose between the two poses of a marker by an outline that is bent
        towards the wrong one.
        """
        before, self._before = self._before, ImageMotion(stamp_ns, observed.ids, observed.corners)
        if self._prior_std == 0.0 or len(observed.ids) == 0:
            return observed
        points = ImagePoints.at(observed.corners, camera)
        shares = camera.readout_shares(observed.corners[..., 1])[..., None, None]
        R = np.eye(3) if predicted is None else predicted.pose.T_map_camera[:3, :3]
        J_camera = points.J @ interaction(points.x, _depths(points.x, observed.branches[:, 0])) @ turn_of_pose(R.T)
        by_readout = _as_detected(shares * J_camera, observed, points)
        if predicted is None:
            flow, unsure = before.until(stamp_ns, observed)
            by_flow = _as_detected(shares * flow[..., None], observed, points)
            late = np.concatenate([by_flow, by_readout * unsure[:, None, None]], axis=-1)
        else:
            late = by_readout @ _motion(predicted)
        return replace(observed, by_readout=by_readout, rates=late[..., 0], late_px=self.estimate.std * late)

    def corrected(self, observed: Observations, predicted: PredictedCamera | None) -> Observations:
        """The corners of N markers at the stamp, without what the time displaces them by in a camera in motion."""
        if predicted is None or self._prior_std == 0.0:
            return observed
        seconds, by_readout = self.estimate.seconds, observed.by_readout
        unsure = by_readout @ predicted.velocity_covariance(1.0) @ by_readout.swapaxes(-1, -2)
        return replace(
            observed,
            corners=observed.corners - seconds * observed.rates,
            covariances=observed.covariances + seconds**2 * unsure,
        )

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
        left = not_taken_up(Q, (W_robust @ sight.observed.by_readout).reshape(-1, 6))
        by_time, rest = left @ predicted.velocity, not_taken_up(Q, (roots * residuals).ravel())
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
        seconds, std = self.estimate.seconds, self.estimate.std
        if abs(seconds) < _CONTRADICTS * math.hypot(std, READOUT_AS_DECLARED):
            return ''
        off, std = 1e3 * abs(seconds), 1e3 * std
        more, add = ('more', 'add') if seconds > 0.0 else ('less', 'subtract')
        return f'rows are read over {off:.1f} +- {std:.1f} ms {more} than readout_time says: {add} {1e-3 * off:.4f}'


def _as_detected(displaced: FloatArray, observed: Observations, points: ImagePoints) -> FloatArray:
    """Displacements (N, 4, 2, m) of the corners in the image as the detector has them, which pulls them to squares."""
    J = squareness(points.x, points.inverse)[1].reshape(-1, 2, 4, 2).swapaxes(1, 2)
    spread = observed.covariances @ J.swapaxes(-1, -2)
    information = inverse_2x2((J @ spread).sum(axis=1) + SQUARE_STD**2 * np.eye(2))
    pulled = information @ (J @ displaced).sum(axis=1)
    return np.asarray(displaced - spread @ pulled[:, None])


def _motion(predicted: PredictedCamera) -> FloatArray:
    """Root (6, 7) of the second moments of the camera's velocity [m/s, rad/s]: its mean, and what it is unsure by."""
    unsure = covariance_root(predicted.velocity_covariance(1.0))
    return np.concatenate([predicted.velocity[:, None], unsure], axis=1)


def _depths(x: FloatArray, T_camera_marker: FloatArray) -> FloatArray:
    """Depths (N, 4) of normalised points (N, 4, 2) in the planes of markers (N, 4, 4); infinite without a pose."""
    normal, centre = T_camera_marker[:, None, :3, 2], T_camera_marker[:, None, :3, 3]
    along_rays = np.sum(x * normal[..., :2], axis=-1) + normal[..., 2]
    depths = np.sum(normal * centre, axis=-1) / along_rays
    return np.where(np.isfinite(depths), depths, np.inf)
