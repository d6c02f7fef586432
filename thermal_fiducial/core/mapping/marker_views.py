"""Fit of a marker's pose to its views; the camera pose of a view is uncertain, and may be one of two."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from thermal_fiducial.core.error_model import (
    block_diagonal,
    covariance_by_draws,
    covariance_of_one_error,
    drawn_sum,
    DRAWS,
    independent_sum,
    LATE_DRAWS,
    noise_factor,
    SystematicErrors,
    with_corner_errors,
)
from thermal_fiducial.core.geometry.camera import by_other_calibration, Camera, ImagePoints
from thermal_fiducial.core.geometry.reprojection import marker_corners
from thermal_fiducial.core.geometry.rigid_fit import (
    Images,
    linearised,
    minimise,
    Quadratic,
    REFUTED,
    SINGULAR,
    TIMES_THE_BEST,
)
from thermal_fiducial.core.geometry.se3 import inverse, lever_arm, rotation_angle, screwed
from thermal_fiducial.core.lens_errors import LensErrors
from thermal_fiducial.core.measurements import LATE
from thermal_fiducial.core.types import BoolArray, FloatArray, IntArray, Stacked, TINY

#: Of a camera pose that no error of the sides has moved.
NOT_MOVED: FloatArray = np.zeros(6)
#: Poses nearer to each other than this [rad] are one pose, and not the two of a planar ambiguity.
SAME_POSE = np.deg2rad(2.0)
# A corner that moves faster in the image than this is hardly before the camera at all [px/m, px/rad].
_STEEPEST = 1e6
# A corner whose place in the image is known worse than this is known nowhere; a covariance with it has no root [px^2].
_WIDEST = 1e12
# How many standard deviations of a camera's pose the likeliest one may be away.
_FARTHEST = 6.0


@dataclass(frozen=True)
class Viewpoint:
    """The pose of a camera, or its two possible poses."""

    #: (2, 4, 4) twice the same where there is no doubt
    T_map_camera: FloatArray
    #: (2, 6, 6) of either, ROS convention: the part that is independent between views
    covariances: FloatArray
    #: (2, 6, K) joint draws of either's error that other views share: it moves the marker, but leaves no residual
    draws: FloatArray
    #: (6,) displacement of the camera by one standard deviation of the markers' sides
    of_sides: FloatArray
    #: (2,) of the known markers' residuals from either: how likely it is
    chi2: FloatArray

    @property
    def poses(self) -> FloatArray:
        """The one or two (k, 4, 4) different poses."""
        return self.T_map_camera if np.any(self.T_map_camera[0] != self.T_map_camera[1]) else self.T_map_camera[:1]

    @cached_property
    def turn_std(self) -> float:
        """Standard deviation of the better known pose's attitude, by noise [rad]."""
        return float(np.sqrt(np.trace(self.covariances[:, 3:, 3:], axis1=1, axis2=2).min()))

    @classmethod
    def known(
        cls, T_map_camera: FloatArray, covariance: FloatArray, draws: FloatArray, of_sides: FloatArray = NOT_MOVED
    ) -> 'Viewpoint':
        """A unique camera pose (4, 4): covariance (6, 6) of its own error, draws (6, K) of the one that views share."""
        T, covariances, both_draws = (np.stack([of_one] * 2) for of_one in (T_map_camera, covariance, draws))
        return cls(T, covariances, both_draws, of_sides, np.zeros(2))

    @classmethod
    def either(cls, first: 'Viewpoint', second: 'Viewpoint', chi2: FloatArray) -> 'Viewpoint':
        """One of two known camera poses, of which the known markers leave residuals of ``chi2`` (2,)."""
        return cls(
            np.stack([first.T_map_camera[0], second.T_map_camera[0]]),
            np.stack([first.covariances[0], second.covariances[0]]),
            np.stack([first.draws[0], second.draws[0]]),
            first.of_sides,
            chi2,
        )


@dataclass(frozen=True)
class MarkerView:
    """A marker in one frame."""

    stamp_ns: int
    viewpoint: Viewpoint
    #: (4, 2) [px]
    corners: FloatArray
    #: (4, 2, 2) [px^2]
    corner_covariances: FloatArray
    #: (2, 4, 4) both branches of T_camera_marker, the better one first
    branches: FloatArray
    #: (4, 2, 7) displacement of the corners by what is not known of rows that are read late [px]
    late_px: FloatArray = field(default_factory=lambda: np.zeros((4, 2, LATE)))

    @cached_property
    def direction(self) -> FloatArray:
        """Unit vector (3,) from the marker to the camera, in the map."""
        # Both branches put the centre at the same place: the direction doesn't depend on the ambiguity.
        arm = self.viewpoint.T_map_camera[0, :3, :3] @ self.branches[0, :3, 3]
        return np.asarray(-arm / np.linalg.norm(arm))

    def in_pixels_of(self, before: Camera, now: Camera) -> 'MarkerView':
        """The same directions in pixels of the camera's calibration ``now``, where it was that of ``before``."""
        corners, gains = by_other_calibration(self.corners, before, now)
        covariances = gains @ self.corner_covariances @ gains.swapaxes(-1, -2)
        return replace(self, corners=corners, corner_covariances=covariances, late_px=gains @ self.late_px)

    def moved(self, T_new_old: FloatArray) -> 'MarkerView':
        """The same view in a displaced map."""
        T_map_camera = T_new_old @ self.viewpoint.T_map_camera
        return replace(self, viewpoint=replace(self.viewpoint, T_map_camera=T_map_camera))


@dataclass(frozen=True, slots=True)
class ViewWeights(Stacked):
    """Weights of n views of S markers, as decided from where the markers and their cameras were taken to be."""

    #: (S, n, 4, 4) where each camera was likeliest
    T_map_camera: FloatArray
    #: (S, n, 8) part of the residuals by the displacement of each camera to there [px]
    displaced: FloatArray
    #: (S, n, 8, 8) covariances of the residuals [px^2]
    covariances: FloatArray
    #: (S, n) chi square of each camera's own pose, and with that of the view's residuals; infinite if that cannot be
    of_cameras: FloatArray
    costs: FloatArray
    #: (S, n, 6) displacement of each camera from the pose that is known to where it is likeliest now
    likeliest: FloatArray

    @property
    def W(self) -> FloatArray:
        """(S, n, 8, 8) by which residuals become unit white."""
        return np.linalg.inv(np.linalg.cholesky(self.covariances))


@dataclass(frozen=True)
class FittedPoses:
    """Results of S fits of a marker's pose to n views, the best first."""

    #: (S, 4, 4)
    T: FloatArray
    #: (S,) of the residuals, and with those of the cameras' own poses: minus twice the logarithm of the likelihood
    chi2: FloatArray
    cost: FloatArray
    #: of the best one: (n,) which of each camera's two poses was used, and the weights
    chosen: IntArray
    weights: ViewWeights


class MarkerViews:
    """n views of one marker as arrays."""

    def __init__(self, views: Sequence[MarkerView], size: float, camera: Camera, errors: SystematicErrors) -> None:
        self._marker_corners, self._side_std = marker_corners(size), errors.marker_size_std
        corners = np.stack([view.corners for view in views])
        points, self._of_lens = ImagePoints.at(corners, camera), LensErrors(corners, camera, errors)
        self._images = Images.of(points, np.broadcast_to(np.eye(2), points.J.shape))
        covariances = np.stack([view.corner_covariances for view in views])
        self._noise = block_diagonal(covariances)
        self._late = np.stack([view.late_px for view in views]).reshape(-1, 8, LATE)
        #: with the bias of the corners and late rows, for weights and decisions
        by_late = self._late @ np.swapaxes(self._late, -1, -2)
        self._uncertain = block_diagonal(with_corner_errors(covariances)) + by_late
        self._T_map_camera = np.stack([view.viewpoint.T_map_camera for view in views])
        self._camera_noise = np.stack([view.viewpoint.covariances for view in views])
        self._of_sides = np.stack([view.viewpoint.of_sides for view in views])
        self._draws = np.stack([view.viewpoint.draws for view in views])
        # Views whose cameras have a larger error in common than the best one's count less: (2, n, 2, 6, 6), by which of
        # its two poses the best one has, as one error displaces each of the two otherwise.
        self._best = int(np.argmin(np.sum(np.square(self._draws), axis=(1, 2, 3))))
        best = self._draws[self._best, :, None, None]
        self._covariances = self._camera_noise + covariance_by_draws(self._draws - best)
        poses = [len(view.viewpoint.poses) for view in views]
        self._poses, self._poses_of_best = max(poses), poses[self._best]
        self._chi2_of_cameras = np.stack([view.viewpoint.chi2 for view in views])

    def fit(self, starts: FloatArray) -> FittedPoses:
        """Fits from all initial poses (S, 4, 4); of two possible camera poses the likelier one is used.

        Twice: with weights from a start some degrees off, a camera's turn that nothing shows counts in part. What is
        hopeless after the first time is no alternative.
        """
        chosen, moved = self._choose_all(starts)
        T, _, cost, _ = self._fitted(starts, chosen, moved)
        # The best first: of two that are the same it is the one that stays.
        order = np.argsort(cost, kind='stable')
        kept = order[_distinct(T[order], chosen[order]) & (cost[order] <= REFUTED + TIMES_THE_BEST * cost[order[0]])]
        T, of_best = T[kept], chosen[kept][:, [self._best]]
        chosen, moved, _ = self._choose(T, of_best, moved[:, kept])
        T, chi2, cost, weights = self._fitted(T, chosen, moved)
        order = np.argsort(cost, kind='stable')
        return FittedPoses(T[order], chi2[order], cost[order], chosen[order[0]], weights.only(order[0]))

    def errors(self, fits: FittedPoses, noise: float, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        """Covariance (6, 6) of the best fit, and joint draws (6, K) of its error but for the sides.

        The errors are the corners', whose covariance counts ``noise`` times, those of late rows, and those of the
        cameras' poses.
        """
        own = np.arange(len(fits.chosen)), fits.chosen
        _, J_camera, J_marker = self._at_best(fits)
        J_camera, J_marker = fits.weights.W @ J_camera, fits.weights.W @ J_marker
        white = np.linalg.inv(np.einsum('vri,vrj->ij', J_marker, J_marker))
        gains = -white @ np.einsum('vri,vrj->vij', J_marker, J_camera)
        by_corner = white @ np.swapaxes(J_marker, -1, -2) @ fits.weights.W
        of_sides = np.einsum('vij,vj->i', gains, self._of_sides)
        of_lens = self._of_lens.drawn_sum(by_corner.reshape(-1, 6, 4, 2).swapaxes(1, 2).reshape(-1, 6, 2))
        # The time that moves these corners has moved those that the camera is known by.
        of_late = drawn_sum(by_corner, self._late) @ LATE_DRAWS
        shared = drawn_sum(gains, self._draws[own]) + of_lens + of_late
        alone = independent_sum(by_corner, self._noise) + independent_sum(gains, self._camera_noise[own])
        alone *= noise
        of_noise = np.linalg.cholesky(alone) @ rng.standard_normal((6, DRAWS))
        return alone + covariance_of_one_error(of_sides) + covariance_by_draws(shared), shared + of_noise

    def chi2_of_side(self, fits: FittedPoses) -> float:
        """Chi square, one degree of freedom, of the declared side against the one that the views show.

        One view allows any side: a marker of twice the side is twice as far away. Cameras that are known better than
        they are apart show the range by themselves. The side is a seventh unknown, one step from the best fit, and its
        variance has the noise of the residuals that this leaves. As well as it is declared a side need not be right:
        that of this marker, and those of the markers that the cameras are known by.
        """
        r, _, J_marker = self._at_best(fits)
        from_centre = self._marker_corners @ fits.T[0, :3, :3].T
        by_side = np.einsum('vcij,cj->vci', J_marker[..., :3].reshape(-1, 4, 2, 3), from_centre).reshape(-1, 8)
        white = (fits.weights.W @ np.concatenate([J_marker, by_side[..., None], r[..., None]], axis=-1)).reshape(-1, 8)
        # What a pose may explain of side and residuals says nothing of the side.
        Q = np.linalg.qr(white[:, :6])[0]
        by_side, r = (white[:, 6:] - Q @ (Q.T @ white[:, 6:])).T
        information, shown = float(by_side @ by_side), float(by_side @ r)
        if information <= SINGULAR * float(white[:, 6] @ white[:, 6]):
            return 0.0
        noise = noise_factor(float(r @ r) - shown**2 / information, len(r) - 7)
        variance = noise / information + 2.0 * self._side_std**2
        return (shown / information) ** 2 / variance

    def _choose_all(self, T: FloatArray) -> tuple[IntArray, FloatArray]:
        """As :meth:`_choose`, for the likelier pose of the best camera too."""
        each, unmoved = np.arange(len(T)), np.zeros((self._poses, len(T), len(self._noise), 6))
        chosen, moved, costs = self._choose(T, np.arange(self._poses_of_best)[:, None, None, None], unmoved)
        likelier = np.argmin(costs, axis=0)
        return chosen[likelier, each], np.swapaxes(moved[likelier, :, each], 0, 1)

    def _choose(self, T: FloatArray, of_best: IntArray, moved: FloatArray) -> tuple[IntArray, FloatArray, FloatArray]:
        """The likelier of P poses of each camera for markers at T, beside that ``of_best`` (..., S, 1) of the best one.

        Parameters
        ----------
        moved : (P, S, n, 6) displacement of each pose to where it is likeliest, as known so far

        Returns
        -------
        Which one, (..., S, n), the displacements as known now (..., P, S, n, 6), and the costs (..., S).
        """
        poses = np.arange(len(moved))[:, None, None] + np.zeros(moved.shape[1:3], dtype=np.int64)
        weights = self._weights(T, poses, of_best, moved)
        excluded = (poses != of_best) & (np.arange(poses.shape[-1]) == self._best)
        costs = np.where(np.isfinite(weights.costs) & ~excluded, weights.costs, np.inf)
        return np.argmin(costs, axis=-3), weights.likeliest, costs.min(axis=-3).sum(axis=-1)

    def _at_best(self, fits: FittedPoses) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Of the best fit: residuals (n, 8) [px], and derivatives (n, 8, 6) by the cameras and by the marker."""
        r, J_camera, J_marker = self._linearised(fits.T[:1], fits.weights.T_map_camera[None])
        return r[0] + fits.weights.displaced, J_camera[0], J_marker[0]

    def _linearised(self, T: FloatArray, T_map_camera: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Residuals (..., S, n, 8) [px] of markers at T, and derivatives (..., 8, 6) by the cameras and by the markers.

        Residuals are NaN where a corner is behind the camera.
        """
        shape = T_map_camera.shape[:-2]
        T_camera_map, count = inverse(T_map_camera), np.prod(shape[:-1], dtype=int)
        images = Images(np.tile(self._images.whitening, (count, 1, 1, 1)), np.tile(self._images.target, (count, 1, 1)))
        off, J, seen = linearised((T_camera_map @ T[:, None]).reshape(-1, 4, 4), self._marker_corners[None], images)
        r = np.where(seen[:, None], -off.reshape(-1, 8), np.nan)
        # From the axes of the cameras to those of the map.
        J_marker = (J.reshape(*shape, 16, 3) @ T_camera_map[..., :3, :3]).reshape(*shape, 8, 6)
        # Moved like the marker, but the other way round.
        J_camera = -J_marker @ lever_arm(T[:, None, :3, 3] - T_map_camera[..., :3, 3])
        return r.reshape(*shape, 8), J_camera, J_marker

    def _weights(self, T: FloatArray, chosen: IntArray, of_best: IntArray, moved: FloatArray) -> ViewWeights:
        """Weights of the views of markers at T (S, 4, 4) from the chosen (S, n) and (S, 1) of the cameras' poses.

        A residual comes of the corners' noise, of the systematic part, and of the camera's own pose, which moves all
        four corners together, along an arc if it is turned. So it is linearised about the likeliest pose of the camera
        by its view, which is ``moved`` (S, n, 6) from the one that is known (B. Bell, F. Cathey, IEEE TAC 1993): a turn
        by 10 degrees about a marker 10 m away is 0.15 m off to first order.
        """
        own = np.arange(chosen.shape[-1]), chosen
        covariances = self._covariances[of_best, *own]
        T_map_camera = screwed(self._T_map_camera[own], moved)
        r, J_camera, _ = self._linearised(T, T_map_camera)
        J_camera, by_camera, possible = _by_cameras(J_camera, covariances)
        displaced = (J_camera @ moved[..., None])[..., 0]
        r, total = (r + displaced)[..., None], by_camera + self._uncertain
        pulls = np.linalg.solve(total, r)
        sigmas = np.sqrt(np.maximum(np.swapaxes(pulls, -1, -2) @ by_camera @ pulls, TINY))[..., 0]
        likeliest = (covariances @ np.swapaxes(J_camera, -1, -2) @ pulls)[..., 0] * np.minimum(1.0, _FARTHEST / sigmas)
        of_cameras = np.where(possible, self._chi2_of_cameras[own], np.inf)
        costs = np.sum(r * pulls, axis=(-1, -2)) + of_cameras
        return ViewWeights(T_map_camera, displaced, total, of_cameras, costs, likeliest)

    def _fitted(
        self, starts: FloatArray, chosen: IntArray, moved: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, ViewWeights]:
        """Poses (S, 4, 4) from starts by the ``chosen`` poses of the cameras, with weights at the starts.

        Returns
        -------
        Poses, chi squares (S,) of their residuals and with those of the cameras, infinite without a pose, and weights.
        """
        own = np.take_along_axis(moved, chosen[None, ..., None], axis=0)[0]
        begun = self._weights(starts, chosen, chosen[:, [self._best]], own)
        W = begun.W

        def evaluated(T: FloatArray) -> Quadratic:
            r, _, J = self._linearised(T, begun.T_map_camera)
            r, J = W @ (r + begun.displaced)[..., None], W @ J
            r, J = r.reshape(len(T), -1, 1), J.reshape(len(T), -1, 6)
            J_transposed, chi2 = np.swapaxes(J, -1, -2), np.sum(r * r, axis=(1, 2))
            # Residuals are measured minus predicted: the gradient is that of their squares.
            return np.where(np.isfinite(chi2), chi2, np.inf), -(J_transposed @ r)[..., 0], J_transposed @ J

        T, chi2, _ = minimise(starts, evaluated, alternatives=len(starts))
        return T, chi2, chi2 + np.sum(begun.of_cameras, axis=-1), begun


def _by_cameras(J_camera: FloatArray, covariances: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
    """What corners are displaced by with their cameras, which are known to ``covariances`` (S, n, 6, 6).

    Returns
    -------
    J_camera (S, n, 8, 6) and covariances (S, n, 8, 8) [px^2], zero where a corner is hardly before the camera, and
    which (S, n) are not.
    """
    possible = np.all(np.abs(J_camera) < _STEEPEST, axis=(-1, -2))
    J_sound = np.where(possible[..., None, None], J_camera, 0.0)
    moved = J_sound @ covariances @ np.swapaxes(J_sound, -1, -2)
    possible = possible & np.all(np.einsum('...ii->...i', moved) < _WIDEST, axis=-1)
    sound = possible[..., None, None]
    return np.where(sound, J_sound, 0.0), np.where(sound, moved, 0.0), possible


def _distinct(T: FloatArray, chosen: IntArray) -> BoolArray:
    """Which (S,) of poses (S, 4, 4) with the ``chosen`` (S, n) poses of cameras are not the same as one before them."""
    turns = rotation_angle(np.swapaxes(T[:, None, :3, :3], -1, -2) @ T[:, :3, :3])
    alike = (turns < SAME_POSE) & np.all(chosen[:, None] == chosen, axis=-1)
    return np.asarray(np.argmax(alike, axis=1) == np.arange(len(T)))
