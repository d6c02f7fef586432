"""Frames that the mapper remembers for the joint refinement, and when that is due."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from thermal_fiducial.core.error_model import alike_odometry, SystematicErrors
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.mapping.keyframes import CameraRig, Displacement, Keyframe, KeyframeStore
from thermal_fiducial.core.mapping.map_data import MarkerMap
from thermal_fiducial.core.mapping.marker_views import Viewpoint
from thermal_fiducial.core.mapping.odometry_prior import growth, PredictedCamera
from thermal_fiducial.core.mapping.snapshot import prior_poses, Snapshot
from thermal_fiducial.core.measurements import CameraPose, corner_covariances, corners_px, Markers
from thermal_fiducial.core.types import FloatArray, SECOND_NS

# A refinement is worth its time when so many keyframes have come since the last one, as a share of it and in number.
_GROWTH, _FEW = 0.2, 15
#: Views of markers that a refinement in flight takes: a second or two of a slow core.
VIEWS = 10_000
# Time between two refinements for each view of the last [s]: a view takes a third of it on a slow core. With three
# times as much, poses from markers just placed along a chain were too vague to publish: 19 of 633 over a carpet.
_PERIOD_A_VIEW = 3e-4


class FrameMemory:
    """What was seen where.

    Parameters
    ----------
    budget : keyframes at most
    marker_map : the map to begin with
    """

    def __init__(self, budget: int, marker_map: MarkerMap) -> None:
        self._keyframes = KeyframeStore(budget)
        self._cameras: list[Camera] = []
        #: when the map last learned from known markers [ns]; None: not yet
        self._last_ns: int | None = None
        #: the odometry when the first marker was seen of those that nothing else joins to the map
        self._gap: CameraPose | None = None
        self._priors = prior_poses(marker_map.markers)
        self._refined_ns, self._refined_frames, self._refined_markers = 0, 0, len(marker_map.markers)
        self._added_then, self._refined_views = 0, 0

    def keep(self, rows: Markers, pose: CameraPose, camera: Camera, predicted: PredictedCamera | None) -> None:
        """Keep a frame whose camera is known; of one marker alone a refinement can learn nothing."""
        self._last_ns, self._gap = pose.stamp_ns, None
        if len(rows) >= 2:
            self._keyframes.add(self._keyframe(rows, pose, camera, predicted))

    def bridge(self, rows: Markers, camera: Camera, predicted: PredictedCamera, *, first: bool) -> Viewpoint:
        """Keep a frame without a known marker; from where its markers are seen.

        Nothing but the odometry joins its markers to the map. Once, for the ``first`` of them, that counts in full: its
        error is the same for all that follow, which hang together through the markers themselves.
        """
        keyframe = self._keyframe(rows, predicted.pose, camera, predicted)
        if first:
            information = np.asarray(np.linalg.inv(predicted.pose.covariance), dtype=np.float64)
            self._keyframes.bridges.add(keyframe.stamp_ns)
            self._keyframes.add(replace(keyframe, information=information))
        elif len(rows) >= 2:
            self._keyframes.add(keyframe)
        if self._gap is None:
            self._gap = predicted.pose
        # What the odometry had gathered when the gap's first marker came is the same for all its views.
        return Viewpoint.known(predicted.pose.T_map_camera, growth(self._gap, predicted), self._gap.covariance)

    def bridgeable(self, stamp_ns: int, longest: float) -> bool:
        """Whether known markers were in view not more than ``longest`` [s] before."""
        return self._last_ns is not None and 0 <= stamp_ns - self._last_ns <= longest * SECOND_NS

    def refinement_due(self, stamp_ns: int, period: float, markers: int) -> bool:
        """Whether a refinement is worth its time, ``period`` [s] after the last or more, for so many markers."""
        if not self._keyframes.frames or period == 0.0:
            return False
        if stamp_ns - self._refined_ns < max(period, _PERIOD_A_VIEW * self._refined_views) * SECOND_NS:
            return False
        enough = self._keyframes.added - self._added_then >= _GROWTH * self._refined_frames + _FEW
        return enough or markers > self._refined_markers

    def snapshot(self, marker_map: MarkerMap, errors: SystematicErrors, views: int) -> Snapshot | None:
        """What a refinement works on, with about so many views of markers at most; None: nothing yet."""
        if not self._keyframes.frames:
            return None
        frames = self._keyframes.selected(views)
        self._refined_ns = next(reversed(self._keyframes.frames))
        self._refined_frames, self._refined_markers = len(self._keyframes.frames), len(marker_map.markers)
        self._refined_views = sum(len(frame.ids) for frame in frames)
        self._added_then = self._keyframes.added
        return Snapshot(
            {key: marker for key, marker in marker_map.markers.items() if marker.trusted},
            frames,
            CameraRig(tuple(self._cameras), np.broadcast_to(np.eye(4), (len(self._cameras), 4, 4))),
            self._priors,
            marker_map.revision,
            errors,
        )

    def move(self, adjusted: Mapping[int, FloatArray]) -> Displacement:
        """Go along with a refinement, poses (4, 4) by stamp: how the map has moved at each time."""
        return self._keyframes.move(adjusted)

    def _keyframe(self, rows: Markers, pose: CameraPose, camera: Camera, predicted: PredictedCamera | None) -> Keyframe:
        frame = Keyframe(
            pose.stamp_ns,
            pose.T_map_camera,
            rows['id'].astype(np.int64),
            corners_px(rows),
            corner_covariances(rows),
            np.full(len(rows), self._index(camera)),
        )
        if predicted is None:
            return frame
        information = np.asarray(np.linalg.inv(alike_odometry(predicted.pose.covariance)), dtype=np.float64)
        return replace(frame, T_odometry=predicted.pose.T_map_camera, information=information)

    def _index(self, camera: Camera) -> int:
        """Index of ``camera`` among those of the keyframes: a calibration may change, or frames of several come.

        One that no keyframe needs any more makes room for the next: there are no more than keyframes.
        """
        for index, known in enumerate(self._cameras):
            if camera is known or camera.matches(known):
                return index
        used = {int(index) for frame in self._keyframes.frames.values() for index in frame.cameras[:1]}
        free = next((index for index in range(len(self._cameras)) if index not in used), len(self._cameras))
        self._cameras[free:] = [camera, *self._cameras[free + 1 :]]
        return free
