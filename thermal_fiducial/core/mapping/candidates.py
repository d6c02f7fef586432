"""New markers on trial: views are collected until they leave only one pose.

A small square seen from one side fits two poses nearly equally well (the planar ambiguity of Schweighofer and Pinz,
"Robust pose estimation from a planar target", 2006). The wrong one is wrong differently from each direction, so the
marker's pose is fitted to views from several directions from either start, and enters the map only when one of the
two fits is refuted.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from thermal_fiducial.core.error_model import correlated_sum, noise_factor, SystematicErrors, with_corner_errors
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.geometry.reprojection import linearise
from thermal_fiducial.core.geometry.rigid_fit import Evaluation, minimise
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
    def known(cls, T_map_camera: FloatArray, covariance: FloatArray, common: FloatArray) -> 'Viewpoint':
        """A camera pose (4, 4) without doubt, by how much its views may differ (6, 6), and what they share (6, 6)."""
        return cls(np.stack([T_map_camera] * 2), np.stack([covariance] * 2), common)


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
        scale = noise_factor(best.chi2, 8 * len(self.views) - 6)
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
        return _ViewArrays(self.views, self.size, camera).fits(starts)


@dataclass(frozen=True)
class _MarkerFit:
    T: FloatArray
    chi2: float
    #: minus twice the logarithm of the likelihood: comparable where the residuals' covariances are not the same
    cost: float
    noise: FloatArray
    from_cameras: FloatArray


@dataclass(frozen=True)
class _Seen:
    """Views of S markers."""

    #: (S, n, 8) [px]
    uv: FloatArray
    #: (S, n, 8, 6)
    J_camera: FloatArray
    J_marker: FloatArray
    #: (S, n, 6, 6)
    camera_covariances: FloatArray
    #: (S, n, 8, 8) that make the residuals unit white, and the logarithms (S, n) of their covariances' determinants
    W: FloatArray
    log_determinants: FloatArray


class _ViewArrays:
    """n views of one marker as arrays, to which its pose is fitted from S starts (S, 4, 4) at a time."""

    def __init__(self, views: Sequence[MarkerView], size: float, camera: Camera) -> None:
        self._camera, self._size = camera, size
        self._corners = np.stack([view.corners for view in views]).reshape(-1, 8)
        covariances = np.stack([view.corner_covariances for view in views])
        self._noise = with_corner_errors(covariances, SystematicErrors())
        self._T_map_camera = np.stack([view.viewpoint.T_map_camera for view in views])
        self._covariances = np.stack([view.viewpoint.covariances for view in views])
        self._common = np.stack([view.viewpoint.common for view in views])
        self._doubtful = any(len(view.viewpoint.poses) > 1 for view in views)

    def fits(self, starts: FloatArray) -> list[_MarkerFit]:
        """Fits from all starts, the best first; of a camera's two poses the one that suits the marker better counts."""
        T, chosen = starts, self._choose(starts)
        for _ in range(_CHOICES):
            begun = self._seen(T, chosen)
            T, chi2 = self._minimised(T, chosen, begun)
            previous, chosen = chosen, self._choose(T)
            if np.array_equal(previous, chosen):
                break
        cost = chi2 + np.sum(begun.log_determinants, axis=-1)
        ended = self._seen(T, previous)
        fits = [self._fit(T[k], chi2[k], cost[k], begun.W[k] @ ended.J_camera[k], begun.W[k] @ ended.J_marker[k],
                          ended.camera_covariances[k]) for k in range(len(T))]  # fmt: skip
        return sorted(fits, key=lambda fit: fit.cost)

    def _seen(self, T: FloatArray, chosen: IntArray) -> _Seen:
        """The views of markers at T (S, 4, 4) from the chosen (S, n) of each camera's poses.

        A residual comes of the corners' noise, of the systematic part, and of the camera's own pose, which moves all
        four corners together. What cannot be, a corner in the plane of the camera, has an infinite determinant.
        """
        covariances = self._covariances[np.arange(chosen.shape[1]), chosen]
        uv, J_camera, J_marker = self._linearised(T, chosen)
        possible = np.all(np.abs(J_camera) < _STEEPEST, axis=(-1, -2))
        J_sound = np.where(possible[..., None, None], J_camera, 0.0)
        C = J_sound @ covariances @ np.swapaxes(J_sound, -1, -2)
        for corner in range(4):
            both = slice(2 * corner, 2 * corner + 2)
            C[..., both, both] += self._noise[:, corner]
        L = np.linalg.cholesky(C)
        log_determinants = 2.0 * np.sum(np.log(np.einsum('...ii->...i', L)), axis=-1)
        log_determinants = np.where(possible, log_determinants, np.inf)
        return _Seen(uv, J_camera, J_marker, covariances, np.linalg.inv(L), log_determinants)

    def _linearised(self, T: FloatArray, chosen: IntArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Corners (S, n, 8) [px], and their derivatives (S, n, 8, 6) by the cameras and by the marker."""
        T_map_camera = self._T_map_camera[np.arange(chosen.shape[1]), chosen]
        T_map_marker = np.broadcast_to(T[:, None], T_map_camera.shape).reshape(-1, 4, 4)
        sizes = np.full(chosen.size, self._size)
        uv, J_camera, J_marker = linearise(self._camera, T_map_camera.reshape(-1, 4, 4), T_map_marker, sizes)
        shape = *chosen.shape, 8
        return uv.reshape(shape), J_camera.reshape(*shape, 6), J_marker.reshape(*shape, 6)

    def _choose(self, T: FloatArray) -> IntArray:
        """Which of its two camera poses suits each view, (S, n), for a marker at T."""
        first = np.zeros((len(T), len(self._corners)), dtype=np.int64)
        if not self._doubtful:
            return first
        costs = []
        for choice in (first, first + 1):
            seen = self._seen(T, choice)
            r = seen.W @ (seen.uv - self._corners)[..., None]
            costs.append(np.sum(r * r, axis=(-1, -2)) + seen.log_determinants)
        return np.asarray(np.argmin(np.where(np.isfinite(costs), costs, np.inf), axis=0))

    def _minimised(self, T: FloatArray, chosen: IntArray, begun: _Seen) -> tuple[FloatArray, FloatArray]:
        """Poses (S, 4, 4) from starts, and their chi squares (S,), inf where there is none."""

        def evaluated(T: FloatArray) -> Evaluation:
            uv, _, J = self._linearised(T, chosen)
            r = (begun.W @ (uv - self._corners)[..., None]).reshape(len(T), -1, 1)
            J = (begun.W @ J).reshape(len(T), -1, 6)
            J_transposed, chi2 = np.swapaxes(J, -1, -2), np.sum(r * r, axis=(1, 2))
            return np.where(np.isfinite(chi2), chi2, np.inf), (J_transposed @ r)[..., 0], J_transposed @ J

        possible = np.all(np.isfinite(begun.log_determinants), axis=-1)
        T, chi2, _ = minimise(T, evaluated, alternatives=len(T))
        return T, np.where(possible, chi2, np.inf)

    def _fit(
        self,
        T: FloatArray,
        chi2: float,
        cost: float,
        J_camera: FloatArray,
        J_marker: FloatArray,
        camera_covariances: FloatArray,
    ) -> _MarkerFit:
        """What came of one start, with whitened derivatives (n, 8, 6)."""
        if not np.isfinite(chi2):
            return _MarkerFit(T, np.inf, np.inf, np.zeros((6, 6)), np.zeros((6, 6)))
        noise = np.linalg.inv(np.einsum('vri,vrj->ij', J_marker, J_marker))
        gains = -noise @ np.einsum('vri,vrj->vij', J_marker, J_camera)
        from_cameras = correlated_sum(gains, camera_covariances) + correlated_sum(gains, self._common)
        return _MarkerFit(T, float(chi2), float(cost), noise, from_cameras)
