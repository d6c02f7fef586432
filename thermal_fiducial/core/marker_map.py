"""The incremental marker map: Algorithm 1 of the paper.

S. Khattak, C. Papachristos, K. Alexis, "Marker based thermal-inertial localization for aerial robots in obscurant
filled environments", ISVC 2018. For every frame: split the markers into known and new, find the camera from all known
ones jointly, weight each by its present and running re-projection error, refine, update the errors, and place new
markers that are seen together with known ones. Beyond the paper: planar ambiguities are settled before anything rests
on them, covariances carry the map's own uncertainty, and markers that stop agreeing are put in quarantine.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from thermal_fiducial.config import MarkerMapperConfig, size_overrides
from thermal_fiducial.core.camera import Camera
from thermal_fiducial.core.candidates import Candidate, View
from thermal_fiducial.core.geometry import so3_exp, transform, transform_from_quaternion
from thermal_fiducial.core.localization import locate, Location, Sight
from thermal_fiducial.core.map_data import MapMarker, MarkerMap
from thermal_fiducial.core.measurements import CameraPose, columns, corner_covariances, corners_px, Markers, Odometry
from thermal_fiducial.core.reprojection import corners_in_map, linearise, reproject
from thermal_fiducial.core.trust import culprits, DISAGREEMENT, Trust
from thermal_fiducial.core.types import BoolArray, FloatArray

__all__ = ['MapMarker', 'MapperResult', 'MarkerMap', 'MarkerMapper']

#: A pose of the past tells rival poses apart for this long [ns].
CONTINUITY_NS = 300_000_000
#: Corner errors to allow for before a marker is said to disagree with the others [px].
TOLERANCE_PX = 0.3


@dataclass(frozen=True)
class MapperResult:
    """What one frame came to."""

    stamp_ns: int
    pose: CameraPose | None
    #: in words: why there is no pose; empty when there is one
    reason: str
    #: the map has another geometry, or trusts other markers, than before
    map_changed: bool = False
    #: rms re-projection error of each known marker in view [px], quarantined ones included
    residuals_px: dict[int, float] = field(default_factory=dict)
    #: markers on trial in view: ID to what each waits for
    candidates: dict[int, str] = field(default_factory=dict)
    #: all markers in quarantine
    quarantined: tuple[int, ...] = ()
    map_version: int = 0

    @property
    def in_view(self) -> frozenset[int]:
        """IDs of the known markers in view."""
        return frozenset(self.residuals_px)


class MarkerMapper:
    """Camera pose from the map, and the map from camera poses.

    Parameters
    ----------
    config : sizes, mode, extrinsics
    marker_map : the map to start from, with at least one marker; it is copied
    """

    def __init__(self, config: MarkerMapperConfig, marker_map: MarkerMap) -> None:
        self.config = config
        self._sizes = size_overrides(config.marker_size_overrides)
        self._T_body_camera = transform_from_quaternion(config.camera_position, config.camera_orientation)
        self._initial = marker_map.copy()
        #: no new markers, no changes of the map, while True
        self.frozen = config.mode == 'localization'
        self.reset()

    def reset(self) -> None:
        """Back to the map that it was started with."""
        self.map = self._initial.copy()
        self._candidates: dict[int, Candidate] = {}
        self._trust = Trust()
        self._quarantined = {key for key, marker in self.map.markers.items() if not marker.trusted}
        self._last: CameraPose | None = None

    def process(
        self, stamp_ns: int, markers: Markers, camera: Camera, odometry: Odometry | None = None
    ) -> MapperResult:
        """One frame of Algorithm 1.

        Parameters
        ----------
        markers : (N,) of MARKER_DTYPE
        camera : its intrinsics
        odometry : the filter's latest output; settles ambiguities, and bridges gaps between known markers
        """
        markers = _usable(markers)
        # Step 2: known and new markers.
        is_known = np.array([int(key) in self.map.markers for key in markers['id']], dtype=bool)
        known = self._sight(markers[is_known])
        trusted = np.array([marker.trusted for marker in known.markers], dtype=bool)
        # Steps 3 to 6: the camera from all known ones, weighted by their errors.
        location = self._locate(stamp_ns, known.select(trusted), camera, odometry)
        if isinstance(location, str):
            return self._result(stamp_ns, None, location)
        ids = tuple(marker.id for marker, used in zip(known.markers, trusted, strict=True) if used)
        self._last = CameraPose(stamp_ns, location.T_map_camera, location.covariance, ids, location.rms_px)
        # Step 7: errors updated.
        errors = self._update_errors(stamp_ns, known, location, camera)
        changed = self._judge(known, trusted, errors, location, camera)
        # Step 8: new markers placed relative to the camera.
        waiting: dict[int, str] = {}
        if not self.frozen:
            placed, waiting = self._place_new(stamp_ns, markers[~is_known], camera, self._last)
            self.map.version += placed
            changed |= placed
        residuals = {marker.id: float(error) for marker, error in zip(known.markers, errors, strict=True)}
        return self._result(stamp_ns, self._last, '', changed, residuals, waiting)

    def _locate(self, stamp_ns: int, sight: Sight, camera: Camera, odometry: Odometry | None) -> Location | str:
        if not sight.markers:
            return self._nothing_known()
        errors = self._trust.running_errors(sight.markers)
        return locate(sight, errors, camera, self._prior(stamp_ns, odometry))

    def _nothing_known(self) -> str:
        if not self.map.markers:
            return 'the map has no marker: give a map file with at least one'
        return 'no known marker in view'

    def _prior(self, stamp_ns: int, odometry: Odometry | None) -> FloatArray | None:
        """T_map_camera that is expected from the filter or, for a short while, from the last pose."""
        if odometry is not None and abs(stamp_ns - odometry.stamp_ns) < CONTINUITY_NS:
            return predict(odometry, stamp_ns) @ self._T_body_camera
        if self._last is not None and 0 < stamp_ns - self._last.stamp_ns < CONTINUITY_NS:
            return self._last.T_map_camera
        return None

    def _sight(self, rows: Markers) -> Sight:
        branches = np.stack([_poses(rows, ''), _poses(rows, 'a')], axis=1)
        known = [self.map.markers[int(key)] for key in rows['id'] if int(key) in self.map.markers]
        return Sight(known, corners_px(rows), corner_covariances(rows), branches)

    def _update_errors(self, stamp_ns: int, known: Sight, location: Location, camera: Camera) -> FloatArray:
        """Re-projection error (N,) [px] of each known marker, taken into its statistics."""
        points = corners_in_map(known.T_map_marker, known.sizes)
        residuals = known.corners - reproject(camera, location.T_map_camera, points)
        squared = np.mean(np.sum(residuals**2, axis=-1), axis=-1)
        errors = np.sqrt(np.where(np.isfinite(squared), squared, float(camera.width) ** 2))
        self._trust.add_errors(known.markers, errors)
        if not self.frozen:
            for marker in known.markers:
                self.map.markers[marker.id] = replace(
                    marker,
                    reprojection_error_px=self._trust.running_error(marker),
                    observations=marker.observations + 1,
                    first_seen_ns=marker.first_seen_ns if marker.observations else stamp_ns,
                    last_seen_ns=stamp_ns,
                )
        return np.asarray(errors)

    def _judge(self, known: Sight, trusted: BoolArray, errors: FloatArray, location: Location, camera: Camera) -> bool:
        """Quarantine markers that persistently disagree; whether any standing changed."""
        if len(known.markers) < 2:
            return False
        disagrees = errors > DISAGREEMENT * _expected_errors(known, location, camera)
        blamed = culprits(disagrees, trusted, known.markers)
        changes = self._trust.judge(known.markers, blamed.tolist())
        for marker_id, trusted_now in changes.items():
            self.map.markers[marker_id] = replace(self.map.markers[marker_id], trusted=trusted_now)
            (self._quarantined.discard if trusted_now else self._quarantined.add)(marker_id)
        return bool(changes)

    def _place_new(self, stamp_ns: int, rows: Markers, camera: Camera, pose: CameraPose) -> tuple[bool, dict[int, str]]:
        """Show new markers to their candidates; whether any entered the map, and what the others wait for."""
        waiting: dict[int, str] = {}
        placed = False
        branches = np.stack([_poses(rows, ''), _poses(rows, 'a')], axis=1)
        corners, covariances = corners_px(rows), corner_covariances(rows)
        for i, marker_id in enumerate(int(key) for key in rows['id']):
            size = self._sizes.get(marker_id, self.config.marker_size)
            candidate = self._candidates.setdefault(marker_id, Candidate(marker_id, size))
            view = View(pose.T_map_camera, pose.covariance, corners[i], covariances[i], branches[i])
            if candidate.add(view):
                placement = candidate.place(camera)
                candidate.reason = placement.reason
                if placement.T_map_marker is not None:
                    self._enter(stamp_ns, candidate, placement.T_map_marker, placement.covariance)
                    placed = True
                    continue
            waiting[marker_id] = candidate.reason
        return placed, waiting

    def _enter(self, stamp_ns: int, candidate: Candidate, T_map_marker: FloatArray, covariance: FloatArray) -> None:
        del self._candidates[candidate.id]
        self._trust.forget([candidate.id])
        self.map.markers[candidate.id] = MapMarker(
            candidate.id, candidate.size, False, T_map_marker, covariance, first_seen_ns=stamp_ns, last_seen_ns=stamp_ns
        )

    def _result(
        self,
        stamp_ns: int,
        pose: CameraPose | None,
        reason: str,
        changed: bool = False,
        residuals: dict[int, float] | None = None,
        waiting: dict[int, str] | None = None,
    ) -> MapperResult:
        quarantined = tuple(sorted(self._quarantined))
        return MapperResult(
            stamp_ns, pose, reason, changed, residuals or {}, waiting or {}, quarantined, self.map.version
        )


def predict(odometry: Odometry, stamp_ns: int) -> FloatArray:
    """T_map_body (4, 4) at ``stamp_ns``, velocities constant since the odometry."""
    dt = (stamp_ns - odometry.stamp_ns) * 1e-9
    step = transform(so3_exp(odometry.angular_velocity_body * dt), odometry.velocity_body * dt)
    return odometry.T_map_body @ step


def _usable(markers: Markers) -> Markers:
    """Rows with finite corners and covariances whose ID is there once: of two alike, nobody knows which is which."""
    ids, counts = np.unique(markers['id'], return_counts=True)
    twice = np.isin(markers['id'], ids[counts > 1])
    finite = np.all(np.isfinite(corners_px(markers)), axis=(1, 2))
    sound = np.all(np.linalg.eigvalsh(np.nan_to_num(corner_covariances(markers))) > 0.0, axis=(1, 2))
    return markers[~twice & finite & sound]


def _poses(rows: Markers, prefix: str) -> FloatArray:
    """T_camera_marker (N, 4, 4) of the rows' pose ('') or alternative pose ('a'), NaN where there is none."""
    q = columns(rows, tuple(f'{prefix}q{axis}' for axis in 'xyzw'))
    with np.errstate(invalid='ignore', divide='ignore'):
        return transform_from_quaternion(columns(rows, tuple(f'{prefix}{axis}' for axis in 'xyz')), q)


def _expected_errors(known: Sight, location: Location, camera: Camera) -> FloatArray:
    """Rms error (N,) [px] that the noise, the pose and the map's own uncertainty explain."""
    n = len(known.markers)
    T = np.broadcast_to(location.T_map_camera, (n, 4, 4))
    _, J_camera, J_marker = linearise(camera, T, known.T_map_marker, known.sizes)
    noise = np.einsum('ncii->n', known.covariances)
    pose = np.einsum('nri,ij,nrj->n', J_camera, location.covariance, J_camera)
    marker = np.einsum('nri,nij,nrj->n', J_marker, known.map_covariances, J_marker)
    variance = 0.25 * (noise + pose + marker)
    return np.asarray(np.sqrt(np.nan_to_num(variance) + TOLERANCE_PX**2))
