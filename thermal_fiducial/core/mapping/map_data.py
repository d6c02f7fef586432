"""Data of the mapper: markers and map, alignment of two maps of one place, result of a frame."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
import math

import numpy as np

from thermal_fiducial.core.error_model import arms_of_scale, assumed_draws, NO_DRAWS, scale_of_map, SystematicErrors
from thermal_fiducial.core.geometry.plausibility import require_numbers, require_pose, require_side
from thermal_fiducial.core.geometry.reprojection import corners_in_map
from thermal_fiducial.core.geometry.se3 import apply, quaternion_from_rotation, rigid_alignment
from thermal_fiducial.core.map_limits import fault_of_covariance
from thermal_fiducial.core.measurements import CameraPose, MAP_DTYPE
from thermal_fiducial.core.types import BoolArray, FloatArray, LARGEST_ID
from thermal_fiducial.core.wording import number_of
from thermal_fiducial.errors import InputError

# Residual of a common marker, in units of the median, beyond which it doesn't take part in an alignment.
_OUTLIER = 4.0
# Residual that is never an outlier [m].
_TOLERANCE_M = 0.01
_REWEIGHTINGS = 4
#: Weight of a new frame in running means over the frames of a marker, its errors and its quarantine: a memory of 20.
NEW_FRAME_SHARE = 0.05


@dataclass(frozen=True, slots=True)
class MapMarker:
    """A marker whose pose in the map is known.

    Instances are immutable, so that a snapshot of a map may be handed to another thread as it is.
    """

    id: int
    #: side of the black square [m]
    size: float
    #: a fixed marker never moves: it is the gauge of the map
    fixed: bool
    #: (4, 4)
    T_map_marker: FloatArray
    #: (6, 6), ROS convention, in the map frame [m, rad]
    covariance: FloatArray = field(default_factory=lambda: np.zeros((6, 6)))
    #: running rms of the re-projection error of its corners [px]; 0 before the first observation
    reprojection_error_px: float = 0.0
    observations: int = 0
    #: stamps of the first and the last observation; 0 if never observed
    first_seen_ns: int = 0
    last_seen_ns: int = 0
    #: False: in quarantine as inconsistent; no pose uses it
    trusted: bool = True
    #: (6, K) draws of its error but for the scale, jointly with those of the other markers of a mapper; a file has none
    draws: FloatArray = field(default_factory=lambda: NO_DRAWS, compare=False, repr=False)
    #: measured by itself, before any flight: its error is independent of those of all other markers
    surveyed: bool = field(default=False, compare=False, repr=False)

    def observed(self, stamp_ns: int, error_px: float) -> 'MapMarker':
        """The marker after one more observation; without ``replace``, as this runs for every marker of every frame."""
        count = self.observations + 1
        mean_square = self.reprojection_error_px**2
        mean_square += max(1.0 / count, NEW_FRAME_SHARE) * (error_px**2 - mean_square)
        first = self.first_seen_ns if self.observations else stamp_ns
        return MapMarker(
            self.id, self.size, self.fixed, self.T_map_marker, self.covariance,
            math.sqrt(mean_square), count, first, stamp_ns, self.trusted, self.draws, self.surveyed,
        )  # fmt: skip


@dataclass
class MarkerMap:
    """Markers by ID, all in one frame.

    ``revision`` grows with every change of the geometry; statistics leave it alone.
    """

    markers: dict[int, MapMarker] = field(default_factory=dict)
    frame_id: str = 'map'
    dictionary: str = 'DICT_4X4_50'
    revision: int = 1
    #: revision and anchors, cached: finding them takes long in a large map
    _anchors: tuple[int, FloatArray] | None = field(default=None, init=False, repr=False, compare=False)

    @property
    def size_in_words(self) -> str:
        """How many markers it has."""
        return number_of(len(self.markers), 'marker')

    def require_usable(self) -> None:
        """Check a map that was not read from a file.

        Raises
        ------
        InputError
            A marker under another ID than its own, or one whose pose, side or covariance is none.
        """
        for key, marker in self.markers.items():
            what = f'marker {key!r} of the map'
            if marker.id != key or not (isinstance(key, int) and 0 <= key <= LARGEST_ID):
                raise InputError(f'{what}: ID {marker.id!r}')
            require_side(marker.size, what)
            require_numbers(marker.T_map_marker, (4, 4), f'{what}: T_map_marker')
            require_numbers(marker.covariance, (6, 6), f'{what}: covariance')
            require_pose(marker.T_map_marker, what)
            if marker.covariance.any() and (fault := fault_of_covariance(marker.covariance)):
                raise InputError(f'{what}: covariance: {fault}')

    def copy(self) -> 'MarkerMap':
        """A copy that shares the immutable markers."""
        return replace(self, markers=dict(self.markers))

    def adjust(self, adjusted: Mapping[int, MapMarker]) -> None:
        """Take over poses and covariances of adjusted markers, except those in quarantine."""
        for marker_id, marker in adjusted.items():
            own = self.markers.get(marker_id)
            if own is not None and own.trusted:
                self.markers[marker_id] = replace(
                    own,
                    T_map_marker=marker.T_map_marker,
                    covariance=marker.covariance,
                    draws=marker.draws,
                    surveyed=marker.surveyed,
                )
        self.revision += 1

    def with_assumed_draws(self, errors: SystematicErrors) -> 'MarkerMap':
        """The map as from a file: how the errors of its markers are correlated is assumed."""
        vague = [marker for marker in self.markers.values() if marker.covariance.any()]
        if not vague:
            return self.copy()
        positions = np.stack([marker.T_map_marker[:3, 3] for marker in vague])
        covariances = np.stack([marker.covariance for marker in vague])
        of_scale = scale_of_map(arms_of_scale(positions, self.anchors), errors)
        placed = np.array([marker.observations > 0 for marker in vague])
        draws = assumed_draws(positions, covariances - placed[:, None, None] * of_scale, placed)
        drawn = {
            marker.id: replace(marker, draws=own, surveyed=not by_mapper)
            for marker, own, by_mapper in zip(vague, draws, placed.tolist(), strict=True)
        }
        return replace(self, markers=self.markers | drawn)

    @property
    def anchors(self) -> FloatArray:
        """Positions (H, 3) of the markers that carry the scale: see :func:`gauge`."""
        if self._anchors is None or self._anchors[0] != self.revision:
            markers = list(self.markers.values())
            held = [marker for marker, is_held in zip(markers, gauge(markers), strict=True) if is_held]
            self._anchors = self.revision, np.array([marker.T_map_marker[:3, 3] for marker in held]).reshape(-1, 3)
        return self._anchors[1]

    def rows(self, in_view: Collection[int] = ()) -> np.ndarray:
        """Rows (N,) of :data:`MAP_DTYPE`, ordered by ID; ``in_view`` are the IDs that the frame at hand shows."""
        markers = [self.markers[key] for key in sorted(self.markers)]
        rows = np.zeros(len(markers), MAP_DTYPE)
        if not markers:
            return rows
        T = np.stack([marker.T_map_marker for marker in markers])
        rows['x'], rows['y'], rows['z'] = T[:, :3, 3].T
        rows['qx'], rows['qy'], rows['qz'], rows['qw'] = quaternion_from_rotation(T[:, :3, :3]).T
        variances = np.stack([marker.covariance for marker in markers])[:, [0, 1, 2], [0, 1, 2]]
        rows['sigma_m'] = np.sqrt(np.maximum(np.mean(variances, axis=1), 0.0))
        rows['rms_px'] = [marker.reprojection_error_px for marker in markers]
        most = int(np.iinfo(MAP_DTYPE['observations']).max)
        rows['observations'] = [min(marker.observations, most) for marker in markers]
        for name in ('id', 'size', 'fixed', 'trusted'):
            rows[name] = [getattr(marker, name) for marker in markers]
        rows['in_view'] = [marker.id in in_view for marker in markers]
        return rows


@dataclass(frozen=True)
class MapperResult:
    """Result of one frame."""

    stamp_ns: int
    pose: CameraPose | None
    #: why there is no pose, or one that says nothing of the turn to another one, in words; else empty
    reason: str
    #: whether the geometry of the map or its quarantine changed
    map_changed: bool = False
    #: IDs of the known markers in view
    in_view: frozenset[int] = frozenset()
    #: candidates in view: ID to what each waits for
    candidates: dict[int, str] = field(default_factory=dict)
    #: all markers in quarantine: ID to the reason, with numbers
    quarantine_reasons: dict[int, str] = field(default_factory=dict)
    #: whether a new marker or statistics of known ones entered the map
    learned: bool = False

    @property
    def quarantined(self) -> tuple[int, ...]:
        """IDs of all markers in quarantine."""
        return tuple(sorted(self.quarantine_reasons))


def exact(markers: list[MapMarker]) -> BoolArray:
    """Which markers are fixed or known exactly."""
    return np.array([m.fixed or not np.any(m.covariance) for m in markers], dtype=bool)


def gauge(markers: list[MapMarker]) -> BoolArray:
    """Those that are exact; failing these, the one known best."""
    chosen = exact(markers)
    if markers and not np.any(chosen):
        chosen[int(np.argmin([np.trace(m.covariance) for m in markers]))] = True
    return chosen


@dataclass(frozen=True)
class Alignment:
    """A rigid transform between two maps, by their common markers."""

    #: (4, 4) takes the moving map into the resting one
    T: FloatArray
    #: rms distance of the corners of each common marker after the alignment [m]
    residuals_m: dict[int, float]
    #: common markers that did not take part, because they disagree with the others
    outliers: tuple[int, ...]


def align(resting: Mapping[int, MapMarker], moving: Mapping[int, MapMarker]) -> Alignment:
    """Rigid transform that takes ``moving`` onto ``resting``, by the corners of the markers that both have.

    Least squares; markers that disagree with the others (moved between the two surveys) are left out, and those in
    quarantine where there are others.

    Raises
    ------
    InputError
        No marker in common, or sizes that differ.
    """
    common = sorted(resting.keys() & moving.keys())
    common = [key for key in common if resting[key].trusted and moving[key].trusted] or common
    if not common:
        raise InputError('the maps have no marker in common')
    for key in common:
        if abs(resting[key].size - moving[key].size) > 1e-3 * resting[key].size:
            raise InputError(f'marker {key} is {resting[key].size} m in one map and {moving[key].size} m in the other')
    target, source = (corners_of_markers([markers[key] for key in common]) for markers in (resting, moving))
    # Each marker alone gives a transform; the one that suits the median marker best shows who disagrees.
    single = [rigid_alignment(t, s) for t, s in zip(target, source, strict=True)]
    T = min(single, key=lambda T: float(np.median(_distances(T, target, source))))
    for _ in range(_REWEIGHTINGS):
        residuals = _distances(T, target, source)
        used = residuals <= max(_OUTLIER * float(np.median(residuals)), _TOLERANCE_M)
        T = rigid_alignment(target[used].reshape(-1, 3), source[used].reshape(-1, 3))
    residuals = _distances(T, target, source)
    outliers = tuple(key for key, keep in zip(common, used, strict=True) if not keep)
    return Alignment(T, dict(zip(common, residuals.tolist(), strict=True)), outliers)


def jump(new: Mapping[int, MapMarker], old: Mapping[int, MapMarker]) -> FloatArray | None:
    """T_new_old (4, 4) of two maps of one place; None where they have no marker in common, or one of two sizes.

    The fixed markers hold both maps in place; the others, which an edit may have moved, count where there are none.
    """
    held = {key: marker for key, marker in old.items() if key in new and _holds(marker) and _holds(new[key])}
    try:
        return align(new, held or old).T
    except InputError:
        return None


def _holds(marker: MapMarker) -> bool:
    return marker.fixed and marker.trusted


def _distances(T: FloatArray, target: FloatArray, source: FloatArray) -> FloatArray:
    """Rms distance (K,) of the corners (K, 4, 3) of each marker."""
    return np.asarray(np.sqrt(np.mean(np.sum((apply(T, source) - target) ** 2, axis=-1), axis=-1)))


def corners_of_markers(markers: Sequence[MapMarker]) -> FloatArray:
    """Corners (K, 4, 3) of markers in the map [m]."""
    T = np.stack([marker.T_map_marker for marker in markers])
    return corners_in_map(T, np.array([marker.size for marker in markers]))
