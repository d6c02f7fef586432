"""Markers that the map doesn't have yet: each frame is shown to the candidates, and some of them are judged."""

from collections.abc import Mapping

from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.mapping.candidates import Candidate, MarkerView, Viewpoint
from thermal_fiducial.core.mapping.keyframes import Displacement
from thermal_fiducial.core.mapping.map_data import MapMarker
from thermal_fiducial.core.measurements import corner_covariances, corners_px, marker_branches, Markers
from thermal_fiducial.core.types import FloatArray

#: Candidates that are judged in one frame: bounds its time when many are new.
TRIALS = 3
#: Candidates at most, more than the largest dictionaries have markers in use: what was seen in passing, or is none at
#: all, is forgotten before it fills the memory, that of the longest ago first.
MOST = 1000


class NewMarkers:
    """All markers on trial.

    Parameters
    ----------
    size, sizes : side of a marker [m], and by ID of those that differ
    """

    def __init__(self, size: float, sizes: Mapping[int, float]) -> None:
        self._size, self._sizes = size, sizes
        self.candidates: dict[int, Candidate] = {}

    def show(
        self, stamp_ns: int, rows: Markers, camera: Camera, viewpoint: Viewpoint
    ) -> tuple[list[MapMarker], dict[int, str]]:
        """Show a frame's rows to their candidates.

        Returns
        -------
        Those that the views have settled by now, as markers of the map, and what the others wait for, in words by ID.
        """
        branches, corners, covariances = marker_branches(rows), corners_px(rows), corner_covariances(rows)
        shown = []
        for i, marker_id in enumerate(rows['id'].tolist()):
            size = self._sizes.get(marker_id, self._size)
            candidate = self.candidates.setdefault(marker_id, Candidate(marker_id, size))
            candidate.add(MarkerView(stamp_ns, viewpoint, corners[i], covariances[i], branches[i]))
            shown.append(candidate)
        placed = []
        for candidate in sorted(shown, key=lambda c: -c.untried)[:TRIALS]:
            if not candidate.untried:
                continue
            placement = candidate.place(camera)
            candidate.reason = placement.reason
            if placement.T_map_marker is not None:
                placed.append(entry(stamp_ns, candidate, placement.T_map_marker, placement.covariance))
                del self.candidates[candidate.id]
        while len(self.candidates) > MOST:
            del self.candidates[min(self.candidates, key=lambda key: self.candidates[key].views[-1].stamp_ns)]
        return placed, {c.id: c.reason for c in shown if c.id in self.candidates}

    def move(self, displacement: Displacement) -> None:
        """The map moved: each candidate's views move with the frames of their time."""
        for candidate in self.candidates.values():
            candidate.move(displacement)


def entry(stamp_ns: int, candidate: Candidate, T_map_marker: FloatArray, covariance: FloatArray) -> MapMarker:
    """A candidate as a marker of the map."""
    return MapMarker(
        candidate.id, candidate.size, False, T_map_marker, covariance, first_seen_ns=stamp_ns, last_seen_ns=stamp_ns
    )
