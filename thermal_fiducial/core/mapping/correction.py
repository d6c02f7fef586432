"""By how much a refinement of the map moves those who stand on it.

Poses near the robot move like the localization of its last frames: the same corners, located in the old map and in the
new one. Where fixed markers alone carry it nothing moves, however much the adjustment has changed its mind about where
the frames were taken. A filter that the new map does not contradict is left alone: it never stood on what was poorly
known, and weighs what it knows from gravity and inertia against the poses that follow. Else it gets the share of the
movement that brings it nearest to where the new map has those frames. Poses of older frames that are still to come
belong to the old map.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.geometry.reprojection import (
    difference,
    fit_pose,
    linearise,
    retract,
    shared_covariances,
    whitening,
)
from thermal_fiducial.core.geometry.se3 import inverse
from thermal_fiducial.core.mapping.keyframes import Keyframe
from thermal_fiducial.core.mapping.map_data import MapMarker
from thermal_fiducial.core.measurements import CameraPose, in_moved_map, LATEST_NS
from thermal_fiducial.core.types import BoolArray, FloatArray

#: Squared distance (6 degrees of freedom) beyond which the filter would not follow the new map by itself.
REFUSED = 22.5


@dataclass(frozen=True)
class _Relocation:
    """A frame in the old map and in the new one."""

    #: (6,) from the old place to the new one, and from the odometry's to the new one (the same without odometry)
    moved: FloatArray
    ahead: FloatArray
    #: (6, 6) of the new place
    information: FloatArray


def correction(
    frames: Sequence[Keyframe],
    cameras: Sequence[Camera],
    old: Mapping[int, MapMarker],
    new: Mapping[int, MapMarker],
    belief: FloatArray | None,
) -> FloatArray:
    """T_new_old (4, 4) for poses of the time of ``frames``, the last ones, from the ``old`` to the ``new`` markers.

    Parameters
    ----------
    cameras : those that the frames' indices stand for
    belief : (6, 6) covariance of the pose by the odometry at the last frame; None without odometry

    Returns
    -------
    The identity where the filter follows by itself.
    """
    relocations = [r for frame in frames if (r := _relocate(frame, cameras, old, new)) is not None]
    if not relocations:
        return np.eye(4)
    informations = np.stack([r.information for r in relocations])
    total = np.linalg.inv(np.sum(informations, axis=0))
    moved = total @ np.sum([r.information @ r.moved for r in relocations], axis=0)
    share = 1.0
    if belief is not None:
        ahead = total @ np.sum([r.information @ r.ahead for r in relocations], axis=0)
        # Errors of successive frames are alike: all together are known no better than one.
        weighted = np.linalg.inv(len(relocations) * total + belief)
        if ahead @ weighted @ ahead < REFUSED:
            return np.eye(4)
        share = float(np.clip(moved @ weighted @ ahead / max(moved @ weighted @ moved, 1e-300), 0.0, 1.0))
    T = frames[-1].T_map_rig
    return np.asarray(retract(T, share * moved) @ inverse(T))


def _relocate(
    frame: Keyframe, cameras: Sequence[Camera], old: Mapping[int, MapMarker], new: Mapping[int, MapMarker]
) -> _Relocation | None:
    """The camera from the same corners in either map; None where it is not determined."""
    seen = np.array([key in old and key in new and new[key].trusted for key in frame.ids.tolist()], dtype=bool)
    if not np.any(seen):
        return None
    camera = cameras[int(frame.cameras[0])]
    before, _ = _located(frame, seen, camera, old)
    after, information = _located(frame, seen, camera, new)
    if not (np.all(np.isfinite(before)) and np.all(np.isfinite(information)) and np.linalg.cond(information) < 1e12):
        return None
    moved = difference(after, before)
    ahead = difference(after, frame.T_odometry) if np.any(frame.information) else moved
    return _Relocation(moved, ahead, information)


def _located(
    frame: Keyframe, seen: BoolArray, camera: Camera, markers: Mapping[int, MapMarker]
) -> tuple[FloatArray, FloatArray]:
    """Camera pose (4, 4) from those of a frame's markers that are ``seen``, and its information (6, 6)."""
    known = [markers[key] for key in frame.ids[seen].tolist()]
    n, sizes = len(known), np.array([marker.size for marker in known])
    T_map_marker = np.stack([marker.T_map_marker for marker in known])
    _, _, J = linearise(camera, np.broadcast_to(frame.T_map_rig, (n, 4, 4)), T_map_marker, sizes)
    shared = np.nan_to_num(shared_covariances(J, np.stack([marker.covariance for marker in known])))
    W = whitening(frame.covariances[seen] + shared)

    def evaluate(T: FloatArray) -> tuple[FloatArray, FloatArray]:
        uv, J, _ = linearise(camera, np.broadcast_to(T, (n, 4, 4)), T_map_marker, sizes)
        return (W @ (frame.corners[seen] - uv)[..., None]).ravel(), (W @ J.reshape(n, 4, 2, 6)).reshape(-1, 6)

    T, _ = fit_pose(frame.T_map_rig, evaluate)
    J = evaluate(T)[1]
    return T, np.asarray(J.T @ J, dtype=np.float64)


class LatePoses:
    """Poses of frames that arrive after the map has moved: in the map that their stamp stands for."""

    def __init__(self) -> None:
        #: stamp of the newest frame so far
        self.newest_ns = 0
        self._moved_ns = 0
        self._T_new_old: FloatArray = np.eye(4)

    def add(self, stamp_ns: int) -> None:
        """Take in the stamp of a frame; one of long before is that of a clock that was set back."""
        self.newest_ns = max(stamp_ns, self.newest_ns) if stamp_ns >= self.newest_ns - LATEST_NS else stamp_ns

    def moved(self, T_new_old: FloatArray) -> None:
        """The map has moved by (4, 4), after the newest frame."""
        self._moved_ns, self._T_new_old = self.newest_ns, T_new_old

    def as_of_its_stamp(self, pose: CameraPose) -> CameraPose:
        """``pose``, found in the map of now, in the map of its stamp."""
        if 0 <= self._moved_ns - pose.stamp_ns <= LATEST_NS:
            return in_moved_map(pose, inverse(self._T_new_old))
        return pose
