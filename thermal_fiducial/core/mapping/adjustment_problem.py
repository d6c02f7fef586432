"""The bundle adjustment as arrays: its input, and residuals, Jacobians and normal equations of all views."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from thermal_fiducial.config import CHI2_OF_POSE
from thermal_fiducial.core.error_model import CHI2_OF_VIEW, SystematicErrors
from thermal_fiducial.core.geometry.camera import Camera, ImagePoints
from thermal_fiducial.core.geometry.reprojection import marker_corners, whitening
from thermal_fiducial.core.geometry.rigid_fit import BEHIND_CHI2, Images, linearised, robust
from thermal_fiducial.core.geometry.se3 import difference, inverse, lever_arm, retract
from thermal_fiducial.core.lens_errors import of_aspect
from thermal_fiducial.core.mapping.map_data import exact, gauge, MapMarker
from thermal_fiducial.core.mapping.normal_equations import Blocks, NormalEquations, Vectors
from thermal_fiducial.core.types import BoolArray, FloatArray, IntArray

# Variance that is added to those of priors [m^2, rad^2]: no place is known better than to 0.1 mm and mrad.
_LEAST_VARIANCE = 1e-8


@dataclass(frozen=True)
class Priors:
    """Priors of k poses: poses (k, 4, 4) and information (k, 6, 6), zero without a prior."""

    T: FloatArray
    information: FloatArray

    def divided(self, factor: float) -> 'Priors':
        """The same with covariances divided by a ``factor``, by which all of an adjustment are multiplied later."""
        return Priors(self.T, factor * self.information)

    def apart(self, T: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Differences (k, 6) from poses (k, 4, 4) to their priors, and chi squares (k,) of these."""
        d = difference(self.T, T)
        return d, np.einsum('ki,kij,kj->k', d, self.information, d)

    def weighted(self, chi2: FloatArray) -> FloatArray:
        """Information (k, 6, 6) with robust weights, by chi squares (k,) of :meth:`apart`."""
        return np.asarray(self.information * robust(chi2, CHI2_OF_POSE)[1][:, None, None])


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
    #: calibration, in whose pixels all views are
    camera: Camera
    #: priors of the camera poses by odometry
    odometry: Priors
    #: of each view, in the order of the keyframes: (n,) index of the keyframe, (n,) ID of the marker, corners
    #: (n, 4, 2) [px] and their covariances (n, 4, 2, 2) [px^2]
    frame: IntArray
    ids: IntArray
    corners: FloatArray
    covariances: FloatArray
    #: (n, 4, 2) [px/s] what corners are displaced by each second that the readout time is declared too short by
    rates: FloatArray
    #: prior pose and covariance (6, 6) by ID, of markers of an earlier map
    known: Mapping[int, tuple[FloatArray, FloatArray]]
    map_revision: int
    #: systematic errors that enter the covariances
    errors: SystematicErrors
    #: what the readout time is declared too short by, as estimated before [s]
    readout: float = 0.0

    def useful(self) -> BoolArray:
        """Which views (n,) constrain the map and are connected with a held or prior marker, by markers or odometry.

        A keyframe needs two markers of the map, or one and odometry. Unconnected parts are not adjusted.
        """
        of_map: BoolArray = np.isin(self.ids, list(self.markers))
        number = np.bincount(self.frame[of_map], minlength=len(self.stamps_ns))
        has_odometry: BoolArray = np.asarray(self.odometry.information.any(axis=(1, 2)))
        useful = of_map & ((number >= 2) | has_odometry)[self.frame]
        marker_ids = np.unique(self.ids[useful])
        held = self.held(marker_ids)
        by_odometry = has_odometry[self.frame]
        reached = np.isin(self.ids, [*marker_ids[held], *self.known])
        while True:
            joined = useful & np.isin(self.frame, self.frame[useful & reached])
            # Odometry connects all frames that have it, but with the map only where one of them is.
            more = reached | np.isin(self.ids, self.ids[joined]) | (by_odometry & by_odometry[joined].any())
            if np.array_equal(more, reached):
                return np.asarray(joined)
            reached = more

    def held(self, ids: IntArray) -> BoolArray:
        """Which of the markers ``ids`` (M,) are held: exact ones; failing these and priors, the one known best.

        Where all are known by priors alone, none is better than all together: to hold one would turn the map by what
        that one is turned by.
        """
        markers = [self.markers[key] for key in ids.tolist()]
        held = exact(markers)
        return held if held.any() or np.isin(ids, list(self.known)).any() else gauge(markers)


@dataclass(frozen=True)
class Poses:
    """Poses of all keyframes (F, 4, 4) and markers (M, 4, 4), and of the frame of the odometry (4, 4).

    And the errors of aspect ratio and readout time (2,), in units of their standard deviations.
    """

    T_map_camera: FloatArray
    T_map_marker: FloatArray
    common: FloatArray
    T_map_odometry: FloatArray = field(default_factory=lambda: np.eye(4))

    def moved(self, step: Vectors) -> 'Poses':
        """By steps (F, 6, 1) of the keyframes, (M + 1, 6, 1) of markers and odometry, (L, 1) of what views share."""
        return Poses(
            retract(self.T_map_camera, step.frames[..., 0]),
            retract(self.T_map_marker, step.nodes[:-1, :, 0]),
            self.common + step.common[:, 0],
            retract(self.T_map_odometry, step.nodes[-1, :, 0]),
        )


@dataclass(frozen=True)
class Linearised:
    """Residuals (n, 8) and Jacobians (n, 8, 6) by the markers of the n views at a state, whitened but not weighted."""

    state: Poses
    r: FloatArray
    J: FloatArray
    #: (n, 6, 6), transposed: from a displacement of a view's camera to the one of its marker that looks the same
    to_camera: FloatArray
    #: (F, 6, 6) how the keyframes' poses by odometry follow the pose of its frame
    J_odometry: FloatArray
    chi2: FloatArray
    #: differences (F, 6) and (M, 6) from the state to the priors, and their chi squares (F,), (M,)
    camera_apart: FloatArray
    camera_chi2: FloatArray
    marker_apart: FloatArray
    marker_chi2: FloatArray
    #: chi square of the priors of what all views have in common
    common_chi2: float

    def weights(self, scale: float) -> FloatArray:
        """Robust weights (n,) of the views, for corners of ``scale`` times their variance."""
        return robust(self.chi2, CHI2_OF_VIEW * scale)[1]

    def view_costs(self, scale: float) -> FloatArray:
        """Robust chi squares (n,) of the views, for corners of ``scale`` times their variance."""
        return robust(self.chi2, CHI2_OF_VIEW * scale)[0]

    def cost(self, scale: float) -> float:
        """Robust sum of squares."""
        of_priors = robust(np.concatenate([self.camera_chi2, self.marker_chi2]), CHI2_OF_POSE)[0]
        return float(np.sum(self.view_costs(scale)) + np.sum(of_priors) + self.common_chi2)


@dataclass(frozen=True)
class MapProblem:
    """The snapshot as arrays: n views, F keyframes, M markers, views ordered by keyframe."""

    start: Poses
    ids: list[int]
    stamps: list[int]
    sizes: FloatArray
    #: (M,) markers that never move, and those that carry the scale
    held: BoolArray
    anchors: BoolArray
    camera: Camera
    frame: IntArray
    marker: IntArray
    corners: FloatArray
    W: FloatArray
    images: Images
    #: (n, 8, 2) whitened corners by one standard deviation of the aspect ratio, and of the readout time
    J_common: FloatArray
    odometry: Priors
    known: Priors
    #: (2,) of the priors of these
    common_information: FloatArray

    @classmethod
    def build(cls, snapshot: Snapshot) -> 'MapProblem | None':
        """The problem of a snapshot; None if there is nothing to adjust."""
        views = snapshot.useful()
        marker_ids, marker = np.unique(snapshot.ids[views], return_inverse=True)
        frames, frame = np.unique(snapshot.frame[views], return_inverse=True)
        markers = [snapshot.markers[key] for key in marker_ids.tolist()]
        held = snapshot.held(marker_ids)
        if np.all(held):
            return None
        T_map_marker = np.stack([m.T_map_marker for m in markers])
        camera = snapshot.camera
        corners, W = snapshot.corners[views], whitening(snapshot.covariances[views])
        readout_std = snapshot.errors.readout_time_std
        by_aspect = of_aspect(corners, camera, snapshot.errors)
        # One that is smaller than the smooth error of the lens looks like it.
        by_aspect *= np.abs(by_aspect).max() > snapshot.errors.corner_px
        by_common = by_aspect, readout_std * snapshot.rates[views]
        common = np.array([0.0, snapshot.readout / readout_std if readout_std else 0.0])
        return cls(
            start=Poses(snapshot.T_map_camera[frames], T_map_marker, common),
            ids=marker_ids.tolist(),
            stamps=snapshot.stamps_ns[frames].tolist(),
            sizes=np.array([m.size for m in markers]),
            held=held,
            anchors=gauge(markers),
            camera=camera,
            frame=frame,
            marker=marker,
            corners=corners,
            W=W,
            images=Images.of(ImagePoints.at(corners, camera), W),
            J_common=(W @ np.stack(by_common, axis=-1)).reshape(-1, 8, 2),
            odometry=Priors(snapshot.odometry.T[frames], snapshot.odometry.information[frames]),
            known=_known(snapshot, marker_ids, T_map_marker),
            common_information=np.ones(2),
        )

    def evaluate(self, state: Poses) -> Linearised:
        """Whitened residuals and derivatives."""
        n = len(self.frame)
        T_camera_map, T_map_marker = inverse(state.T_map_camera)[self.frame], state.T_map_marker[self.marker]
        corners = marker_corners(self.sizes)[self.marker]
        off, J, seen = linearised(T_camera_map @ T_map_marker, corners, self.images)
        # From the axes of the camera to those of the map.
        J = (J.reshape(n, 16, 3) @ T_camera_map[:, :3, :3]).reshape(n, 8, 6)
        r = -off.reshape(n, 8) - self.J_common @ state.common
        # Markers behind the camera have no gradient, and the cost of an outlier.
        r[~seen], J[~seen] = 0.0, 0.0
        chi2 = np.where(seen, np.sum(r * r, axis=-1), BEHIND_CHI2)
        # Moved like the camera, but the other way round.
        arms = T_map_marker[:, :3, 3] - state.T_map_camera[self.frame, :3, 3]
        to_camera = -lever_arm(arms).swapaxes(-1, -2)
        J_odometry = lever_arm(self.odometry.T[:, :3, 3] @ state.T_map_odometry[:3, :3].T)
        by_odometry = Priors(state.T_map_odometry @ self.odometry.T, self.odometry.information)
        of_cameras = by_odometry.apart(state.T_map_camera)
        of_markers = self.known.apart(state.T_map_marker)
        of_common = float(self.common_information @ state.common**2)
        return Linearised(state, r, J, to_camera, J_odometry, chi2, *of_cameras, *of_markers, of_common)

    def rms_px(self, now: Linearised) -> float:
        """Rms re-projection error of all corners [px]."""
        residuals = np.linalg.solve(self.W, now.r.reshape(*self.corners.shape, 1))
        return float(np.sqrt(np.sum(residuals**2) / (4 * len(residuals))))

    def step(self, now: Linearised, scale: float, damping: float) -> Linearised | None:
        """After one damped Gauss-Newton step; None where the equations are singular."""
        blocks, sides = self.normal(now, scale)
        system = self.equations.reduced(blocks, damping)
        if system is None:
            return None
        step = system.solve(sides)
        return self.evaluate(now.state.moved(step)) if all(np.all(np.isfinite(part)) for part in step) else None

    def only(self, views: BoolArray) -> 'MapProblem':
        """The same unknowns with some of the ``views`` (n,); for steps of markers alone."""
        return replace(
            self,
            frame=self.frame[views],
            marker=self.marker[views],
            corners=self.corners[views],
            W=self.W[views],
            images=Images(self.images.whitening[views], self.images.target[views]),
            J_common=self.J_common[views],
        )

    def thinned(self, most: int) -> BoolArray:
        """Which views (n,) are of at most so many of each marker, at equal distances among all of these."""
        order, starts = self._by_marker
        counts = np.diff(starts, append=len(order))
        place = np.arange(len(order)) - np.repeat(starts, counts)
        chosen = np.empty(len(order), dtype=np.bool_)
        chosen[order] = place % np.repeat(-(-counts // most), counts) == 0
        return chosen

    @cached_property
    def equations(self) -> NormalEquations:
        """Which keyframe is connected with which node: with markers by views, and with the frame of the odometry.

        The filter's poses know no better where the map lies than the map that they come from: its odometry is of motion
        alone, and the frame of it is never held.
        """
        keyframes = np.arange(len(self.stamps))
        frame = np.concatenate([self.frame, keyframes])
        node = np.concatenate([self.marker, np.full(len(keyframes), len(self.ids))])
        return NormalEquations(frame, node, np.append(self.held, False))

    def normal(self, now: Linearised, scale: float) -> tuple[Blocks, Vectors]:
        """Normal equations, and their right sides."""
        weights, count = now.weights(scale)[:, None, None], self.J_common.shape[-1]
        # What the poses' derivatives are multiplied with beside each other: those by what views share, and residuals.
        beside = np.concatenate([self.J_common, now.r[..., None]], axis=-1)
        of_marker = weights * np.swapaxes(now.J, -1, -2)
        node, by_marker = of_marker @ now.J, of_marker @ beside
        cross = now.to_camera @ node
        of_frames, of_markers = self.over_frames(now.to_camera @ by_marker), self.over_markers(by_marker)
        of_common = np.tensordot(weights * self.J_common, beside, axes=([0, 1], [0, 1]))
        odometry, known = self.odometry.weighted(now.camera_chi2), self.known.weighted(now.marker_chi2)
        by_odometry, back = odometry @ now.J_odometry, np.swapaxes(now.J_odometry, -1, -2)
        blocks = Blocks(
            frame=self.over_frames(cross @ np.swapaxes(now.to_camera, -1, -2)) + odometry,
            node=_with_odometry(self.over_markers(node) + known, back @ by_odometry),
            cross=np.concatenate([cross, -by_odometry]),
            common=Vectors(
                of_frames[..., :-1],
                _with_odometry(of_markers[..., :-1], np.zeros((1, 6, count))),
                of_common[:, :-1] + np.diag(self.common_information),
            ),
        )
        of_odometry = odometry @ now.camera_apart[..., None]
        of_known = known @ now.marker_apart[..., None]
        return blocks, Vectors(
            of_frames[..., -1:] + of_odometry,
            _with_odometry(of_markers[..., -1:] + of_known, -back @ of_odometry),
            of_common[:, -1:] - (self.common_information * now.state.common)[:, None],
        )

    def over_frames(self, values: FloatArray) -> FloatArray:
        """Sums (F, ...) of values (n, ...) of the views over those of each keyframe."""
        return np.asarray(np.add.reduceat(values, np.flatnonzero(np.diff(self.frame, prepend=-1)), axis=0))

    def over_markers(self, values: FloatArray) -> FloatArray:
        """Sums (M, ...) over the views of each marker."""
        order, starts = self._by_marker
        sums = np.zeros((len(self.ids), *values.shape[1:]))
        sums[self.marker[order[starts]]] = np.add.reduceat(values[order], starts, axis=0)
        return sums

    @cached_property
    def _by_marker(self) -> tuple[IntArray, IntArray]:
        """Views (n,) ordered by marker, and where there those of each marker begin that has any."""
        order = np.argsort(self.marker, kind='stable')
        return order, np.flatnonzero(np.diff(self.marker[order], prepend=-1))


def _with_odometry(of_markers: FloatArray, of_frames: FloatArray) -> FloatArray:
    """Those of M markers (M, ...), and last the sum over the keyframes (F, ...): (M + 1, ...)."""
    return np.concatenate([of_markers, np.sum(of_frames, axis=0, keepdims=True)])


def _known(snapshot: Snapshot, ids: IntArray, T_map_marker: FloatArray) -> Priors:
    """Priors of the M markers; of those that are held they change nothing."""
    T, information = T_map_marker.copy(), np.zeros((len(ids), 6, 6))
    for index, key in enumerate(ids.tolist()):
        if key in snapshot.known:
            T[index], covariance = snapshot.known[key]
            information[index] = np.linalg.inv(covariance + _LEAST_VARIANCE * np.eye(6))
    return Priors(T, information)
