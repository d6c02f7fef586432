"""The recorded tag corners of tagslam, through the mapper, and the re-projection error of either solution."""

from collections import defaultdict
import csv
from dataclasses import dataclass, field, replace
import sys

import numpy as np
import yaml

from support.scenes import motion_prior
from thermal_fiducial.config import MarkerMapperConfig
from thermal_fiducial.core.detection.detector import rows_from_corners
from thermal_fiducial.core.error_model import SystematicErrors
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.geometry.reprojection import corners_in_map, reproject
from thermal_fiducial.core.geometry.se3 import inverse, so3_exp, transform, transform_from_quaternion
from thermal_fiducial.core.lens_errors import of_aspect
from thermal_fiducial.core.mapping.bundle_adjustment import refine
from thermal_fiducial.core.mapping.map_data import MapMarker, MarkerMap
from thermal_fiducial.core.mapping.mapper import MarkerMapper
from thermal_fiducial.core.measurements import Odometry
from thermal_fiducial.map_tools.map_building import decide

#: Noise of the recorded corners [px]: the re-projection errors of the reference are about that.
SIGMA_PX = 0.3
# Growth of the odometry's error with the way and with time: 2 % of the way is what drifting visual odometry has.
_DRIFT, _WALK_M, _WALK_RAD = 0.02, 0.005, 0.003
# And what that is of a velocity of 1 m/s and a turn of 1 rad/s.
_SPEED_SIGMA, _TURN_SIGMA = 0.02, 0.01


@dataclass
class Recording:
    """One recorded set: corners by stamp and camera, and the solution of the reference."""

    #: the first camera on the rig
    camera: Camera
    T_rig_camera: np.ndarray
    sizes: defaultdict[int, float]
    #: stamp -> list of (marker, corners (4, 2)) that it saw
    views: dict[int, list[tuple[int, np.ndarray]]]
    fixed: list[int]
    #: reference: T_map_rig by stamp, T_map_marker by ID
    T_map_rig: dict[int, np.ndarray]
    T_map_marker: dict[int, np.ndarray]
    odometry: list[tuple[int, np.ndarray]] = field(default_factory=list)
    T_rig_odometry: np.ndarray = field(default_factory=lambda: np.eye(4))


def _stamp(text):
    seconds, _, fraction = text.partition('.')
    return int(seconds) * 10**9 + int(fraction.ljust(9, '0')[:9])


def _pose(row):
    return transform_from_quaternion([float(row[k]) for k in 'xyz'], [float(row['q' + k]) for k in 'xyzw'])


def _rows(path):
    with path.open(newline='') as file:
        yield from csv.DictReader(file)


def _camera(entry):
    fx, fy, cx, cy = entry['intrinsics']
    model = 'equidistant' if entry['distortion_model'] == 'equidistant' else 'plumb_bob'
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    return Camera(*entry['resolution'], K, model, np.array(entry['distortion_coeffs']))


def load(folder):
    """Recording in ``folder``."""
    cameras = yaml.safe_load((folder / 'cameras.yaml').read_text())
    bodies = [next(iter(body.values())) for body in yaml.safe_load((folder / 'tagslam.yaml').read_text())['bodies']]
    static = next(body for body in bodies if body.get('is_static'))
    sizes = defaultdict(lambda: static['default_tag_size'], {tag['id']: tag['size'] for tag in static['tags']})
    ignored = {key for body in bodies for key in body.get('ignore_tags') or []}
    name, first = next(iter(cameras.items()))
    views = defaultdict(list)
    for row in _rows(folder / 'detections.csv'):
        # Recorded (-,-) (+,-) (+,+) (-,+) of the tag's frame; ours begin at (-,+) and run clockwise.
        corners = np.array([[float(row[f'u{i}']), float(row[f'v{i}'])] for i in (3, 2, 1, 0)])
        if int(row['id']) not in ignored and row['topic'] == first['tagtopic']:
            views[_stamp(row['stamp'])].append((int(row['id']), corners))
    transforms, rig_poses = {}, {}
    for row in _rows(folder / 'reference_tf.csv'):
        if row['parent'] == 'map' and 'rig' in row['child']:
            rig_poses[_stamp(row['stamp'])] = _pose(row)
        else:
            transforms[row['parent'], row['child']] = _pose(row)
    body = next(child for parent, child in transforms if parent == 'map')
    rig = next(parent for parent, child in transforms if child == 'cam0')
    recording = Recording(
        _camera(first),
        transforms[rig, name],
        sizes,
        dict(sorted(views.items())),
        [tag['id'] for tag in static['tags']],
        rig_poses,
        {
            int(child[4:]): transforms['map', body] @ T
            for (parent, child), T in transforms.items()
            if parent == body and child.startswith('tag_')
        },
    )
    if (folder / 'input_odom.csv').exists():
        recording.odometry = [(_stamp(row['stamp']), _pose(row)) for row in _rows(folder / 'input_odom.csv')]
        mount = next(entry['T_body_odom'] for entry in bodies if 'T_body_odom' in entry)
        position, rotation = ([mount[kind][axis] for axis in 'xyz'] for kind in ('position', 'rotation'))
        recording.T_rig_odometry = transform(so3_exp(rotation), position)
    return recording


class _Filter:
    """Stands in for the pose filter: carries the last pose on by the recorded odometry, and what it is known to."""

    def __init__(self, recording):
        self._stamps = np.array([stamp for stamp, _ in recording.odometry], dtype=np.int64)
        self._poses = [T for _, T in recording.odometry]
        self._T_camera_odometry = inverse(recording.T_rig_camera) @ recording.T_rig_odometry
        self._anchor = None

    def _at(self, stamp):
        if not len(self._stamps):
            return None
        i = int(np.argmin(np.abs(self._stamps - stamp)))
        return self._poses[i] if abs(self._stamps[i] - stamp) < 50_000_000 else None

    def add(self, pose):
        T = self._at(pose.stamp_ns)
        if T is not None:
            self._anchor = (pose.stamp_ns, pose.T_map_camera, pose.covariance, T)

    def odometry(self, stamp):
        T = self._at(stamp)
        if T is None or self._anchor is None:
            return []
        since, T_map_camera, known, T_then = self._anchor
        moved = self._T_camera_odometry @ inverse(T_then) @ T @ inverse(self._T_camera_odometry)
        walk = np.sqrt(abs(stamp - since) * 1e-9)
        sigma_m = 0.005 + _DRIFT * np.linalg.norm(moved[:3, 3]) + _WALK_M * walk
        covariance = np.diag([sigma_m**2] * 3 + [(0.002 + _WALK_RAD * walk) ** 2] * 3)
        zero = np.zeros(3)
        twist = np.diag([_SPEED_SIGMA**2] * 3 + [_TURN_SIGMA**2] * 3)
        return [Odometry(stamp, T_map_camera @ moved, zero, zero, known + covariance, twist)]


def solve(recording, passes=1):
    """The map of the mapper, fed with the frames of the first camera, then adjusted to all of them.

    Returns
    -------
    Markers by ID, and the refinement.
    """
    start = {key: MapMarker(key, recording.sizes[key], True, recording.T_map_marker[key]) for key in recording.fixed}
    config = MarkerMapperConfig(
        marker_size=recording.sizes[-1],
        camera_orientation=(0.0, 0.0, 0.0, 1.0),
        bridge_duration=60.0,
        keyframe_budget=5000,
        refinement_period=1.0,
    )
    mapper = MarkerMapper(config, MarkerMap(start))
    camera = recording.camera
    for _ in range(passes):
        stand_in = _Filter(recording)
        for stamp, seen in recording.views.items():
            rows = _frame(recording, seen)
            result = mapper.process(stamp, rows, camera, motion_prior(*stand_in.odometry(stamp)))
            if result.pose is not None:
                stand_in.add(result.pose)
            if mapper.refinement_due(stamp):
                mapper.refine()
        mapper.refine()
    whole = mapper.snapshot(sys.maxsize)
    # Markers seen too briefly: all frames together decide between their two poses.
    for candidate in mapper.candidates.values():
        settled = decide(whole, candidate.id, candidate.size, candidate.solutions(camera)[:2])
        if settled is not None:
            whole = replace(whole, markers={**whole.markers, candidate.id: settled})
    refinement = refine(whole)
    return {**whole.markers, **refinement.markers}, refinement


def _frame(recording, seen):
    ids = np.array([key for key, _ in seen], dtype=np.int64)
    sizes = np.array([recording.sizes[key] for key in ids.tolist()])
    corners = np.array([corners for _, corners in seen]).reshape(-1, 4, 2)
    covariances = np.broadcast_to(SIGMA_PX**2 * np.eye(2), (len(ids), 4, 2, 2))
    return rows_from_corners(ids, corners, covariances, sizes, recording.camera)


def compare(recording, markers, refinement):
    """Rms re-projection error [px] of our solution and of the reference over the same views, and their number.

    Ours with the aspect ratio of the pixels that it found, the reference with the one that it was given.
    """
    ours, theirs, found = [], [], refinement.aspect.share
    for stamp, T_map_camera in refinement.keyframes.items():
        for key, corners in recording.views[stamp]:
            if key in markers and key in recording.T_map_marker and stamp in recording.T_map_rig:
                off_px = found * of_aspect(corners, recording.camera, SystematicErrors())
                for errors, T_camera, T_marker, there in (
                    (ours, T_map_camera, markers[key].T_map_marker, corners - off_px),
                    (theirs, recording.T_map_rig[stamp] @ recording.T_rig_camera, recording.T_map_marker[key], corners),
                ):
                    uv = reproject(recording.camera, T_camera, corners_in_map(T_marker, recording.sizes[key]))
                    errors.append(np.sum((uv - there) ** 2, axis=-1))
    return np.sqrt(np.mean(ours)), np.sqrt(np.mean(theirs)), len(ours)
