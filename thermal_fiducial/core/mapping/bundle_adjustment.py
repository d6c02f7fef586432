"""Joint refinement of the map: sparse bundle adjustment over keyframes and markers.

Minimises the whitened re-projection errors of all corners over the poses of all keyframes and markers. Keyframes are
eliminated first (each sees few markers, and none sees another keyframe), which leaves a sparse system of the markers
(the Schur complement; B. Triggs et al., "Bundle adjustment - a modern synthesis", 2000, section 6). What odometry knows
of keyframes, and what was known of markers beforehand, are priors of their poses. The gauge is the fixed markers: they
are held, and their covariance enters that of the others (as consider parameters; S. Schmidt, 1966).

A pure function on a snapshot: it may run in another thread or process while the mapper goes on.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from thermal_fiducial.core.error_model import scale_of_map, SystematicErrors
from thermal_fiducial.core.geometry.reprojection import difference, linearise, retract, whitening
from thermal_fiducial.core.geometry.se3 import skew
from thermal_fiducial.core.mapping.keyframes import CameraRig
from thermal_fiducial.core.mapping.map_data import MapMarker
from thermal_fiducial.core.mapping.normal_equations import Blocks, NormalEquations, ReducedSystem
from thermal_fiducial.core.mapping.residual_checks import correlation_time, two_places
from thermal_fiducial.core.mapping.snapshot import gauge, Snapshot
from thermal_fiducial.core.types import BoolArray, FloatArray, IntArray

#: Chi square of a view (8 residuals) up to which it counts in full: 99.9 % of consistent ones.
ROBUST_CHI2 = 26.1
#: Chi square of a pose from odometry (6 residuals) up to which it counts in full.
ROBUST_ODOMETRY = 22.5
MAX_ITERATIONS = 25
# Decrease of the cost, in chi squares of the actual noise, that ends the iteration: the last step is a third of the
# standard deviation of one pose for all together, the next would be half of that.
_CONVERGED = 0.1
# Median of chi square of eight degrees of freedom.
_MEDIAN_CHI2 = 7.34
# Samples of systematic errors: the covariance of six numbers from so many is good to a fifth.
_SAMPLES = 32
# Of these at a time: bounds the memory.
_AT_ONCE = 8
# Chi square of a view that no pose near the present one explains.
_BEHIND_CHI2 = 1e8
# Each round takes the corners' variance anew from the residuals.
_ROUNDS = 4


@dataclass(frozen=True)
class AdjustedMap:
    """The outcome of a refinement."""

    #: adjusted markers by ID; those that were held are not among them
    markers: dict[int, MapMarker]
    #: stamp of each keyframe to its adjusted T_map_rig
    keyframes: dict[int, FloatArray]
    #: rms re-projection error [px] before and after
    rms_before_px: float
    rms_px: float
    #: robust sum of squared whitened residuals, in units of their actual variance
    cost: float
    #: ratio of the residuals' variance to what the corner covariances promise
    variance_factor: float
    #: marker ID to the share of its views that are outliers
    outliers: dict[int, float]
    #: adjusted markers whose views don't belong to one marker that hangs still
    inconsistent: tuple[int, ...]
    iterations: int
    map_revision: int


def refine(snapshot: Snapshot) -> AdjustedMap | None:
    """Adjust the map to all keyframes; None when they don't determine anything."""
    problem = _Problem.build(snapshot)
    if problem is None:
        return None
    before = now = problem.evaluate(problem.start)
    scale, iterations = 0.0, 0
    for _ in range(_ROUNDS):
        previous, scale = scale, _scale(now.chi2)
        if abs(scale - previous) < 0.05 * scale:
            break
        now, steps = _minimise(problem, now, scale)
        iterations += steps
    return problem.result(snapshot, before, now, scale, iterations)


def _minimise(problem: '_Problem', now: '_Evaluation', scale: float) -> tuple['_Evaluation', int]:
    """Levenberg-Marquardt; the minimum and the number of steps."""
    cost = now.cost(scale)
    damping, steps = 1e-5, 0
    while steps < MAX_ITERATIONS and damping < 1e6:
        steps += 1
        trial = problem.step(now, scale, damping)
        trial_cost = np.inf if trial is None else trial.cost(scale)
        if trial is None or not trial_cost <= cost:
            damping *= 10.0
            continue
        gain, now, cost, damping = cost - trial_cost, trial, trial_cost, max(0.1 * damping, 1e-9)
        if gain <= _CONVERGED * scale:
            break
    return now, steps


def _scale(chi2: FloatArray) -> float:
    """Ratio of the corners' variance to the promised one, at least 1; from the median, which outliers don't move."""
    return max(1.0, float(np.nanmedian(chi2)) / _MEDIAN_CHI2)


@dataclass(frozen=True)
class _Poses:
    T_map_rig: FloatArray
    T_map_marker: FloatArray


@dataclass(frozen=True)
class _Evaluation:
    """Residuals at a state, and the derivatives of the n views' (n, 8, 6), whitened but not weighted."""

    state: _Poses
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

    def weights(self, scale: float) -> FloatArray:
        """Robust weights (n,) of the views, for corners of ``scale`` times their variance."""
        return _robust_weights(self.chi2, ROBUST_CHI2 * scale)

    def cost(self, scale: float) -> float:
        """Robust sum of squares."""
        of_views = np.sum(_robust_cost(self.chi2, ROBUST_CHI2 * scale))
        of_rigs = np.sum(_robust_cost(self.rig_chi2, ROBUST_ODOMETRY))
        return float(of_views + of_rigs + np.sum(self.marker_chi2))


@dataclass(frozen=True)
class _Priors:
    """What is known of k poses beside the views: poses (k, 4, 4) and information (k, 6, 6), zero for nothing."""

    T: FloatArray
    information: FloatArray

    def apart(self, T: FloatArray) -> tuple[FloatArray, FloatArray]:
        """From poses (k, 4, 4) to the known ones (k, 6), and the chi square of that (k,)."""
        d = difference(self.T, T)
        return d, np.einsum('ki,kij,kj->k', d, self.information, d)


@dataclass(frozen=True)
class _Problem:
    """The snapshot as arrays: n views, F keyframes, M markers, views ordered by keyframe."""

    start: _Poses
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
    odometry: _Priors
    known: _Priors

    @classmethod
    def build(cls, snapshot: Snapshot) -> '_Problem | None':
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
            start=_Poses(np.stack([f.T_map_rig for f in frames]), T_map_marker),
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
            odometry=_Priors(np.stack([f.T_odometry for f in frames]), np.stack([f.information for f in frames])),
            known=_known(snapshot, index, T_map_marker),
        )

    def evaluate(self, state: _Poses) -> _Evaluation:
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
        return _Evaluation(state, r, J_rig, J_marker, chi2, squared_px, *of_rigs, *of_markers)

    def step(self, now: _Evaluation, scale: float, damping: float) -> _Evaluation | None:
        """After one damped Gauss-Newton step; None where the equations are singular."""
        blocks, *sides = self._normal(now, scale)
        system = self.equations.reduced(blocks, damping)
        if system is None:
            return None
        frames, markers = (steps[..., 0] for steps in system.solve(*sides))
        if not (np.all(np.isfinite(frames)) and np.all(np.isfinite(markers))):
            return None
        return self.evaluate(_Poses(retract(now.state.T_map_rig, frames), retract(now.state.T_map_marker, markers)))

    @property
    def equations(self) -> NormalEquations:
        """Which view connects what."""
        return NormalEquations(self.frame, self.marker, self.held)

    def _normal(self, now: _Evaluation, scale: float) -> tuple[Blocks, FloatArray, FloatArray]:
        """Normal equations, and their right sides (F, 6, 1) and (M, 6, 1)."""
        weights = now.weights(scale)[:, None, None]
        of_rig, of_marker = (weights * np.swapaxes(J, -1, -2) for J in (now.J_rig, now.J_marker))
        r = now.r[..., None]
        odometry = self.odometry.information * _robust_weights(now.rig_chi2, ROBUST_ODOMETRY)[:, None, None]
        blocks = Blocks(
            rig=self._over_frames(of_rig @ now.J_rig) + odometry,
            marker=self._over_markers(of_marker @ now.J_marker) + self.known.information,
            cross=of_rig @ now.J_marker,
        )
        return (
            blocks,
            self._over_frames(of_rig @ r) + odometry @ now.rig_apart[..., None],
            self._over_markers(of_marker @ r) + self.known.information @ now.marker_apart[..., None],
        )

    def _over_frames(self, values: FloatArray) -> FloatArray:
        """Sums (F, ...) of values (n, ...) of the views over those of each keyframe."""
        return np.asarray(np.add.reduceat(values, np.flatnonzero(np.diff(self.frame, prepend=-1)), axis=0))

    def _over_markers(self, values: FloatArray) -> FloatArray:
        """Sums (M, ...) over the views of each marker."""
        order = np.argsort(self.marker, kind='stable')
        starts = np.flatnonzero(np.diff(self.marker[order], prepend=-1))
        return np.asarray(np.add.reduceat(values[order], starts, axis=0))

    def result(
        self, snapshot: Snapshot, before: _Evaluation, now: _Evaluation, scale: float, iterations: int
    ) -> AdjustedMap | None:
        """The outcome with its covariances; None where these do not exist."""
        n, weights = len(self.frame), now.weights(scale)
        unknowns = 6 * (len(self.stamps) + np.count_nonzero(~self.held))
        full = weights == 1.0
        factor = float(np.sum(now.chi2[full]) / max(8 * np.count_nonzero(full) - unknowns, 1))
        noise = max(factor, 1.0) * correlation_time(now.r[full], self.marker[full])
        system = self.equations.reduced(self._normal(now, scale)[0])
        if system is None:
            return None
        covariances = system.covariances(noise, np.stack([snapshot.markers[key].covariance for key in self.ids]))
        positions = now.state.T_map_marker[:, :3, 3]
        covariances += self._shape_covariances(system, now, weights, snapshot.errors)
        covariances += scale_of_map(positions, positions[self.held], snapshot.errors)
        if not np.all(np.isfinite(covariances)):
            return None
        free = [(i, key) for i, key in enumerate(self.ids) if not self.held[i]]
        outlying = np.bincount(self.marker, ~full) / np.bincount(self.marker)
        return AdjustedMap(
            {
                key: replace(snapshot.markers[key], T_map_marker=now.state.T_map_marker[i], covariance=covariances[i])
                for i, key in free
            },
            dict(zip(self.stamps, now.state.T_map_rig, strict=True)),
            float(np.sqrt(np.sum(before.squared_px) / (4 * n))),
            float(np.sqrt(np.sum(now.squared_px) / (4 * n))),
            now.cost(scale) / max(factor, 1.0),
            factor,
            dict(zip(self.ids, outlying.tolist(), strict=True)),
            tuple(key for i, key in free if self._two_places(i, now, full)),
            iterations,
            snapshot.map_revision,
        )

    def _shape_covariances(
        self, system: ReducedSystem, now: _Evaluation, weights: FloatArray, errors: SystematicErrors
    ) -> FloatArray:
        """Covariances (M, 6, 6) of what corners make of the map that are wrong alike in all views of a marker.

        Nothing averages that out, and no residual shows it: the shape of a fixed marker turns the whole map. It is
        sampled, as every corner of every marker has a direction of its own.
        """
        if errors.marker_shape == 0.0:
            return np.zeros((len(self.ids), 6, 6))
        precision = np.bincount(self.marker, 0.5 * np.mean(np.sum(self.W**2, axis=(2, 3)), axis=1))
        std = errors.marker_shape * np.sqrt(np.bincount(self.marker) / precision)
        rng, covariances = np.random.default_rng(0), np.zeros((len(self.ids), 6, 6))
        for _ in range(_SAMPLES // _AT_ONCE):
            samples = std[:, None, None, None] * rng.standard_normal((len(self.ids), 4, 2, _AT_ONCE))
            off = weights[:, None, None] * (self.W @ samples[self.marker]).reshape(-1, 8, _AT_ONCE)
            of_frames = self._over_frames(np.swapaxes(now.J_rig, -1, -2) @ off)
            of_markers = self._over_markers(np.swapaxes(now.J_marker, -1, -2) @ off)
            _, steps = system.solve(of_frames, of_markers)
            covariances += steps @ np.swapaxes(steps, -1, -2) / _SAMPLES
        return covariances

    def _two_places(self, marker: int, now: _Evaluation, full: BoolArray) -> bool:
        own = self.marker == marker
        return two_places(now.r[own], now.J_marker[own], ~full[own])


def _known(snapshot: Snapshot, index: dict[int, int], T_map_marker: FloatArray) -> _Priors:
    """Priors of the M markers; of those that are held they change nothing."""
    T, information = T_map_marker.copy(), np.zeros((len(index), 6, 6))
    for key, (T_known, covariance) in snapshot.priors.items():
        if key in index:
            T[index[key]], information[index[key]] = T_known, np.linalg.inv(covariance)
    return _Priors(T, information)


def _robust_weights(chi2: FloatArray, limit: float) -> FloatArray:
    return np.asarray(np.minimum(1.0, limit / np.maximum(chi2, 1e-300)))


def _robust_cost(chi2: FloatArray, limit: float) -> FloatArray:
    """The cost whose derivative has the robust weights: quadratic, then logarithmic."""
    return np.where(chi2 <= limit, chi2, limit * (1.0 - np.log(_robust_weights(chi2, limit))))
