"""Scenes that show what the parts of the mapper are for: flights of corners, simulated and recorded."""

from collections.abc import Callable
from dataclasses import replace
import os
from pathlib import Path
import time
from typing import Any

import numpy as np

from support import real_flights, tagslam, walls
from support.corner_runs import rms
from support.following_filter import FollowingFilter
from support.scenes import motion_prior
from support.wrong_lenses import bent_corridor
from thermal_fiducial.calibration.joint_pose import solve_camera_pose
from thermal_fiducial.config import MarkerMapperConfig
from thermal_fiducial.core.geometry.se3 import difference, inverse, quaternion_from_rotation, retract, transform
from thermal_fiducial.core.mapping.bundle_adjustment import refine
from thermal_fiducial.core.mapping.map_data import MapMarker, MarkerMap
from thermal_fiducial.core.mapping.mapper import MarkerMapper
from thermal_fiducial.core.measurements import corner_covariances, corners_px, Odometry

AS_BODY = {'camera_orientation': (0.0, 0.0, 0.0, 1.0)}
SECOND_NS = 1_000_000_000
#: Distortion that a calibration has missed: 2.9 px in the corners of the image, 0.4 px half-way there.
WRONG_K1 = 0.012

Figures = dict[str, float]


def _mapped(mapper: MarkerMapper, frames: dict[int, Any], camera: Any, ekf: Any = None) -> Figures:
    """Frames through the mapper with its refinements: located, and what a frame and the refinements cost."""
    located, adjusting, begin = 0, 0.0, time.process_time()
    for stamp, rows in frames.items():
        pose = mapper.process(stamp, rows, camera, None if ekf is None else ekf.prior(stamp)).pose
        located += pose is not None
        if ekf is not None:
            ekf.follow(stamp, pose)
        if mapper.refinement_due(stamp):
            since = time.process_time()
            snapshot = mapper.snapshot()
            refinement = None if snapshot is None else refine(snapshot)
            if refinement is not None:
                mapper.apply(refinement)
            adjusting += time.process_time() - since
    total = time.process_time() - begin
    stamps = list(frames)
    return {
        'located %': 100 * located / len(frames),
        'ms a frame': 1e3 * (total - adjusting) / len(frames),
        'refinement, % of a core': 100 * adjusting / ((stamps[-1] - stamps[0]) / SECOND_NS),
    }


def _scale_free(stamps: np.ndarray, positions: np.ndarray) -> float:
    """Rms second difference of positions (N, 3) between frames in steady succession [mm]."""
    steps = np.diff(stamps)
    even = (np.abs(steps[1:] - steps[:-1]) < 0.1 * steps[1:]) & (steps[1:] < 2 * np.median(steps))
    second = positions[2:] - 2.0 * positions[1:-1] + positions[:-2]
    return 1e3 * rms(np.linalg.norm(second, axis=1)[even]) / np.sqrt(6.0)


def _jitter(marker_map: MarkerMap, frames: dict[int, Any], flight: Any) -> float:
    """Jitter of the mapper's poses on its own map, over that of plain least squares of the same corners on it."""
    mapper = MarkerMapper(MarkerMapperConfig(mode='localization', marker_size=flight.marker_size), marker_map)
    stamps, ours, plain = [], [], []
    for stamp, rows in frames.items():
        pose = mapper.process(stamp, rows, flight.camera).pose
        rows = rows[np.isin(rows['id'], list(marker_map.markers))]
        if pose is None or len(rows) < 2:
            continue
        known = [marker_map.markers[int(key)] for key in rows['id']]
        squares = real_flights.corners_of(known)
        solution = solve_camera_pose(
            corners_px(rows), corner_covariances(rows), squares, flight.camera, pose.T_map_camera, compete=False
        )
        stamps.append(stamp)
        ours.append(pose.T_map_camera[:3, 3])
        plain.append(solution.T_map_camera[:3, 3])
    return _scale_free(np.array(stamps), np.array(ours)) / _scale_free(np.array(stamps), np.array(plain))


def carpet() -> Figures:
    """Every third frame of a flight over a carpet of 81 tags: the map from one of them."""
    flight = real_flights.carpet('carpet_mountain')
    frames = dict(list(flight.frames.items())[::3])
    config = MarkerMapperConfig(marker_size=flight.marker_size)
    mapper = MarkerMapper(config, real_flights.origin_alone())
    figures = _mapped(mapper, frames, flight.camera)
    figures['placed'] = len(mapper.map.markers)
    figures['map mm'] = real_flights.map_error_mm(mapper.map, flight.marker_map)
    figures['jitter over plain'] = _jitter(mapper.map, frames, flight)
    return figures


def _errors(what: str, poses: list[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> Figures:
    """Of true poses, poses and covariances: errors of position, and NEES per degree of freedom."""
    apart = [(difference(T, truth), P) for truth, T, P in poses]
    return {
        f'{what} mm': 1e3 * rms([np.linalg.norm(d[:3]) for d, _ in apart]),
        f'{what} NEES': float(np.mean([d @ np.linalg.solve(P, d) / 6.0 for d, P in apart])),
    }


def board(surveyed: bool = False) -> Figures:
    """Every other frame of a real calibration flight before 36 tags, on the map of the board.

    ``surveyed``: each tag off by 5 mm and 20 mrad of its own, as its covariance says.
    """
    flight = real_flights.april_board('cam0')
    config = MarkerMapperConfig(
        mode='localization',
        marker_size=flight.marker_size,
        camera_position=tuple(flight.T_body_camera[:3, 3]),
        camera_orientation=tuple(quaternion_from_rotation(flight.T_body_camera[:3, :3])),
    )
    marker_map = _surveyed(flight.marker_map, (0.005, 0.02)) if surveyed else flight.marker_map
    mapper, located = MarkerMapper(config, marker_map), []
    for stamp, rows in list(flight.frames.items())[::2]:
        pose = mapper.process(stamp, rows, flight.camera).pose
        if pose is not None and flight.reference_ns[0] <= stamp <= flight.reference_ns[-1]:
            located.append((flight.truth([stamp])[0] @ flight.T_body_camera, pose.T_map_camera, pose.covariance))
    return {'located': len(located), **_errors('pose', located)}


def _surveyed(marker_map: MarkerMap, stds: tuple[float, float]) -> MarkerMap:
    """The map by a survey of each marker: positions and rotations off by ``stds`` [m, rad] along each axis."""
    rng, of_each = np.random.default_rng(0), np.repeat(stds, 3)
    measured = {
        key: MapMarker(
            key, marker.size, False, retract(marker.T_map_marker, of_each * rng.normal(size=6)), np.diag(of_each**2)
        )
        for key, marker in marker_map.markers.items()
    }
    return MarkerMap(measured)


def _figures_of_maps(maps: list[tuple[MarkerMap, dict[int, np.ndarray]]]) -> Figures:
    """Of maps and the true poses of their markers, all but the first: how many are placed, and how well."""
    placed = [(truth[key], marker) for marker_map, truth in maps for key, marker in marker_map.markers.items() if key]
    return {
        'placed': len(placed),
        **_errors('map', [(T, marker.T_map_marker, marker.covariance) for T, marker in placed]),
    }


def wall(shape_px: float = 0.0) -> Figures:
    """A slow simulated flight past eight markers of which one is known, corners of 0.1 px, without odometry.

    Corners are off by ``shape_px``, those of a marker by the same in all views.
    """
    maps, frames_located = [], []
    for seed in range(2):
        rng = np.random.default_rng(seed)
        poses = walls.wall(rng)
        off = shape_px * np.random.default_rng(seed).normal(size=(len(poses), 4, 2))
        mapper = MarkerMapper(MarkerMapperConfig(), MarkerMap({0: MapMarker(0, walls.SIZE, True, poses[0])}))
        frames = {}
        for k in range(0, 600, 5):
            seen = walls.see(walls.flight(k / 30 + 5.0 * seed), poses, 0.1, rng)
            frames[walls.stamp(k)] = walls.rows(seen['id'], corners_px(seen) + off[seen['id']], 0.1)
        frames_located.append(_mapped(mapper, frames, walls.CAMERA)['located %'])
        maps.append((mapper.map, poses))
    return {'located %': float(np.mean(frames_located)), **_figures_of_maps(maps)}


def wrong_lens() -> Figures:
    """The same wall, known, before a lens whose calibration is off by up to 3 px in the corners of the image."""
    rng = np.random.default_rng(0)
    poses = walls.wall(rng)
    lens = replace(walls.CAMERA, D=[WRONG_K1, 0.0, 0.0, 0.0, 0.0])
    known = MarkerMap({key: MapMarker(key, walls.SIZE, True, T) for key, T in poses.items()})
    mapper, located = MarkerMapper(MarkerMapperConfig(mode='localization'), known), []
    for k in range(450):
        T = walls.flight(k / 30)
        pose = mapper.process(walls.stamp(k), walls.see(T, poses, 0.1, rng, camera=lens), walls.CAMERA).pose
        if pose is not None and k > 150:
            located.append((T, pose.T_map_camera, pose.covariance))
    return _errors('pose', located)


def small_markers() -> Figures:
    """Small and noisy markers far away: how many enter the map, and how many of them by the wrong planar branch."""
    entered = wrong = 0
    located = []
    for seed in (13, 24):
        rng = np.random.default_rng(seed)
        size, sigma, distance = rng.uniform(0.1, 0.3), rng.choice([0.05, 0.15, 0.3]), rng.uniform(2.0, 5.0)
        poses = walls.wall(rng, 8, tilt=rng.choice([0.0, 0.1, 0.3]))
        centre = np.mean([T[:3, 3] for T in poses.values()], axis=0)
        config = MarkerMapperConfig(marker_size=size, refinement_period=1.0)
        mapper = MarkerMapper(config, MarkerMap({0: MapMarker(0, size, True, poses[0])}))
        frames = {}
        for k in range(0, 300, 4):
            offset = [-distance, 0.4 * distance * np.sin(k / 50), 0.3 * distance * np.sin(k / 30)]
            T = walls.look(centre + offset, centre, 0.1 * np.sin(k / 30))
            frames[walls.stamp(k)] = walls.see(T, poses, sigma, rng, size=size)
        located.append(_mapped(mapper, frames, walls.CAMERA)['located %'])
        for key, marker in mapper.map.markers.items():
            entered += key != 0
            wrong += bool(np.linalg.norm(difference(marker.T_map_marker, poses[key])[3:]) > np.deg2rad(8.0))
    return {'located %': float(np.mean(located)), 'placed': entered, 'wrong': wrong}


def from_the_front() -> Figures:
    """A known marker alone, seen nearly along its axis: its two poses merge. Odometry is off by 0.1 m and 0.2 rad."""
    located = []
    poses = {0: walls.wall(np.random.default_rng(0), 1, tilt=0.0)[0]}
    config = MarkerMapperConfig(mode='localization', **AS_BODY)
    place, stds = poses[0][:3, 3], np.repeat([0.1, 0.2], 3)
    for seed in range(300):
        rng = np.random.default_rng(seed)
        aside = rng.normal(0.0, 0.3, size=2)
        T = walls.look(place - [rng.uniform(4.0, 6.0), *aside], place)
        off = retract(T, stds * rng.normal(size=6))
        odometry = Odometry(walls.stamp(0), off, np.zeros(3), np.zeros(3), np.diag(stds**2), 1e-6 * np.eye(6))
        mapper = MarkerMapper(config, MarkerMap({0: MapMarker(0, walls.SIZE, True, poses[0])}))
        rows = walls.see(T, poses, 0.1, rng)
        pose = mapper.process(walls.stamp(0), rows, walls.CAMERA, motion_prior(odometry)).pose
        if pose is not None:
            located.append((T, pose.T_map_camera, pose.covariance))
    return {'located %': len(located) / 3.0, **_errors('pose', located)}


def turned_markers() -> Figures:
    """Three of eight mapped markers of a wall have the other one of their two poses when the map is adjusted."""
    wrong = 0
    for seed in range(6):
        rng = np.random.default_rng(seed)
        poses = walls.wall(rng, tilt=0.3)
        mapper = MarkerMapper(MarkerMapperConfig(), MarkerMap({0: MapMarker(0, walls.SIZE, True, poses[0])}))
        frames = {walls.stamp(k): walls.see(walls.flight(k / 30), poses, 0.3, rng) for k in range(0, 600, 5)}
        _mapped(mapper, frames, walls.CAMERA)
        markers = mapper.map.markers
        for key in (2, 5, 7):
            markers[key] = replace(markers[key], T_map_marker=walls.mirrored(poses[key], walls.flight(0.0)))
        mapper.refine()
        wrong += sum(
            bool(np.linalg.norm(difference(marker.T_map_marker, poses[key])[3:]) > np.deg2rad(8.0))
            for key, marker in mapper.map.markers.items()
        )
    return {'turned': wrong}


def chain() -> Figures:
    """A corridor of markers of which at most two are in view, some spans with none known: odometry that drifts."""
    maps, located = [], []
    for seed in range(2):
        rng = np.random.default_rng(seed)
        row = walls.wall(rng, 4)
        poses = {i: retract(row[0], [0.0, 1.1 * i + (0.9 * (i > 4)), 0.0, 0.0, 0.0, 0.0]) for i in range(9)}
        mapper = MarkerMapper(MarkerMapperConfig(**AS_BODY), MarkerMap({0: MapMarker(0, walls.SIZE, True, poses[0])}))
        frames, truth = {}, {}
        for k in range(0, 600, 4):
            y = poses[0][1, 3] + 0.5 + 9.5 * k / 600
            eye = np.array([-1.6, y + 0.3 * np.sin(k / 9), 1.0 + 0.3 * np.sin(k / 14)])
            T = walls.look(eye, [0.0, y, 1.0 + 0.1 * np.sin(k / 20)])
            stamp = walls.stamp(k)
            frames[stamp], truth[stamp] = walls.see(T, poses, 0.1, rng), T
        located.append(_mapped(mapper, frames, walls.CAMERA, FollowingFilter(truth, rng))['located %'])
        maps.append((mapper.map, poses))
    return {'located %': float(np.mean(located)), **_figures_of_maps(maps)}


def moved_marker() -> Figures:
    """Two of eight known markers hang elsewhere than the map has them, one by 5 cm and one by half a metre."""
    rng = np.random.default_rng(5)
    truth = walls.wall(rng)
    in_map = truth | {
        3: transform(np.eye(3), [0.0, 0.05, 0.0]) @ truth[3],
        6: transform(np.eye(3), [0.0, 0.0, 0.5]) @ truth[6],
    }
    covariance = np.diag([0.002**2] * 3 + [0.002**2] * 3)
    marker_map = MarkerMap({i: MapMarker(i, walls.SIZE, i == 0, T, covariance * (i > 0)) for i, T in in_map.items()})
    mapper = MarkerMapper(MarkerMapperConfig(mode='localization'), marker_map)
    located, result = [], None
    for k in range(0, 450, 3):
        T = walls.flight(k / 30)
        result = mapper.process(walls.stamp(k), walls.see(T, truth, 0.1, rng), walls.CAMERA)
        if result.pose is not None:
            located.append((T, result.pose.T_map_camera, result.pose.covariance))
    return {**_errors('pose', located), 'quarantined': len(result.quarantined) if result else 0}


def uneven_map() -> Figures:
    """Markers surveyed to a millimetre, and between them markers measured by hand to 3 cm."""
    located = []
    fine, rough = np.diag([0.001**2] * 6), np.diag([0.03**2] * 3 + [0.02**2] * 3)
    for seed in range(3):
        rng = np.random.default_rng(seed)
        truth, marker_map = walls.wall(rng), MarkerMap()
        for i, T in truth.items():
            P = rough if i % 2 else fine
            off = rng.multivariate_normal(np.zeros(6), P)
            marker_map.markers[i] = MapMarker(i, walls.SIZE, False, retract(T, off), P)
        mapper = MarkerMapper(MarkerMapperConfig(mode='localization'), marker_map)
        for k in range(0, 450, 6):
            T = walls.flight(k / 30)
            pose = mapper.process(walls.stamp(k), walls.see(T, truth, 0.1, rng), walls.CAMERA).pose
            if pose is not None:
                located.append((T, pose.T_map_camera, pose.covariance))
    return _errors('pose', located)


def second_flight() -> Figures:
    """A map of an earlier flight, good to 2 mm and 0.2 deg, and a short flight with corners of half a pixel."""
    maps = []
    P = np.diag([0.002**2] * 3 + [0.003**2] * 3)
    for seed in range(2):
        rng = np.random.default_rng(seed)
        poses, marker_map = walls.wall(rng), MarkerMap()
        for i, T in poses.items():
            known = T if i == 0 else retract(T, rng.multivariate_normal(np.zeros(6), P))
            marker_map.markers[i] = MapMarker(i, walls.SIZE, i == 0, known, P * (i > 0))
        mapper = MarkerMapper(MarkerMapperConfig(refinement_period=1.0), marker_map)
        frames = {
            walls.stamp(k): walls.see(walls.flight(k / 30 + 5.0 * seed), poses, 0.5, rng) for k in range(0, 240, 5)
        }
        _mapped(mapper, frames, walls.CAMERA)
        maps.append((mapper.map, poses))
    return _figures_of_maps(maps)


def second_plate() -> Figures:
    """Six known markers in view, then for 4 s one of them alone, a second plate of it; odometry drifts meanwhile."""
    rng = np.random.default_rng(6)
    poses = walls.wall(rng, 6)
    elsewhere = {2: transform(np.eye(3), [0.0, 1.2, 0.0]) @ poses[2]}
    known = MarkerMap({key: MapMarker(key, walls.SIZE, True, T) for key, T in poses.items()})
    mapper = MarkerMapper(MarkerMapperConfig(mode='localization', **AS_BODY), known)
    located = []
    for k in range(0, 180, 2):
        T, stamp, seconds = walls.flight(k / 30), walls.stamp(k), max(k - 60, 0) / 30
        # Without poses that it accepts, a filter's position drifts with the square of the time.
        stds = np.array([0.01 + 0.02 * seconds**2] * 3 + [0.003 + 0.002 * seconds] * 3)
        state = Odometry(
            stamp, retract(T, 0.5 * stds), np.zeros(3), np.zeros(3), np.diag(stds**2), np.diag([0.03**2] * 6)
        )
        rows = walls.see(T, poses if seconds == 0.0 else elsewhere, 0.1, rng)
        pose = mapper.process(stamp, rows, walls.CAMERA, motion_prior(state)).pose
        if pose is not None:
            located.append(np.linalg.norm(difference(pose.T_map_camera, T)[:3]))
    return {'located': len(located), 'worst pose mm': 1e3 * max(located)}


def two_sheets() -> Figures:
    """One of eight markers that are being mapped is there twice, its two sheets seen in turn; or is moved half-way."""
    named, others = 0, []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        poses, twice = walls.wall(rng), seed % 2 == 0
        off = [0.0, -0.7, 0.45] if twice else [0.0, 0.1, 0.0]
        later = poses | {5: transform(np.eye(3), off) @ poses[5]}
        mapper = MarkerMapper(MarkerMapperConfig(), MarkerMap({0: MapMarker(0, walls.SIZE, True, poses[0])}))
        frames = {}
        for k in range(0, 600, 5):
            now = later if ((k // 60) % 2 if twice else k >= 300) else poses
            frames[walls.stamp(k)] = walls.see(walls.flight(k / 30 + 2.5 * seed), now, 0.1, rng)
        _mapped(mapper, frames, walls.CAMERA)
        named += 5 in mapper.map.markers and not mapper.map.markers[5].trusted
        others += [
            np.linalg.norm(difference(marker.T_map_marker, poses[key])[:3])
            for key, marker in mapper.map.markers.items()
            if key not in (0, 5)
        ]
    return {'quarantined': named, 'other markers mm': 1e3 * rms(others)}


def optimistic_corners() -> Figures:
    """Corners of 0.3 px that promise 0.1 px, and a tenth of the markers off by 5 px."""
    maps = []
    for seed in range(2):
        rng = np.random.default_rng(seed)
        poses = walls.wall(rng)
        mapper = MarkerMapper(MarkerMapperConfig(), MarkerMap({0: MapMarker(0, walls.SIZE, True, poses[0])}))
        frames = {}
        for k in range(0, 600, 5):
            rows = walls.see(walls.flight(k / 30 + 5.0 * seed), poses, 0.3, rng)
            wrong = rng.random(len(rows)) < 0.1
            corners = corners_px(rows) + wrong[:, None, None] * 5.0 * rng.normal(size=(len(rows), 1, 2))
            frames[walls.stamp(k)] = walls.rows(rows['id'], corners, 0.1)
        _mapped(mapper, frames, walls.CAMERA)
        maps.append((mapper.map, poses))
    return _figures_of_maps(maps)


def _recorded_tags(name: str) -> Callable[[], Figures]:
    def scene() -> Figures:
        recording = tagslam.load(Path(os.environ['THERMAL_FIDUCIAL_DATA']) / 'tagslam' / name)
        try:
            markers, refinement = tagslam.solve(recording, 1)
        except AttributeError:
            return {'placed': 0.0, 'views': 0.0, 'px over theirs': np.inf, 'from theirs mm': np.inf}
        ours, theirs, views = tagslam.compare(recording, markers, refinement)
        placed = len(markers.keys() & recording.T_map_marker.keys())
        apart = [
            np.linalg.norm((inverse(recording.T_map_marker[key]) @ markers[key].T_map_marker)[:3, 3])
            for key in markers.keys() & recording.T_map_marker.keys()
        ]
        return {'placed': placed, 'views': views, 'px over theirs': ours / theirs, 'from theirs mm': 1e3 * rms(apart)}

    return scene


def bent() -> Figures:
    """A corridor behind a lens that is off by 0.1 px, mean of two."""
    off, of_map, of_poses = np.mean([bent_corridor(seed, 0.1, 600) for seed in range(2)], axis=0).tolist()
    return {'map mm': 1e3 * off, 'map NEES': of_map, 'pose NEES': of_poses}


SCENES: dict[str, Callable[[], Figures]] = {
    'wall': wall,
    'shaped markers': lambda: wall(0.07),
    'wrong lens': wrong_lens,
    'small markers': small_markers,
    'from the front': from_the_front,
    'turned markers': turned_markers,
    'chain': chain,
    'bent corridor': bent,
    'moved markers': moved_marker,
    'uneven map': uneven_map,
    'second flight': second_flight,
    'two sheets': two_sheets,
    'second plate': second_plate,
    'optimistic corners': optimistic_corners,
}
if 'THERMAL_FIDUCIAL_DATA' in os.environ:
    SCENES |= {'carpet': carpet, 'board': board, 'surveyed board': lambda: board(surveyed=True)} | {
        f'tags {name}': _recorded_tags(name) for name in ('test_16', 'test_22')
    }
