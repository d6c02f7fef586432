"""Recorded flights of real IMUs before real markers (``real_flights`` of the real data; its README says what they are).

A folder has ``imu.csv``, corners a row a marker, ``rig.yaml``, and, the board, a map and a reference.
"""

import csv
from dataclasses import replace
from functools import cache, partial
import hashlib
import os
from pathlib import Path
import tempfile

import numpy as np
from scipy.spatial.transform import Rotation
import yaml

from support import self_calibration
from support.batch_map import adjust
from support.corner_runs import CornerFlight
from thermal_fiducial.calibration.camera_imu import calibrate_rolling_camera_imu
from thermal_fiducial.calibration.joint_pose import solve_camera_pose
from thermal_fiducial.calibration.lens_choice import choose_model
from thermal_fiducial.calibration.preintegration import ImuTrack
from thermal_fiducial.calibration.rolling import FrameCorners
from thermal_fiducial.calibration.targets import MarkerBoard
from thermal_fiducial.config import ImuNoise, MarkerMapperConfig
from thermal_fiducial.core.detection.detector import rows_from_corners
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.geometry.reprojection import corners_in_map
from thermal_fiducial.core.geometry.se3 import (
    apply,
    inverse,
    rigid_alignment,
    so3_exp,
    so3_log,
    transform,
    transform_from_quaternion,
)
from thermal_fiducial.core.mapping.map_data import MapMarker, MarkerMap
from thermal_fiducial.core.measurements import corner_covariances, corners_px, ImuSample
from thermal_fiducial.files.marker_map import load_map, save_map
from thermal_fiducial.files.trajectory_file import load_tum
from thermal_fiducial.map_tools.map_building import build_map

CARPETS = ('carpet_mountain', 'carpet_slow_circle')
#: Corner noise [px]: what re-projection leaves of the board's corners, and the median that it leaves of the carpet's
#: (0.24 px of both coordinates together; one corner in a hundred is 1.6 px off).
BOARD_SIGMA_PX, CARPET_SIGMA_PX = 0.35, 0.20
#: In-run bias stability by the data sheet of the ADIS16448, 14.5 deg/h and 0.25 mg: the lowest Allan deviation, 0.664
#: of the coefficient of flicker noise. That of flight would be more, but this rig is carried by hand.
_INSTABILITY = {'gyroscope_instability': 1.06e-4, 'accelerometer_instability': 3.7e-3}
#: Of the board's recording [s].
_BOARD_S = 40.0
#: The marker that the carpet's map starts with lies on the floor, face up.
CARPET_ORIGIN = 40
#: Frames to either side that a pose of the carpet's reference is smoothed over.
_NEIGHBOURS = 4
#: Frames of fewer markers are no reference: single ones of the course's corners are pixels off.
_FEWEST_MARKERS = 6
#: Re-projection error [px] beyond which a frame's pose starts from its own markers, not from the last frame's pose.
_LOST_PX = 2.0
#: Folders of maps by the hash of the corners that they are made of.
_KEPT = (Path(__file__).with_name('carpet_maps'), Path(tempfile.gettempdir()) / 'thermal_fiducial_carpet_maps')
#: One frame in so many estimates lens and board: 50 of them.
_OF_LENS = 16
#: The same of the carpets: 200 of each flight.
_OF_CARPET_LENS = 3
#: What the lens as given may displace the carpet's corners by, at the most [m]: of 0.02 to 0.1 the same lens is found.
_BENT_BY_LENS = 0.02


def folder(name) -> Path:
    """Folder of a recording; a KeyError where there are no real data."""
    return Path(os.environ['THERMAL_FIDUCIAL_DATA']) / 'real_flights' / name


@cache
def april_board(camera='cam0', sigma_px=BOARD_SIGMA_PX, seconds=_BOARD_S, every=1) -> CornerFlight:
    """Forty seconds before the board, or the first of them, through ``cam0`` or ``cam1``: ``every`` so many frames."""
    place = folder('april_board')
    rig = yaml.safe_load((place / 'rig.yaml').read_text())
    entry = rig['cameras'][camera]
    marker_map = load_map(place / 'map.yaml')
    stamps, positions, quaternions = load_tum(place / 'reference.tum')
    size = next(iter(marker_map.markers.values())).size
    published = {name: value for name, value in rig['imu'].items() if name != 'rate_hz'}
    lens = _lens(entry)
    return CornerFlight(
        f'april board {camera}',
        _samples(place / 'imu.csv', seconds),
        _frames(place / f'{camera}.csv', size, lens, sigma_px, seconds, every),
        lens,
        np.array(entry['T_body_camera']).reshape(4, 4),
        marker_map,
        stamps,
        transform_from_quaternion(positions, quaternions),
        size,
        ImuNoise(**published, **_INSTABILITY),
    )


def camera_against_imu(flight):
    """What ``calibrate camera-imu`` finds from the corners and the map of a flight."""
    stamps = np.array([sample.stamp_ns for sample in flight.samples])
    rate = np.array([sample.angular_velocity for sample in flight.samples])
    force = np.array([sample.linear_acceleration for sample in flight.samples])
    imu = ImuTrack((stamps - stamps[0]) * 1e-9, rate, force)
    frames = []
    for stamp, rows in sorted(flight.frames.items()):
        markers = [flight.marker_map.markers[marker_id] for marker_id in rows['id'].tolist()]
        T = np.stack([marker.T_map_marker for marker in markers])
        sizes = np.array([marker.size for marker in markers])
        frames.append(FrameCorners(stamp, corners_px(rows), corner_covariances(rows), T, sizes))
    return calibrate_rolling_camera_imu(frames, flight.camera, imu, int(stamps[0]), flight.imu_noise)


def lens_and_board(flight, every, board_std=5e-4):
    """What ``calibrate intrinsics`` finds from one in so many frames of a flight, and the map of the board as found."""
    # No detector: the corners are there.
    board = MarkerBoard(flight.marker_map, None)
    views = [board.sighting(rows) for _, rows in sorted(flight.frames.items())[::every]]
    lens = flight.camera
    found, _ = choose_model(views, lens.width, lens.height, ['plumb_bob'], focal_px=460.0, board_std=board_std)
    return found, board.as_found(found.board)


def part(flight, begin, seconds) -> CornerFlight:
    """So many ``seconds`` of a flight from ``begin`` [s] on."""
    first_ns = flight.samples[0].stamp_ns + round(1e9 * begin)
    last_ns = first_ns + round(1e9 * seconds)
    samples = [sample for sample in flight.samples if first_ns <= sample.stamp_ns < last_ns]
    frames = {stamp: rows for stamp, rows in flight.frames.items() if first_ns <= stamp < last_ns}
    return replace(flight, samples=samples, frames=frames)


@cache
def board_reference(camera) -> tuple[np.ndarray, np.ndarray]:
    """Stamps (N,) [ns] and T_map_body (N, 4, 4) by ``camera`` alone, with lens and board from its own corners.

    The published reference shares lens and board with the poses from the markers, and so their largest error. Where the
    camera sits on the body is taken from it in the mean, as the published extrinsics belong to the published lens.
    """
    # Of its frames only the corners are needed, not the poses of each marker, which take longer than all the rest.
    flight, frames = april_board(camera, seconds=0.0), dict(_corners(folder('april_board') / f'{camera}.csv', _BOARD_S))
    _, _, T_map_camera = _by_own_lens(list(frames.values()), flight.marker_map, flight.camera, _OF_LENS)
    stamps = np.array(list(frames)) + round(1e9 * flight.time_offset)
    inside = (stamps >= flight.reference_ns[0]) & (stamps <= flight.reference_ns[-1])
    mounted = inverse(flight.truth(stamps[inside])) @ T_map_camera[inside]
    R_body_camera = Rotation.from_matrix(mounted[:, :3, :3]).mean().as_matrix()
    return stamps, T_map_camera @ inverse(transform(R_body_camera, mounted[:, :3, 3].mean(axis=0)))


def _by_own_lens(frames, marker_map, camera, every, **priors):
    """Lens and points (P, 3) of a map, by ID, from ``every`` so many frames of its corners, and all camera poses.

    Parameters
    ----------
    frames : IDs (N,) and corners (N, 4, 2) [px] of each; all markers are in the map
    """
    place = {key: 4 * index + np.arange(4) for index, key in enumerate(sorted(marker_map.markers))}
    known = [marker_map.markers[key] for key in place]
    squares = corners_of(known)
    seen = [np.concatenate([place[int(key)] for key in ids]) for ids, _ in frames]
    views = self_calibration.Views(seen, [corners.reshape(-1, 2) for _, corners in frames])
    some = self_calibration.Views(views.points[::every], views.pixels[::every])
    given = self_calibration.Lens(camera.K, camera.D)
    lens, points = self_calibration.calibrate(some, given, squares.reshape(-1, 3), **priors)
    T_map_camera = self_calibration.camera_poses(views, lens, points)
    return lens, {key: points[where] for key, where in place.items()}, T_map_camera


@cache
def carpet_by_own_lens(name):
    """What the reference of a carpet becomes with the lens estimated, which else it shares with what it judges.

    Returns
    -------
    The lens, the carpet's corners (4, 3) [m] by ID, and the flight with this reference.
    """
    flight = carpet(name)
    known = list(flight.marker_map.markers)
    rich = {stamp: rows[np.isin(rows['id'], known)] for stamp, rows in flight.frames.items()}
    rich = {stamp: rows for stamp, rows in rich.items() if len(rows) >= _FEWEST_MARKERS}
    frames = [(rows['id'], corners_px(rows)) for rows in rich.values()]
    lens, corners, T = _by_own_lens(frames, flight.marker_map, flight.camera, _OF_CARPET_LENS, board_std=_BENT_BY_LENS)
    held = corners_in_map(np.eye(4), flight.marker_map.markers[CARPET_ORIGIN].size)
    T_map_found = rigid_alignment(held, corners[CARPET_ORIGIN])
    stamps = np.array(list(rich))
    reference = _smoothed(stamps, T_map_found @ T) @ inverse(flight.T_body_camera)
    placed = {key: apply(T_map_found, points) for key, points in corners.items()}
    return lens, placed, replace(flight, reference_ns=stamps, reference=reference)


@cache
def carpet(name, sigma_px=CARPET_SIGMA_PX, seconds=np.inf) -> CornerFlight:
    """A flight over the carpet, or the beginning of it.

    Its reference is smoothed from the poses of all corners, on the map of all corners.
    """
    place = folder(name)
    rig = yaml.safe_load((place / 'rig.yaml').read_text())
    entry, size = rig['cameras']['cam0'], rig['marker_size']
    lens = _lens(entry)
    frames = _frames(place / 'detections.csv', size, lens, sigma_px, seconds)
    T_body_camera = transform_from_quaternion(entry['camera_position'], entry['camera_orientation'])
    marker_map = batch_map(name, sigma_px)
    rich = {stamp: rows for stamp, rows in frames.items() if len(rows) >= _FEWEST_MARKERS}
    stamps, cameras = _camera_poses(rich, lens, marker_map)
    reference = _smoothed(stamps, cameras) @ inverse(T_body_camera)
    samples = _samples(place / 'imu.csv', seconds)
    return CornerFlight(name, samples, frames, lens, T_body_camera, marker_map, stamps, reference, size)


@cache
def batch_map(name, sigma_px=CARPET_SIGMA_PX) -> MarkerMap:
    """The carpet's map by an adjustment of all corners of a flight that shares nothing with ours, taken for exact.

    It takes 15 s. Those that all tests need are kept beside this file, others among the temporary files.
    """
    detections = (folder(name) / 'detections.csv').read_bytes()
    places = [place / f'{hashlib.sha256(detections).hexdigest()[:16]}_{sigma_px}.yaml' for place in _KEPT]
    kept = next((place for place in places if place.exists()), places[-1])
    if not kept.exists():
        kept.parent.mkdir(exist_ok=True)
        save_map(kept, adjusted_map(name, sigma_px))
    return load_map(kept)


def adjusted_map(name, sigma_px=CARPET_SIGMA_PX) -> MarkerMap:
    """The better of two, from two starts: from one of them a marker of `carpet_slow_circle` stays turned by 77 deg."""
    place = folder(name)
    rig = yaml.safe_load((place / 'rig.yaml').read_text())
    size, lens = rig['marker_size'], _lens(rig['cameras']['cam0'])
    frames = _frames(place / 'detections.csv', size, lens, sigma_px)
    starts = (build_map(_some(frames, n), lens, origin_alone(), MarkerMapperConfig(marker_size=size)) for n in (4, 5))
    adjusted, _ = min((_adjusted(built.map, frames, lens, size) for built in starts), key=lambda result: result[1])
    return MarkerMap({key: MapMarker(key, size, True, T) for key, T in adjusted.items()})


def _some(frames, every):
    """One frame in ``every``."""
    return list(frames.values())[::every]


def _adjusted(built, frames, lens, size):
    """T_map_marker by ID, and the rms error [px], of least squares over all frames from the map ``built``."""
    stamps, cameras = _camera_poses(frames, lens, built)
    views = [
        (int(stamp), int(key), corners)
        for stamp in stamps
        for key, corners in zip(frames[stamp]['id'], corners_px(frames[stamp]), strict=True)
        if int(key) in built.markers
    ]
    starts = {key: marker.T_map_marker for key, marker in built.markers.items()}
    return adjust(lens.K, size, views, dict(zip(stamps.tolist(), cameras, strict=True)), starts, held=CARPET_ORIGIN)


def origin_alone() -> MarkerMap:
    """What mapping the carpet starts with."""
    size = yaml.safe_load((folder(CARPETS[0]) / 'rig.yaml').read_text())['marker_size']
    return MarkerMap({CARPET_ORIGIN: MapMarker(CARPET_ORIGIN, size, True, np.eye(4))})


def map_error_mm(marker_map, other) -> float:
    """Rms distance of the common markers' centres after the best similarity [mm]: of any scale."""
    common = sorted(marker_map.markers.keys() & other.markers.keys())
    a, b = (np.array([m.markers[key].T_map_marker[:3, 3] for key in common]) for m in (marker_map, other))
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    turned = Rotation.align_vectors(b, a)[0].apply(a)
    scale = np.sum(turned * b) / np.sum(turned * turned)
    return 1e3 * float(np.sqrt(np.mean(np.sum((scale * turned - b) ** 2, axis=1))))


def corners_of(markers):
    """Corners (N, 4, 3) [m] of markers of a map."""
    return corners_in_map(np.stack([m.T_map_marker for m in markers]), np.array([m.size for m in markers]))


def _camera_poses(frames, lens, marker_map):
    """Stamps (N,) and T_map_camera (N, 4, 4) by least squares over the corners of each frame."""
    stamps, poses = [], []
    for stamp, rows in frames.items():
        rows = rows[np.isin(rows['id'], list(marker_map.markers))]
        if not len(rows):
            continue
        known = [marker_map.markers[int(key)] for key in rows['id']]
        squares = corners_of(known)
        solve = partial(solve_camera_pose, corners_px(rows), corner_covariances(rows), squares, lens)
        solution = solve(poses[-1], compete=False) if poses else solve()
        solution = solution if solution.rms_px < _LOST_PX else solve()
        stamps.append(stamp)
        poses.append(solution.T_map_camera)
    return np.array(stamps), np.array(poses)


def _smoothed(stamps, poses):
    """Each pose by a cubic through its neighbours, so that a frame's own noise hardly counts."""
    smooth = np.empty_like(poses)
    for k, (stamp, T) in enumerate(zip(stamps, poses, strict=True)):
        near = slice(max(k - _NEIGHBOURS, 0), k + _NEIGHBOURS + 1)
        t = (stamps[near] - stamp) * 1e-9
        turns = so3_log(T[:3, :3].T @ poses[near, :3, :3])
        values = np.concatenate((poses[near, :3, 3], turns), axis=1)
        at_zero = np.linalg.lstsq(np.vander(t, 4), values, rcond=None)[0][-1]
        smooth[k] = transform(T[:3, :3] @ so3_exp(at_zero[3:]), at_zero[:3])
    return smooth


def _lens(entry) -> Camera:
    K = np.array(entry['K']).reshape(3, 3)
    return Camera(entry['width'], entry['height'], K, entry['model'], np.array(entry['D']))


def _table(path, seconds):
    with path.open(newline='') as file:
        rows = list(csv.reader(file))[1:]
    stamps, values = np.array([int(row[0]) for row in rows]), np.array([[float(v) for v in row[1:]] for row in rows])
    first = stamps - stamps.min() < seconds * 1e9
    return stamps[first], values[first]


def _samples(path, seconds=np.inf):
    stamps, values = _table(path, seconds)
    return [ImuSample(int(stamp), row[:3], row[3:]) for stamp, row in zip(stamps, values, strict=True)]


def _frames(path, size, lens, sigma_px, seconds=np.inf, every=1):
    frames = {}
    for stamp, (ids, corners) in _corners(path, seconds, every):
        covariances = np.broadcast_to(sigma_px**2 * np.eye(2), (len(ids), 4, 2, 2))
        frames[stamp] = rows_from_corners(ids, corners, covariances, np.full(len(ids), size), lens)
    return frames


def _corners(path, seconds=np.inf, every=1):
    """Stamp [ns], and IDs (N,) with corners (N, 4, 2) [px], of ``every`` so many frames."""
    stamps, values = _table(path, seconds)
    for stamp in np.unique(stamps)[::every]:
        rows = values[stamps == stamp]
        yield int(stamp), (rows[:, 0].astype(np.int64), rows[:, 1:9].reshape(-1, 4, 2))
