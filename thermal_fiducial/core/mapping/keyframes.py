"""Frames kept for the joint refinement: few enough for hours, different enough to hold the map together."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.geometry.se3 import inverse
from thermal_fiducial.core.types import FloatArray, IntArray

# Side of a cell of camera positions [m] and of viewing directions [components of a unit vector] to begin with.
_CELL_M = 0.25
_CELL_DIRECTION = 0.25
# Share of the budget to which the store is thinned, so that it is thinned seldom.
_THINNED = 0.85


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


def packed(frames: Sequence[Keyframe]) -> tuple[FloatArray | IntArray, ...]:
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


def unpacked(
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


@dataclass(frozen=True)
class Displacement:
    """How an adjustment has moved the map, which after a gap or round a loop is not the same everywhere."""

    #: (n,) of the adjusted keyframes, ascending
    stamps_ns: IntArray
    #: (n, 4, 4) T_new_old near the keyframe of each
    T_new_old: FloatArray

    def at(self, stamp_ns: int) -> FloatArray:
        """T_new_old (4, 4) for poses of the time ``stamp_ns``: that of the nearest keyframe."""
        after = int(np.searchsorted(self.stamps_ns, stamp_ns))
        near = [i for i in (after - 1, after) if 0 <= i < len(self.stamps_ns)]
        return np.asarray(self.T_new_old[min(near, key=lambda i: abs(int(self.stamps_ns[i]) - stamp_ns))])


@dataclass
class KeyframeStore:
    """At most ``budget`` keyframes; of many alike (camera near, direction alike) only as many as there is room for."""

    budget: int
    frames: dict[int, Keyframe] = field(default_factory=dict)
    #: stamps of those that odometry alone joins to the rest: they are never dropped
    bridges: set[int] = field(default_factory=set)
    #: frames that were ever added
    added: int = 0

    def add(self, frame: Keyframe) -> None:
        """Keep ``frame``; thin out when there are too many."""
        self.frames[frame.stamp_ns] = frame
        self.added += 1
        if len(self.frames) > self.budget:
            self._thin(int(_THINNED * self.budget))

    def move(self, adjusted: Mapping[int, FloatArray]) -> Displacement:
        """Take over adjusted poses by stamp; frames that were not adjusted move like the nearest in time.

        Returns
        -------
        How the map has moved at each time.
        """
        stamps = sorted(adjusted.keys() & self.frames.keys())
        if not stamps:
            return Displacement(np.zeros(1, dtype=np.int64), np.eye(4)[None])
        T = np.stack([adjusted[stamp] @ inverse(self.frames[stamp].T_map_rig) for stamp in stamps])
        displacement = Displacement(np.array(stamps, dtype=np.int64), _rigid(T))
        self.frames = {
            stamp: replace(frame, T_map_rig=adjusted.get(stamp, displacement.at(stamp) @ frame.T_map_rig))
            for stamp, frame in self.frames.items()
        }
        return displacement

    def selected(self, views: int) -> tuple[Keyframe, ...]:
        """Keyframes of at most about so many markers' views, spread like all of them."""
        total = sum(len(frame.ids) for frame in self.frames.values())
        if total <= views:
            return tuple(self.frames.values())
        kept = self._spread(max(len(self.frames) * views // total, 1))
        return tuple(frame for stamp, frame in self.frames.items() if stamp in kept)

    def _thin(self, room: int) -> None:
        kept = self._spread(room)
        self.frames = {stamp: frame for stamp, frame in self.frames.items() if stamp in kept}

    def _spread(self, room: int) -> set[int]:
        """Stamps of about ``room`` keyframes from all places and directions, and of all bridges."""
        coarseness = 1.0
        while len(cells := self._cells(coarseness)) > room:
            coarseness *= 2.0
        share = _fair_share([len(stamps) for stamps in cells.values()], room)
        kept = self.bridges & self.frames.keys()
        for stamps in cells.values():
            chosen = np.linspace(0, len(stamps) - 1, min(share, len(stamps))).round().astype(int)
            kept.update(stamps[i] for i in chosen)
        return kept

    def _cells(self, coarseness: float) -> dict[tuple[int, ...], list[int]]:
        """Stamps of the keyframes by cell of camera position and viewing direction."""
        T = np.stack([frame.T_map_rig for frame in self.frames.values()])
        scaled = np.concatenate([T[:, :3, 3] / _CELL_M, T[:, :3, 2] / _CELL_DIRECTION], axis=-1) / coarseness
        cells: dict[tuple[int, ...], list[int]] = defaultdict(list)
        for stamp, key in zip(self.frames, np.floor(scaled).astype(int).tolist(), strict=True):
            cells[tuple(key)].append(stamp)
        return cells


def _rigid(T: FloatArray) -> FloatArray:
    """Transforms (n, 4, 4) freed of what rounding has made of their rotations: else it doubles with every product."""
    U, _, Vt = np.linalg.svd(T[:, :3, :3])
    result = T.copy()
    result[:, :3, :3] = U @ Vt
    return result


def _fair_share(counts: list[int], room: int) -> int:
    """The largest number that each cell may keep so that all together fit into ``room``; at least one."""
    share = 1
    while sum(min(count, share + 1) for count in counts) <= room and share < max(counts):
        share += 1
    return share
