"""Joint refinement of the map: sparse bundle adjustment over keyframes and markers.

Minimises the whitened re-projection errors of all corners over the poses of all keyframes and markers. Keyframes are
eliminated first (each sees few markers, and none sees another keyframe), which leaves a sparse system of the markers
(the Schur complement; B. Triggs et al., "Bundle adjustment - a modern synthesis", 2000, section 6). Keyframes that
odometry links to each other stay in the system beside the markers. The gauge is the fixed markers: they are held, and
their covariance enters that of the others (as consider parameters; S. Schmidt, 1966).

A pure function on a snapshot: it may run in another thread or process while the mapper goes on.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from thermal_fiducial.core.error_model import NO_SYSTEMATIC_ERRORS, scale_of_map, SystematicErrors
from thermal_fiducial.core.geometry.reprojection import difference, linearise, retract, whitening
from thermal_fiducial.core.geometry.se3 import inverse, skew
from thermal_fiducial.core.mapping.keyframes import CameraRig, Keyframe, Link, packed, unpacked
from thermal_fiducial.core.mapping.map_data import MapMarker
from thermal_fiducial.core.mapping.normal_equations import Blocks, NormalEquations, ReducedSystem
from thermal_fiducial.core.mapping.residual_checks import correlation_time, two_places
from thermal_fiducial.core.types import BoolArray, FloatArray, IntArray

#: Chi square of a view (8 residuals) up to which it counts in full: 99.9 % of honest ones.
ROBUST_CHI2 = 26.1
#: Chi square of a pose from odometry (6 residuals) up to which it counts in full.
ROBUST_ODOMETRY = 22.5
MAX_ITERATIONS = 25
# Decrease of the cost, in chi squares of the actual noise, that ends the iteration: a tenth of the standard deviation
# of one pose.
_CONVERGED = 0.01
# Median of chi square of eight degrees of freedom.
_MEDIAN_CHI2 = 7.34
# Samples of errors that last: the covariance of six numbers from so many is good to a fifth.
_SAMPLES = 32
# Of these at a time: bounds the memory.
_AT_ONCE = 8
# Chi square of a view that no pose near the present one explains.
_BEHIND_CHI2 = 1e8
# Each round takes the corners' variance anew from the residuals.
_ROUNDS = 4


@dataclass(frozen=True)
class Snapshot:
    """What a refinement works on. Immutable throughout; can be pickled."""

    #: the markers to adjust
    markers: Mapping[int, MapMarker]
    keyframes: tuple[Keyframe, ...]
    rig: CameraRig
    links: tuple[Link, ...] = ()
    #: pose and covariance (6, 6) by ID of markers that were known beforehand; see :func:`prior_poses`
    priors: Mapping[int, tuple[FloatArray, FloatArray]] = field(default_factory=dict)
    map_revision: int = 0
    #: what the covariances are to allow for beside the noise
    errors: SystematicErrors = NO_SYSTEMATIC_ERRORS

    def __reduce__(self) -> tuple[Any, ...]:
        rest = (self.rig, self.links, self.priors, self.map_revision, self.errors)
        return _snapshot, (self.markers, packed(self.keyframes), *rest)


def _snapshot(markers: Mapping[int, MapMarker], keyframes: tuple[Any, ...], *rest: Any) -> Snapshot:
    return Snapshot(markers, unpacked(*keyframes), *rest)


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
    state, scale, iterations = problem.start, 0.0, 0
    before = problem.evaluate(state, 1.0)
    for _ in range(_ROUNDS):
        previous, scale = scale, _scale(problem.evaluate(state, 1.0).chi2)
        if abs(scale - previous) < 0.05 * scale:
            break
        state, steps = _minimise(problem, state, scale)
        iterations += steps
    return problem.result(snapshot, state, before, problem.evaluate(state, scale), iterations)


def _minimise(problem: '_Problem', state: '_Poses', scale: float) -> tuple['_Poses', int]:
    """Levenberg-Marquardt; the state at the minimum and the number of steps."""
    evaluation = problem.evaluate(state, scale)
    damping, steps = 1e-5, 0
    while steps < MAX_ITERATIONS and damping < 1e6:
        steps += 1
        trial = problem.step(state, evaluation, damping)
        outcome = None if trial is None else problem.evaluate(trial, scale)
        if trial is None or outcome is None or not outcome.cost <= evaluation.cost:
            damping *= 10.0
            continue
        gain = evaluation.cost - outcome.cost
        state, evaluation, damping = trial, outcome, max(0.1 * damping, 1e-9)
        if gain <= _CONVERGED * scale:
            break
    return state, steps


def _scale(chi2: FloatArray) -> float:
    """Ratio of the corners' variance to the promised one, at least 1; from the median, which outliers don't move."""
    return max(1.0, float(np.nanmedian(chi2)) / _MEDIAN_CHI2)


def prior_poses(markers: Mapping[int, MapMarker]) -> dict[int, tuple[FloatArray, FloatArray]]:
    """Pose and covariance (6, 6) of markers that are known from before the keyframes, as a refinement may use them.

    Only each marker's own covariance is kept in a map, not how the errors of two hang together. Divided among n
    markers (each covariance n times as large) they are an upper bound of the joint covariance whatever that is.
    """
    known = [m for m in markers.values() if not m.fixed and np.any(m.covariance)]
    return {m.id: (m.T_map_marker, len(known) * m.covariance) for m in known}


@dataclass(frozen=True)
class _Poses:
    T_map_rig: FloatArray
    T_map_marker: FloatArray


@dataclass(frozen=True)
class _Evaluation:
    cost: float
    #: (n, 8) whitened residuals, and derivatives (n, 8, 6), robust weights (n,) applied to none of them
    r: FloatArray
    J_rig: FloatArray
    J_marker: FloatArray
    weights: FloatArray
    chi2: FloatArray
    squared_px: FloatArray


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
    links: list[tuple[int, int, FloatArray, FloatArray]]
    priors: list[tuple[int, FloatArray, FloatArray]]
    #: (F, 4, 4), (F, 6, 6) what odometry knows of the keyframes
    T_odometry: FloatArray
    information: FloatArray
    equations: NormalEquations

    @classmethod
    def build(cls, snapshot: Snapshot) -> '_Problem | None':
        frames, links = _useful(snapshot)
        frames, links = _anchored(snapshot, frames, links)
        seen = sorted({int(key) for frame in frames for key in frame.ids if int(key) in snapshot.markers})
        markers = [snapshot.markers[key] for key in seen]
        held = _gauge(markers)
        if not frames or np.all(held):
            return None
        index = {key: i for i, key in enumerate(seen)}
        keep = [np.array([int(key) in index for key in frame.ids], dtype=bool) for frame in frames]
        frame = np.repeat(np.arange(len(frames)), [np.count_nonzero(k) for k in keep])
        marker = np.array([index[int(key)] for f, k in zip(frames, keep, strict=True) for key in f.ids[k]])
        position = {f.stamp_ns: i for i, f in enumerate(frames)}
        tied = np.zeros(len(frames), dtype=bool)
        joined = [(position[k.stamp_a_ns], position[k.stamp_b_ns], k.T_a_b, _root(k.covariance)) for k in links]
        for a, b, _, _ in joined:
            tied[[a, b]] = True
        return cls(
            start=_Poses(np.stack([f.T_map_rig for f in frames]), np.stack([m.T_map_marker for m in markers])),
            ids=seen,
            stamps=[f.stamp_ns for f in frames],
            sizes=np.array([m.size for m in markers]),
            held=held,
            rig=snapshot.rig,
            frame=frame,
            marker=marker,
            camera=np.concatenate([f.cameras[k] for f, k in zip(frames, keep, strict=True)]),
            corners=np.concatenate([f.corners[k] for f, k in zip(frames, keep, strict=True)]),
            W=whitening(np.concatenate([f.covariances[k] for f, k in zip(frames, keep, strict=True)])),
            links=joined,
            priors=[
                (index[key], T, _root(covariance))
                for key, (T, covariance) in snapshot.priors.items()
                if key in index and not held[index[key]]
            ],
            T_odometry=np.stack([f.T_odometry for f in frames]),
            information=np.stack([f.information for f in frames]),
            equations=NormalEquations(frame, marker, tied, held),
        )

    def evaluate(self, state: _Poses, scale: float) -> _Evaluation:
        """Whitened residuals, derivatives, robust weights and cost, for corners of ``scale`` times their variance."""
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
        limit = ROBUST_CHI2 * scale
        weights = _robust_weights(chi2, limit)
        cost = float(np.sum(_robust_cost(chi2, limit)))
        cost += sum(float(e @ e) for _, _, e, _, _ in self._linked(state))
        cost += sum(float(e @ e) for _, e, _ in self._prior_terms(state))
        cost += float(np.sum(_robust_cost(self._odometry_chi2(state)[1], ROBUST_ODOMETRY)))
        whitened = [(self.W @ J.reshape(n, 4, 2, 6)).reshape(n, 8, 6) for J in (J_camera, J_marker)]
        return _Evaluation(cost, r, whitened[0], whitened[1], weights, chi2, np.sum(residuals**2, axis=(1, 2)))

    def step(self, state: _Poses, evaluation: _Evaluation, damping: float) -> _Poses | None:
        """The state after one damped Gauss-Newton step; None where the equations are singular."""
        solution = self.equations.solve(self._blocks(state, evaluation), damping)
        if solution is None:
            return None
        frames, markers = solution
        return _Poses(retract(state.T_map_rig, frames), retract(state.T_map_marker, markers))

    def result(
        self, snapshot: Snapshot, state: _Poses, before: _Evaluation, after: _Evaluation, iterations: int
    ) -> AdjustedMap | None:
        """The outcome with its covariances; None where these do not exist."""
        n = len(self.frame)
        unknowns = 6 * (len(self.stamps) + np.count_nonzero(~self.held))
        full = after.weights == 1.0
        freedom = max(8 * np.count_nonzero(full) - unknowns, 1)
        factor = float(np.sum(after.chi2[full]) / freedom)
        held_covariances = np.stack([snapshot.markers[key].covariance for key in self.ids])
        noise = max(factor, 1.0) * correlation_time(after.r[full], self.marker[full])
        blocks = self._blocks(state, after)
        system = self.equations.reduced(blocks)
        if system is None:
            return None
        covariances = self.equations.covariances(system, noise, held_covariances)
        positions = state.T_map_marker[:, :3, 3]
        covariances += self._shape_covariances(system, after, snapshot.errors)
        covariances += scale_of_map(positions, positions[self.held], snapshot.errors)
        if not np.all(np.isfinite(covariances)):
            return None
        adjusted = {
            key: replace(snapshot.markers[key], T_map_marker=state.T_map_marker[i], covariance=covariances[i])
            for i, key in enumerate(self.ids)
            if not self.held[i]
        }
        outlying = np.bincount(self.marker, ~full) / np.bincount(self.marker)
        return AdjustedMap(
            adjusted,
            dict(zip(self.stamps, state.T_map_rig, strict=True)),
            float(np.sqrt(np.sum(before.squared_px) / (4 * n))),
            float(np.sqrt(np.sum(after.squared_px) / (4 * n))),
            after.cost / max(factor, 1.0),
            factor,
            dict(zip(self.ids, outlying.tolist(), strict=True)),
            tuple(key for i, key in enumerate(self.ids) if not self.held[i] and self._two_places(i, after)),
            iterations,
            snapshot.map_revision,
        )

    def _shape_covariances(self, system: ReducedSystem, e: _Evaluation, errors: SystematicErrors) -> FloatArray:
        """Covariances (M, 6, 6) of what corners make of the map that are wrong alike in all views of a marker.

        Nothing averages that out, and no residual shows it: the shape of a fixed marker turns the whole map. It is
        sampled, as every corner of every marker has a direction of its own.
        """
        covariances = np.zeros((len(self.ids), 6, 6))
        if errors.marker_shape == 0.0:
            return covariances
        precision = np.bincount(self.marker, 0.5 * np.mean(np.sum(self.W**2, axis=(2, 3)), axis=1))
        std = errors.marker_shape * np.sqrt(np.bincount(self.marker) / precision)
        whitened = e.weights[:, None, None, None] * self.W
        rig, marker = (
            np.swapaxes((np.swapaxes(whitened, -1, -2) @ J.reshape(-1, 4, 2, 6)).reshape(-1, 8, 6), -1, -2)
            for J in (e.J_rig, e.J_marker)
        )
        rng = np.random.default_rng(0)
        for _ in range(_SAMPLES // _AT_ONCE):
            off = (std[:, None, None] * rng.standard_normal((len(self.ids), 8, _AT_ONCE)))[self.marker]
            steps = self.equations.responses(system, rig @ off, marker @ off)
            covariances += steps @ np.swapaxes(steps, -1, -2) / _SAMPLES
        return covariances

    def _two_places(self, marker: int, after: _Evaluation) -> bool:
        own = self.marker == marker
        return two_places(after.r[own], after.J_marker[own], after.weights[own] < 1.0)

    def _blocks(self, state: _Poses, e: _Evaluation) -> Blocks:
        weighted_rig = np.swapaxes(e.J_rig, -1, -2) * e.weights[:, None, None]
        weighted_marker = np.swapaxes(e.J_marker, -1, -2) * e.weights[:, None, None]
        apart, chi2 = self._odometry_chi2(state)
        known = self.information * _robust_weights(chi2, ROBUST_ODOMETRY)[:, None, None]
        return Blocks(
            rig=weighted_rig @ e.J_rig,
            marker=weighted_marker @ e.J_marker,
            cross=weighted_rig @ e.J_marker,
            rig_gradient=(weighted_rig @ e.r[..., None])[..., 0],
            marker_gradient=(weighted_marker @ e.r[..., None])[..., 0],
            links=self._linked(state),
            priors=self._prior_terms(state),
            known=known,
            known_gradient=(known @ apart[..., None])[..., 0],
        )

    def _odometry_chi2(self, state: _Poses) -> tuple[FloatArray, FloatArray]:
        """How far each keyframe is from where odometry has it (F, 6), and the chi square of that (F,)."""
        apart = difference(self.T_odometry, state.T_map_rig)
        return apart, np.einsum('fi,fij,fj->f', apart, self.information, apart)

    def _linked(self, state: _Poses) -> list[tuple[int, int, FloatArray, FloatArray, FloatArray]]:
        """Frames a and b, whitened residual (6,) of each link, and the derivatives of its prediction."""
        terms = []
        for a, b, T_a_b, root in self.links:
            T_a, T_b = state.T_map_rig[a], state.T_map_rig[b]
            R = T_a[:3, :3].T
            apart = T_b[:3, 3] - T_a[:3, 3]
            e = difference(T_a_b, inverse(T_a) @ T_b)
            J_b = np.zeros((6, 6))
            J_b[:3, :3] = J_b[3:, 3:] = R
            J_a = -J_b
            J_a[:3, 3:] = R @ skew(apart)
            terms.append((a, b, root @ e, root @ J_a, root @ J_b))
        return terms

    def _prior_terms(self, state: _Poses) -> list[tuple[int, FloatArray, FloatArray]]:
        """Marker, whitened residual (6,) of each prior, and the derivative of its prediction."""
        return [(m, root @ difference(T, state.T_map_marker[m]), root) for m, T, root in self.priors]


def _useful(snapshot: Snapshot) -> tuple[list[Keyframe], list[Link]]:
    """Keyframes that say anything of the map: two of its markers in one, or one and a link."""
    stamps = {frame.stamp_ns for frame in snapshot.keyframes}
    links = [link for link in snapshot.links if {link.stamp_a_ns, link.stamp_b_ns} <= stamps]
    linked = {stamp for link in links for stamp in (link.stamp_a_ns, link.stamp_b_ns)}
    frames = []
    for frame in snapshot.keyframes:
        known = sum(int(key) in snapshot.markers for key in frame.ids)
        if known >= 2 or (known and frame.stamp_ns in linked):
            frames.append(frame)
    kept = {frame.stamp_ns for frame in frames}
    return frames, [link for link in links if {link.stamp_a_ns, link.stamp_b_ns} <= kept]


def _anchored(snapshot: Snapshot, frames: list[Keyframe], links: list[Link]) -> tuple[list[Keyframe], list[Link]]:
    """Keyframes that hang together with a marker that is held: what has lost its connection stays where it is."""
    seen = {frame.stamp_ns: {int(key) for key in frame.ids} & snapshot.markers.keys() for frame in frames}
    markers = [snapshot.markers[key] for key in sorted(set().union(*seen.values()))]
    reached = {
        marker.id for marker, held in zip(markers, _gauge(markers), strict=True) if held
    } | snapshot.priors.keys()
    stamps: set[int] = set()
    before = -1
    while len(stamps) > before:
        before = len(stamps)
        stamps |= {stamp for stamp, ids in seen.items() if ids & reached}
        for link in links:
            if {link.stamp_a_ns, link.stamp_b_ns} & stamps:
                stamps |= {link.stamp_a_ns, link.stamp_b_ns}
        reached |= set().union(*(seen[stamp] for stamp in stamps))
    return (
        [frame for frame in frames if frame.stamp_ns in stamps],
        [link for link in links if link.stamp_a_ns in stamps],
    )


def _gauge(markers: list[MapMarker]) -> BoolArray:
    """Which markers are held: fixed ones and those known exactly; failing these, the one known best."""
    held = np.array([m.fixed or not np.any(m.covariance) for m in markers], dtype=bool)
    if markers and not np.any(held):
        held[int(np.argmin([np.trace(m.covariance) for m in markers]))] = True
    return held


def _robust_weights(chi2: FloatArray, limit: float) -> FloatArray:
    return np.asarray(np.minimum(1.0, limit / np.maximum(chi2, 1e-300)))


def _robust_cost(chi2: FloatArray, limit: float) -> FloatArray:
    """The cost whose derivative has the robust weights: quadratic, then logarithmic."""
    return np.where(chi2 <= limit, chi2, limit * (1.0 - np.log(_robust_weights(chi2, limit))))


def _root(covariance: npt.ArrayLike) -> FloatArray:
    """Matrix (6, 6) that whitens residuals of ``covariance`` (6, 6)."""
    return np.asarray(np.linalg.inv(np.linalg.cholesky(np.asarray(covariance, dtype=np.float64))))
