"""New markers on trial: views are collected until they leave only one pose.

A small square seen from one side fits two poses nearly equally well (the planar ambiguity of Schweighofer and Pinz,
"Robust pose estimation from a planar target", 2006). The wrong one is wrong differently from each direction, so the
marker's pose is fitted to views from several directions from either start, and enters the map only when one of the
two fits is refuted.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from thermal_fiducial.core.error_model import correlated_sum, SystematicErrors, with_corner_errors
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.geometry.reprojection import fit_pose, linearise
from thermal_fiducial.core.geometry.se3 import rotation_angle
from thermal_fiducial.core.mapping.keyframes import Displacement
from thermal_fiducial.core.types import FloatArray, IntArray

#: Views closer in direction than this say nothing new of the ambiguity [rad].
MIN_SEPARATION = np.deg2rad(1.0)
MIN_VIEWS = 3
#: Views kept of a candidate: the fit's cost stays bounded, however long the trial lasts.
MAX_VIEWS = 16
#: Difference of the two fits' chi squares that refutes the worse one: odds of e^-12 against a flip.
DECISIVE = 25.0
#: Mean chi square of a view (8 residuals) above which the views don't belong to one marker that hangs still.
INCONSISTENT = 200.0
#: Fits that end nearer to each other than this are one fit [rad].
SAME_FIT = np.deg2rad(2.0)
# A corner that moves faster in the image than this is hardly before the camera at all [px/m, px/rad].
_STEEPEST = 1e6
# How often a fit may change its mind about the cameras' poses.
_CHOICES = 4


@dataclass(frozen=True)
class Viewpoint:
    """Where a camera is, or the two places where it may be."""

    #: (2, 4, 4) twice the same where there is no doubt
    T_map_camera: FloatArray
    #: (2, 6, 6) of either, ROS convention: by how much views may differ from each other
    covariances: FloatArray
    #: (6, 6) error that all views share (of odometry over a gap): it moves the marker, but no view against another
    common: FloatArray = field(default_factory=lambda: np.zeros((6, 6)))

    @property
    def poses(self) -> FloatArray:
        """The one or two (k, 4, 4) different poses."""
        return self.T_map_camera if np.any(self.T_map_camera[0] != self.T_map_camera[1]) else self.T_map_camera[:1]

    @classmethod
    def known(cls, T_map_camera: FloatArray, covariance: FloatArray) -> 'Viewpoint':
        """A camera pose (4, 4) without doubt, and its covariance (6, 6)."""
        return cls(np.stack([T_map_camera] * 2), np.stack([covariance] * 2))


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
    views: list[MarkerView] = field(default_factory=list)
    #: what it waits for, in words
    reason: str = 'not judged yet'
    #: views since it was last judged
    untried: int = 0
    _directions: list[FloatArray] = field(default_factory=list)

    def add(self, view: MarkerView) -> bool:
        """Keep ``view`` if it shows the marker from a new direction; whether it did."""
        # Both branches put the centre at the same place: the direction doesn't depend on the ambiguity.
        arm = view.viewpoint.T_map_camera[0, :3, :3] @ view.branches[0, :3, 3]
        direction = -arm / np.linalg.norm(arm)
        stamps = [kept.stamp_ns for kept in self.views]
        if view.stamp_ns in stamps:
            # The same frame again, its camera's pose known better by now.
            index = stamps.index(view.stamp_ns)
            self.views[index], self._directions[index] = view, direction
            self.untried += 1
            return True
        if self._directions and np.max(np.stack(self._directions) @ direction) > np.cos(MIN_SEPARATION):
            return False
        self.views.append(view)
        self._directions.append(direction)
        self.untried += 1
        if len(self.views) > MAX_VIEWS:
            self._drop_most_redundant()
        return True

    def move(self, displacement: Displacement) -> None:
        """The map moved: each view's camera pose moves with the frames of its time."""
        moves = [displacement.at(view.stamp_ns) for view in self.views]
        self.views = [
            replace(view, viewpoint=replace(view.viewpoint, T_map_camera=T @ view.viewpoint.T_map_camera))
            for view, T in zip(self.views, moves, strict=True)
        ]
        self._directions = [T[:3, :3] @ direction for direction, T in zip(self._directions, moves, strict=True)]

    def place(self, camera: Camera) -> Placement:
        """Pose in the map if the views settle it."""
        self.untried = 0
        nothing = np.zeros((6, 6))
        if len(self.views) < MIN_VIEWS:
            return Placement(None, nothing, f'marker {self.id} needs views from more directions')
        fits = self._fits(camera)
        best = fits[0]
        if not best.chi2 <= INCONSISTENT * len(self.views):
            return Placement(None, nothing, f'marker {self.id}: its views contradict each other')
        scale = max(1.0, best.chi2 / (8 * len(self.views) - 6))
        others = [fit for fit in fits[1:] if rotation_angle(fit.T[:3, :3].T @ best.T[:3, :3]) > SAME_FIT]
        if others and others[0].cost - best.cost < DECISIVE * scale:
            return Placement(None, nothing, f'planar ambiguity of marker {self.id} unsettled')
        return Placement(best.T, scale * best.noise + best.from_cameras)

    def solutions(self, camera: Camera) -> list[FloatArray]:
        """All poses (4, 4) that a fit to the views ends in, the best first."""
        poses: list[FloatArray] = []
        for fit in self._fits(camera):
            if all(rotation_angle(fit.T[:3, :3].T @ T[:3, :3]) > SAME_FIT for T in poses) and np.isfinite(fit.chi2):
                poses.append(fit.T)
        return poses

    def _drop_most_redundant(self) -> None:
        """Drop the view whose nearest neighbour is the nearest of all."""
        directions = np.stack(self._directions)
        cosines = directions @ directions.T - 2.0 * np.eye(len(directions))
        index = int(np.argmax(np.max(cosines, axis=1)))
        del self.views[index], self._directions[index]

    def _fits(self, camera: Camera) -> list['_MarkerFit']:
        """Fits from every branch of two views far apart, the best first."""
        pairs = [view.viewpoint.poses[:, None] @ view.branches for view in (self.views[0], self.views[-1])]
        starts = np.concatenate([pair.reshape(-1, 4, 4) for pair in pairs])
        starts = starts[np.all(np.isfinite(starts), axis=(1, 2))]
        return sorted((_fit(start, self.size, self.views, camera) for start in starts), key=lambda fit: fit.cost)


@dataclass(frozen=True)
class _MarkerFit:
    T: FloatArray
    chi2: float
    #: minus twice the logarithm of the likelihood: comparable where the residuals' covariances are not the same
    cost: float
    noise: FloatArray
    from_cameras: FloatArray


def _fit(start: FloatArray, size: float, views: list[MarkerView], camera: Camera) -> _MarkerFit:
    """Fit of one marker to views; of a camera's two poses the one that suits the marker better is taken."""
    chosen = _choose(start, size, views, camera)
    fit = _fit_chosen(start, size, views, chosen, camera)
    for _ in range(_CHOICES):
        previous, chosen = chosen, _choose(fit.T, size, views, camera)
        if np.array_equal(previous, chosen):
            break
        fit = _fit_chosen(fit.T, size, views, chosen, camera)
    return fit


def _choose(T: FloatArray, size: float, views: list[MarkerView], camera: Camera) -> IntArray:
    """Which of its two camera poses suits each of n views, (n,), for a marker at T."""
    n = len(views)
    if all(len(view.viewpoint.poses) == 1 for view in views):
        return np.zeros(n, dtype=np.int64)
    T_map_camera = np.concatenate([view.viewpoint.T_map_camera for view in views])
    uv, J, _ = linearise(camera, T_map_camera, np.broadcast_to(T, (2 * n, 4, 4)), np.full(2 * n, size))
    covariances = np.concatenate([view.viewpoint.covariances for view in views])
    W, log_determinants = _whitening([view for view in views for _ in range(2)], J, covariances)
    r = W @ (np.repeat([view.corners for view in views], 2, axis=0) - uv).reshape(-1, 8, 1)
    cost = (np.sum(r**2, axis=(1, 2)) + log_determinants).reshape(n, 2)
    return np.asarray(np.argmin(np.where(np.isfinite(cost), cost, np.inf), axis=1), dtype=np.int64)


def _fit_chosen(
    start: FloatArray, size: float, views: list[MarkerView], chosen: IntArray, camera: Camera
) -> _MarkerFit:
    n = len(views)
    T_map_camera = np.stack([view.viewpoint.T_map_camera[i] for view, i in zip(views, chosen, strict=True)])
    camera_covariances = np.stack([view.viewpoint.covariances[i] for view, i in zip(views, chosen, strict=True)])
    corners = np.stack([view.corners for view in views])
    sizes = np.full(n, size)
    _, J, _ = linearise(camera, T_map_camera, np.broadcast_to(start, (n, 4, 4)), sizes)
    W, log_determinants = _whitening(views, J, camera_covariances)
    if not np.isfinite(log_determinants).all():
        return _MarkerFit(start, np.inf, np.inf, np.zeros((6, 6)), np.zeros((6, 6)))

    def evaluate(T: FloatArray) -> tuple[FloatArray, FloatArray]:
        uv, _, J = linearise(camera, T_map_camera, np.broadcast_to(T, (n, 4, 4)), sizes)
        return (W @ (corners - uv).reshape(n, 8, 1)).ravel(), (W @ J).reshape(-1, 6)

    T, chi2 = fit_pose(start, evaluate)
    if not np.isfinite(chi2):
        return _MarkerFit(T, np.inf, np.inf, np.zeros((6, 6)), np.zeros((6, 6)))
    _, J_camera, J_marker = linearise(camera, T_map_camera, np.broadcast_to(T, (n, 4, 4)), sizes)
    J_camera, J_marker = W @ J_camera, W @ J_marker
    noise = np.linalg.inv(np.einsum('vri,vrj->ij', J_marker, J_marker))
    gains = -noise @ np.einsum('vri,vrj->vij', J_marker, J_camera)
    common = np.stack([view.viewpoint.common for view in views])
    from_cameras = correlated_sum(gains, camera_covariances) + correlated_sum(gains, common)
    return _MarkerFit(T, chi2, chi2 + float(np.sum(log_determinants)), noise, from_cameras)


def _whitening(
    views: Sequence[MarkerView], J_camera: FloatArray, camera_covariances: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Matrices (n, 8, 8) that make the residuals of n views unit white, and the logarithms of their determinants (n,).

    A residual comes of the corners' noise, of the systematic part, and of the camera's own pose, which moves all four
    corners together. The determinant is infinite of a view that cannot be: a corner lies in the plane of the camera.
    """
    n = len(views)
    possible = np.all(np.abs(J_camera) < _STEEPEST, axis=(1, 2))
    J_camera = np.where(possible[:, None, None], J_camera, 0.0)
    C = J_camera @ camera_covariances @ np.swapaxes(J_camera, -1, -2)
    corner = np.arange(4)
    noise = with_corner_errors(np.stack([view.corner_covariances for view in views]), SystematicErrors())
    C.reshape(n, 4, 2, 4, 2)[:, corner, :, corner] += np.swapaxes(noise, 0, 1)
    L = np.linalg.cholesky(C)
    log_determinants = 2.0 * np.sum(np.log(np.einsum('nii->ni', L)), axis=-1)
    return np.linalg.inv(L), np.where(possible, log_determinants, np.inf)
