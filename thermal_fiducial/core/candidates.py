"""New markers on trial: views are collected until they leave only one pose.

A small square seen from one side fits two poses nearly equally well (the planar ambiguity of Schweighofer and Pinz,
"Robust pose estimation from a planar target", 2006). The wrong one is wrong differently from each direction, so the
marker's pose is fitted to views from several directions from either start, and enters the map only when one of the
two fits is refuted.
"""

from dataclasses import dataclass, field

import numpy as np

from thermal_fiducial.core.camera import Camera
from thermal_fiducial.core.fitting import fit_pose
from thermal_fiducial.core.geometry import rotation_angle
from thermal_fiducial.core.reprojection import linearise, shared_covariances, whitening
from thermal_fiducial.core.types import FloatArray

#: Views closer in direction than this tell nothing new of the ambiguity [rad].
MIN_SEPARATION = np.deg2rad(1.0)
MIN_VIEWS = 3
#: Views kept of a candidate: the fit's cost stays bounded, however long the trial lasts.
MAX_VIEWS = 16
#: Difference of the two fits' chi squares that refutes the worse one: odds of e^-12 against a flip.
DECISIVE = 25.0
#: Corner errors that no covariance of white noise speaks of (lens, lag of a moving camera) [px].
SYSTEMATIC_PX = 0.1
#: Mean chi square of a view (8 residuals) above which the views don't belong to one marker that hangs still.
INCONSISTENT = 200.0
# Fits that end nearer to each other than this are one fit [rad].
_SAME_FIT = np.deg2rad(2.0)


@dataclass(frozen=True)
class View:
    """A marker seen from a known camera pose."""

    T_map_camera: FloatArray
    #: (6, 6) of the camera pose, ROS convention
    covariance: FloatArray
    #: (4, 2) [px]
    corners: FloatArray
    #: (4, 2, 2) [px^2]
    corner_covariances: FloatArray
    #: (2, 4, 4) both branches of T_camera_marker, the better one first
    branches: FloatArray


@dataclass(frozen=True)
class Placement:
    """The pose of a new marker, or why there is none yet."""

    T_map_marker: FloatArray | None
    covariance: FloatArray
    reason: str = ''


@dataclass
class Candidate:
    """A marker on trial."""

    id: int
    size: float
    views: list[View] = field(default_factory=list)
    #: what it waits for, in words
    reason: str = ''
    _directions: list[FloatArray] = field(default_factory=list)

    def add(self, view: View) -> bool:
        """Keep ``view`` if it shows the marker from a new direction; whether it did."""
        # Both branches put the centre at the same place: the direction doesn't depend on the ambiguity.
        arm = view.T_map_camera[:3, :3] @ view.branches[0, :3, 3]
        direction = -arm / np.linalg.norm(arm)
        if self._directions and np.max(np.stack(self._directions) @ direction) > np.cos(MIN_SEPARATION):
            return False
        self.views.append(view)
        self._directions.append(direction)
        if len(self.views) > MAX_VIEWS:
            self._drop_most_redundant()
        return True

    def place(self, camera: Camera) -> Placement:
        """Pose in the map if the views settle it."""
        nothing = np.zeros((6, 6))
        if len(self.views) < MIN_VIEWS:
            return Placement(None, nothing, f'marker {self.id} needs views from more directions')
        fits = self._fits(camera)
        best = fits[0]
        if not best.chi2 <= INCONSISTENT * len(self.views):
            return Placement(None, nothing, f'marker {self.id}: its views contradict each other')
        scale = max(1.0, best.chi2 / (8 * len(self.views) - 6))
        rivals = [fit for fit in fits[1:] if rotation_angle(fit.T[:3, :3].T @ best.T[:3, :3]) > _SAME_FIT]
        if rivals and rivals[0].chi2 - best.chi2 < DECISIVE * scale:
            return Placement(None, nothing, f'planar ambiguity of marker {self.id} unsettled')
        return Placement(best.T, scale * best.noise + best.from_cameras)

    def _drop_most_redundant(self) -> None:
        """Drop the view whose nearest neighbour is the nearest of all."""
        directions = np.stack(self._directions)
        cosines = directions @ directions.T - 2.0 * np.eye(len(directions))
        index = int(np.argmax(np.max(cosines, axis=1)))
        del self.views[index], self._directions[index]

    def _fits(self, camera: Camera) -> list['_Fit']:
        """Fits from both branches of two views far apart, the best first."""
        starts = [view.T_map_camera @ branch for view in (self.views[0], self.views[-1]) for branch in view.branches]
        finite = [start for start in starts if np.all(np.isfinite(start))]
        return sorted((_fit(start, self.size, self.views, camera) for start in finite), key=lambda fit: fit.chi2)


@dataclass(frozen=True)
class _Fit:
    T: FloatArray
    chi2: float
    noise: FloatArray
    from_cameras: FloatArray


def _fit(start: FloatArray, size: float, views: list[View], camera: Camera) -> _Fit:
    """Fit of one marker to views from known camera poses."""
    n = len(views)
    T_map_camera = np.stack([view.T_map_camera for view in views])
    corners = np.stack([view.corners for view in views])
    camera_covariances = np.stack([view.covariance for view in views])
    sizes = np.full(n, size)
    _, J, _ = linearise(camera, T_map_camera, np.broadcast_to(start, (n, 4, 4)), sizes)
    noise = np.stack([view.corner_covariances for view in views]) + SYSTEMATIC_PX**2 * np.eye(2)
    W = whitening(noise + np.nan_to_num(shared_covariances(J, camera_covariances)))

    def evaluate(T: FloatArray) -> tuple[FloatArray, FloatArray]:
        uv, _, J = linearise(camera, T_map_camera, np.broadcast_to(T, (n, 4, 4)), sizes)
        return (W @ (corners - uv)[..., None]).ravel(), _whitened(W, J).reshape(-1, 6)

    T, chi2 = fit_pose(start, evaluate)
    if not np.isfinite(chi2):
        return _Fit(T, np.inf, np.zeros((6, 6)), np.zeros((6, 6)))
    _, J_camera, J_marker = linearise(camera, T_map_camera, np.broadcast_to(T, (n, 4, 4)), sizes)
    J_camera, J_marker = _whitened(W, J_camera), _whitened(W, J_marker)
    noise = np.linalg.inv(np.einsum('vri,vrj->ij', J_marker, J_marker))
    gains = -noise @ np.einsum('vri,vrj->vij', J_marker, J_camera)
    return _Fit(T, chi2, noise, correlated_sum(gains, camera_covariances))


def _whitened(W: FloatArray, J: FloatArray) -> FloatArray:
    """Whitening (n, 4, 2, 2) of a Jacobian (n, 8, 6)."""
    return np.asarray((W @ J.reshape(-1, 4, 2, 6)).reshape(-1, 8, 6))


def correlated_sum(gains: FloatArray, covariances: FloatArray) -> FloatArray:
    """Covariance (m, m) of ``sum_i gains_i x_i`` that holds whatever the correlations of the ``x_i`` are.

    Errors of the markers of a map, and of camera poses that rest on the same map, are correlated by an amount that
    nobody keeps. For any weights a_i that sum to one, ``sum_i gains_i P_i gains_i' / a_i`` is an upper bound (as in
    covariance intersection; S. Julier, J. Uhlmann, 1997); these a_i make its trace the smallest.

    Parameters
    ----------
    gains : (n, m, 6)
    covariances : (n, 6, 6)
    """
    terms = gains @ covariances @ np.swapaxes(gains, -1, -2)
    # Rotations and metres are made comparable by the terms' own mean variances.
    variances = np.diagonal(terms, axis1=-2, axis2=-1)
    total = np.sum(variances, axis=0)
    shares = np.sqrt(np.sum(variances / np.where(total > 0.0, total, 1.0), axis=-1))
    used = shares > 0.0
    if not np.any(used):
        return np.zeros(terms.shape[1:])
    weights = shares[used] / np.sum(shares[used])
    return np.asarray(np.sum(terms[used] / weights[:, None, None], axis=0))
