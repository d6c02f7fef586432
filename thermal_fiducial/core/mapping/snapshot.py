"""What a joint refinement works on: markers and keyframes of one moment, and which of them it can adjust."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from thermal_fiducial.core.error_model import divided_prior, NO_SYSTEMATIC_ERRORS, SystematicErrors
from thermal_fiducial.core.mapping.keyframes import CameraRig, Keyframe, packed, unpacked
from thermal_fiducial.core.mapping.map_data import MapMarker
from thermal_fiducial.core.types import BoolArray, FloatArray


@dataclass(frozen=True)
class Snapshot:
    """What a refinement works on. Immutable throughout; can be pickled."""

    #: the markers to adjust
    markers: Mapping[int, MapMarker]
    keyframes: tuple[Keyframe, ...]
    rig: CameraRig
    #: pose and covariance (6, 6) by ID of markers that were known beforehand; see :func:`prior_poses`
    priors: Mapping[int, tuple[FloatArray, FloatArray]] = field(default_factory=dict)
    map_revision: int = 0
    #: what the covariances are to allow for beside the noise
    errors: SystematicErrors = NO_SYSTEMATIC_ERRORS

    def __reduce__(self) -> tuple[Any, ...]:
        rest = (self.rig, self.priors, self.map_revision, self.errors)
        return _snapshot, (self.markers, packed(self.keyframes), *rest)

    @property
    def useful(self) -> list[Keyframe]:
        """Keyframes that say anything of the map and hang together with what is held.

        That is two of its markers in one, or one and odometry. What has lost its connection stays where it is.
        """
        seen = {frame.stamp_ns: {int(key) for key in frame.ids} & self.markers.keys() for frame in self.keyframes}
        frames = [f for f in self.keyframes if len(seen[f.stamp_ns]) >= 2 or (seen[f.stamp_ns] and f.has_odometry)]
        markers = [self.markers[key] for key in sorted(set().union(*(seen[f.stamp_ns] for f in frames)))]
        reached = {m.id for m, held in zip(markers, gauge(markers), strict=True) if held} | self.priors.keys()
        reached |= set().union(*(seen[f.stamp_ns] for f in frames if f.has_odometry))
        before = -1
        while len(reached) > before:
            before = len(reached)
            reached |= set().union(*(seen[f.stamp_ns] for f in frames if seen[f.stamp_ns] & reached))
        return [f for f in frames if seen[f.stamp_ns] & reached]


def _snapshot(markers: Mapping[int, MapMarker], keyframes: tuple[Any, ...], *rest: Any) -> Snapshot:
    return Snapshot(markers, unpacked(*keyframes), *rest)


def prior_poses(markers: Mapping[int, MapMarker]) -> dict[int, tuple[FloatArray, FloatArray]]:
    """Pose and covariance (6, 6) of markers that are known from before the keyframes, as a refinement may use them.

    Only each marker's own covariance is kept in a map, not how the errors of two hang together.
    """
    known = [m for m in markers.values() if not m.fixed and np.any(m.covariance)]
    return {m.id: (m.T_map_marker, divided_prior(m.covariance, len(known))) for m in known}


def gauge(markers: list[MapMarker]) -> BoolArray:
    """Which markers are held: fixed ones and those known exactly; failing these, the one known best."""
    held = np.array([m.fixed or not np.any(m.covariance) for m in markers], dtype=bool)
    if markers and not np.any(held):
        held[int(np.argmin([np.trace(m.covariance) for m in markers]))] = True
    return held
