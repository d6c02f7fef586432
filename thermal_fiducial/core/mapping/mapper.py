"""The incremental marker map: Algorithm 1 of the paper.

S. Khattak, C. Papachristos, K. Alexis, "Marker based thermal-inertial localization for aerial robots in obscurant
filled environments", ISVC 2018. For every frame: split the markers into known and new, find the camera from all known
ones jointly, weight each by its present and running re-projection error, refine, update the errors, and place new
markers that are seen together with known ones. Beyond the paper: planar ambiguities are settled before anything rests
on them, covariances carry the map's own uncertainty, and markers that stop agreeing are put in quarantine.
"""

from dataclasses import replace
import sys

import numpy as np

from thermal_fiducial.config import MarkerMapperConfig, size_overrides
from thermal_fiducial.core.error_model import positive, SystematicErrors
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.geometry.se3 import transform_from_quaternion
from thermal_fiducial.core.mapping.bundle_adjustment import AdjustedMap, refine
from thermal_fiducial.core.mapping.candidates import Candidate, Viewpoint
from thermal_fiducial.core.mapping.corner_bias import CornerBias
from thermal_fiducial.core.mapping.frame_memory import FrameMemory, VIEWS
from thermal_fiducial.core.mapping.localization import expected_errors, locate, reprojection_errors
from thermal_fiducial.core.mapping.located import Located, LocatedFrame, Location, Refusal, Sight
from thermal_fiducial.core.mapping.map_alignment import align
from thermal_fiducial.core.mapping.map_data import MapJump, MapMarker, MapperResult, MarkerMap
from thermal_fiducial.core.mapping.motion import CameraMotion
from thermal_fiducial.core.mapping.new_markers import entry, NewMarkers
from thermal_fiducial.core.mapping.odometry_prior import (
    contradicts,
    growth,
    predicted_camera,
    PredictedCamera,
)
from thermal_fiducial.core.mapping.snapshot import Snapshot
from thermal_fiducial.core.mapping.trust import DISAGREEMENT, inconsistent, MEMORY, Trust
from thermal_fiducial.core.measurements import (
    CameraPose,
    corner_covariances,
    corners_px,
    marker_poses,
    Markers,
    usable,
)
from thermal_fiducial.core.motion_prior import MotionPrior
from thermal_fiducial.core.types import FloatArray
from thermal_fiducial.errors import InputError

__all__ = ['MapJump', 'MapMarker', 'MapperResult', 'MarkerMap', 'MarkerMapper']

#: A pose of the past decides between alternative poses for this long [ns].
CONTINUITY_NS = 300_000_000
#: Why nothing is learned from a frame that has a pose.
CONTRADICTED = 'the known markers in view contradict the odometry'


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
        self._new = NewMarkers()
        self._trust = Trust()
        self._trust.start(self.map.markers)
        self._last: CameraPose | None = None
        #: whether odometry has been in this map
        self._odometry_agreed = False
        self._motion = CameraMotion()
        self._bias = CornerBias(SystematicErrors())
        self._gap: CameraPose | None = None
        self._memory = FrameMemory(self.config.keyframe_budget, self._initial)

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
            self._memory.keep(frame.rows, pose, frame.camera, predicted)
            placed, waiting = self._place_new(frame, _viewpoint(location))
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
        return Sight(known, corners_px(rows), corner_covariances(rows), branches)

    def _update_errors(self, frame: LocatedFrame, location: Location) -> FloatArray:
        """Re-projection error (N,) [px] of each known marker, taken into its statistics."""
        known = frame.known
        errors = reprojection_errors(known, frame.camera, location.T_map_camera)
        self._trust.add_errors(known.markers, errors)
        if not self.frozen:
            for marker in known.markers:
                self.map.markers[marker.id] = marker.seen(frame.stamp_ns, self._trust.running_error(marker))
        return errors

    def _judge(self, frame: LocatedFrame, errors: FloatArray, location: Location) -> bool:
        """Quarantine markers that persistently disagree; whether any standing changed."""
        known = frame.known
        if len(known.markers) < 2:
            return False
        explained = expected_errors(known, location, frame.camera)
        blamed = inconsistent(errors > DISAGREEMENT * explained, frame.trusted, known.markers)
        changes = self._trust.judge(known.markers, blamed.tolist())
        for marker, error, sigma in zip(known.markers, errors, explained, strict=True):
            if marker.id in changes:
                reason = f'{error:.1f} px off, {error / sigma:.1f} sigma, in most of the last {1.0 / MEMORY:.0f} frames'
                self._trust.set_standing(self.map.markers, marker.id, '' if changes[marker.id] else reason)
        return bool(changes)

    def _place_new(self, frame: LocatedFrame, viewpoint: Viewpoint) -> tuple[bool, dict[int, str]]:
        """Show new markers to their candidates; whether any entered the map, and what the others wait for."""
        sizes = {key: self._sizes.get(key, self.config.marker_size) for key in frame.new['id'].tolist()}
        shown = self._new.add(frame.stamp_ns, frame.new, sizes, viewpoint)
        placed = self._new.judge(frame.stamp_ns, shown, frame.camera)
        for marker in placed:
            self._take_in(marker)
        self.map.revision += bool(placed)
        return bool(placed), {c.id: c.reason for c in shown if c.id in self._new.candidates}

    def _without_pose(self, frame: LocatedFrame, refusal: Refusal) -> tuple[bool, dict[int, str]]:
        """What a frame without a pose may still teach of new markers."""
        predicted, last = frame.predicted, self._memory.last
        if self.frozen or not len(frame.new):
            return False, {}
        if refusal.alternatives is not None and refusal.covariances is not None:
            return self._place_new(frame, Viewpoint(refusal.alternatives, refusal.covariances))
        if predicted is None or last is None:
            return False, {}
        if not 0 <= frame.stamp_ns - last.stamp_ns <= self.config.bridge_duration * 1e9:
            return False, {}
        return self._bridge(frame, predicted)

    def _bridge(self, frame: LocatedFrame, predicted: PredictedCamera) -> tuple[bool, dict[int, str]]:
        """Place new markers from the odometry while no known one is in view."""
        pose = predicted.pose
        first = not any(int(key) in self._new.candidates for key in frame.new['id'])
        self._memory.bridge(frame.new, frame.camera, predicted, first=first)
        if self._gap is None:
            self._gap = pose
        # What the odometry had gathered when the gap's first marker came is the same for all its views.
        viewpoint = Viewpoint.known(pose.T_map_camera, growth(self._gap, predicted))
        return self._place_new(frame, replace(viewpoint, common=self._gap.covariance))

    def refinement_due(self, stamp_ns: int) -> bool:
        """Whether enough has been seen since the last joint refinement for another to be worth its time."""
        if self.frozen:
            return False
        return self._memory.refinement_due(stamp_ns, self.config.refinement_period, len(self.map.markers))

    def snapshot(self, views: int = VIEWS) -> Snapshot | None:
        """What a refinement works on, for ``bundle_adjustment.refine``; None: nothing yet.

        The snapshot is immutable: the refinement may run elsewhere while frames are processed.

        Parameters
        ----------
        views : about so many views of markers at most, which bounds its time
        """
        return self._memory.snapshot(self.map, self._errors, views)

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
                    self._trust.set_standing(
                        self.map.markers, marker_id, f'{share:.0f} % of its views contradict the joint refinement'
                    )
        displacement, T_new_old = self._memory.move(refinement, before, self.map.markers)
        self._new.move(displacement)
        if self._last is not None:
            self._last = replace(self._last, T_map_camera=T_new_old @ self._last.T_map_camera)
        self._motion = CameraMotion()
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
        return dict(self._new.candidates)

    def enter(self, stamp_ns: int, candidate: Candidate, T_map_marker: FloatArray, covariance: FloatArray) -> None:
        """Take a candidate into the map."""
        self._take_in(entry(stamp_ns, candidate, T_map_marker, covariance))

    def _take_in(self, marker: MapMarker) -> None:
        self._new.candidates.pop(marker.id, None)
        self._trust.forget([marker.id])
        self.map.markers[marker.id] = marker

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
            tuple(sorted(self._trust.quarantined)),
            self.map.revision,
            self.resets,
            dict(self._trust.quarantined),
            not self.frozen and bool(changed or residuals),
        )


def _viewpoint(location: Location) -> Viewpoint:
    """The camera where the markers have it: what is not relative to the map is an error that all views share."""
    relative = location.errors.relative
    common = positive(location.covariance - relative)
    return replace(Viewpoint.known(location.T_map_camera, relative), common=common)
