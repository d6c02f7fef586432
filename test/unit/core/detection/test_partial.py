"""Known markers that the border of the image cuts: measured where they show themselves, and never anything else."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from support import approach
from support.close_views import BITS, BLUR_WITH_PIXEL, CAMERAS, draw, plate, pose
from support.scenes import motion_prior

from thermal_fiducial.calibration.joint_pose import solve_camera_pose
from thermal_fiducial.config import ArucoDetectorConfig
from thermal_fiducial.core.detection.corners.gray_scale import GrayScale, UNKNOWN_SCALE
from thermal_fiducial.core.detection.partial.grid import adjusted, grid_edges, Layer
from thermal_fiducial.core.detection.partial.partial_markers import PartialMarkerSearch
from thermal_fiducial.core.detection.patterns import Decoder
from thermal_fiducial.core.detection.prediction.frame import Frame
from thermal_fiducial.core.detection.prediction.known_markers import KnownMarkers
from thermal_fiducial.core.detection.prediction.twist import Twist
from thermal_fiducial.core.geometry import se3
from thermal_fiducial.core.geometry.reprojection import marker_corners
from thermal_fiducial.core.measurements import corner_covariances, corners_px, Odometry
from thermal_fiducial.sim.spline_trajectory import SplineTrajectory
from thermal_fiducial.sim.thermal_camera import render_frames

SIZE, ID, CELLS = 0.3, 8, BITS.shape[1] + 2
#: Side [px], direction of the middle, and rotation: a side outside, a corner, all four, a small one at the border, one
#: that is tilted.
VIEWS = {
    'side': (180, -0.35, 0.0, (0.1, 0.05, 0.2)),
    'corner': (200, 0.3, 0.22, (-0.2, 0.1, 0.7)),
    'all sides': (330, 0.03, -0.02, (0.05, -0.1, 0.4)),
    'small': (60, 0.55, 0.0, (0.2, 0.1, 0.1)),
    'tilted': (200, 0.15, 0.3, (0.6, 0.1, 0.0)),
}
CONFIG = ArucoDetectorConfig(blur_px=BLUR_WITH_PIXEL)
SEARCH = PartialMarkerSearch(Decoder(BITS), BITS)
STILL = Twist(np.zeros(6), 1e-9 * np.eye(6))
#: Time constant of the bolometers [s], and the instants whose mean is a lagging image.
LAG, INSTANTS = 0.010, 24


@cache
def drawn(model, view):
    return draw(model, plate(ID), pose(*VIEWS[view]))


def look(image, camera, T_expected, noise, marker_id=ID, config=CONFIG, twist=STILL):
    """What is found of a marker where it is expected."""
    frame = Frame(0, image.astype(np.float32), noise, camera, twist, LAG, 0.0, CONFIG.blur_px, image)
    return look_at(frame, T_expected, marker_id, config)


def look_at(frame, T_expected, marker_id=ID, config=CONFIG, scale=UNKNOWN_SCALE):
    """The same in a frame."""
    camera = frame.camera
    known = KnownMarkers({marker_id: (T_expected, SIZE)}, np.ones(len(BITS)))
    cut = known.partially_visible(np.eye(4), camera, np.zeros(0, dtype=np.int64))
    assert len(cut) == 1
    return SEARCH.find(frame, scale, cut, 0.01, config)


def disturbed(T, rng, scale=0.005):
    return se3.transform(se3.so3_exp(rng.normal(0, scale, 3)), rng.normal(0, scale, 3)) @ T


@pytest.mark.parametrize('model', CAMERAS)
@pytest.mark.parametrize('view', VIEWS)
def test_corners_outside_the_image_are_found_without_noise(model, view):
    camera, T = CAMERAS[model], pose(*VIEWS[view])
    true = camera.project(se3.apply(T, marker_corners(SIZE)))
    assert not camera.contains(true, 8.0).all()
    image = 7000.0 + 200.0 * drawn(model, view)
    ids, found = look(image, camera, disturbed(T, np.random.default_rng(1)), 0.5)
    assert ids.tolist() == [ID]
    # What comes out is 0.003 to 0.02 px, of the drawing's samples, most in corners far outside.
    assert np.abs(found.corners_px[0] - true).max() < 0.04
    assert found.contrast[0] == pytest.approx(200.0, rel=0.03)


@cache
def turning(view, rate):
    """A marker seen with lag in a turn [rad/s], 1 for white; its pose and the twist."""
    T, turn = pose(*VIEWS[view]), np.array([rate, -rate, 0.0]) / np.sqrt(2.0)
    ages = -LAG * np.log1p(-(np.arange(INSTANTS) + 0.5) / INSTANTS)
    then = [se3.transform(se3.so3_exp(turn * age), np.zeros(3)) @ T for age in ages.tolist()]
    image = np.mean([draw('plumb_bob', plate(ID), T_then) for T_then in then], axis=0)
    return image, T, Twist(np.concatenate([np.zeros(3), turn]), 1e-9 * np.eye(6))


@pytest.mark.parametrize('rate', [*(pytest.param(rate, marks=pytest.mark.nightly) for rate in (0.2, 0.5)), 1.0])
@pytest.mark.parametrize('view', ['side', 'small'])
def test_what_lags_behind_in_a_turn_displaces_no_corner(view, rate):
    """By 1 to 5 px; edges with a tail that are fitted as if blur were symmetric seem a fifth of that ahead."""
    camera, (image, T, twist) = CAMERAS['plumb_bob'], turning(view, rate)
    ids, found = look(7000.0 + 200.0 * image, camera, T, 0.5, twist=twist)
    assert ids.tolist() == [ID]
    error = found.corners_px[0] - camera.project(se3.apply(T, marker_corners(SIZE)))
    # 0.01 to 0.05 px, of the instants and of what is not Gaussian in the blur that is left.
    assert np.abs(error.mean(axis=0)).max() < 0.08


@pytest.mark.parametrize(
    ('view', 'bent', 'white'),
    [('side', 2.0, 1.0), ('side', 0.5, 1.0), ('side', 1.0, 0.6), ('small', 2.0, 1.0), ('small', 1.0, 0.8)],
)
def test_a_gray_scale_displaces_no_corner_in_a_turn(view, bent, white):
    """Counts to a power, as whole markers have shown it, or white from a share of the contrast on."""
    camera, (image, T, twist) = CAMERAS['plumb_bob'], turning(view, 1.0)
    gray = np.rint(20.0 + 235.0 * np.clip(image / white, 0.0, 1.0) ** bent).astype(np.uint8)
    frame = Frame.of(0, gray, camera, twist, replace(CONFIG, bolometer_lag=LAG), CONFIG.blur_px, keep_columns=True)
    counts = 235.0 * (np.clip(np.arange(256) - 20.0, 0.0, None) / 235.0) ** (1.0 / bent)
    ids, found = look_at(frame, T, scale=GrayScale(counts, slice(20, 256)))
    assert ids.tolist() == [ID]
    error = found.corners_px[0] - camera.project(se3.apply(T, marker_corners(SIZE)))
    # When written at most 0.052 px; in gray levels 0.17 to 0.44 px.
    assert np.abs(error.mean(axis=0)).max() < 0.08


@pytest.mark.parametrize('view', VIEWS)
def test_holes_in_a_thick_plate_are_smaller_seen_from_the_side(view):
    """Of a plate of 3 mm the camera sees the cut sides of holes: the farther from its axis, the more."""
    camera, T, thickness = CAMERAS['plumb_bob'], pose(*VIEWS[view]), 0.003
    true = camera.project(se3.apply(T, marker_corners(SIZE)))
    image = 7000.0 + 200.0 * draw('plumb_bob', plate(ID), T, thickness=thickness)
    errors = []
    for declared in (0.0, thickness):
        config = replace(CONFIG, plate_thickness=declared)
        _, found = look(image, camera, disturbed(T, np.random.default_rng(1)), 0.5, config=config)
        errors.append(np.abs(found.corners_px[0] - true).max())
    # Measured 0.23 to 2.2 px, and 0.010 to 0.022 px: as for thin plates.
    assert errors[0] > 0.2
    assert errors[1] < 0.04


@pytest.mark.parametrize('view', VIEWS)
def test_errors_are_those_that_the_covariance_claims(view):
    """Normalised squared errors of poses, 60 draws of noise: 360 degrees of freedom."""
    camera, T = CAMERAS['plumb_bob'], pose(*VIEWS[view])
    clean, pattern = 7000.0 + 8.0 * drawn('plumb_bob', view), grid_edges(BITS[ID])
    rng, nees = np.random.default_rng(2), []
    for _ in range(60):
        image = (clean + rng.normal(0.0, 1.5, clean.shape)).astype(np.float32)
        layer = Layer(image, camera, lambda points: np.zeros((len(points), 2)), BLUR_WITH_PIXEL, np.zeros(2))
        fit = adjusted(adjusted(T, SIZE, pattern, layer).T_camera_marker, SIZE, pattern, layer)
        found = fit.T_camera_marker
        turn = se3.so3_log(T[:3, :3] @ found[:3, :3].T)
        error = np.concatenate([T[:3, 3] - found[:3, 3], turn])
        nees.append(error @ np.linalg.inv(fit.covariance) @ error / 6.0)
    # Three sigma of the mean are 0.22; the floor of an edge's place, which nothing here needs, takes up to 0.15.
    assert 0.6 < np.mean(nees) < 1.25


def test_corners_taken_for_independent_claim_no_more_than_is_known():
    camera, T = CAMERAS['plumb_bob'], pose(*VIEWS['corner'])
    clean, rng = 7000.0 + 15.0 * drawn('plumb_bob', 'corner'), np.random.default_rng(3)
    nees = []
    for _ in range(40):
        _, found = look(clean + rng.normal(0.0, 1.5, clean.shape), camera, disturbed(T, rng), 1.5)
        if len(found.corners_px) == 0:
            continue
        square = (marker_corners(SIZE))[None]
        T_marker_camera = se3.inverse(T)
        solved = solve_camera_pose(found.corners_px, found.covariances, square, camera, T_marker_camera, compete=False)
        off = T_marker_camera[:3, 3] - solved.T_map_camera[:3, 3]
        turn = se3.so3_log(T_marker_camera[:3, :3] @ solved.T_map_camera[:3, :3].T)
        error = np.concatenate([off, turn])
        nees.append(error @ np.linalg.solve(solved.covariance, error) / 6.0)
    # One in forty may be refused where noise makes the pattern doubtful.
    assert len(nees) >= 38
    # Covariances of single corners cannot say how these err together: what they claim is too little, never too much.
    assert 0.15 < np.mean(nees) < 1.0


def clutter(kind, rng):
    if kind == 'random':
        return (rng.random((CELLS + 2, CELLS + 2)) < 0.5).astype(float)
    if kind == 'stripes':
        return np.indices((CELLS + 2, CELLS + 2))[rng.integers(2)] % 2.0
    if kind == 'turned':
        return np.rot90(plate(ID), rng.integers(1, 4))
    if kind == 'black':
        return plate(ID) * 0.0 + np.pad(np.zeros((CELLS, CELLS)), 1, constant_values=1.0)
    return plate((ID + rng.integers(1, len(BITS))) % len(BITS))


@pytest.mark.parametrize('kind', ['random', 'stripes', 'turned', 'black', 'other', 'noise'])
def test_nothing_else_is_taken_for_the_expected_marker(kind):
    rng = np.random.default_rng(4)
    camera = CAMERAS['equidistant']
    for name in VIEWS:
        T = pose(*VIEWS[name])
        for contrast in (4.0, 100.0):
            shown = 0.0 if kind == 'noise' else contrast * draw('equidistant', clutter(kind, rng), T, samples=2)
            image = 7000.0 + shown + rng.normal(0.0, 1.5, (camera.height, camera.width))
            assert len(look(image, camera, disturbed(T, rng), 1.5)[0]) == 0


def test_what_too_few_cells_show_is_not_published():
    """A strip of three cells at one side is that of many markers."""
    camera, T = CAMERAS['equidistant'], pose(200, -0.93, 0.0, (0.0, 0.0, 0.0))
    image = 7000.0 + 200.0 * draw('equidistant', plate(ID), T, samples=2)
    assert len(look(image, camera, T, 0.5)[0]) == 0


def test_a_detector_with_odometry_sees_it():
    scenario = approach.scenario()
    frame = next(iter(render_frames(scenario, 7.0, 3, start=150, stop=151)))
    assert frame.corners_px == {}
    T_map_body = frame.T_map_camera @ se3.inverse(scenario.T_body_camera)
    motion = still(scenario, frame)
    state = Odometry(frame.stamp_ns, T_map_body, *motion, 1e-6 * np.eye(6), 1e-4 * np.eye(6))
    detector, camera = approach.detector_of(scenario, with_map=True), approach.camera_of(scenario)
    assert len(detector.detect(frame.stamp_ns, frame.counts, camera)) == 0
    row = detector.detect(frame.stamp_ns + 1, frame.counts, camera, motion_prior(state))
    assert row['id'].tolist() == [7]
    marker = scenario.markers[0]
    T = se3.inverse(frame.T_map_camera) @ marker.T_map_marker
    error = corners_px(row)[0] - camera.project(se3.apply(T, marker_corners(marker.size)))
    assert np.abs(error).max() < 0.5
    sigma = np.sqrt(np.trace(corner_covariances(row)[0], axis1=1, axis2=2))
    assert np.all(np.linalg.norm(error, axis=1) < 4.0 * sigma)


def still(scenario, frame):
    """Velocity and turn rate of the body."""
    path: SplineTrajectory = scenario.flight.trajectory(7.0, 3)
    motion = path(frame.seconds)
    return motion.rotation.as_matrix()[0].T @ motion.velocity[0], motion.angular_velocity_body[0]
