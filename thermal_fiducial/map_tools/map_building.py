"""A map from frames in any order: photos of a site, or the detections of a whole run."""

from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from thermal_fiducial.config import MarkerMapperConfig, MOST_KEYFRAMES
from thermal_fiducial.core.error_model import SystematicErrors
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.geometry.reprojection import corners_in_map, reproject
from thermal_fiducial.core.geometry.se3 import difference, turn_between
from thermal_fiducial.core.mapping.adjustment_problem import Snapshot
from thermal_fiducial.core.mapping.bundle_adjustment import AdjustedMap, refine
from thermal_fiducial.core.mapping.candidates import UNAMBIGUOUS
from thermal_fiducial.core.mapping.map_data import MapMarker, MarkerMap
from thermal_fiducial.core.mapping.mapper import MarkerMapper
from thermal_fiducial.core.mapping.marker_views import SAME_POSE
from thermal_fiducial.core.measurements import corners_px, Markers
from thermal_fiducial.core.types import FloatArray, SECOND_NS
from thermal_fiducial.map_tools.map_doubts import LARGE_PX

# Most passes over all frames: more than a chain of markers needs, each seen only together with the previous one.
_MAX_PASSES = 50
# Variances [m^2, rad^2] of entries without a covariance, which somebody wrote by hand, before the views show them.
_BY_HAND = np.array([0.1, np.deg2rad(5.0)]) ** 2
# Most adjustments for the variances of such entries, and their relative change at convergence.
_MAX_ROUNDS, _SETTLED = 5, 0.1
# Initial covariance of an alternative pose in its bundle adjustment: practically unknown.
_UNKNOWN = np.diag([1.0, 1.0, 1.0, 0.1, 0.1, 0.1])


@dataclass(frozen=True)
class Built:
    """A map from frames, and the result of its adjustment."""

    map: MarkerMap
    #: the last bundle adjustment; None: there was nothing to adjust
    refinement: AdjustedMap | None
    #: markers that were seen but could not be placed, with the reason
    unplaced: dict[int, str]
    #: number of frames with a camera pose in the final map
    frames_used: int
    #: index of each other frame, with the reason
    unused: dict[int, str] = field(default_factory=dict)
    #: that most markers contradict the map to start from, in words; empty if they do not, or agree with this one
    contradiction: str = ''


def build_map(
    frames: Sequence[Markers],
    camera: Camera,
    marker_map: MarkerMap,
    config: MarkerMapperConfig,
    progress: Callable[[int, float], None] = lambda markers, share: None,
) -> Built:
    """Extend ``marker_map`` by all markers connected to it by common views, and run a bundle adjustment.

    The mapper processes all frames repeatedly until no pass adds a marker, since a frame without known markers may
    become a link later. If the views leave a marker's pose ambiguous, a bundle adjustment with either pose decides. The
    last adjustment claims what residuals in the adjusted map show, and not those in the map to start from.

    Parameters
    ----------
    frames : rows of MARKER_DTYPE of each frame
    progress : called with the number of markers in the map and the share of this pass that is done
    """
    budget = min(max(len(frames), config.keyframe_budget), MOST_KEYFRAMES)
    config = replace(config, mode='mapping', keyframe_budget=budget)
    by_hand = [key for key, m in marker_map.markers.items() if not m.fixed and not np.any(m.covariance)]
    entries = {key: replace(marker_map.markers[key], covariance=_covariance(_BY_HAND)) for key in by_hand}
    mapper = MarkerMapper(config, replace(marker_map, markers=marker_map.markers | entries))
    refinement = None
    waiting: dict[int, str] = {}
    for _ in range(_MAX_PASSES):
        before = len(mapper.map.markers)
        for k, rows in enumerate(frames):
            result = mapper.process(_stamp(k), rows, camera)
            waiting |= result.candidates
            progress(len(mapper.map.markers), (k + 1) / len(frames))
        refinement = mapper.refine() or refinement
        if len(mapper.map.markers) == before and not _settle(mapper, camera):
            break
    unplaced = {key: why for key, why in waiting.items() if key not in mapper.map.markers}
    unused, errors, systematic = _residuals(mapper.map, frames, camera, config)
    snapshot = mapper.snapshot()
    if refinement is not None and snapshot is not None:
        refinement = _with_learned_errors(replace(snapshot, errors=systematic), by_hand) or refinement
        mapper.apply(refinement)
    used = [rows for k, rows in enumerate(frames) if k not in unused]
    final = _with_statistics(mapper.map, used, marker_map, errors)
    cured = bool(errors) and float(np.median(list(errors.values()))) <= LARGE_PX
    return Built(final, refinement, unplaced, len(used), unused, '' if cured else mapper.doubt_of_map)


def _stamp(k: int) -> int:
    """Stamp of frame k, the same in every pass."""
    return (k + 1) * SECOND_NS


def _settle(mapper: MarkerMapper, camera: Camera) -> bool:
    """Resolve one candidate's pose ambiguity by a bundle adjustment with either pose; returns whether one was."""
    snapshot = mapper.snapshot()
    if snapshot is None:
        return False
    for candidate in mapper.candidates.values():
        winner = decide(snapshot, candidate.id, candidate.size, candidate.solutions(camera)[:2])
        if winner is not None:
            mapper.enter(winner)
            return True
    return False


def decide(snapshot: Snapshot, marker_id: int, size: float, alternatives: Sequence[FloatArray]) -> MapMarker | None:
    """The new marker at the one of ``alternatives``, poses (4, 4), that the bundle adjustment clearly prefers."""
    outcomes = []
    for T in alternatives:
        trial = MapMarker(marker_id, size, False, T, _UNKNOWN)
        refinement = refine(replace(snapshot, markers={**snapshot.markers, marker_id: trial}))
        if refinement is not None and marker_id in refinement.markers:
            outcomes.append((refinement.cost, refinement.markers[marker_id]))
    if not outcomes:
        return None
    outcomes.sort(key=lambda outcome: outcome[0])
    cost, best = outcomes[0]
    for other_cost, other in outcomes[1:]:
        apart = turn_between(best.T_map_marker, other.T_map_marker)
        if apart > SAME_POSE and other_cost - cost < UNAMBIGUOUS:
            return None
    return best


def _with_learned_errors(snapshot: Snapshot, by_hand: Sequence[int]) -> AdjustedMap | None:
    """The adjustment with priors of the entries ``by_hand`` that are as wide as these turn out to be off.

    Expectation maximisation of their variances (A. Dempster, N. Laird, D. Rubin, 1977), with one entry more that is off
    by what is assumed at first.
    """
    variances = _BY_HAND
    for _ in range(_MAX_ROUNDS):
        adjusted = refine(snapshot)
        keys = [] if adjusted is None else [key for key in by_hand if key in adjusted.markers]
        if adjusted is None or not keys:
            break
        off = np.stack([difference(snapshot.known[key][0], adjusted.markers[key].T_map_marker) for key in keys])
        squares = np.stack([np.diag(adjusted.markers[key].covariance) for key in keys]) + off**2
        before, variances = variances, (_BY_HAND + squares.reshape(-1, 2, 3).mean(axis=2).sum(axis=0)) / (1 + len(keys))
        if np.all(np.abs(variances - before) < _SETTLED * before):
            break
        priors = {key: (snapshot.known[key][0], _covariance(variances)) for key in keys}
        snapshot = replace(snapshot, known={**snapshot.known, **priors})
    return adjusted


def _covariance(variances: FloatArray) -> FloatArray:
    """Covariance (6, 6) of a pose by the variances (2,) of each coordinate of position and rotation."""
    return np.diag(np.repeat(variances, 3))


def _residuals(
    built: MarkerMap, frames: Sequence[Markers], camera: Camera, config: MarkerMapperConfig
) -> tuple[dict[int, str], dict[int, float], SystematicErrors]:
    """What the frames show of the map once more.

    Returns
    -------
    Frames that are not located in the map with the reason; each marker's re-projection error in the others [px], the
    median over the views, as the mapper's own is a running mean from before the adjustment; and the systematic errors
    by residuals in this map: in one that was centimetres off, its errors were taken for those of corners.
    """
    mapper = MarkerMapper(replace(config, mode='localization'), built)
    unused, errors = dict[int, str](), defaultdict[int, list[float]](list)
    for k, rows in enumerate(frames):
        result = mapper.process(_stamp(k), rows, camera)
        pose = result.pose
        if pose is None:
            unused[k] = result.reason
            continue
        for marker_id, seen in zip(rows['id'].tolist(), corners_px(rows), strict=True):
            marker = built.markers.get(marker_id)
            if marker is not None:
                corners = corners_in_map(marker.T_map_marker, marker.size)
                off = reproject(camera, pose.T_map_camera, corners) - seen
                errors[marker_id].append(float(np.sqrt(np.mean(off**2))))
    return unused, {marker_id: float(np.median(values)) for marker_id, values in errors.items()}, mapper.errors


def _with_statistics(
    built: MarkerMap, frames: Sequence[Markers], start: MarkerMap, errors: Mapping[int, float]
) -> MarkerMap:
    """The map with its final errors, observations counted once in spite of several passes, and no artificial stamps."""
    seen = Counter(key for rows in frames for key in rows['id'].tolist())
    for key, marker in built.markers.items():
        earlier = start.markers.get(key)
        built.markers[key] = replace(
            marker,
            reprojection_error_px=errors.get(key, marker.reprojection_error_px),
            observations=seen[key] + (earlier.observations if earlier else 0),
            first_seen_ns=earlier.first_seen_ns if earlier else 0,
            last_seen_ns=earlier.last_seen_ns if earlier else 0,
        )
    return built
