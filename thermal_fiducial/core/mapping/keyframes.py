"""Keyframes of the bundle adjustment: a bounded store, and when the next adjustment is due."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from thermal_fiducial.core.error_model import divided_prior, draws_of, information_of_followed_map, SystematicErrors
from thermal_fiducial.core.geometry.camera import by_other_calibration, Camera
from thermal_fiducial.core.geometry.se3 import rigid_alignment
from thermal_fiducial.core.mapping.adjustment_problem import Priors, Snapshot
from thermal_fiducial.core.mapping.map_data import corners_of_markers, MapMarker, MarkerMap
from thermal_fiducial.core.mapping.marker_views import Viewpoint
from thermal_fiducial.core.measurements import CameraPose, Observations
from thermal_fiducial.core.motion_prior import displacement_covariance, PredictedCamera
from thermal_fiducial.core.types import FloatArray, IntArray, SECOND_NS

# Side of a cell of camera positions [m] and of viewing directions [components of a unit vector] to begin with.
_CELL = 0.25
# Share of the budget to which the store is thinned, so that it is thinned seldom.
_THINNED = 0.85
# A refinement is worth its time when so many keyframes have come since the last one, as a share of it and in number.
_GROWTH, _FEW = 0.2, 15
# Velocity of a frame, in its standard deviations, from which on it says where rows that are read late are.
_SURE = 3.0
#: Views of markers that a refinement in flight takes: half a second or one of a slow core.
VIEWS = 10_000
# Time between two refinements for each view of the last [s]: a view takes a fifth of it on a slow core. With three
# times as much, poses from markers just placed along a chain were too vague to publish: 19 of 633 over a carpet.
_PERIOD_A_VIEW = 3e-4


@dataclass(frozen=True)
class Keyframe:
    """All markers of one frame, known or not, and the odometry there."""

    stamp_ns: int
    T_map_camera: FloatArray
    #: (k,)
    ids: IntArray
    #: (k, 4, 2) [px]
    corners: FloatArray
    #: (k, 4, 2, 2) [px^2]
    covariances: FloatArray
    #: camera pose by odometry (4, 4), and the information (6, 6) of that one alone, zero without odometry
    T_odometry: FloatArray = field(default_factory=lambda: np.eye(4))
    information: FloatArray = field(default_factory=lambda: np.zeros((6, 6)))
    #: whether only odometry connects it, and markers that follow, with keyframes before: never dropped
    bridge: bool = False
    #: (k, 4, 2) [px/s] what corners are displaced by each second that the readout time is declared too short by
    rates: FloatArray = field(default_factory=lambda: np.zeros((1, 1, 2)))
    #: (k, 4, 2, 2) [px^2] what they may be displaced by where that velocity is not known
    late: FloatArray = field(default_factory=lambda: np.zeros((1, 1, 2, 2)))


def snapshot_of(
    markers: Mapping[int, MapMarker],
    frames: Sequence[Keyframe],
    camera: Camera,
    known: Mapping[int, tuple[FloatArray, FloatArray]],
    map_revision: int,
    errors: SystematicErrors,
    readout: float = 0.0,
) -> Snapshot:
    """At least one keyframe, and ``markers`` of the map to adjust, as a refinement works on them."""
    information = np.stack([frame.information for frame in frames])
    bridges = np.array([frame.bridge for frame in frames])
    covariances = np.concatenate([frame.covariances for frame in frames])
    # Where no velocity is known these are pictures, a few a second without odometry: what robots usually do would weigh
    # their corners by rows.
    if any(frame.rates.any() for frame in frames):
        covariances += np.concatenate([np.broadcast_to(frame.late, frame.covariances.shape) for frame in frames])
    return Snapshot(
        markers,
        np.array([frame.stamp_ns for frame in frames], dtype=np.int64),
        np.stack([frame.T_map_camera for frame in frames]),
        camera,
        Priors(np.stack([frame.T_odometry for frame in frames]), information_of_followed_map(information, bridges)),
        np.repeat(np.arange(len(frames)), [len(frame.ids) for frame in frames]),
        np.concatenate([frame.ids for frame in frames]),
        np.concatenate([frame.corners for frame in frames]),
        covariances,
        np.concatenate([np.broadcast_to(frame.rates, frame.corners.shape) for frame in frames]),
        known,
        map_revision,
        errors,
        readout,
    )


def prior_poses(markers: Mapping[int, MapMarker]) -> dict[int, tuple[FloatArray, FloatArray]]:
    """Prior poses and covariances (6, 6) of markers that the map had before the keyframes.

    A map contains the covariance of each marker, without correlations between markers: those bound the joint covariance
    of as many as are used. Markers that were surveyed one by one have none.
    """
    known = [m for m in markers.values() if not m.fixed and np.any(m.covariance)]
    related = sum(not m.surveyed for m in known)
    return {m.id: (m.T_map_marker, m.covariance if m.surveyed else divided_prior(m.covariance, related)) for m in known}


@dataclass(frozen=True)
class Displacement:
    """Displacement of the map by an adjustment, which differs over the map after gaps and loop closures."""

    #: (n,) of the frames that see markers of the map, ascending
    stamps_ns: IntArray
    #: (n, 4, 4) T_new_old of the markers that each sees
    T_new_old: FloatArray

    def at(self, stamp_ns: int) -> FloatArray:
        """T_new_old (4, 4) for poses at ``stamp_ns``: that of the frame nearest in time."""
        if len(self.stamps_ns) == 0:
            return np.eye(4)
        after = int(np.searchsorted(self.stamps_ns, stamp_ns))
        near = [i for i in (after - 1, after) if 0 <= i < len(self.stamps_ns)]
        return np.asarray(self.T_new_old[min(near, key=lambda i: abs(int(self.stamps_ns[i]) - stamp_ns))])


@dataclass(frozen=True)
class LastAdjustment:
    """When an adjustment was last begun, and with what."""

    #: stamp of its newest keyframe, keyframes kept, its views and markers, and the frames added until then
    stamp_ns: int = 0
    frames: int = 0
    views: int = 0
    markers: int = 0
    added: int = 0


class KeyframeStore:
    """Keyframes of a flight, thinned out evenly over camera positions and viewing directions, and the last adjustment.

    Parameters
    ----------
    budget : keyframes at most
    marker_map : the map to begin with
    """

    def __init__(self, budget: int, marker_map: MarkerMap) -> None:
        self._budget = budget
        #: by stamp
        self.frames: dict[int, Keyframe] = {}
        #: the markers of that map
        self._before = dict(marker_map.markers)
        self._adjustment = LastAdjustment(markers=len(marker_map.markers))
        #: frames that were ever added
        self._added = 0
        #: in whose pixels all keyframes are
        self._camera: Camera | None = None
        #: stamp of the last frame with known markers [ns]; None: not yet
        self._last_ns: int | None = None
        #: pose by odometry at the first unmapped marker of the present gap
        self._gap: CameraPose | None = None

    def add(self, frame: Keyframe) -> None:
        """Keep ``frame``, the first one of its stamp; thin out when there are too many."""
        if frame.stamp_ns in self.frames:
            # The clock was set back. An adjustment under way has the pose of the first one.
            return
        self.frames[frame.stamp_ns] = frame
        self._added += 1
        if len(self.frames) > self._budget:
            kept = self._thinned_out(int(_THINNED * self._budget))
            self.frames = {stamp: frame for stamp, frame in self.frames.items() if stamp in kept}

    def keep(self, observed: Observations, pose: CameraPose, camera: Camera, predicted: PredictedCamera | None) -> None:
        """Keep a frame with a known camera pose and at least two markers."""
        self._last_ns, self._gap = pose.stamp_ns, None
        if len(observed.ids) >= 2:
            self.add(self._keyframe(observed, pose, camera, predicted))

    def settle(self, observed: Observations, pose: CameraPose, camera: Camera) -> None:
        """Keep an earlier frame, whose camera pose is known only now."""
        self.add(self._keyframe(observed, pose, camera, None))

    def bridge(self, observed: Observations, camera: Camera, predicted: PredictedCamera, *, first: bool) -> Viewpoint:
        """Keep a frame without a known marker; returns the viewpoint of its markers, by odometry.

        Only odometry connects these markers with the map. Its error at the ``first`` of them is common to all that
        follow in the gap, since the markers connect the later frames.
        """
        keyframe = self._keyframe(observed, predicted.pose, camera, predicted)
        if first or len(observed.ids) >= 2:
            self.add(replace(keyframe, bridge=first))
        if self._gap is None:
            self._gap = predicted.pose
        # The error of the odometry at the gap's first marker is common to all views.
        draws = draws_of(self._gap.covariance, np.random.default_rng(abs(self._gap.stamp_ns)))
        return Viewpoint.known(predicted.pose.T_map_camera, displacement_covariance(self._gap, predicted), draws)

    def bridgeable(self, stamp_ns: int, longest: float) -> bool:
        """Whether known markers were in view not more than ``longest`` [s] before."""
        return self._last_ns is not None and 0 <= stamp_ns - self._last_ns <= longest * SECOND_NS

    def refinement_due(self, stamp_ns: int, period: float, markers: int) -> bool:
        """Whether an adjustment of ``markers`` markers is due, at least ``period`` [s] after the last one."""
        if not self.frames or period == 0.0:
            return False
        last = self._adjustment
        wait_ns = max(period, _PERIOD_A_VIEW * last.views) * SECOND_NS
        # A clock that was set back leaves the last one in the future.
        if 0 <= stamp_ns - last.stamp_ns < wait_ns:
            return False
        return self._added - last.added >= _GROWTH * last.frames + _FEW or markers > last.markers

    @property
    def grown(self) -> bool:
        """Whether keyframes have come since the last adjustment was begun."""
        return self._added > self._adjustment.added

    def snapshot(self, marker_map: MarkerMap, errors: SystematicErrors, views: int, readout: float) -> Snapshot | None:
        """Input of an adjustment, with about ``views`` views of markers at most; None without keyframes.

        ``readout`` : what the readout time is declared too short by, as estimated before [s]
        """
        if not self.frames or self._camera is None:
            return None
        markers = len(marker_map.markers)
        frames = self._selected(views)
        number = sum(len(frame.ids) for frame in frames)
        self._adjustment = LastAdjustment(next(reversed(self.frames)), len(self.frames), number, markers, self._added)
        trusted = {key: marker for key, marker in marker_map.markers.items() if marker.trusted}
        observed_ids = set(np.concatenate([frame.ids for frame in frames]).tolist())
        priors = prior_poses({key: marker for key, marker in self._before.items() if key in observed_ids})
        return snapshot_of(trusted, frames, self._camera, priors, marker_map.revision, errors, readout)

    def move(
        self, adjusted: Mapping[int, FloatArray], before: Mapping[int, MapMarker], after: Mapping[int, MapMarker]
    ) -> Displacement:
        """Take over adjusted poses by stamp; other keyframes move with the markers that they see.

        What a pose was corrected by is no displacement of the map: the noise of one keyframe would move others.

        Parameters
        ----------
        before, after : the map before the adjustment and after it
        """
        displacement = self._displacement(before, after)
        for stamp, frame in self.frames.items():
            T_map_camera = adjusted[stamp] if stamp in adjusted else displacement.at(stamp) @ frame.T_map_camera
            self.frames[stamp] = replace(frame, T_map_camera=T_map_camera)
        return displacement

    def _displacement(self, before: Mapping[int, MapMarker], after: Mapping[int, MapMarker]) -> Displacement:
        """By the markers that each keyframe sees: rigid alignments of their corners, of all keyframes at once."""
        ids = sorted(key for key in before.keys() & after.keys() if before[key].trusted)
        stamps, sees = np.array(list(self.frames), dtype=np.int64), self._sees(ids)
        shown = sees.any(axis=1)
        stamps, sees = stamps[shown], sees[shown]
        if len(stamps) == 0:
            return Displacement(stamps, np.zeros((0, 4, 4)))
        new, old = (corners_of_markers([markers[key] for key in ids]) for markers in (after, before))
        T_new_old = rigid_alignment(new.reshape(-1, 3), old.reshape(-1, 3), np.repeat(sees, 4, axis=1))
        order = np.argsort(stamps, kind='stable')
        return Displacement(stamps[order], T_new_old[order])

    def _sees(self, ids: Sequence[int]) -> FloatArray:
        """Which of the N markers ``ids``, ascending, each of n keyframes sees, (n, N): 1 or 0."""
        frames = list(self.frames.values())
        sees = np.zeros((len(frames), len(ids)))
        shown = np.concatenate([frame.ids for frame in frames]) if frames else np.zeros(0, dtype=np.int64)
        rows = np.repeat(np.arange(len(frames)), [len(frame.ids) for frame in frames])
        known = np.isin(shown, ids)
        sees[rows[known], np.searchsorted(ids, shown[known])] = 1.0
        return sees

    def _keyframe(
        self, observed: Observations, pose: CameraPose, camera: Camera, predicted: PredictedCamera | None
    ) -> Keyframe:
        """A frame to keep, after which all keyframes are in the pixels of its ``camera``."""
        if self._camera is not None and self.frames and not camera.matches(self._camera):
            self._carry_over(self._camera, camera)
        self._camera = camera
        frame = Keyframe(pose.stamp_ns, pose.T_map_camera, observed.ids, observed.corners, observed.covariances)
        rates, late = _displaced(observed)
        frame = replace(frame, rates=rates, late=late)
        if predicted is None:
            return frame
        information = np.asarray(np.linalg.inv(predicted.pose.covariance), dtype=np.float64)
        return replace(frame, T_odometry=predicted.pose.T_map_camera, information=information)

    def _carry_over(self, before: Camera, now: Camera) -> None:
        """Give all keyframes the pixels that their directions have by another calibration."""
        frames = list(self.frames.values())
        px, gains = by_other_calibration(np.concatenate([frame.corners for frame in frames]), before, now)
        ends = np.cumsum([len(frame.ids) for frame in frames])[:-1]
        for frame, corners, gain in zip(frames, np.split(px, ends), np.split(gains, ends), strict=True):
            back = gain.swapaxes(-1, -2)
            self.frames[frame.stamp_ns] = replace(
                frame,
                corners=corners,
                covariances=gain @ frame.covariances @ back,
                rates=(gain @ frame.rates[..., None])[..., 0],
                late=gain @ frame.late @ back,
            )

    def _selected(self, views: int) -> tuple[Keyframe, ...]:
        """Keyframes with about ``views`` views of markers at most, spread over the map like all of them."""
        total = sum(len(frame.ids) for frame in self.frames.values())
        if total <= views:
            return tuple(self.frames.values())
        kept = self._thinned_out(max(len(self.frames) * views // total, 1))
        return tuple(frame for stamp, frame in self.frames.items() if stamp in kept)

    def _thinned_out(self, room: int) -> set[int]:
        """Stamps of about ``room`` keyframes from all places and directions, and of all bridges."""
        coarseness = 1.0
        while len(cells := self._cells(coarseness)) > room:
            coarseness *= 2.0
        share = _fair_share([len(stamps) for stamps in cells.values()], room)
        kept = {stamp for stamp, frame in self.frames.items() if frame.bridge}
        for stamps in cells.values():
            chosen = np.linspace(0, len(stamps) - 1, min(share, len(stamps))).round().astype(int)
            kept.update(stamps[i] for i in chosen)
        return kept

    def _cells(self, coarseness: float) -> dict[tuple[int, ...], list[int]]:
        """Stamps of the keyframes by cell of camera position and viewing direction.

        A cell has its middle, not a corner, in the origin of the map, so that coarse enough ones hold all keyframes.
        """
        T = np.stack([frame.T_map_camera for frame in self.frames.values()])
        scaled = np.concatenate([T[:, :3, 3], T[:, :3, 2]], axis=-1) / (_CELL * coarseness)
        cells: dict[tuple[int, ...], list[int]] = defaultdict(list)
        for stamp, key in zip(self.frames, np.rint(scaled).astype(int).tolist(), strict=True):
            cells[tuple(key)].append(stamp)
        return cells


def _displaced(observed: Observations) -> tuple[FloatArray, FloatArray]:
    """Rates (k, 4, 2) of markers, zero where their velocity is not known, and covariances (k, 4, 2, 2) by that.

    What is not known of the velocity displaces late rows as noise would.
    """
    late = observed.late_px.copy()
    squares = np.sum(late**2, axis=(1, 2))
    known = squares[:, 0] > _SURE**2 * squares[:, 1:].sum(axis=1)
    late[known, ..., 0] = 0.0
    rates = np.where(known[:, None, None], observed.rates, 0.0)
    return rates, late @ np.swapaxes(late, -1, -2)


def _fair_share(counts: list[int], room: int) -> int:
    """The largest number that each cell may keep so that all together fit into ``room``; at least one."""
    share = 1
    while sum(min(count, share + 1) for count in counts) <= room and share < max(counts):
        share += 1
    return share
