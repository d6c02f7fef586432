"""Measurements of the detector in rendered views of markers, for the tables of ``markers plan``."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from thermal_fiducial.config import ArucoDetectorConfig
from thermal_fiducial.core.detection.detector import MarkerDetector
from thermal_fiducial.core.geometry import se3
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.geometry.reprojection import narrow_sides
from thermal_fiducial.core.measurements import columns, corners_px, Markers
from thermal_fiducial.core.types import Counts, FloatArray, IntArray, SIGMA_OF_MEDIAN
from thermal_fiducial.fabrication.planning import expected_errors, Measurements, pose_errors
from thermal_fiducial.files.dictionary import load_dictionary
from thermal_fiducial.sim.lens import Lens
from thermal_fiducial.sim.render import Quality, Renderer
from thermal_fiducial.sim.scenario import LENSES
from thermal_fiducial.sim.scene import Acrylic, Fog, Plate, Room
from thermal_fiducial.sim.sensor import Sensor
from thermal_fiducial.sim.spline_trajectory import SplineTrajectory

DICTIONARY = 'STENCIL_4X4_100'
LENS = '13mm'
_SIZE = 0.30
# Time of the frames [s]: six seconds after a shutter event, half the time until the next.
_TIME = 13.0
# Bad pixels are removed before the detector.
_SENSOR = replace(Sensor(), bad_pixel_share=0.0, lag=0.0)
_MOST_MARKERS = 12
# Largest number of views of one kind; a view has one or two large markers.
_MOST_VIEWS = 12
# Largest side in a view from the front: such a marker and its warm border are in the image in any rotation.
_LARGEST_PX = 240.0
# Least number of poses on the right branch for their median error: exactly from the front there are few.
_ENOUGH_POSES = 8
# Number of poses from which the error of independent corners is taken.
_SAMPLES = 200
# Steps to the distance at which the narrowest side has a given length, which perspective changes by a twentieth, and to
# the noise that makes a given error, which is all but proportional to it.
_STEPS = 3


@dataclass(frozen=True)
class View:
    """One frame with markers of equal side, contrast and tilt.

    Parameters
    ----------
    stamp_ns : random, so that the detector assumes no motion between views
    counts : (height, width)
    ids : (N,)
    T_camera_marker : (N, 4, 4)
    corners_px : (N, 4, 2) true corners
    """

    stamp_ns: int
    counts: Counts
    ids: list[int]
    T_camera_marker: FloatArray
    corners_px: FloatArray


def render_view(
    side_px: float, contrast: float, tilt_deg: float, rng: np.random.Generator, *, narrowest: bool = False
) -> View:
    """Markers at random places of the image with random rotations, tilted by ``tilt_deg`` from the line of sight.

    Parameters
    ----------
    side_px : side of the black square in a view from the front
    contrast : [K]
    narrowest : ``side_px`` is the narrowest side of each marker in the image instead
    """
    lens = LENSES[LENS]
    bits = load_dictionary(DICTIONARY).bits
    tilt = np.radians(tilt_deg)
    largest = side_px / np.cos(tilt) if narrowest else side_px
    T = np.stack([_place(lens, pixel, side_px, tilt, rng) for pixel in _places(lens, largest, rng)])
    if narrowest:
        T = _with_narrowest_sides(lens, T, side_px)
    ids = rng.choice(len(bits), len(T), replace=False).tolist()
    plates = [_plate(pose, bits[marker_id], contrast) for pose, marker_id in zip(T, ids, strict=True)]
    still = SplineTrajectory(
        np.arange(8.0), np.zeros((8, 3)), Rotation.from_quat(np.tile([0.0, 0.0, 0.0, 1.0], (8, 1)))
    )
    room = Room((-30.0, -30.0, -30.0), (30.0, 30.0, 30.0))
    quality, blur = Quality(samples=97, warm_up=0), _SENSOR.psf_sigma_px
    renderer = Renderer(
        lens, plates, room, Fog(), Acrylic(), still, np.eye(4), lag=0.0, quality=quality, psf_sigma_px=blur
    )
    counts = _SENSOR.counts(renderer.frame(_TIME), _TIME, 0, int(rng.integers(1 << 31)))
    return View(int(rng.integers(1 << 60)), counts, ids, T, _corners_px(lens, T))


def _corners_px(lens: Lens, T: FloatArray) -> FloatArray:
    """True corners (N, 4, 2) of markers with poses (N, 4, 4)."""
    s = 0.5 * _SIZE
    corners = np.array([[-s, s, 0.0], [s, s, 0.0], [s, -s, 0.0], [-s, -s, 0.0]])
    return lens.project(se3.apply(T, corners))


def _with_narrowest_sides(lens: Lens, T: FloatArray, side_px: float) -> FloatArray:
    """Poses (N, 4, 4) moved along the lines of sight to where the narrowest sides have ``side_px``."""
    T = T.copy()
    for _ in range(_STEPS):
        T[:, :3, 3] *= narrow_sides(_corners_px(lens, T))[:, None] / side_px
    return T


def _places(lens: Lens, side_px: float, rng: np.random.Generator) -> Iterator[FloatArray]:
    """Pixels (2,) far enough apart for markers and their warm borders in any rotation."""
    pitch = 1.95 * side_px + 6.0
    columns_, rows = max(1, int(lens.width / pitch)), max(1, int(lens.height / pitch))
    cells = rng.permutation(columns_ * rows)[:_MOST_MARKERS]
    for row, column in zip(*np.divmod(cells, columns_), strict=True):
        middle = np.array([(column + 0.5) * lens.width / columns_, (row + 0.5) * lens.height / rows])
        yield middle + rng.uniform(-2.0, 2.0, 2)


def _place(lens: Lens, pixel: FloatArray, side_px: float, tilt: float, rng: np.random.Generator) -> FloatArray:
    """T_camera_marker (4, 4) with the marker's centre on ``pixel``."""
    ray = np.append(lens.slopes(pixel), 1.0)
    ray /= np.linalg.norm(ray)
    towards = np.cross([0.0, 0.0, 1.0], ray)
    turned, own = rng.uniform(0.0, 2.0 * np.pi, 2)
    axis = tilt * np.array([np.cos(turned), np.sin(turned), 0.0])
    aim = se3.so3_exp(towards * np.arcsin(np.linalg.norm(towards)) / max(float(np.linalg.norm(towards)), 1e-12))
    R = aim @ se3.so3_exp(axis) @ np.diag([1.0, -1.0, -1.0]) @ se3.so3_exp([0.0, 0.0, own])
    distance = float(np.sqrt(lens.focal[0] * lens.focal[1])) * _SIZE / side_px
    return se3.transform(R, distance * ray)


def _plate(T: FloatArray, bits: np.ndarray, contrast: float) -> Plate:
    """A stencil with a warm border of one cell."""
    levels = np.pad(np.pad(bits > 0, 1), 1, constant_values=True)
    side = _SIZE * len(levels) / (len(levels) - 2)
    return Plate(T, side, side, levels, np.ones_like(levels), contrast, 0.0)


def detect(view: View, detector: MarkerDetector, camera: Camera) -> tuple[Markers, IntArray]:
    """Rows of the markers of ``view`` that were found, and for each its index among the true ones."""
    rows = detector.detect(view.stamp_ns, view.counts, camera)
    order = {marker_id: index for index, marker_id in enumerate(view.ids)}
    known = np.array([marker_id in order for marker_id in rows['id'].tolist()], dtype=np.bool_)
    rows = rows[known]
    index = np.array([order[marker_id] for marker_id in rows['id'].tolist()], dtype=np.int64)
    off = np.abs(corners_px(rows) - view.corners_px[index]).max(axis=(1, 2))
    near = off < 3.0
    return rows[near], index[near]


def camera_and_detector() -> tuple[Camera, MarkerDetector]:
    """Camera and detector of the measurements."""
    lens = LENSES[LENS]
    camera = Camera(lens.width, lens.height, lens.matrix, lens.model, np.array(lens.distortion))
    config = ArucoDetectorConfig(dictionary=DICTIONARY, marker_size=_SIZE)
    return camera, MarkerDetector(config, load_dictionary(DICTIONARY))


def both_poses(rows: Markers) -> tuple[FloatArray, FloatArray]:
    """T_camera_marker (N, 4, 4) of rows, the chosen branch and the other one."""
    best = se3.transform_from_quaternion(columns(rows, ('x', 'y', 'z')), columns(rows, ('qx', 'qy', 'qz', 'qw')))
    other = columns(rows, ('ax', 'ay', 'az')), columns(rows, ('aqx', 'aqy', 'aqz', 'aqw'))
    return best, se3.transform_from_quaternion(*other)


@dataclass
class Tally:
    """Results of the detector in all views of one kind."""

    shown: int
    corner_errors: FloatArray
    best: FloatArray
    other: FloatArray
    T_true: FloatArray

    @property
    def found(self) -> float:
        """Share of the markers that was found."""
        return len(self.best) / self.shown

    @property
    def sigma_px(self) -> float:
        """Standard deviation of a corner coordinate, robust against single outliers."""
        return SIGMA_OF_MEDIAN * float(np.median(np.abs(self.corner_errors))) if len(self.best) >= 3 else np.nan

    @property
    def distance_error(self) -> float:
        """Median relative error of the distance."""
        if len(self.best) < 3:
            return np.nan
        measured, true = (np.linalg.norm(T[:, :3, 3], axis=1) for T in (self.best, self.T_true))
        return float(np.median(np.abs(measured / true - 1.0)))


def show(
    detector: MarkerDetector,
    camera: Camera,
    side_px: float,
    kelvin: float,
    tilt_deg: float,
    markers: int,
    seed: list[int],
    *,
    narrowest: bool = False,
) -> Tally:
    """Run the detector on about ``markers`` markers of one kind, see :func:`render_view`."""
    rng = np.random.default_rng(seed)
    shown, parts = 0, []
    for _ in range(_MOST_VIEWS):
        if shown >= markers:
            break
        view = render_view(side_px, kelvin, tilt_deg, rng, narrowest=narrowest)
        rows, index = detect(view, detector, camera)
        parts.append((corners_px(rows) - view.corners_px[index], *both_poses(rows), view.T_camera_marker[index]))
        shown += len(view.ids)
    return Tally(shown, *(np.concatenate(part) for part in zip(*parts, strict=True)))


def _pose_sigma_px(tally: Tally, camera: Camera) -> float:
    """Noise of independent corners whose poses are as good as those of ``tally``; NaN for too few of them."""
    measured, _, _, wrong = pose_errors(tally.best, tally.other, tally.T_true)
    if len(tally.best) * (1.0 - wrong) < _ENOUGH_POSES:
        return np.nan
    T, sigma = tally.T_true[np.arange(_SAMPLES) % len(tally.T_true)], tally.sigma_px
    for _ in range(_STEPS):
        expected = expected_errors(camera, _SIZE, T, np.full(_SAMPLES, sigma), np.random.default_rng(1))[0]
        sigma *= measured / expected
    return sigma


def measure(
    narrow_px: FloatArray,
    contrast: FloatArray,
    tilt_deg: FloatArray,
    *,
    markers: int,
    seed: int,
    progress: Callable[[float], None] | None = None,
) -> Measurements:
    """Run the detector on about ``markers`` markers of each narrowest side, contrast (in NETD) and tilt."""
    camera, detector = camera_and_detector()
    shape = (len(narrow_px), len(contrast), len(tilt_deg))
    found, sigma, pose_sigma, off = np.full((4, *shape), np.nan)
    for done, node in enumerate(np.ndindex(*shape), 1):
        side, tilt = float(narrow_px[node[0]]), float(tilt_deg[node[2]])
        kelvin = float(contrast[node[1]]) * _SENSOR.netd
        if side <= _LARGEST_PX * np.cos(np.radians(tilt)):
            tally = show(detector, camera, side, kelvin, tilt, markers, [seed, *node], narrowest=True)
            found[node], sigma[node], off[node] = tally.found, tally.sigma_px, tally.distance_error
            pose_sigma[node] = _pose_sigma_px(tally, camera)
        if progress is not None:
            progress(done / found.size)
    return Measurements(narrow_px, contrast, tilt_deg, found, sigma, pose_sigma, off)
