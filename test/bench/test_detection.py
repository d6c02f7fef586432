"""Detection and corners beside OpenCV's detector, on the same rendered frames, one thread.

Leaves its table in ``.doc/tables/detection.md`` and its plot in ``.doc/detection.png``.
"""

from dataclasses import dataclass, replace
from pathlib import Path
import time

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from thermal_fiducial.config import ArucoDetectorConfig
from thermal_fiducial.core import geometry
from thermal_fiducial.core.camera import Camera
from thermal_fiducial.core.detection import MarkerDetector
from thermal_fiducial.core.measurements import corners_px, Odometry
from thermal_fiducial.sim.camera import render_frames
from thermal_fiducial.sim.scenario import named, with_contrast

DOC = Path(__file__).resolve().parents[2] / '.doc'
METHODS = {
    'OpenCV': cv2.aruco.CORNER_REFINE_NONE,
    'OpenCV SUBPIX': cv2.aruco.CORNER_REFINE_SUBPIX,
    'OpenCV APRILTAG': cv2.aruco.CORNER_REFINE_APRILTAG,
}
#: Scenario, contrast [K], first and last frame.
SCENES = {
    'slow, 8 K': ('wall', 8.0, 120, 140),
    'slow, 2 K': ('wall', 2.0, 120, 140),
    'slow, 0.5 K': ('wall', 0.5, 120, 140),
    'slow, 0.3 K': ('wall', 0.3, 120, 140),
    'slow, 0.1 K': ('wall', 0.1, 120, 140),
    'slow, 0.05 K': ('wall', 0.05, 120, 140),
    'room, 25 to 50 px': ('room', 8.0, 150, 180),
    'turning up to 140 deg/s': ('fast', 8.0, 250, 310),
}


@dataclass(frozen=True)
class Scene:
    """Frames with truth, and what else the detector may know."""

    camera: Camera
    frames: list
    odometry: list
    markers: dict
    size: float
    T_body_camera: np.ndarray


def scene(name, contrast, start, stop):
    scenario = with_contrast(named(name), contrast)
    # Seconds after the shutter's correction; bad pixels are the business of the stage before.
    sensor = replace(scenario.sensor, bad_pixel_share=0.0, pixel_growth=0.0, column_growth=0.0, column_pattern=0.01)
    scenario = replace(scenario, sensor=sensor, acrylic=replace(scenario.acrylic, steady=0.0))
    frames = [f for f in render_frames(scenario, seconds=20.0, seed=3, start=start, stop=stop) if not f.shutter]
    lens, T_body_camera = scenario.lens, scenario.T_body_camera
    return Scene(
        Camera(lens.width, lens.height, lens.matrix, lens.model, lens.distortion),
        frames,
        [odometry(frames, index, T_body_camera) for index in range(len(frames))],
        {marker.id: (marker.T_map_marker, marker.size) for marker in scenario.markers},
        scenario.markers[0].size,
        T_body_camera,
    )


def odometry(frames, index, T_body_camera):
    """What a filter knows at a frame: 4 mm and 1 mrad off."""
    rng = np.random.default_rng(index)
    first, last = max(index - 1, 0), min(index + 1, len(frames) - 1)
    dt = (frames[last].stamp_ns - frames[first].stamp_ns) * 1e-9
    T = [frames[k].T_map_camera @ geometry.inverse(T_body_camera) for k in (first, index, last)]
    turn = geometry.so3_log(T[0][:3, :3].T @ T[2][:3, :3]) / dt
    velocity = T[1][:3, :3].T @ (T[2][:3, 3] - T[0][:3, 3]) / dt
    R = geometry.so3_exp(rng.normal(0, 0.001, 3)) @ T[1][:3, :3]
    pose = geometry.transform(R, T[1][:3, 3] + rng.normal(0, 0.004, 3))
    covariances = np.diag([0.004] * 3 + [0.001] * 3) ** 2, np.diag([0.02] * 3 + [0.01] * 3) ** 2
    return Odometry(frames[index].stamp_ns, pose, velocity, turn, *covariances)


def eight_bits(counts):
    low, high = np.percentile(counts[::4, ::4], (1, 99))
    return np.clip((counts.astype(np.float32) - low) * (255.0 / max(high - low, 1.0)), 0, 255).astype(np.uint8)


def opencv(data, method):
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = METHODS[method]
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50), parameters)
    for frame in data.frames:
        gray = eight_bits(frame.counts)
        begin = time.thread_time()
        corners, ids, _ = detector.detectMarkers(gray)
        seconds = time.thread_time() - begin
        yield seconds, {} if ids is None else {int(i): c[0] for i, c in zip(ids.ravel(), corners, strict=True)}


def ours(data, method):
    orientation = tuple(Rotation.from_matrix(data.T_body_camera[:3, :3]).as_quat())
    config = ArucoDetectorConfig(
        marker_size=data.size, camera_position=tuple(data.T_body_camera[:3, 3]), camera_orientation=orientation
    )
    detector = MarkerDetector(config, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50))
    guided = method == 'guided'
    if guided:
        detector.set_map(data.markers)
    for frame, hint in zip(data.frames, data.odometry, strict=True):
        begin = time.thread_time()
        rows = detector.detect(frame.stamp_ns, frame.counts, data.camera, hint if guided else None)
        seconds = time.thread_time() - begin
        yield seconds, dict(zip(rows['id'].tolist(), corners_px(rows), strict=True))


def shape_error(found, truth):
    error = found - truth
    return np.mean(np.sum((error - error.mean(axis=0)) ** 2, axis=-1))


def score(data, results):
    """Rate, corner rms (shape) [px], false IDs, median time [s]."""
    expected = hits = false = 0
    errors, times = [], []
    for frame, (seconds, found) in zip(data.frames, results, strict=True):
        times.append(seconds)
        expected += len(frame.corners_px)
        for marker_id, corners in found.items():
            if marker_id in frame.corners_px:
                hits += 1
                errors.append(shape_error(corners, frame.corners_px[marker_id]))
            false += marker_id not in data.markers
    return hits / max(expected, 1), float(np.sqrt(np.mean(errors))) if errors else np.nan, false, np.median(times)


def run_all(data):
    results = {method: score(data, opencv(data, method)) for method in METHODS}
    return results | {method: score(data, ours(data, method)) for method in ('blind', 'guided')}


def table(scores):
    methods = list(next(iter(scores.values())))
    lines = ['| scene | ' + ' | '.join(methods) + ' |', '|---' * (len(methods) + 1) + '|']
    for name, row in scores.items():
        base = row['OpenCV SUBPIX'][3]
        cells = [
            f'{100 * rate:.0f} % · {"-" if np.isnan(rms) else f"{rms:.3f}"} px · {seconds / base:.1f}x'
            + (f' · {false} false' if false else '')
            for rate, rms, false, seconds in row.values()
        ]
        lines.append(f'| {name} | ' + ' | '.join(cells) + ' |')
    return '\n'.join(lines)


def plot(scores, path):
    pyplot = pytest.importorskip('matplotlib.pyplot')
    figure, axes = pyplot.subplots(1, 2, figsize=(11, 4))
    slow = {name: row for name, row in scores.items() if name.startswith('slow')}
    contrast = [float(name.split()[1]) for name in slow]
    for method in next(iter(slow.values())):
        axes[0].loglog(contrast, [row[method][1] for row in slow.values()], marker='o', label=method)
        axes[1].semilogx(contrast, [100 * row[method][0] for row in slow.values()], marker='o', label=method)
    axes[0].set(xlabel='contrast [K]', ylabel='corner rms (shape) [px]')
    axes[1].set(xlabel='contrast [K]', ylabel='markers found [%]')
    axes[0].legend()
    figure.tight_layout()
    figure.savefig(path, dpi=120)
    pyplot.close(figure)


def test_against_opencv(benchmark):
    cv2.setNumThreads(1)
    scores = benchmark.pedantic(
        lambda: {name: run_all(scene(*arguments)) for name, arguments in SCENES.items()}, rounds=1
    )
    (DOC / 'tables').mkdir(parents=True, exist_ok=True)
    (DOC / 'tables' / 'detection.md').write_text(table(scores) + '\n')
    plot(scores, DOC / 'detection.png')
    for name, row in scores.items():
        assert row['blind'][2] == row['guided'][2] == 0, name
        if row['OpenCV SUBPIX'][0] > 0.5:
            assert row['blind'][1] < 0.6 * row['OpenCV SUBPIX'][1], name


@pytest.mark.parametrize('method', ['blind', 'guided', *METHODS])
def test_time_of_a_frame(benchmark, method):
    cv2.setNumThreads(1)
    data = scene('wall', 8.0, 120, 132)
    run = opencv if method in METHODS else ours
    benchmark.pedantic(lambda: list(run(data, method)), rounds=3, warmup_rounds=1)
