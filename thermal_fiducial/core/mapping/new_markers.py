"""Markers that the map doesn't have yet: each frame is shown to the candidates, and some of them are judged."""

from collections.abc import Mapping

import numpy as np

from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.mapping.candidates import Candidate, MarkerView, Viewpoint
from thermal_fiducial.core.mapping.keyframes import Displacement
from thermal_fiducial.core.mapping.map_data import MapMarker
from thermal_fiducial.core.measurements import corner_covariances, corners_px, marker_poses, Markers
from thermal_fiducial.core.types import FloatArray

#: Candidates that are judged in one frame: bounds its time when many are new.
TRIALS = 3


class NewMarkers:
    """All markers on trial."""

    def __init__(self) -> None:
        self.candidates: dict[int, Candidate] = {}

    def add(self, stamp_ns: int, rows: Markers, sizes: Mapping[int, float], viewpoint: Viewpoint) -> list[Candidate]:
        """Show a frame's rows to their candidates, markers of ``sizes`` [m]; those candidates."""
        branches = np.stack([marker_poses(rows, ''), marker_poses(rows, 'a')], axis=1)
        corners, covariances = corners_px(rows), corner_covariances(rows)
        shown = []
        for i, marker_id in enumerate(rows['id'].tolist()):
            candidate = self.candidates.setdefault(marker_id, Candidate(marker_id, sizes[marker_id]))
            candidate.add(MarkerView(stamp_ns, viewpoint, corners[i], covariances[i], branches[i]))
            shown.append(candidate)
        return shown

    def judge(self, stamp_ns: int, shown: list[Candidate], camera: Camera) -> list[MapMarker]:
        """Those of the candidates whose views have settled their poses by now."""
        placed = []
        for candidate in sorted(shown, key=lambda c: -c.untried)[:TRIALS]:
            if not candidate.untried:
                continue
            placement = candidate.place(camera)
            candidate.reason = placement.reason
            if placement.T_map_marker is not None:
                placed.append(entry(stamp_ns, candidate, placement.T_map_marker, placement.covariance))
        return placed

    def move(self, displacement: Displacement) -> None:
        """The map moved: each candidate's views move with the frames of their time."""
        for candidate in self.candidates.values():
            candidate.move(displacement)


def entry(stamp_ns: int, candidate: Candidate, T_map_marker: FloatArray, covariance: FloatArray) -> MapMarker:
    """A candidate as a marker of the map."""
    return MapMarker(
        candidate.id, candidate.size, False, T_map_marker, covariance, first_seen_ns=stamp_ns, last_seen_ns=stamp_ns
    )
