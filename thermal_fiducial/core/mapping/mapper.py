"""The incremental marker map: Algorithm 1 of the paper.

S. Khattak, C. Papachristos, K. Alexis, "Marker based thermal-inertial localization for aerial robots in obscurant
filled environments", ISVC 2018. For every frame: split the markers into known and new, find the camera from all known
ones jointly, weight each by its present and running re-projection error, refine, update the errors, and place new
markers that are seen together with known ones. Beyond the paper: planar ambiguities are settled before anything rests
on them, covariances carry the map's own uncertainty, and markers that stop agreeing are put in quarantine.
"""

from collections import deque
from dataclasses import replace
import sys

import numpy as np

from thermal_fiducial.config import MarkerMapperConfig, size_overrides
from thermal_fiducial.core.error_model import alike_odometry, INCONSISTENT_PX, positive, SystematicErrors
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.geometry.reprojection import corners_in_map, linearise, reproject
from thermal_fiducial.core.geometry.se3 import transform_from_quaternion
from thermal_fiducial.core.mapping.bundle_adjustment import AdjustedMap, refine
from thermal_fiducial.core.mapping.candidates import Candidate, MarkerView, Viewpoint
from thermal_fiducial.core.mapping.correction import correction
from thermal_fiducial.core.mapping.keyframes import CameraRig, Keyframe, KeyframeStore
from thermal_fiducial.core.mapping.localization import locate, Location, Refusal, Sight
from thermal_fiducial.core.mapping.located import Located, LocatedFrame
from thermal_fiducial.core.mapping.map_data import MapJump, MapMarker, MapperResult, MarkerMap
from thermal_fiducial.core.mapping.map_editing import align
from thermal_fiducial.core.mapping.map_rows import marker_poses, usable
from thermal_fiducial.core.mapping.motion import CameraMotion
from thermal_fiducial.core.mapping.noise_level import CornerBias, NoiseLevel
from thermal_fiducial.core.mapping.odometry_prior import (
    contradicts,
    Fused,
    growth,
    predicted_camera,
    PredictedCamera,
    together,
)
from thermal_fiducial.core.mapping.snapshot import prior_poses, Snapshot
from thermal_fiducial.core.mapping.trust import DISAGREEMENT, inconsistent, MEMORY, Trust
from thermal_fiducial.core.measurements import CameraPose, corner_covariances, corners_px, Markers
from thermal_fiducial.core.motion_prior import MotionPrior
from thermal_fiducial.core.types import FloatArray
from thermal_fiducial.errors import InputError

__all__ = ['MapJump', 'MapMarker', 'MapperResult', 'MarkerMap', 'MarkerMapper']

#: A pose of the past decides between alternative poses for this long [ns].
CONTINUITY_NS = 300_000_000
#: Why a marker is in quarantine that came so with the map.
FROM_FILE = 'in quarantine since before the map was loaded'
#: Why nothing is learned from a frame that has a pose.
CONTRADICTED = 'the known markers in view contradict the odometry'
#: Candidates that are judged in one frame: bounds its time when many are new.
TRIALS = 3
# Last frames that show how the map has moved where the robot is, each so many-th of them: neighbours show the same.
_RECENT, _EVERY = 10, 3
# A candidate is judged again when its views have grown by one in so many.
_PATIENCE = 6
# A refinement is worth its time when so many keyframes have come since the last one, as a share of it and in number.
_GROWTH, _FEW = 0.2, 15
#: Views of markers that a refinement in flight takes: a second or two of a slow core.
VIEWS = 10_000
# Time between two refinements for each view of the last [s]: a view takes a third of it on a slow core. With three
# times as much, poses from markers just placed along a chain were too vague to publish: 19 of 633 over a carpet.
_PERIOD_A_VIEW = 3e-4


class MarkerMapper:
    """Camera pose from the map, and the map from camera poses.

    Parameters
    ----------
    config : sizes, mode, extrinsics
    marker_map : the map to start from, with at least one marker; it is copied
    """

    def __init__(self, config: MarkerMapperConfig, marker_map: MarkerMap) -> None:
        self.config = config
        self._sizes = size_overrides(config.marker_size_overrides)
        self._T_body_camera = transform_from_quaternion(config.camera_position, config.camera_orientation)
        #: no new markers, no changes of the map, while True; ``config.mode`` only says how it starts
        self.frozen = config.mode == 'localization'
        self.resets = 0
        self._begin(marker_map)

    def configure(self, config: MarkerMapperConfig) -> None:
        """Take over the dynamic parameters of ``config``, and where the camera is on the robot."""
        self.config = config
        self._T_body_camera = transform_from_quaternion(config.camera_position, config.camera_orientation)

    def reset(self) -> MapJump | None:
        """Back to the map that it was started with; see :meth:`load`."""
        return self.load(self._initial)

    def load(self, marker_map: MarkerMap) -> MapJump | None:
        """Go on with another map of the place, of the next revision; what was seen before is forgotten.

        Returns
        -------
        The jump from the old map to the new by the markers that both have; None where they have none.
        """
        try:
            T_new_old = align(marker_map.markers, self.map.markers).T
        except InputError:
            T_new_old = None
        self._begin(replace(marker_map, revision=max(self.map.revision, marker_map.revision) + 1))
        self.resets += 1
        return None if T_new_old is None else MapJump(self.map.revision, self.resets, T_new_old)

    def _begin(self, marker_map: MarkerMap) -> None:
        self._initial, self.map = marker_map.copy(), marker_map.copy()
        self._candidates: dict[int, Candidate] = {}
        self._trust = Trust()
        self._quarantined = {key: FROM_FILE for key, marker in self.map.markers.items() if not marker.trusted}
        self._last: CameraPose | None = None
        #: whether odometry has been in this map
        self._odometry_agreed = False
        self._motion = CameraMotion()
        self._recent: deque[Keyframe] = deque(maxlen=_RECENT)
        #: what the map learned from last; None: nothing yet
        self._last_frame: Keyframe | None = None
        self._belief: FloatArray | None = None
        self._cameras: list[Camera] = []
        self._noise = NoiseLevel()
        self._bias = CornerBias(SystematicErrors())
        self._gap: CameraPose | None = None
        self._keyframes = KeyframeStore(self.config.keyframe_budget)
        self._refined_ns, self._refined_frames, self._refined_markers = 0, 0, len(self.map.markers)
        self._frames_then, self._refined_views = 0, 0

    def process(
        self, stamp_ns: int, markers: Markers, camera: Camera, prior: MotionPrior | None = None
    ) -> MapperResult:
        """One frame of Algorithm 1.

        Parameters
        ----------
        markers : (N,) of MARKER_DTYPE
        camera : its intrinsics
        prior : the filter's states and clock; settles ambiguities, and bridges gaps between known markers
        """
        return self.learn(self.locate(stamp_ns, markers, camera, prior))

    def locate(self, stamp_ns: int, markers: Markers, camera: Camera, prior: MotionPrior | None = None) -> LocatedFrame:
        """The first half of :meth:`process`, which ends with the pose: whoever waits for that need wait no longer."""
        markers = usable(markers)
        self._noise.add(markers)
        # Step 2: known and new markers.
        is_known = np.array([int(key) in self.map.markers for key in markers['id']], dtype=bool)
        known = self._sight(markers[is_known])
        trusted = np.array([marker.trusted for marker in known.markers], dtype=bool)
        # Steps 3 to 6: the camera from all known ones, weighted by their errors.
        predicted = self._predicted(stamp_ns, prior)
        outcome = self._locate(stamp_ns, known.select(trusted), camera, predicted)
        return LocatedFrame(stamp_ns, camera, markers, is_known, known, trusted, predicted, outcome)

    def learn(self, frame: LocatedFrame) -> MapperResult:
        """The second half: errors, standings and new markers, from the frame that was located last."""
        predicted = frame.predicted
        if isinstance(frame.outcome, Refusal):
            changed, waiting = self._without_pose(frame, frame.outcome)
            return self._result(frame, changed, waiting=waiting)
        location, pose = frame.outcome.location, frame.outcome.pose
        if predicted is not None:
            contradicted = contradicts(pose.T_map_camera, pose.covariance, predicted.pose)
            if contradicted and self._odometry_agreed:
                # A marker that was moved, or that hangs in two places: what it teaches would spoil the map.
                return self._result(frame, False, waiting=dict.fromkeys(frame.new['id'].tolist(), CONTRADICTED))
            self._odometry_agreed |= not contradicted
        self._last, self._gap = pose, None
        # Step 7: errors updated.
        errors = self._update_errors(frame, location)
        changed = self._judge(frame, errors, location)
        # Step 8: new markers placed relative to the camera.
        waiting = {}
        if not self.frozen:
            fused = _fused(location, predicted)
            self._keep(frame, pose, fused)
            placed, waiting = self._place_new(frame, _viewpoint(fused))
            changed |= placed
        residuals = {marker.id: float(error) for marker, error in zip(frame.known.markers, errors, strict=True)}
        return self._result(frame, changed, residuals, waiting)

    def _predicted(self, stamp_ns: int, prior: MotionPrior | None) -> PredictedCamera | None:
        if prior is None:
            return None
        return predicted_camera(prior, stamp_ns, self._T_body_camera, self.config.time_offset_std)

    def _locate(
        self, stamp_ns: int, sight: Sight, camera: Camera, predicted: PredictedCamera | None
    ) -> Located | Refusal:
        if not sight.markers:
            return Refusal(self._nothing_known())
        errors = self._trust.running_errors(sight.markers)
        location = locate(sight, errors, camera, self._prior(stamp_ns, predicted), self._errors)
        if isinstance(location, Refusal):
            return location
        ids = np.array([marker.id for marker in sight.markers])
        self._bias.add(stamp_ns, ids, location.residuals, location.errors.visible)
        delay = self._motion.delay_covariance(stamp_ns, location.T_map_camera, self._errors)
        systematic = location.errors.systematic + delay
        covariance = location.errors.white + systematic
        used = tuple(ids.tolist())
        pose = CameraPose(stamp_ns, location.T_map_camera, covariance, systematic, used, location.rms_px)
        return Located(location, pose)

    @property
    def _errors(self) -> SystematicErrors:
        return SystematicErrors(corner_px=self._bias.px, marker_size_std=self.config.marker_size_std)

    def _nothing_known(self) -> str:
        if not self.map.markers:
            return 'the map has no marker: give a map file with at least one'
        return 'no known marker in view'

    def _prior(self, stamp_ns: int, predicted: PredictedCamera | None) -> FloatArray | None:
        """T_map_camera that is expected from the filter or, for a short while, from the last pose."""
        if predicted is not None:
            return predicted.pose.T_map_camera
        if self._last is not None and 0 < stamp_ns - self._last.stamp_ns < CONTINUITY_NS:
            return self._last.T_map_camera
        return None

    def _sight(self, rows: Markers) -> Sight:
        branches = np.stack([marker_poses(rows, ''), marker_poses(rows, 'a')], axis=1)
        known = [self.map.markers[int(key)] for key in rows['id'] if int(key) in self.map.markers]
        return Sight(known, corners_px(rows), self._noise.factor * corner_covariances(rows), branches)

    def _update_errors(self, frame: LocatedFrame, location: Location) -> FloatArray:
        """Re-projection error (N,) [px] of each known marker, taken into its statistics."""
        known, camera = frame.known, frame.camera
        points = corners_in_map(known.T_map_marker, known.sizes)
        residuals = known.corners - reproject(camera, location.T_map_camera, points)
        squared = np.mean(np.sum(residuals**2, axis=-1), axis=-1)
        errors = np.sqrt(np.where(np.isfinite(squared), squared, float(camera.width) ** 2))
        self._trust.add_errors(known.markers, errors)
        if not self.frozen:
            for marker in known.markers:
                self.map.markers[marker.id] = marker.seen(frame.stamp_ns, self._trust.running_error(marker))
        return np.asarray(errors)

    def _judge(self, frame: LocatedFrame, errors: FloatArray, location: Location) -> bool:
        """Quarantine markers that persistently disagree; whether any standing changed."""
        known = frame.known
        if len(known.markers) < 2:
            return False
        explained = _expected_errors(known, location, frame.camera)
        blamed = inconsistent(errors > DISAGREEMENT * explained, frame.trusted, known.markers)
        changes = self._trust.judge(known.markers, blamed.tolist())
        for marker, error, sigma in zip(known.markers, errors, explained, strict=True):
            if marker.id in changes:
                reason = f'{error:.1f} px off, {error / sigma:.1f} sigma, in most of the last {1.0 / MEMORY:.0f} frames'
                self._set_standing(marker.id, '' if changes[marker.id] else reason)
        return bool(changes)

    def _set_standing(self, marker_id: int, reason: str) -> None:
        """Trust a marker, or put it in quarantine for a reason."""
        self.map.markers[marker_id] = replace(self.map.markers[marker_id], trusted=not reason)
        self._quarantined.pop(marker_id, None)
        if reason:
            self._quarantined[marker_id] = reason

    def _place_new(self, frame: LocatedFrame, viewpoint: Viewpoint) -> tuple[bool, dict[int, str]]:
        """Show new markers to their candidates; whether any entered the map, and what the others wait for."""
        rows = frame.new
        branches = np.stack([marker_poses(rows, ''), marker_poses(rows, 'a')], axis=1)
        corners, covariances = corners_px(rows), self._noise.factor * corner_covariances(rows)
        shown = []
        for i, marker_id in enumerate(int(key) for key in rows['id']):
            size = self._sizes.get(marker_id, self.config.marker_size)
            candidate = self._candidates.setdefault(marker_id, Candidate(marker_id, size))
            candidate.add(MarkerView(frame.stamp_ns, viewpoint, corners[i], covariances[i], branches[i]))
            shown.append(candidate)
        placed = False
        for candidate in sorted(shown, key=lambda c: -c.untried)[:TRIALS]:
            if candidate.untried <= len(candidate.views) // _PATIENCE:
                continue
            placement = candidate.place(frame.camera)
            candidate.reason = placement.reason
            if placement.T_map_marker is not None:
                self.enter(frame.stamp_ns, candidate, placement.T_map_marker, placement.covariance)
                placed = True
        self.map.revision += placed
        return placed, {candidate.id: candidate.reason for candidate in shown if candidate.id in self._candidates}

    def _keep(self, frame: LocatedFrame, pose: CameraPose, fused: Fused) -> None:
        """Keep the frame for the refinement; of one marker alone nothing can be learned."""
        pose = replace(pose, T_map_camera=fused.T_map_camera)
        self._last_frame = keyframe = _keyframe(frame.rows, pose, self._camera_index(frame.camera), frame.predicted)
        self._belief = None if frame.predicted is None else frame.predicted.pose.covariance
        self._recent.append(keyframe)
        if len(frame.rows) >= 2:
            self._keyframes.add(keyframe)

    def _camera_index(self, camera: Camera) -> int:
        """Index of ``camera`` among those seen so far: a calibration may change, or frames of several cameras come."""
        for index, known in enumerate(self._cameras):
            if camera is known or camera.matches(known):
                return index
        self._cameras.append(camera)
        return len(self._cameras) - 1

    def _without_pose(self, frame: LocatedFrame, refusal: Refusal) -> tuple[bool, dict[int, str]]:
        """What a frame without a pose may still teach of new markers."""
        predicted = frame.predicted
        if self.frozen or not len(frame.new):
            return False, {}
        if refusal.alternatives is not None and refusal.covariances is not None:
            return self._place_new(frame, Viewpoint(refusal.alternatives, refusal.covariances))
        last = self._last_frame
        if predicted is None or last is None:
            return False, {}
        if not 0 <= frame.stamp_ns - last.stamp_ns <= self.config.bridge_duration * 1e9:
            return False, {}
        return self._bridge(frame, predicted)

    def _bridge(self, frame: LocatedFrame, predicted: PredictedCamera) -> tuple[bool, dict[int, str]]:
        """Place new markers from the odometry while no known one is in view."""
        pose, rows = predicted.pose, frame.new
        keyframe = _keyframe(rows, pose, self._camera_index(frame.camera), predicted)
        if not any(int(key) in self._candidates for key in rows['id']):
            # Nothing but the odometry joins these markers to the map. Once in full is enough: its error is the same
            # for all that follow, which hang together through the markers themselves.
            information = np.asarray(np.linalg.inv(pose.covariance), dtype=np.float64)
            self._keyframes.bridges.add(frame.stamp_ns)
            self._keyframes.add(replace(keyframe, information=information))
        elif len(rows) >= 2:
            self._keyframes.add(keyframe)
        if self._gap is None:
            self._gap = pose
        # What the odometry had gathered when the gap's first marker came is the same for all its views.
        viewpoint = Viewpoint.known(pose.T_map_camera, growth(self._gap, predicted))
        return self._place_new(frame, replace(viewpoint, common=self._gap.covariance))

    def refinement_due(self, stamp_ns: int) -> bool:
        """Whether enough has been seen since the last joint refinement for another to be worth its time."""
        if self.frozen or not self._keyframes.frames or self.config.refinement_period == 0.0:
            return False
        period = max(self.config.refinement_period, _PERIOD_A_VIEW * self._refined_views)
        if stamp_ns - self._refined_ns < period * 1e9:
            return False
        enough = self._keyframes.added - self._frames_then >= _GROWTH * self._refined_frames + _FEW
        return enough or len(self.map.markers) > self._refined_markers

    def snapshot(self, views: int = VIEWS) -> Snapshot | None:
        """What a refinement works on, for ``bundle_adjustment.refine``; None: nothing yet.

        The snapshot is immutable: the refinement may run elsewhere while frames are processed.

        Parameters
        ----------
        views : about so many views of markers at most, which bounds its time
        """
        if not self._keyframes.frames:
            return None
        frames = self._keyframes.selected(views)
        self._refined_ns = next(reversed(self._keyframes.frames))
        self._refined_frames, self._refined_markers = len(self._keyframes.frames), len(self.map.markers)
        self._refined_views = sum(len(frame.ids) for frame in frames)
        self._frames_then = self._keyframes.added
        return Snapshot(
            {key: marker for key, marker in self.map.markers.items() if marker.trusted},
            frames,
            CameraRig(tuple(self._cameras), np.broadcast_to(np.eye(4), (len(self._cameras), 4, 4))),
            prior_poses(self._initial.markers),
            self.map.revision,
            self._errors,
        )

    def refine(self) -> AdjustedMap | None:
        """Refine here and now with all keyframes, and take it over: for tools, and wherever time doesn't press."""
        snapshot = self.snapshot(views=sys.maxsize)
        refinement = refine(snapshot) if snapshot is not None else None
        if refinement is not None:
            self.apply(refinement)
        return refinement

    def apply(self, refinement: AdjustedMap) -> MapJump | None:
        """Take over a refinement: markers, keyframes, candidates and the last pose move together.

        Returns
        -------
        The jump, for whoever holds poses in the map; None where the map is frozen, or was replaced since.
        """
        if self.frozen or refinement.map_revision < self._initial.revision:
            return None
        before = dict(self.map.markers)
        for marker_id, adjusted in refinement.markers.items():
            marker = self.map.markers.get(marker_id)
            if marker is not None and marker.trusted:
                self.map.markers[marker_id] = replace(
                    marker, T_map_marker=adjusted.T_map_marker, covariance=adjusted.covariance
                )
                if marker_id in refinement.inconsistent:
                    self._trust.flag(marker)
                    share = 100.0 * refinement.outliers[marker_id]
                    self._set_standing(marker_id, f'{share:.0f} % of its views contradict the joint refinement')
        displacement = self._keyframes.move(refinement.keyframes)
        for candidate in self._candidates.values():
            candidate.move(displacement)
        T_new_old = np.eye(4)
        if self._last is not None and self._last_frame is not None:
            T_new_old = correction(tuple(self._recent)[::_EVERY], self._cameras, before, self.map.markers, self._belief)
            self._recent = deque((frame.moved(T_new_old) for frame in self._recent), maxlen=_RECENT)
            self._last = replace(self._last, T_map_camera=T_new_old @ self._last.T_map_camera)
            self._motion = CameraMotion()
            self._last_frame = self._last_frame.moved(T_new_old)
        self.map.revision += 1
        self.resets += 1
        return MapJump(self.map.revision, self.resets, T_new_old)

    @property
    def corner_bias_px(self) -> float:
        """Systematic error of the corners, as learned so far [px]."""
        return self._bias.px

    @property
    def candidates(self) -> dict[int, Candidate]:
        """Markers on trial."""
        return dict(self._candidates)

    def enter(self, stamp_ns: int, candidate: Candidate, T_map_marker: FloatArray, covariance: FloatArray) -> None:
        """Take a candidate into the map."""
        self._candidates.pop(candidate.id, None)
        self._trust.forget([candidate.id])
        self.map.markers[candidate.id] = MapMarker(
            candidate.id, candidate.size, False, T_map_marker, covariance, first_seen_ns=stamp_ns, last_seen_ns=stamp_ns
        )

    def _result(
        self,
        frame: LocatedFrame,
        changed: bool,
        residuals: dict[int, float] | None = None,
        waiting: dict[int, str] | None = None,
    ) -> MapperResult:
        return MapperResult(
            frame.stamp_ns,
            frame.pose,
            frame.outcome.reason,
            changed,
            residuals or {},
            waiting or {},
            tuple(sorted(self._quarantined)),
            self.map.revision,
            self.resets,
            dict(self._quarantined),
            not self.frozen and bool(changed or residuals),
        )


def _fused(location: Location, predicted: PredictedCamera | None) -> Fused:
    systematic = positive(location.covariance - location.errors.relative)
    if predicted is None:
        return Fused(location.T_map_camera, location.errors.relative, systematic)
    return together(location.T_map_camera, location.errors.relative, systematic, predicted.pose)


def _viewpoint(fused: Fused) -> Viewpoint:
    return replace(Viewpoint.known(fused.T_map_camera, fused.white), common=fused.systematic)


def _keyframe(rows: Markers, pose: CameraPose, camera: int, predicted: PredictedCamera | None) -> Keyframe:
    frame = Keyframe(
        pose.stamp_ns,
        pose.T_map_camera,
        rows['id'].astype(np.int64),
        corners_px(rows),
        corner_covariances(rows),
        np.full(len(rows), camera),
    )
    if predicted is None:
        return frame
    information = np.asarray(np.linalg.inv(alike_odometry(predicted.pose.covariance)), dtype=np.float64)
    return replace(frame, T_odometry=predicted.pose.T_map_camera, information=information)


def _expected_errors(known: Sight, location: Location, camera: Camera) -> FloatArray:
    """Rms error (N,) [px] that the noise, the pose and the map's own uncertainty explain."""
    n = len(known.markers)
    T = np.broadcast_to(location.T_map_camera, (n, 4, 4))
    _, J_camera, J_marker = linearise(camera, T, known.T_map_marker, known.sizes)
    noise = np.trace(known.covariances, axis1=-2, axis2=-1).sum(axis=-1)
    pose = np.sum(J_camera @ location.covariance * J_camera, axis=(1, 2))
    marker = np.sum(J_marker @ known.map_covariances * J_marker, axis=(1, 2))
    variance = 0.25 * (noise + pose + marker)
    return np.asarray(np.sqrt(np.nan_to_num(variance) + INCONSISTENT_PX**2))
