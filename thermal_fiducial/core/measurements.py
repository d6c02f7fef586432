"""Rows and records that pass between the stages, on topics and in the pipeline.

Pose covariances, here and in every message and file, are in the ROS convention: order (x, y, z, rotation
about x, y, z), both expressed in the parent frame ``a`` of ``T_a_b``, so that the true pose is
``p = p_hat + d[:3]`` and ``R = exp(d[3:]) @ R_hat``.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from operator import index
from typing import Any, TYPE_CHECKING

import numpy as np

from thermal_fiducial.core.geometry.plausibility import require_numbers
from thermal_fiducial.core.geometry.se3 import quaternion_from_rotation, transform_from_quaternion, turned
from thermal_fiducial.core.types import BoolArray, Float32Array, FloatArray, IntArray, Stacked
from thermal_fiducial.errors import InputError

if TYPE_CHECKING:
    # Not imported here: the filter uses this module, and restarts sooner without OpenCV.
    from thermal_fiducial.core.geometry.planar_pose import PlanarPoses

_F4 = '<f4'
#: A message may be this late [ns]: one that is older than the newest by more is of a clock that was set back, or of a
#: bag that was restarted.
MOST_LATE_NS = 1_000_000_000
#: Standard deviation [rad] that a camera pose claims for turns of which it says nothing: any turn is possible.
NOTHING_KNOWN = 3.0
#: Standard deviation of a pose's attitude [rad] beyond which it is neither published nor begun with: a first-order
#: covariance fails there, and it may be one of two.
VAGUE = 0.2

CORNER_FIELDS = tuple(f'{axis}{corner}' for corner in range(4) for axis in 'uv')
CORNER_COVARIANCE_FIELDS = tuple(f'c{corner}{term}' for corner in range(4) for term in ('uu', 'uv', 'vv'))

#: A row of the ``markers`` topic (meanings: doc/nodes.md). New fields go to the end: readers look them up by name.
MARKER_DTYPE = np.dtype(
    [('x', _F4), ('y', _F4), ('z', _F4), ('id', '<u4')]
    + [(name, _F4) for name in CORNER_FIELDS]
    + [('sigma_px', _F4)]
    + [(name, _F4) for name in ('qx', 'qy', 'qz', 'qw', 'rms_px')]
    + [(name, _F4) for name in ('ax', 'ay', 'az', 'aqx', 'aqy', 'aqz', 'aqw', 'arms_px')]
    + [('contrast_counts', _F4)]
    + [(name, _F4) for name in CORNER_COVARIANCE_FIELDS]
    + [('detector_px', _F4)]
)

_MARKER_NAMES = MARKER_DTYPE.names or ()
#: Fields that were added later: clouds without them, of other detectors and of older bags, are read all the same.
LATER_MARKER_FIELDS = _MARKER_NAMES[_MARKER_NAMES.index('contrast_counts') + 1 :]

#: A row of the ``marker_map`` topic: pose and side of a marker in ``map``, one-sigma position, error and number of
#: observations, and whether it is fixed (surveyed), used for poses, and in view of the frame that published it.
MAP_DTYPE = np.dtype(
    [('x', _F4), ('y', _F4), ('z', _F4), ('id', '<u4')]
    + [(name, _F4) for name in ('qx', 'qy', 'qz', 'qw', 'size', 'sigma_m', 'rms_px')]
    + [('observations', '<u4'), ('fixed', '<u1'), ('trusted', '<u1'), ('in_view', '<u1')]
)

#: Number of the unknowns of rows that are read late.
LATE = 7

#: The structured array of the markers of one frame, shape (N,) of :data:`MARKER_DTYPE`.
Markers = np.ndarray


# All fields have four bytes, so rows can be read and written as a table of numbers, many times faster.
_COLUMN = {name: column for column, name in enumerate(_MARKER_NAMES) if name != 'id'}
_CORNERS = [_COLUMN[name] for name in CORNER_FIELDS]
_COVARIANCES = [_COLUMN[f'c{corner}{term}'] for corner in range(4) for term in ('uu', 'uv', 'uv', 'vv')]
_COVARIANCE_TERMS = [_COLUMN[name] for name in CORNER_COVARIANCE_FIELDS]
_DETECTOR_PX = [_COLUMN['detector_px']]
_BRANCHES = [_COLUMN[f'{prefix}{name}'] for prefix in ('', 'a') for name in ('x', 'y', 'z', 'qx', 'qy', 'qz', 'qw')]


def columns(markers: Markers, names: tuple[str, ...]) -> FloatArray:
    """Fields ``names``, all but the IDs, of ``markers`` as a float64 matrix (N, len(names))."""
    if markers.dtype == MARKER_DTYPE:
        return _numbers(markers, [_COLUMN[name] for name in names])
    return np.stack([markers[name].astype(np.float64) for name in names], axis=-1)


def _numbers(markers: Markers, places: list[int]) -> FloatArray:
    """Columns (N, len(places)) of the rows, read as a table."""
    table = _table(np.ascontiguousarray(markers))
    # Invalid bytes may be a signalling NaN; it is refused later like any other NaN.
    with np.errstate(invalid='ignore'):
        return table.take(places, axis=1).astype(np.float64)


def _table(markers: Markers) -> Float32Array:
    """Contiguous rows as a table of numbers, all but the IDs: a view."""
    return markers.view(_F4).reshape(len(markers), len(_MARKER_NAMES))


def marker_rows(
    ids: IntArray,
    corners_px: FloatArray,
    covariances: FloatArray,
    poses: 'PlanarPoses',
    contrast: FloatArray | None = None,
) -> Markers:
    """Rows of N markers by rising ID, without those that have no pose.

    Parameters
    ----------
    ids : (N,)
    corners_px, covariances : (N, 4, 2) [px], (N, 4, 2, 2) [px^2]
    contrast : (N,) [counts], where it is known
    """
    rows = np.zeros(len(ids), dtype=MARKER_DTYPE)
    table = _table(rows)
    table[:, _CORNERS] = corners_px.reshape(-1, 8)
    terms = covariances.reshape(-1, 4, 4)[..., [0, 1, 3]]
    table[:, _COVARIANCE_TERMS] = terms.reshape(-1, len(_COVARIANCE_TERMS))
    rows['sigma_px'] = np.sqrt(terms[..., [0, 2]].mean(axis=(1, 2)))
    if contrast is not None:
        # They are our own: all that their covariances contain are errors of the detector.
        rows['contrast_counts'], rows['detector_px'] = contrast, rows['sigma_px']
    positions = poses.T_camera_marker[..., :3, 3]
    orientations = quaternion_from_rotation(poses.T_camera_marker[..., :3, :3])
    table[:, _BRANCHES] = np.concatenate([positions, orientations], axis=-1).reshape(-1, len(_BRANCHES))
    rows['rms_px'], rows['arms_px'] = poses.rms_px[:, 0], poses.rms_px[:, 1]
    rows['id'] = ids
    usable = np.flatnonzero(np.isfinite(poses.rms_px[:, 0]))
    return np.asarray(rows[usable[np.argsort(ids[usable], kind='stable')]])


def places_of(rows: Markers) -> tuple[dict[int, tuple[FloatArray, float]], frozenset[int]]:
    """ID to T_map_marker (4, 4) and side [m] of rows of :data:`MAP_DTYPE`; IDs of those that are in quarantine."""
    T = transform_from_quaternion(columns(rows, ('x', 'y', 'z')), columns(rows, ('qx', 'qy', 'qz', 'qw')))
    places = {int(row['id']): (T_map_marker, float(row['size'])) for row, T_map_marker in zip(rows, T, strict=True)}
    return places, frozenset(rows['id'][rows['trusted'] == 0].tolist())


def corners_px(markers: Markers) -> FloatArray:
    """Corners (N, 4, 2) [px] in the raw image, clockwise from the marker's top-left."""
    return _numbers(markers, _CORNERS).reshape(-1, 4, 2)


def corner_covariances(markers: Markers) -> FloatArray:
    """Corner covariances (N, 4, 2, 2) [px^2]."""
    return _numbers(markers, _COVARIANCES).reshape(-1, 4, 2, 2)


@dataclass(frozen=True, slots=True)
class Observations(Stacked):
    """Markers of a frame in numbers, N of them."""

    #: (N,)
    ids: IntArray
    #: (N, 4, 2) [px] and (N, 4, 2, 2) [px^2]
    corners: FloatArray
    covariances: FloatArray
    #: (N,) standard deviation of a coordinate by errors of the detector alone [px]; 0 where it is not known
    detector_px: FloatArray
    #: (N, 2, 4, 4) T_camera_marker and its alternative, NaN where there is none
    branches: FloatArray
    #: (N, 4, 2, 6) derivative by a displacement of the camera from the first row to the last [m, rad], in map axes, or
    #: those of the camera where nothing predicts it; zero where the readout time is exactly known
    by_readout: FloatArray
    #: (N, 4, 2) velocity of the corners by the share of the rows at which each is read [px/s]
    rates: FloatArray
    #: (N, 4, 2, 7) displacement by one standard deviation of each of what is not known of rows that are read late [px]:
    #: the readout time, and six of the camera's motion
    late_px: FloatArray

    @staticmethod
    def of(markers: Markers) -> 'Observations':
        """Observations of rows with valid corners; rows whose ID occurs twice are left out as ambiguous.

        Raises
        ------
        InputError
            ``markers`` are no rows of :data:`MARKER_DTYPE`.
        """
        if getattr(markers, 'dtype', None) != MARKER_DTYPE:
            raise InputError('markers that are no rows of MARKER_DTYPE, as MarkerDetector.detect returns them')
        corners, covariances = corners_px(markers), corner_covariances(markers)
        detector_px, poses = _numbers(markers, _DETECTOR_PX), _numbers(markers, _BRANCHES).reshape(-1, 2, 7)
        with np.errstate(invalid='ignore', divide='ignore'):
            branches = transform_from_quaternion(poses[..., :3], poses[..., 3:])
        by_readout, rates = np.zeros((len(markers), 4, 2, 6)), np.zeros((len(markers), 4, 2))
        late_px = np.zeros((len(markers), 4, 2, LATE))
        ids = markers['id'].astype(np.int64)
        observations = Observations(ids, corners, covariances, detector_px[:, 0], branches, by_readout, rates, late_px)
        uu, uv, vv = covariances[..., 0, 0], covariances[..., 0, 1], covariances[..., 1, 1]
        sound = (uu > 0.0) & (uu * vv > uv**2) & np.isfinite(corners).all(axis=2)
        usable: BoolArray = np.asarray(sound.all(axis=1))
        if len(set(ids.tolist())) < len(ids):
            _, place, times = np.unique(ids, return_inverse=True, return_counts=True)
            usable &= times[place] == 1
        return observations if usable.all() else observations.only(usable)

    @property
    def readout_px(self) -> FloatArray:
        """Standard deviation (N,) of a coordinate by what is not known of rows that are read late."""
        return np.asarray(np.sqrt(np.sum(self.late_px**2, axis=-1).mean(axis=(1, 2))))


_IMU_SHAPES = {'angular_velocity': (3,), 'linear_acceleration': (3,)}
_POSE_SHAPES = {'T_map_camera': (4, 4), 'covariance': (6, 6), 'map_covariance': (6, 6)}


def whole_ns(stamp_ns: Any, what: str) -> int:
    """A stamp of ``what`` as an integer.

    Raises
    ------
    InputError
        It is none, as one in seconds.
    """
    try:
        # Differences of numpy's unsigned integers would never be negative.
        return index(stamp_ns)
    except TypeError:
        raise InputError(f'{what}: stamp_ns {stamp_ns!r} is not an integer of nanoseconds') from None


def _check(record: 'ImuSample | CameraPose', shapes: Mapping[str, tuple[int, ...]]) -> None:
    """Raise InputError if arrays of a ``record`` are not numbers of ``shapes``, or its stamp is not an integer."""
    kind = type(record).__name__
    object.__setattr__(record, 'stamp_ns', whole_ns(record.stamp_ns, kind))
    for name, shape in shapes.items():
        require_numbers(getattr(record, name), shape, f'{kind}: {name}')


@dataclass(frozen=True, slots=True)
class ImuSample:
    """One IMU message, in ``base_link`` (x forward, y left, z up).

    Raises
    ------
    InputError
        A stamp that is not an integer, or an array of another shape or not of numbers.
    """

    stamp_ns: int
    #: (3,) [rad/s]
    angular_velocity: FloatArray
    #: (3,) specific force [m/s^2]: +9.81 on z at rest
    linear_acceleration: FloatArray

    def __post_init__(self) -> None:
        _check(self, _IMU_SHAPES)


@dataclass(frozen=True, slots=True)
class CameraPose:
    """The camera in the map from the markers of one frame.

    Raises
    ------
    InputError
        A stamp that is not an integer, or an array of another shape or not of numbers.
    """

    stamp_ns: int
    #: (4, 4)
    T_map_camera: FloatArray
    #: (6, 6), ROS convention, in ``map`` [m, rad]
    covariance: FloatArray
    #: (6, 6) the part of ``covariance`` that is due to errors of the map and its scale
    map_covariance: FloatArray = field(default_factory=lambda: np.zeros((6, 6)))
    #: IDs of the markers that it was estimated from
    marker_ids: tuple[int, ...] = field(default=())
    #: re-projection error, rms over their corners [px]
    rms_px: float = 0.0

    def __post_init__(self) -> None:
        _check(self, _POSE_SHAPES)

    def widened(self, by: FloatArray) -> 'CameraPose':
        """The pose with a covariance that is larger ``by`` (6, 6)."""
        return replace(self, covariance=self.covariance + by)

    def in_moved_map(self, T_new_old: FloatArray) -> 'CameraPose':
        """The pose in a map whose coordinates are moved by ``T_new_old`` (4, 4)."""
        R = T_new_old[:3, :3]
        return replace(
            self,
            T_map_camera=T_new_old @ self.T_map_camera,
            covariance=turned(self.covariance, R),
            map_covariance=turned(self.map_covariance, R),
        )


@dataclass(frozen=True, slots=True)
class Odometry:
    """The robot's state at the stamp of one IMU message."""

    stamp_ns: int
    #: (4, 4)
    T_map_body: FloatArray
    #: (3,) velocity in ``base_link`` [m/s]
    velocity_body: FloatArray
    #: (3,) bias-free angular velocity in ``base_link`` [rad/s]
    angular_velocity_body: FloatArray
    #: (6, 6), ROS convention, in ``map`` [m, rad]
    pose_covariance: FloatArray
    #: (6, 6), linear then angular, in ``base_link`` [m/s, rad/s]
    twist_covariance: FloatArray

    def in_moved_map(self, T_new_old: FloatArray) -> 'Odometry':
        """The odometry in a map whose coordinates are moved by ``T_new_old`` (4, 4)."""
        covariance = turned(self.pose_covariance, T_new_old[:3, :3])
        return replace(self, T_map_body=T_new_old @ self.T_map_body, pose_covariance=covariance)


@dataclass(frozen=True, slots=True)
class Condition:
    """Condition of a stage in words: what it does or lacks, and details, which may change with every message."""

    words: str
    details: str = ''

    def __str__(self) -> str:
        return f'{self.words}: {self.details}' if self.details else self.words
