"""The bundle adjustment as arrays: its input, and residuals, Jacobians and normal equations of all views."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from thermal_fiducial.config import CHI2_OF_POSE
from thermal_fiducial.core.error_model import CHI2_OF_VIEW, SystematicErrors
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.geometry.reprojection import difference, linearise, retract, whitening
from thermal_fiducial.core.geometry.rigid_fit import robust
from thermal_fiducial.core.mapping.map_data import gauge, MapMarker
from thermal_fiducial.core.mapping.normal_equations import Blocks, NormalEquations
from thermal_fiducial.core.types import BoolArray, FloatArray, IntArray, TINY

# Chi square of a view whose marker is behind the camera.
_BEHIND_CHI2 = 1e8


@dataclass(frozen=True)
class Priors:
    """Priors of k poses: poses (k, 4, 4) and information (k, 6, 6), zero without a prior."""

    T: FloatArray
    information: FloatArray

    def apart(self, T: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Differences (k, 6) from poses (k, 4, 4) to their priors, and chi squares (k,) of these."""
        d = difference(self.T, T)
        return d, np.einsum('ki,kij,kj->k', d, self.information, d)


@dataclass(frozen=True)
class Snapshot:
    """Input of a bundle adjustment: n views of markers in F keyframes. Immutable.

    A few large arrays, as thousands of small ones would take long to send to another process.
    """

    #: the markers to adjust, by ID
    markers: Mapping[int, MapMarker]
    #: (F,) of the keyframes, and (F, 4, 4) T_map_camera
    stamps_ns: IntArray
    T_map_camera: FloatArray
    #: calibrations of the cameras, and (F,) which of them took each keyframe
    cameras: tuple[Camera, ...]
    camera: IntArray
    #: priors of the camera poses by odometry
    odometry: Priors
    #: of each view, in the order of the keyframes: (n,) index of the keyframe, (n,) ID of the marker, corners
    #: (n, 4, 2) [px] and their covariances (n, 4, 2, 2) [px^2]
    frame: IntArray
    ids: IntArray
    corners: FloatArray
    covariances: FloatArray
    #: prior pose and covariance (6, 6) by ID, of markers of an earlier map
    known: Mapping[int, tuple[FloatArray, FloatArray]]
    map_revision: int
    #: systematic errors that enter the covariances
    errors: SystematicErrors

    def useful(self) -> BoolArray:
        """Which views (n,) constrain the map and are connected with a held or prior marker, or with odometry.

        A keyframe needs two markers of the map, or one and odometry. Unconnected parts are not adjusted.
        """
        of_map: BoolArray = np.isin(self.ids, list(self.markers))
        number = np.bincount(self.frame[of_map], minlength=len(self.stamps_ns))
        has_odometry: BoolArray = np.asarray(self.odometry.information.any(axis=(1, 2)))
        useful = of_map & ((number >= 2) | has_odometry)[self.frame]
        seen = np.unique(self.ids[useful])
        held = gauge([self.markers[key] for key in seen.tolist()])
        reached = np.isin(self.ids, [*seen[held], *self.known]) | has_odometry[self.frame]
        while True:
            joined = useful & np.isin(self.frame, self.frame[useful & reached])
            more = reached | np.isin(self.ids, self.ids[joined])
            if np.array_equal(more, reached):
                return np.asarray(joined)
            reached = more


@dataclass(frozen=True)
class Poses:
    """Poses of all keyframes (F, 4, 4) and markers (M, 4, 4)."""

    T_map_camera: FloatArray
    T_map_marker: FloatArray


@dataclass(frozen=True)
class Linearised:
    """Residuals (n, 8) and Jacobians (n, 8, 6) of the n views at a state, whitened but not weighted."""

    state: Poses
    r: FloatArray
    J_camera: FloatArray
    J_marker: FloatArray
    chi2: FloatArray
    squared_px: FloatArray
    #: differences (F, 6) and (M, 6) from the state to the priors, and their chi squares (F,), (M,)
    camera_apart: FloatArray
    camera_chi2: FloatArray
    marker_apart: FloatArray
    marker_chi2: FloatArray

    def weights(self, scale: float) -> FloatArray:
        """Robust weights (n,) of the views, for corners of ``scale`` times their variance."""
        return robust(self.chi2, CHI2_OF_VIEW * scale)[1]

    def view_costs(self, scale: float) -> FloatArray:
        """Robust chi squares (n,) of the views, for corners of ``scale`` times their variance."""
        return robust(self.chi2, CHI2_OF_VIEW * scale)[0]

    def cost(self, scale: float) -> float:
        """Robust sum of squares."""
        of_views = np.sum(self.view_costs(scale))
        of_cameras = np.sum(robust(self.camera_chi2, CHI2_OF_POSE)[0])
        return float(of_views + of_cameras + np.sum(self.marker_chi2))


@dataclass(frozen=True)
class MapProblem:
    """The snapshot as arrays: n views, F keyframes, M markers, views ordered by keyframe."""

    start: Poses
    ids: list[int]
    stamps: list[int]
    sizes: FloatArray
    held: BoolArray
    cameras: tuple[Camera, ...]
    frame: IntArray
    marker: IntArray
    camera: IntArray
    corners: FloatArray
    W: FloatArray
    odometry: Priors
    known: Priors

    @classmethod
    def build(cls, snapshot: Snapshot) -> 'MapProblem | None':
        """The problem of a snapshot; None if there is nothing to adjust."""
        views = snapshot.useful()
        seen, marker = np.unique(snapshot.ids[views], return_inverse=True)
        frames, frame = np.unique(snapshot.frame[views], return_inverse=True)
        markers = [snapshot.markers[key] for key in seen.tolist()]
        held = gauge(markers)
        if np.all(held):
            return None
        T_map_marker = np.stack([m.T_map_marker for m in markers])
        return cls(
            start=Poses(snapshot.T_map_camera[frames], T_map_marker),
            ids=seen.tolist(),
            stamps=snapshot.stamps_ns[frames].tolist(),
            sizes=np.array([m.size for m in markers]),
            held=held,
            cameras=snapshot.cameras,
            frame=frame,
            marker=marker,
            camera=snapshot.camera[frames][frame],
            corners=snapshot.corners[views],
            W=whitening(snapshot.covariances[views]),
            odometry=Priors(snapshot.odometry.T[frames], snapshot.odometry.information[frames]),
            known=_known(snapshot, seen, T_map_marker),
        )

    def evaluate(self, state: Poses) -> Linearised:
        """Whitened residuals and derivatives."""
        n = len(self.frame)
        T_map_camera, T_map_marker = state.T_map_camera[self.frame], state.T_map_marker[self.marker]
        uv, J_camera, J_marker = np.empty((n, 4, 2)), np.empty((n, 8, 6)), np.empty((n, 8, 6))
        for index, camera in enumerate(self.cameras):
            own = self.camera == index
            uv[own], J_camera[own], J_marker[own] = linearise(
                camera, T_map_camera[own], T_map_marker[own], self.sizes[self.marker[own]]
            )
        # Markers behind the camera have no gradient, and the cost of an outlier.
        behind = ~np.all(np.isfinite(uv), axis=(1, 2))
        J_camera[behind], J_marker[behind] = 0.0, 0.0
        residuals = np.where(behind[:, None, None], 0.0, self.corners - uv)
        r = (self.W @ residuals[..., None]).reshape(n, 8)
        chi2 = np.where(behind, _BEHIND_CHI2, np.sum(r * r, axis=-1))
        J_camera, J_marker = ((self.W @ J.reshape(n, 4, 2, 6)).reshape(n, 8, 6) for J in (J_camera, J_marker))
        squared_px = np.sum(residuals**2, axis=(1, 2))
        of_cameras, of_markers = self.odometry.apart(state.T_map_camera), self.known.apart(state.T_map_marker)
        return Linearised(state, r, J_camera, J_marker, chi2, squared_px, *of_cameras, *of_markers)

    def step(self, now: Linearised, scale: float, damping: float) -> Linearised | None:
        """After one damped Gauss-Newton step; None where the equations are singular."""
        blocks, *sides = self.normal(now, scale)
        system = self.equations.reduced(blocks, damping)
        if system is None:
            return None
        frames, markers = (steps[..., 0] for steps in system.solve(*sides))
        if not (np.all(np.isfinite(frames)) and np.all(np.isfinite(markers))):
            return None
        return self.evaluate(Poses(retract(now.state.T_map_camera, frames), retract(now.state.T_map_marker, markers)))

    def mirrored(self, state: Poses) -> Poses:
        """The state with each marker in about the other pose that its views allow: turned by 180 deg about them."""
        sight = state.T_map_camera[self.frame, :3, 3] - state.T_map_marker[self.marker, :3, 3]
        mean = self.over_markers(sight / np.maximum(np.linalg.norm(sight, axis=-1, keepdims=True), TINY))
        mean /= np.maximum(np.linalg.norm(mean, axis=-1, keepdims=True), TINY)
        about_sight = 2.0 * mean[:, :, None] * mean[:, None, :] - np.eye(3)
        T_map_marker = state.T_map_marker.copy()
        T_map_marker[:, :3, :3] = about_sight @ T_map_marker[:, :3, :3] @ np.diag([-1.0, -1.0, 1.0])
        return Poses(state.T_map_camera, T_map_marker)

    def markers_stepped(self, now: Linearised, scale: float) -> Poses:
        """After one Gauss-Newton step of each marker alone."""
        blocks, _, side = self.normal(now, scale)
        largest = np.max(blocks.marker, axis=(1, 2), keepdims=True)
        steps = np.linalg.solve(blocks.marker + (TINY * largest + TINY) * np.eye(6), side)
        return Poses(now.state.T_map_camera, retract(now.state.T_map_marker, steps[..., 0]))

    @property
    def equations(self) -> NormalEquations:
        """Which view connects what."""
        return NormalEquations(self.frame, self.marker, self.held)

    def normal(self, now: Linearised, scale: float) -> tuple[Blocks, FloatArray, FloatArray]:
        """Normal equations, and their right sides (F, 6, 1) and (M, 6, 1)."""
        weights = now.weights(scale)[:, None, None]
        of_camera, of_marker = (weights * np.swapaxes(J, -1, -2) for J in (now.J_camera, now.J_marker))
        r = now.r[..., None]
        odometry = self.odometry.information * robust(now.camera_chi2, CHI2_OF_POSE)[1][:, None, None]
        blocks = Blocks(
            frame=self.over_frames(of_camera @ now.J_camera) + odometry,
            marker=self.over_markers(of_marker @ now.J_marker) + self.known.information,
            cross=of_camera @ now.J_marker,
        )
        return (
            blocks,
            self.over_frames(of_camera @ r) + odometry @ now.camera_apart[..., None],
            self.over_markers(of_marker @ r) + self.known.information @ now.marker_apart[..., None],
        )

    def over_frames(self, values: FloatArray) -> FloatArray:
        """Sums (F, ...) of values (n, ...) of the views over those of each keyframe."""
        return np.asarray(np.add.reduceat(values, np.flatnonzero(np.diff(self.frame, prepend=-1)), axis=0))

    def over_markers(self, values: FloatArray) -> FloatArray:
        """Sums (M, ...) over the views of each marker."""
        order = np.argsort(self.marker, kind='stable')
        starts = np.flatnonzero(np.diff(self.marker[order], prepend=-1))
        return np.asarray(np.add.reduceat(values[order], starts, axis=0))


def _known(snapshot: Snapshot, ids: IntArray, T_map_marker: FloatArray) -> Priors:
    """Priors of the M markers; of those that are held they change nothing."""
    T, information = T_map_marker.copy(), np.zeros((len(ids), 6, 6))
    for index, key in enumerate(ids.tolist()):
        if key in snapshot.known:
            T[index], covariance = snapshot.known[key]
            information[index] = np.linalg.inv(covariance)
    return Priors(T, information)
