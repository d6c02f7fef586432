"""A joint adjustment as arrays: residuals, derivatives and normal equations of all views of markers in keyframes."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from thermal_fiducial.core.error_model import CHI2_OF_POSE, CHI2_OF_VIEW
from thermal_fiducial.core.geometry.reprojection import difference, linearise, retract, whitening
from thermal_fiducial.core.geometry.se3 import skew
from thermal_fiducial.core.mapping.map_data import gauge
from thermal_fiducial.core.mapping.normal_equations import Blocks, NormalEquations
from thermal_fiducial.core.mapping.snapshot import CameraRig, Snapshot
from thermal_fiducial.core.types import BoolArray, FloatArray, IntArray

# Chi square of a view that no pose near the present one explains.
_BEHIND_CHI2 = 1e8


@dataclass(frozen=True)
class Poses:
    """Of all keyframes (F, 4, 4) and markers (M, 4, 4)."""

    T_map_rig: FloatArray
    T_map_marker: FloatArray


@dataclass(frozen=True)
class Linearised:
    """Residuals at a state, and the derivatives of the n views' (n, 8, 6), whitened but not weighted."""

    state: Poses
    r: FloatArray
    J_rig: FloatArray
    J_marker: FloatArray
    chi2: FloatArray
    squared_px: FloatArray
    #: (F, 6) and (M, 6) from the state to the priors, and (F,), (M,) the chi squares of that
    rig_apart: FloatArray
    rig_chi2: FloatArray
    marker_apart: FloatArray
    marker_chi2: FloatArray

    def of_views(self, chosen: BoolArray) -> tuple[FloatArray, FloatArray]:
        """Residuals and derivatives with respect to the markers of the views ``chosen`` (n,)."""
        return self.r[chosen], self.J_marker[chosen]

    def weights(self, scale: float) -> FloatArray:
        """Robust weights (n,) of the views, for corners of ``scale`` times their variance."""
        return _robust_weights(self.chi2, CHI2_OF_VIEW * scale)

    def cost(self, scale: float) -> float:
        """Robust sum of squares."""
        of_views = np.sum(_robust_cost(self.chi2, CHI2_OF_VIEW * scale))
        of_rigs = np.sum(_robust_cost(self.rig_chi2, CHI2_OF_POSE))
        return float(of_views + of_rigs + np.sum(self.marker_chi2))


@dataclass(frozen=True)
class Priors:
    """What is known of k poses beside the views: poses (k, 4, 4) and information (k, 6, 6), zero for nothing."""

    T: FloatArray
    information: FloatArray

    def apart(self, T: FloatArray) -> tuple[FloatArray, FloatArray]:
        """From poses (k, 4, 4) to the known ones (k, 6), and the chi square of that (k,)."""
        d = difference(self.T, T)
        return d, np.einsum('ki,kij,kj->k', d, self.information, d)


@dataclass(frozen=True)
class MapProblem:
    """The snapshot as arrays: n views, F keyframes, M markers, views ordered by keyframe."""

    start: Poses
    ids: list[int]
    stamps: list[int]
    sizes: FloatArray
    held: BoolArray
    rig: CameraRig
    frame: IntArray
    marker: IntArray
    camera: IntArray
    corners: FloatArray
    W: FloatArray
    odometry: Priors
    known: Priors

    @classmethod
    def build(cls, snapshot: Snapshot) -> 'MapProblem | None':
        """The problem of a snapshot; None when it has nothing to adjust."""
        frames = snapshot.useful
        seen = sorted({int(key) for frame in frames for key in frame.ids if int(key) in snapshot.markers})
        markers = [snapshot.markers[key] for key in seen]
        held = gauge(markers)
        if not frames or np.all(held):
            return None
        index = {key: i for i, key in enumerate(seen)}
        keep = [np.array([int(key) in index for key in frame.ids], dtype=bool) for frame in frames]

        def views(name: str) -> Any:
            return np.concatenate([getattr(f, name)[k] for f, k in zip(frames, keep, strict=True)])

        T_map_marker = np.stack([m.T_map_marker for m in markers])
        return cls(
            start=Poses(np.stack([f.T_map_rig for f in frames]), T_map_marker),
            ids=seen,
            stamps=[f.stamp_ns for f in frames],
            sizes=np.array([m.size for m in markers]),
            held=held,
            rig=snapshot.rig,
            frame=np.repeat(np.arange(len(frames)), [np.count_nonzero(k) for k in keep]),
            marker=np.array([index[int(key)] for key in views('ids')]),
            camera=views('cameras'),
            corners=views('corners'),
            W=whitening(views('covariances')),
            odometry=Priors(np.stack([f.T_odometry for f in frames]), np.stack([f.information for f in frames])),
            known=_known(snapshot, index, T_map_marker),
        )

    def evaluate(self, state: Poses) -> Linearised:
        """Whitened residuals and derivatives."""
        n = len(self.frame)
        T_map_rig = state.T_map_rig[self.frame]
        T_map_camera = T_map_rig @ self.rig.T_rig_camera[self.camera]
        uv, J_camera, J_marker = np.empty((n, 4, 2)), np.empty((n, 8, 6)), np.empty((n, 8, 6))
        for index, camera in enumerate(self.rig.cameras):
            own = self.camera == index
            uv[own], J_camera[own], J_marker[own] = linearise(
                camera, T_map_camera[own], state.T_map_marker[self.marker[own]], self.sizes[self.marker[own]]
            )
        arms = T_map_camera[:, :3, 3] - T_map_rig[:, :3, 3]
        J_camera[..., 3:] -= J_camera[..., :3] @ skew(arms)
        # Markers that the state has behind the camera say nothing of where to go, and cost as much as any outlier.
        behind = ~np.all(np.isfinite(uv), axis=(1, 2))
        J_camera[behind], J_marker[behind] = 0.0, 0.0
        residuals = np.where(behind[:, None, None], 0.0, self.corners - uv)
        r = (self.W @ residuals[..., None]).reshape(n, 8)
        chi2 = np.where(behind, _BEHIND_CHI2, np.sum(r * r, axis=-1))
        J_rig, J_marker = ((self.W @ J.reshape(n, 4, 2, 6)).reshape(n, 8, 6) for J in (J_camera, J_marker))
        squared_px = np.sum(residuals**2, axis=(1, 2))
        of_rigs, of_markers = self.odometry.apart(state.T_map_rig), self.known.apart(state.T_map_marker)
        return Linearised(state, r, J_rig, J_marker, chi2, squared_px, *of_rigs, *of_markers)

    def step(self, now: Linearised, scale: float, damping: float) -> Linearised | None:
        """After one damped Gauss-Newton step; None where the equations are singular."""
        blocks, *sides = self.normal(now, scale)
        system = self.equations.reduced(blocks, damping)
        if system is None:
            return None
        frames, markers = (steps[..., 0] for steps in system.solve(*sides))
        if not (np.all(np.isfinite(frames)) and np.all(np.isfinite(markers))):
            return None
        return self.evaluate(Poses(retract(now.state.T_map_rig, frames), retract(now.state.T_map_marker, markers)))

    @property
    def equations(self) -> NormalEquations:
        """Which view connects what."""
        return NormalEquations(self.frame, self.marker, self.held)

    def normal(self, now: Linearised, scale: float) -> tuple[Blocks, FloatArray, FloatArray]:
        """Normal equations, and their right sides (F, 6, 1) and (M, 6, 1)."""
        weights = now.weights(scale)[:, None, None]
        of_rig, of_marker = (weights * np.swapaxes(J, -1, -2) for J in (now.J_rig, now.J_marker))
        r = now.r[..., None]
        odometry = self.odometry.information * _robust_weights(now.rig_chi2, CHI2_OF_POSE)[:, None, None]
        blocks = Blocks(
            rig=self.over_frames(of_rig @ now.J_rig) + odometry,
            marker=self.over_markers(of_marker @ now.J_marker) + self.known.information,
            cross=of_rig @ now.J_marker,
        )
        return (
            blocks,
            self.over_frames(of_rig @ r) + odometry @ now.rig_apart[..., None],
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


def _known(snapshot: Snapshot, index: dict[int, int], T_map_marker: FloatArray) -> Priors:
    """Priors of the M markers; of those that are held they change nothing."""
    T, information = T_map_marker.copy(), np.zeros((len(index), 6, 6))
    for key, (T_known, covariance) in snapshot.priors.items():
        if key in index:
            T[index[key]], information[index[key]] = T_known, np.linalg.inv(covariance)
    return Priors(T, information)


def _robust_weights(chi2: FloatArray, limit: float) -> FloatArray:
    return np.asarray(np.minimum(1.0, limit / np.maximum(chi2, 1e-300)))


def _robust_cost(chi2: FloatArray, limit: float) -> FloatArray:
    """The cost whose derivative has the robust weights: quadratic, then logarithmic."""
    return np.where(chi2 <= limit, chi2, limit * (1.0 - np.log(_robust_weights(chi2, limit))))
