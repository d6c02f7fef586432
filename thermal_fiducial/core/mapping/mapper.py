"""The incremental marker map: Algorithm 1 of the paper.

S. Khattak, C. Papachristos, K. Alexis, "Marker based thermal-inertial localization for aerial robots in obscurant
filled environments", ISVC 2018. For every frame: split the markers into known and new ones, estimate the camera pose
from all known ones jointly, weight each by its re-projection error, refine, update the errors, and place new markers
observed together with known ones. Beyond the paper: planar ambiguities are resolved before a marker
enters the map, covariances contain the map's uncertainty, and inconsistent markers are put in quarantine.
"""

from dataclasses import replace
from functools import partial
import sys

import numpy as np

from thermal_fiducial.config import MarkerMapperConfig, size_overrides
from thermal_fiducial.core.error_model import SystematicErrors
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.geometry.se3 import camera_in_body
from thermal_fiducial.core.lens_errors import without_found_aspect
from thermal_fiducial.core.mapping.adjustment_problem import Snapshot
from thermal_fiducial.core.mapping.bundle_adjustment import AdjustedMap, FoundAspect, refine
from thermal_fiducial.core.mapping.candidates import Candidate, NewMarkers
from thermal_fiducial.core.mapping.consistency import Consistency, from_consistent_markers
from thermal_fiducial.core.mapping.corner_bias import CornerBias
from thermal_fiducial.core.mapping.keyframes import KeyframeStore, VIEWS
from thermal_fiducial.core.mapping.localization import locate
from thermal_fiducial.core.mapping.located import LocatedFrame, Location, Refusal, Sight
from thermal_fiducial.core.mapping.map_data import jump, MapMarker, MapperResult, MarkerMap
from thermal_fiducial.core.mapping.marker_views import Viewpoint
from thermal_fiducial.core.mapping.undeclared_readout import UndeclaredReadout
from thermal_fiducial.core.measurements import Markers, Observations
from thermal_fiducial.core.motion_prior import MotionPrior, predicted_camera
from thermal_fiducial.core.types import BoolArray, FloatArray

#: Reason for which the map is not updated from a frame with a pose.
CONTRADICTED = 'the known markers in view contradict the odometry'
#: ID of a new marker in view to the reason, in words, for which it is not in the map yet.
Waiting = dict[int, str]


class MarkerMapper:
    """Camera pose from the map, and the map from camera poses.

    Parameters
    ----------
    config : sizes, mode, extrinsics
    marker_map : the map to start from, with at least one marker; it is copied

    Raises
    ------
    InputError
        A marker of the map is unusable.
    """

    def __init__(self, config: MarkerMapperConfig, marker_map: MarkerMap) -> None:
        marker_map.require_usable()
        self.configure(config)
        #: while True the map does not change but for its quarantine; ``config.mode`` gives the initial value
        self.frozen = config.mode == 'localization'
        self._owns_map = True
        self.resets = 0
        self._begin(marker_map)

    def configure(self, config: MarkerMapperConfig) -> None:
        """Take over the dynamic parameters of ``config``, and the pose of the camera on the robot."""
        self.config = config
        self._T_body_camera = camera_in_body(config)

    def reset(self) -> FloatArray | None:
        """Return to the initial map; see :meth:`load`."""
        return self.load(self._initial)

    def load(self, marker_map: MarkerMap) -> FloatArray | None:
        """Replace the map by another one of the place, with the next revision; keyframes and statistics are dropped.

        Returns
        -------
        T_new_old (4, 4), which moves poses from the old map to the new, by the markers that both have; None if there
        are none.
        """
        T_new_old = jump(marker_map.markers, self.map.markers)
        self._begin(replace(marker_map, revision=max(self.map.revision, marker_map.revision) + 1))
        self.resets += 1
        return T_new_old

    def _begin(self, marker_map: MarkerMap) -> None:
        self._bias = CornerBias()
        #: what a rolling shutter is declared too short by
        self.readout = UndeclaredReadout(self.config.readout_time_std)
        self._found: FoundAspect | None = None
        self._initial, self.map = marker_map.copy(), marker_map.with_assumed_draws(self.errors)
        self._new = NewMarkers(self.config.marker_size, size_overrides(self.config.marker_size_overrides))
        self._consistency = Consistency(self.map.markers)
        self._keyframes = KeyframeStore(self.config.keyframe_budget, self.map)
        #: frames with two possible poses that candidates have views of, by stamp
        self._doubtful: dict[int, LocatedFrame] = {}

    def use_map_of(self, owner: 'MarkerMapper') -> None:
        """Locate in the map of ``owner`` as it is now, and change nothing in it, quarantine included.

        Which markers agree with odometry, and which one is misplaced, both learn together: one robot carries them.
        """
        self.map, self._consistency = owner.map, owner._consistency
        self.frozen, self._owns_map = True, False

    def process(
        self, stamp_ns: int, markers: Markers, camera: Camera, prior: MotionPrior | None = None
    ) -> MapperResult:
        """One frame of Algorithm 1.

        Parameters
        ----------
        markers : (N,) of MARKER_DTYPE
        camera : its intrinsics
        prior : the filter's odometry and clock offset; resolves ambiguities, bridges gaps between known markers. None
            for pictures of a camera that stands still
        """
        return self.learn(self.locate(stamp_ns, markers, camera, prior))

    def locate(self, stamp_ns: int, markers: Markers, camera: Camera, prior: MotionPrior | None = None) -> LocatedFrame:
        """First half of :meth:`process`, up to the pose, which can be published before the map is updated."""
        predicted = predicted_camera(prior, stamp_ns, self._T_body_camera, self.config.time_offset_std)
        raw, errors = Observations.of(markers), self._errors_of(camera)
        # Pictures without any odometry are of a camera that stands still.
        raw = raw if prior is None else self.readout.with_readout_derivative(stamp_ns, raw, camera, predicted)
        observed = self.readout.corrected(raw, predicted)
        observed = replace(observed, corners=without_found_aspect(observed.corners, camera, errors))
        # Step 2: known and new markers.
        is_known, known = self._in_map(observed)
        # Steps 3 to 6: the camera from all known ones, weighted by their errors.
        sight = known if known.trusted.all() else known.only(known.trusted)
        outcome: Location | Refusal = Refusal('no known marker in view')
        if len(sight.sizes):
            odometry = None if predicted is None else predicted.pose
            fit = partial(locate, stamp_ns, camera=camera, errors=errors, odometry=odometry)
            outcome = from_consistent_markers(sight, camera, predicted, fit)
        elif len(known.sizes):
            outcome = Refusal('all known markers in view are in quarantine')
        elif not self.map.markers:
            outcome = Refusal('the map has no marker: give a map file with at least one')
        frame = LocatedFrame(stamp_ns, camera, raw, observed, is_known, known, predicted, outcome)
        return self._consistency.checked(frame)

    def _in_map(self, observed: Observations) -> tuple[BoolArray, Sight]:
        """Which of N markers are in the map, (N,), and these with their entries."""
        is_known = np.array([key in self.map.markers for key in observed.ids.tolist()], dtype=np.bool_)
        return is_known, Sight.of(observed if is_known.all() else observed.only(is_known), self.map)

    @property
    def errors(self) -> SystematicErrors:
        """Systematic errors as declared, those of corners as learned so far."""
        config = self.config
        return SystematicErrors(
            self._bias.px,
            marker_size_std=config.marker_size_std,
            focal_length_std=config.focal_length_std,
            readout_time_std=config.readout_time_std,
            likely_corner_px=self._bias.likely_px,
        )

    def _errors_of(self, camera: Camera) -> SystematicErrors:
        """Those of frames of ``camera``."""
        found = self._found
        if found is None or not camera.matches(found.camera):
            return self.errors
        return replace(self.errors, aspect_found=found.share, aspect_left=found.left)

    def learn(self, frame: LocatedFrame) -> MapperResult:
        """Second half of :meth:`process`: updates errors, quarantine and new markers with the frame located last."""
        outcome, waiting = frame.outcome, Waiting()
        changed = updated = False
        if isinstance(outcome, Refusal):
            changed, waiting = self._without_pose(frame, outcome)
        elif frame.contradicts_odometry and self._consistency.odometry_agreed:
            # Probably a moved or duplicated marker: an update would corrupt the map.
            waiting = dict.fromkeys(frame.new.ids.tolist(), CONTRADICTED)
        else:
            updated = True
            # Step 7: errors updated.
            self._bias.add(outcome)
            ids, (errors, error_stds) = frame.known.observed.ids.tolist(), frame.known_errors
            if self._owns_map:
                used = outcome.pose.marker_ids
                changed = self._consistency.judge(self.map.markers, ids, errors, error_stds, used)
            # Step 8: new markers placed relative to the camera.
            if not self.frozen:
                for key, error in zip(ids, errors.tolist(), strict=True):
                    self.map.markers[key] = self.map.markers[key].observed(frame.stamp_ns, error)
                self._keyframes.keep(frame.raw, outcome.pose, frame.camera, frame.predicted)
                if not frame.is_known.all():
                    placed, waiting = self._place_new(frame, outcome.viewpoint)
                    changed |= placed
        self._consistency.add(frame)
        if self._owns_map:
            self._consistency.weigh_map(frame)
        if isinstance(outcome, Location):
            # Also where its pose contradicts the odometry: in fast motion this may be why.
            self.readout.add(outcome, frame.predicted)
        return MapperResult(
            frame.stamp_ns, frame.pose, frame.reason, changed, frozenset(frame.known.observed.ids.tolist()), waiting,
            dict(self._consistency.quarantined), not self.frozen and (changed or updated),
        )  # fmt: skip

    def _place_new(self, frame: LocatedFrame, viewpoint: Viewpoint) -> tuple[bool, Waiting]:
        """Add views to the candidates of new markers; whether any entered the map, and what the others wait for."""
        placed, waiting = self._new.add_views(
            frame.stamp_ns, frame.new, frame.camera, viewpoint, self._errors_of(frame.camera)
        )
        self.map.markers |= {marker.id: marker for marker in placed}
        self.map.revision += bool(placed)
        if placed:
            self._settle([marker.id for marker in placed])
        if self._doubtful:
            needed = self._new.stamps_ns
            self._doubtful = {key: frame for key, frame in self._doubtful.items() if key in needed}
        return bool(placed), waiting

    def _settle(self, placed: list[int]) -> None:
        """Make keyframes of frames that had two possible poses, where the markers just ``placed`` settle which.

        An adjustment without them would know less of these markers than their placement did.
        """
        showing = {key: frame for key, frame in self._doubtful.items() if np.isin(frame.observed.ids, placed).any()}
        for key, frame in showing.items():
            _, known = self._in_map(frame.observed)
            outcome = locate(key, known.only(known.trusted), frame.camera, self._errors_of(frame.camera))
            if isinstance(outcome, Location) and outcome.settled:
                self._keyframes.settle(frame.raw, outcome.pose, frame.camera)
                del self._doubtful[key]

    def _without_pose(self, frame: LocatedFrame, refusal: Refusal) -> tuple[bool, Waiting]:
        """Views of new markers from a frame without a pose: with two possible camera poses, or one by odometry."""
        predicted, longest = frame.predicted, self.config.bridge_duration
        if self.frozen or frame.is_known.all():
            return False, {}
        if refusal.viewpoint is not None:
            self._doubtful[frame.stamp_ns] = frame
            return self._place_new(frame, refusal.viewpoint)
        if predicted is None or not self._keyframes.bridgeable(frame.stamp_ns, longest):
            return False, {}
        # No known marker is in view: the camera pose is that of the odometry.
        first = not any(key in self._new.candidates for key in frame.new.ids.tolist())
        return self._place_new(
            frame, self._keyframes.bridge(frame.raw.only(~frame.is_known), frame.camera, predicted, first=first)
        )

    def refinement_due(self, stamp_ns: int) -> bool:
        """Whether there are enough new keyframes since the last bundle adjustment for another."""
        if self.frozen:
            return False
        return self._keyframes.refinement_due(stamp_ns, self.config.refinement_period, len(self.map.markers))

    @property
    def has_unrefined(self) -> bool:
        """Whether the map may be refined with keyframes that no bundle adjustment has had."""
        return not self.frozen and self.config.refinement_period > 0.0 and self._keyframes.grown

    def snapshot(self, views: int = VIEWS) -> Snapshot | None:
        """Input of ``bundle_adjustment.refine``; None without keyframes.

        The snapshot is immutable: the refinement may run elsewhere while frames are processed.

        Parameters
        ----------
        views : approximate largest number of views of markers, which bounds the time
        """
        return self._keyframes.snapshot(self.map, self.errors, views, self.readout.estimate.seconds)

    def refine(self, views: int = sys.maxsize) -> AdjustedMap | None:
        """Run a bundle adjustment here, of so many ``views`` as :meth:`snapshot` takes, and apply it."""
        snapshot = self.snapshot(views)
        refinement = refine(snapshot) if snapshot is not None else None
        if refinement is not None:
            self.apply(refinement)
        return refinement

    def apply(self, refinement: AdjustedMap) -> bool:
        """Take over a refinement: markers, keyframes and candidates move together.

        Returns
        -------
        False where the map is frozen, or was replaced since.
        """
        if self.frozen or refinement.map_revision < self._initial.revision:
            return False
        before = dict(self.map.markers)
        self.map.adjust(refinement.markers)
        self._found = refinement.aspect
        self.readout.adopt(refinement.readout)
        self._consistency.quarantine(self.map.markers, refinement.inconsistent)
        self._new.move(self._keyframes.move(refinement.keyframes, before, self.map.markers))
        self.resets += 1
        return True

    @property
    def doubt_of_map(self) -> str:
        """Why there is no pose from the map, which most markers contradict; empty if it may be used."""
        return self._consistency.of_map.doubt

    @property
    def candidates(self) -> dict[int, Candidate]:
        """Candidates: new markers that are not in the map yet, by ID."""
        return dict(self._new.candidates)

    def enter(self, marker: MapMarker) -> None:
        """Take a candidate into the map, as ``marker``."""
        del self._new.candidates[marker.id]
        self.map.markers[marker.id] = marker
        self.map.revision += 1
