"""What a joint refinement works on: markers and keyframes of one moment, and which of them it can adjust."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from thermal_fiducial.core.error_model import divided_prior, NO_SYSTEMATIC_ERRORS, SystematicErrors
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.mapping.map_data import gauge, MapMarker
from thermal_fiducial.core.types import FloatArray, IntArray


@dataclass(frozen=True)
class CameraRig:
    """Cameras that move as one; a single camera is its own rig."""

    cameras: tuple[Camera, ...]
    #: (C, 4, 4) T_rig_camera of each
    T_rig_camera: FloatArray

    @classmethod
    def single(cls, camera: Camera) -> 'CameraRig':
        """A rig of one camera."""
        return cls((camera,), np.eye(4)[None])


@dataclass(frozen=True)
class Keyframe:
    """What one frame showed, all markers of it, known or not."""

    stamp_ns: int
    T_map_rig: FloatArray
    #: (k,)
    ids: IntArray
    #: (k, 4, 2) [px]
    corners: FloatArray
    #: (k, 4, 2, 2) [px^2]
    covariances: FloatArray
    #: (k,) index of the camera of the rig that saw each
    cameras: IntArray
    #: (4, 4) where the odometry has the rig, and (6, 6) how well it knows: information, zero without any
    T_odometry: FloatArray = field(default_factory=lambda: np.eye(4))
    information: FloatArray = field(default_factory=lambda: np.zeros((6, 6)))

    @property
    def has_odometry(self) -> bool:
        """Whether odometry knows anything of it."""
        return bool(np.any(self.information))


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
        return _snapshot, (self.markers, _packed(self.keyframes), *rest)

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
    return Snapshot(markers, _unpacked(*keyframes), *rest)


def _packed(frames: Sequence[Keyframe]) -> tuple[FloatArray | IntArray, ...]:
    """Keyframes as a few large arrays: thousands of small ones take a process long to hand to another."""
    return (
        np.array([frame.stamp_ns for frame in frames], dtype=np.int64),
        np.array([frame.T_map_rig for frame in frames]).reshape(-1, 4, 4),
        np.array([frame.T_odometry for frame in frames]).reshape(-1, 4, 4),
        np.array([frame.information for frame in frames]).reshape(-1, 6, 6),
        np.array([len(frame.ids) for frame in frames], dtype=np.int64),
        *(
            np.concatenate([getattr(frame, name) for frame in frames]) if frames else np.zeros(0)
            for name in ('ids', 'corners', 'covariances', 'cameras')
        ),
    )


def _unpacked(
    stamps: IntArray,
    T_map_rig: FloatArray,
    T_odometry: FloatArray,
    information: FloatArray,
    counts: IntArray,
    *views: FloatArray | IntArray,
) -> tuple[Keyframe, ...]:
    """The keyframes again."""
    ends = np.cumsum(counts)[:-1]
    parts = [np.split(array, ends) for array in views]
    return (
        tuple(
            Keyframe(*fields)
            for fields in zip(stamps.tolist(), T_map_rig, *parts, T_odometry, information, strict=True)
        )
        if len(stamps)
        else ()
    )


def prior_poses(markers: Mapping[int, MapMarker]) -> dict[int, tuple[FloatArray, FloatArray]]:
    """Pose and covariance (6, 6) of markers that are known from before the keyframes, as a refinement may use them.

    Only each marker's own covariance is kept in a map, not how the errors of two hang together.
    """
    known = [m for m in markers.values() if not m.fixed and np.any(m.covariance)]
    return {m.id: (m.T_map_marker, divided_prior(m.covariance, len(known))) for m in known}
