"""The oracle itself: lens, path, IMU, pictures and conversions, each against what it can be computed by otherwise."""

from dataclasses import replace
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.special import ndtr

from rigs import inertial, motion, room
from rigs.bolometer import Bolometer
from rigs.display import Linear, Plateau, shown
from rigs.lens import Lens
from rigs.renderer import Renderer
from rigs.rig import AHEAD, pose, Rig, SECONDS, STYLES
from rigs.room import FACING, Plate, Room, WALL

#: Distortion as strong as any that is drawn.
LENS = Lens(160, 120, np.array([130.0, 131.0]), np.array([80.0, 58.5]), np.array([-0.3, 0.08, 5e-4, -5e-4]))
T_MAP_CAMERA = pose(AHEAD, np.zeros(3))
BITS = np.random.default_rng(0).integers(0, 2, (20, 4, 4))


def before_a_cold_wall(*plates):
    """A room of plates."""
    wall = np.zeros((WALL, WALL), dtype=np.float32)
    return Room(dict(enumerate(plates)), wall, pose(FACING, np.array([3.0, 0.0, 0.0])), 9.0)


def bright_plate(turn=(0.0, 0.0, 0.0), y=0.0, z=0.0, kelvin=1.0):
    """A plate of 0.3 m without a pattern, 1.5 m ahead: 26 px."""
    T = pose(FACING @ Rotation.from_rotvec(turn).as_matrix(), np.array([1.5, y, z]))
    return Plate(T, np.ones((4, 4)), 0.3, 0.0, kelvin, np.zeros(2))


def along_the_sides(corners):
    """Points (400, 3) on the sides between corners (4, 3), in their order."""
    shares = np.linspace(0.0, 1.0, 100, endpoint=False)[:, None]
    return np.concatenate([a + shares * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)])


def centroid(image):
    """Of the warmth of an image (H, W) [px]."""
    v, u = np.indices(image.shape)
    return np.array([np.sum(u * image), np.sum(v * image)]) / image.sum()


def first_frames(seed, count):
    """Frames of a rig as its driver hands them over."""
    rig = Rig(seed)
    bolometer = Bolometer(rig, room.drawn(rig, BITS), motion.drawn(rig))
    return [image for _, image in islice(shown(rig, bolometer.frames()), count)]


def test_the_oracle_is_not_made_of_what_it_judges():
    users = [path.name for path in Path(__file__).parent.glob('*.py') if 'thermal_' + 'fiducial' in path.read_text()]
    assert users == ['flight.py']


def test_lenses_do_not_fold_and_their_rays_come_back_to_their_pixels():
    for lens in (Rig(seed).lens for seed in range(8)):
        pixels = lens.pixels()
        rays = lens.rays(pixels)
        again = lens.project(np.dstack((rays, np.ones(rays.shape[:2]))))
        # A hundredth of what the detector resolves at best.
        assert np.abs(again - pixels).max() < 1e-3
        # Rays from behind a fold would come back too.
        assert np.all(np.diff(rays[..., 0], axis=1) > 0.0)
        assert np.all(np.diff(rays[..., 1], axis=0) > 0.0)


def test_a_lens_that_folds_in_a_corner_is_not_drawn():
    assert replace(LENS, focal=np.full(2, 70.0), distortion=np.array([-0.3, 0.0, 0.0, 0.0])).folds
    assert not LENS.folds


def test_points_are_projected_as_by_opencv():
    points = np.random.default_rng(1).uniform([-1.0, -0.8, 1.8], [1.0, 0.8, 4.0], (100, 3))
    theirs, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), LENS.matrix, LENS.distortion)
    np.testing.assert_allclose(LENS.project(points), theirs[:, 0], atol=1e-9)


@pytest.mark.parametrize('style', STYLES)
def test_readings_integrate_to_the_path(style):
    path = motion.drawn(next(rig for rig in map(Rig, range(1000)) if rig.task.style == style))
    step = 1.0 / 400.0
    readings = inertial.readings(path, np.arange(step / 2.0, SECONDS, step))
    turns = Rotation.from_rotvec(readings[:, :3] * step).as_matrix()
    halves = Rotation.from_rotvec(readings[:, :3] * step / 2.0).as_matrix()
    instants = np.array([-1e-4, 0.0, 1e-4, SECONDS])
    coordinates, rotations = path.coordinates(instants)[:, :3], path.rotations(instants).as_matrix()
    p, v, R = coordinates[1], (coordinates[2] - coordinates[0]) / 2e-4, rotations[1]
    for force, half, turn in zip(readings[:, 3:], halves, turns, strict=True):
        a = R @ half @ force - inertial.GRAVITY
        p, v, R = p + v * step + a * step**2 / 2.0, v + a * step, R @ turn
    # Ten times what steps of 2.5 ms cost at worst. A gyroscope that is 1e-5 rad/s off turns by 1.5e-4.
    np.testing.assert_allclose(R, rotations[3], atol=2e-6)
    np.testing.assert_allclose(p, coordinates[3], atol=1.2e-3)


def test_vibration_is_no_slow_motion_in_the_samples():
    for imu in (Rig(seed).imu for seed in range(20)):
        assert imu.turns.min() * imu.rate >= 8.0


def test_samples_without_errors_are_the_readings():
    rig = Rig(0)
    nothing = dict.fromkeys(('density', 'walk', 'bias'), np.zeros(6))
    rig.imu = replace(rig.imu, scale=np.zeros((2, 3, 3)), shaking=0.0, jitter=0.0, loss=0.0, **nothing)
    path = motion.drawn(rig)
    times, values = zip(*inertial.samples(rig, path), strict=True)
    np.testing.assert_allclose(values, inertial.readings(path, np.array(times)))


@pytest.mark.parametrize('seed', range(10))
def test_a_bright_plate_is_where_the_formula_of_the_lens_says(seed):
    rng = np.random.default_rng(seed)
    plate = bright_plate(rng.normal(0.0, 0.3, 3), *rng.uniform(-0.3, 0.3, 2))
    image = Renderer(LENS, before_a_cold_wall(plate)).kelvin(T_MAP_CAMERA)
    T = np.linalg.inv(T_MAP_CAMERA) @ plate.T_map_plate
    outline = LENS.project(along_the_sides(plate.corners) @ T[:3, :3].T + T[:3, 3]).astype(np.float32)
    area = cv2.moments(outline)
    # Of forty such plates 0.005 px rms, 0.014 at worst; their sides are displaced by 0.006 px at worst.
    np.testing.assert_allclose(centroid(image), [area['m10'] / area['m00'], area['m01'] / area['m00']], atol=0.02)
    assert abs(image.sum() - area['m00']) < 0.01 * cv2.arcLength(outline, closed=True)


def without_noise(lens, **sensor):
    """A rig of 30 Hz that looks ahead through clear air."""
    rig = Rig(0)
    rig.lens, rig.T_body_camera, rig.task = lens, T_MAP_CAMERA, replace(rig.task, smoke=0.0)
    rig.sensor = replace(rig.sensor, rate=30.0, lag=0.01, noise=0.0, pattern=np.zeros(2), count=0.01, stuck=0, **sensor)
    return rig


def beyond(distance, spread):
    """Share of a pixel, blurred by optics of ``spread`` [px], beyond an edge at ``distance`` [px] from its middle."""

    def integral(z):
        return z * ndtr(z / spread) + spread * np.exp(-0.5 * (z / spread) ** 2) / np.sqrt(2.0 * np.pi)

    return integral(0.5 - distance) - integral(-0.5 - distance)


@pytest.mark.parametrize('blur', [0.5, 0.9])
def test_the_optics_blur_before_the_pixels_sample(blur):
    lens = replace(LENS, focal=np.full(2, 130.0), centre=np.array([80.0, 60.0]), distortion=np.zeros(4))
    still, pixels = motion.Path(*np.zeros((3, 6, 4)), [], -10.0), np.arange(84, 104)
    for phase in np.linspace(0.0, 1.0, 8, endpoint=False):
        # The right side of a plate, 1.3 m ahead, at column 95 and ``phase``.
        T = pose(FACING, np.array([1.3, -phase / 100.0, 0.0]))
        scene = before_a_cold_wall(Plate(T, np.ones((4, 4)), 0.3, 0.0, 100.0, np.zeros(2)))
        counts = next(Bolometer(without_noise(lens, blur=blur), scene, still).frames())[1]
        seen = (counts[60, pixels] - np.median(counts)) * 0.01 / 100.0
        # Texels of 0.33 px: 0.009 at worst. Means over pixels that are blurred afterwards are 0.10 and 0.02 off.
        expected = beyond(pixels - 95.0 - phase, np.sqrt(blur**2 - 1.0 / 12.0))
        np.testing.assert_allclose(seen, expected, atol=0.012)


def test_pictures_are_late_by_the_lag():
    rig = without_noise(LENS)
    # 1 m/s to the right.
    rate = np.full((6, 4), 0.01)
    amplitude = np.zeros((6, 4))
    amplitude[1, 0] = -1.0 / 0.01
    path = motion.Path(amplitude, rate, np.zeros((6, 4)), [], -10.0)
    scene = before_a_cold_wall(bright_plate(kelvin=100.0))
    *_, (t, counts) = islice(Bolometer(rig, scene, path).frames(), 5)
    seen = Renderer(LENS, scene).kelvin(path.T_map_body(t - 0.01) @ T_MAP_CAMERA)
    # The lag moves it by 0.87 px, and half of a millisecond of it by 0.04.
    np.testing.assert_allclose(centroid(counts - np.median(counts)), centroid(seen), atol=0.02)


@pytest.mark.parametrize('kind', [Linear, Plateau])
def test_conversions_are_monotone(kind):
    rng = np.random.default_rng(2)
    convert = kind()
    for brightness in (5000.0, 5100.0, 5050.0):
        counts = np.round(rng.normal(brightness, 40.0, (60, 80))).astype(np.uint16)
        gray = convert(counts)
        order = np.argsort(counts, axis=None)
        assert gray.dtype == np.uint8
        assert np.all(np.diff(gray.ravel()[order].astype(int)) >= 0)
        assert len(np.unique(gray)) > 50


def test_a_plateau_gives_a_count_twelve_levels_at_most():
    counts = np.repeat(np.array([4000, 4001, 4002], dtype=np.uint16), 100)[None]
    np.testing.assert_array_equal(np.diff(np.unique(Plateau()(counts)).astype(int)), [12, 12])


def test_the_same_seed_gives_the_same_flight():
    small = [seed for seed in range(60) if Rig(seed).lens.width == 160][:2]
    np.testing.assert_array_equal(first_frames(small[0], 3), first_frames(small[0], 3))
    assert not np.array_equal(first_frames(small[0], 3)[2], first_frames(small[1], 3)[2])


def test_the_shutter_freezes_the_last_picture():
    rig = Rig(0)
    rig.sensor, rig.task = replace(rig.sensor, closes=1.0, closed=2.0), replace(rig.task, display='raw')
    frames = ((float(t), np.full((2, 2), t)) for t in range(5))
    assert [int(image[0, 0]) for _, image in shown(rig, frames)] == [0, 0, 0, 3, 4]
