"""The renderer against OpenCV's projection and against what a first-order lag does in closed form."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation
from scipy.special import ndtr
from support.opencv import opencv_detector
from support.tiny import LENS, TINY

from thermal_fiducial.errors import InputError
from thermal_fiducial.sim.lens import Lens
from thermal_fiducial.sim.render import LATTICES, Quality, Renderer
from thermal_fiducial.sim.scene import Acrylic, Clutter, clutter_plate, facing, Fog, Marker, marker_plate, Plate, Room
from thermal_fiducial.sim.spline_trajectory import Motion, pose_matrix
from thermal_fiducial.sim.thermal_camera import CHUNK, render_frames

EMPTY_ROOM = Room(excess=(0.0,) * 6, texture=0.0)
ACRYLIC = Acrylic(contrast=1.0, gradient=0.0, steady=0.0)
LENSES = {
    'plumb_bob': LENS,
    'rational_polynomial': Lens(
        (150.0, 151.0), (78.2, 65.1), 'rational_polynomial', (0.31, 0.05, 3e-4, -2e-4, 0.01, 0.64, 0.12, 0.02), 160, 128
    ),
    'equidistant': Lens((110.0, 111.0), (80.4, 61.7), 'equidistant', (0.0143, -0.0218, 0.0312, -0.0174), 160, 128),
}
# The camera looks along +x of the body, slightly askew.
T_BODY_CAMERA = pose_matrix(
    Rotation.from_quat([-0.5, 0.5, -0.5, 0.5]) * Rotation.from_euler('xyz', [3, -4, 7], True), 0
)
_S, _HALF = np.linspace(-0.5, 0.5, 200, endpoint=False), np.full(200, 0.5)
# Of a unit square, 200 points a side.
OUTLINE = np.concatenate([np.stack(xy, 1) for xy in ((_S, -_HALF), (_HALF, _S), (-_S, _HALF), (-_HALF, -_S))])


class Straight:
    """A body that glides at constant velocity without turning."""

    def __init__(self, position=(0.0, 0.0, 1.2), velocity=(0.0, 0.0, 0.0)):
        self.position, self.velocity = np.array(position), np.array(velocity)

    def __call__(self, t):
        t = np.atleast_1d(t)
        zero = np.zeros((len(t), 3))
        still = Rotation.identity(len(t))
        return Motion(self.position + t[:, None] * self.velocity, still, zero + self.velocity, zero, zero)


def renderer(plates, lens=LENS, body=None, lag=0.0, samples=251, fog=Fog(), room=EMPTY_ROOM, blur=0.0):  # noqa: B008
    body = body or Straight()
    quality = Quality(samples)
    return Renderer(lens, plates, room, fog, ACRYLIC, body, T_BODY_CAMERA, 1 / 30, lag, quality, psf_sigma_px=blur)


def opencv_pixels(lens, points_map, T_map_camera):
    T, points_map = np.linalg.inv(T_map_camera), np.ascontiguousarray(points_map)
    rotation, translation = cv2.Rodrigues(T[:3, :3])[0], T[:3, 3]
    D = np.array(lens.distortion)
    if lens.model == 'equidistant':
        return cv2.fisheye.projectPoints(points_map[:, None], rotation, translation, lens.matrix, D)[0][:, 0]
    return cv2.projectPoints(points_map, rotation, translation, lens.matrix, D)[0][:, 0]


def on_plate(plate, points):
    """Points (N, 2) [m] on a plate, in map (N, 3)."""
    return np.column_stack([points, np.zeros(len(points)), np.ones(len(points))]) @ plate.T_map_plate.T[:, :3]


def polygon_moments(p):
    """Area and centroid of a polygon (N, 2), Green's theorem."""
    q = np.roll(p, -1, axis=0)
    cross = p[:, 0] * q[:, 1] - q[:, 0] * p[:, 1]
    area = cross.sum() / 2
    return abs(area), ((p + q) * cross[:, None]).sum(axis=0) / (6 * area)


def hole(yaw=180.0, tilt=20.0, roll=25.0, position=(2.0, 0.1, 1.3), size=0.3):
    """A single warm square."""
    T = pose_matrix(facing(yaw, tilt, roll), position)
    return Plate(T, size, size, np.ones((1, 1)), np.ones((1, 1), bool), 1.0, 0.0)


def image_moments(image):
    v, u = np.mgrid[0 : image.shape[0], 0 : image.shape[1]]
    total = float(image.sum(dtype=np.float64))
    return total, np.array([float((u * image).sum(dtype=np.float64)), float((v * image).sum(dtype=np.float64))]) / total


@pytest.mark.parametrize('model', LENSES)
@pytest.mark.parametrize('y', [-0.3, 0.0, 0.4])
def test_centroid_and_area_of_a_hole_are_opencvs(model, y):
    lens, plate = LENSES[model], hole(position=(1.8, y, 1.2 + 0.5 * y))
    image = renderer([plate], lens).frame(0.0)
    pixels = opencv_pixels(lens, on_plate(plate, OUTLINE * 0.3), renderer([plate], lens).camera_poses(np.zeros(1))[0])
    area, centroid = polygon_moments(pixels)
    total, mean = image_moments(image)
    # 251 points a pixel on an outline of 100 pixels: the lattice's error is far below the 0.01 px that is asked for.
    np.testing.assert_allclose(mean, centroid, atol=0.003)
    assert total == pytest.approx(area, abs=0.003 * np.sqrt(area) * 4)


def edge_offsets(image, outline, normals):
    """Signed distance [px] from the points of an edge to where the image is 0.5, along the normals."""
    reach = np.linspace(-5, 5, 201)
    offsets = []
    for point, normal in zip(outline, normals, strict=True):
        line = point + reach[:, None] * normal
        values = map_coordinates(image, [line[:, 1], line[:, 0]], order=3)
        crossing = np.flatnonzero((values[:-1] - 0.5) * (values[1:] - 0.5) <= 0)[0]
        part = (0.5 - values[crossing]) / (values[crossing + 1] - values[crossing])
        offsets.append(reach[crossing] + part * (reach[1] - reach[0]))
    return np.array(offsets)


@pytest.mark.parametrize('samples', LATTICES)
@pytest.mark.parametrize('model', LENSES)
def test_edges_of_the_black_square_are_opencvs(model, samples):
    lens = LENSES[model]
    marker = Marker(5, (1.5, 0.05, 1.25), 175.0, 12.0, 9.0, 0.5)
    plate = marker_plate(marker, TINY.aruco_dictionary, ACRYLIC)
    view = renderer([plate], lens, samples=samples, blur=0.6)
    image = view.frame(0.0).astype(np.float64)
    pose = view.camera_poses(np.zeros(1))[0]
    for start, end in zip(marker.corners_map, np.roll(marker.corners_map, -1, axis=0), strict=True):
        s = np.linspace(0.15, 0.85, 60)[:, None]
        outline = opencv_pixels(lens, start + s * (end - start), pose)
        tangent = np.gradient(outline, axis=0)
        normals = np.stack([-tangent[:, 1], tangent[:, 0]], 1) / np.linalg.norm(tangent, axis=1)[:, None]
        # The mean over an edge, so that the phase of the pixels cancels: 0.0061 px with 23 points, 0.0031 with more;
        # 0.01 px is the requirement.
        assert abs(edge_offsets(image, outline, normals).mean()) < 0.007


def test_true_corners_are_opencvs():
    frame = next(render_frames(TINY, noise=False, start=40))
    assert set(frame.corners_px) == {5, 7}
    for marker in TINY.markers:
        expected = opencv_pixels(TINY.lens, marker.corners_map, frame.T_map_camera)
        np.testing.assert_allclose(frame.corners_px[marker.id], expected, atol=1e-6)


def test_a_room_without_markers_has_no_corners():
    assert next(render_frames(replace(TINY, markers=()), noise=False, start=40)).corners_px == {}


def test_corners_are_clockwise_from_the_top_left_and_the_code_reads():
    frame = next(render_frames(TINY, noise=False, start=40))
    low, high = np.percentile(frame.counts, [1, 99])
    gray = np.clip((frame.counts - low) / (high - low) * 255, 0, 255).astype(np.uint8)
    gray = cv2.resize(gray, None, fx=4, fy=4, interpolation=cv2.INTER_CUBIC)
    corners, ids, _ = opencv_detector(TINY.aruco_dictionary).detectMarkers(gray)
    assert sorted(ids.ravel().tolist()) == [5, 7]
    for found, marker_id in zip(corners, ids.ravel().tolist(), strict=True):
        # Unrefined corners in an enlarged picture: a pixel is enough to show the order.
        np.testing.assert_allclose((found[0] - 1.5) / 4, frame.corners_px[marker_id], atol=1.0)


# --- point spread -------------------------------------------------------------------------------------

PINHOLE = Lens((100.0, 100.0), (20.0, 20.0), width=40, height=40)
SIGMA = 0.6


def before(plate, **optics):
    """Image of a plate in front of a camera that looks along z of the map."""
    still, quality = Straight((0.0, 0.0, 0.0)), Quality(**optics)
    args = (PINHOLE, [plate], EMPTY_ROOM, Fog(), ACRYLIC, still, np.eye(4), 1 / 30, 0.0, quality)
    return Renderer(*args, psf_sigma_px=SIGMA).frame(0.0)


def facing_camera(x, size, *, roll_deg=0.0):
    """A warm square a metre away whose middle is ``x`` [m] to the right."""
    R = Rotation.from_euler('xz', [180.0, roll_deg], degrees=True)
    return Plate(pose_matrix(R, (x, 0.0, 1.0)), size, size, np.ones((1, 1)), np.ones((1, 1), bool), 1.0, 0.0)


def covered(distance):
    """Share of a blurred pixel that lies beyond an edge at ``distance`` [px] from its middle."""

    def integral(z):
        return z * ndtr(z / SIGMA) + SIGMA * np.exp(-0.5 * (z / SIGMA) ** 2) / np.sqrt(2 * np.pi)

    return integral(0.5 - distance) - integral(-0.5 - distance)


# Points of a lattice have as many places along a row, each for a share of the pixel: an edge is half of it off at most,
# where the slope of the blurred step is 0.6 a pixel. Pixels that are blurred after their means are 0.057 off.
@pytest.mark.parametrize(('samples', 'allowed'), [(23, 0.0131), (97, 0.0032), (251, 0.0013)])
@pytest.mark.parametrize('phase', np.linspace(0.0, 1.0, 8, endpoint=False))
def test_pixels_at_an_edge_are_those_of_blur_before_sampling(samples, allowed, phase):
    image = before(facing_camera(0.05 + phase / 100.0, 0.1), samples=samples)
    pixels = np.arange(13, 27)
    np.testing.assert_allclose(image[20, 13:27], covered(20.0 + phase - pixels), atol=allowed)


def test_uniform_areas_are_not_changed_by_the_blur():
    image = before(facing_camera(0.0, 0.2, roll_deg=20.0), samples=23)
    # Single precision: up to 575 points a pixel.
    np.testing.assert_allclose(image[18:23, 18:23], 1.0, atol=2e-6)
    np.testing.assert_allclose(image[:3, :3], 0.0, atol=2e-6)


def test_a_plate_that_leaves_the_image_is_blurred_up_to_its_border():
    image = before(facing_camera(0.0, 0.9), samples=23)
    np.testing.assert_allclose(image, 1.0, atol=2e-6)
    # Pixels beyond the border have no points: an edge that crosses it is 0.035 px off in the outermost row.
    across = before(facing_camera(0.253, 0.5), samples=251)
    np.testing.assert_allclose(across[2:-2], across[20:21].repeat(36, axis=0), atol=1e-6)
    np.testing.assert_allclose(across[0], across[20], atol=0.022)


# --- lag ----------------------------------------------------------------------------------------------


def moving(speed, lag):
    """Image at t = 0 of a hole in front of a camera that glides sideways, and the pose then."""
    plate = hole(180.0, 0.0, 0.0, (2.0, 0.0, 1.2), 0.45)
    view = renderer([plate], body=Straight(velocity=(0.0, speed, 0.0)), lag=lag, samples=97)
    return plate, view.frame(0.0), view.camera_poses(np.array([-1e-3, 0.0]))


def test_lag_shifts_the_centroid_by_tau():
    tau, speed = 0.010, 1.5
    plate, still, poses = moving(speed, 0.0)
    _, lagged, _ = moving(speed, tau)
    _, before = image_moments(still)
    total, after = image_moments(lagged)
    earlier, later = (polygon_moments(opencv_pixels(LENS, on_plate(plate, OUTLINE * 0.45), pose))[1] for pose in poses)
    velocity = (later - earlier) / 1e-3
    # 140 px/s. What is forgotten of the frames before the warm-up is e^-13; the lens' distortion bends the path of
    # 1.4 px by some thousandths.
    np.testing.assert_allclose(before - after, velocity * tau, atol=0.01)
    assert np.linalg.norm(velocity) > 100
    assert total == pytest.approx(still.sum(), rel=2e-3)


@pytest.mark.parametrize('tau', [0.008, 0.012])
def test_lag_shifts_the_half_height_of_an_edge_by_tau_ln_2(tau):
    speed = 3.0
    plate, lagged, poses = moving(speed, tau)
    side = np.array([[-0.225, y] for y in np.linspace(-0.1, 0.1, 30)])
    earlier, outline = (opencv_pixels(LENS, on_plate(plate, side), pose) for pose in poses)
    velocity = (outline - earlier) / 1e-3
    tangent = np.gradient(outline, axis=0)
    normals = np.stack([-tangent[:, 1], tangent[:, 0]], 1) / np.linalg.norm(tangent, axis=1)[:, None]
    normal_speed = np.sum(velocity * normals, axis=1)
    length = abs(normal_speed) * tau
    # The response 1 - exp(-x/L), averaged over the pixel's width, crosses 1/2 at L ln 2 + 1/(24 L) to second order.
    expected = -np.sign(normal_speed) * (length * np.log(2) + 1 / (24 * length))
    offsets = edge_offsets(lagged.astype(np.float64), outline, normals)
    assert length.mean() > 2.0
    # The mean over the edge; cubic interpolation of the unblurred picture and the lattice leave some hundredths.
    assert abs((offsets - expected).mean()) < 0.03


def test_stepwise_lag_is_the_sum_of_its_sub_frames():
    tau, speed, step = 0.010, 1.5, 1 / 120
    plate = hole(180.0, 0.0, 0.0, (2.0, 0.0, 1.2), 0.45)
    body = Straight(velocity=(0.0, speed, 0.0))
    view = Renderer(
        LENS, [plate], EMPTY_ROOM, Fog(), ACRYLIC, body, T_BODY_CAMERA, 1 / 30, tau, Quality(97, stepwise=True)
    )
    _, after = image_moments(view.frame(0.0))
    poses = view.camera_poses(np.array([-1e-3, 0.0]))
    earlier, before = (polygon_moments(opencv_pixels(LENS, on_plate(plate, OUTLINE * 0.45), p))[1] for p in poses)
    forget = np.exp(-step / tau)
    # Weights (1 - e) e^k at ages k steps: their mean is e / (1 - e) steps. Distortion bends the path a little.
    shift = (before - earlier) / 1e-3 * step * forget / (1 - forget)
    np.testing.assert_allclose(before - after, shift, atol=0.01)


def test_a_moving_edge_is_blurred_without_steps():
    _, lagged, _ = moving(3.0, 0.010)
    # Along a row the response rises and decays monotonically: no ghost edge at the seams of the sub-frames.
    row = cv2.GaussianBlur(lagged, (0, 0), 0.5)[60]
    peak = int(np.argmax(row))
    assert np.all(np.diff(row[: peak - 2]) > -0.005)
    assert np.all(np.diff(row[peak + 2 :]) < 0.005)


# --- rolling read-out ---------------------------------------------------------------------------------


class Turning(Straight):
    """A body that glides and yaws at constant rates."""

    rate = 1.5

    def __call__(self, t):
        motion, turned = super().__call__(t), np.atleast_1d(t)[:, None] * [0.0, 0.0, self.rate]
        return replace(motion, rotation=Rotation.from_rotvec(turned))


READOUT = 0.016
ROLLING_MARKER = Marker(5, (1.6, 0.05, 1.25), 172.0, 12.0, 9.0, 0.5)


def rolling(lag, readout, samples=97, blur=0.0):
    plate = marker_plate(ROLLING_MARKER, TINY.aruco_dictionary, ACRYLIC)
    body = Turning(velocity=(0.3, 1.0, -0.6))
    quality = Quality(samples)
    return Renderer(LENS, [plate], EMPTY_ROOM, Fog(), ACRYLIC, body, T_BODY_CAMERA, 1 / 30, lag, quality, readout, blur)


def delay_of(row):
    return READOUT * (row / (LENS.height - 1) - 0.5)


def test_each_row_is_that_of_a_frame_at_its_own_time():
    image, still = rolling(0.010, READOUT).frame(0.0), rolling(0.010, 0.0)
    at_once = still.frame(0.0)
    errors, skews = [], []
    for row in (0, 17, 40, 63, 64, 90, 111, 127):
        still.forget()
        expected = still.frame(delay_of(row))[row]
        errors.append(np.abs(image[row] - expected).max())
        skews.append(np.abs(at_once[row] - expected).max())
    # Edges of up to 0.5 K/px: 0.002 px, of single precision and of points that fall into another cell.
    assert max(errors) < 1e-3
    assert max(skews) > 0.1


def test_edges_of_a_rolling_frame_are_where_they_are_when_their_rows_are_sampled():
    view = rolling(0.0, READOUT, samples=251, blur=0.6)
    image = view.frame(0.0).astype(np.float64)
    s = np.linspace(0.15, 0.85, 60)[:, None]
    offsets, skews = [], []
    for start, end in zip(ROLLING_MARKER.corners_map, np.roll(ROLLING_MARKER.corners_map, -1, axis=0), strict=True):
        points = start + s * (end - start)
        outline = at_once = opencv_pixels(LENS, points, view.camera_poses(np.zeros(1))[0])
        for _ in range(8):
            poses = view.camera_poses(delay_of(outline[:, 1]))
            outline = np.array([opencv_pixels(LENS, p[None], T)[0] for p, T in zip(points, poses, strict=True)])
        tangent = np.gradient(outline, axis=0)
        normals = np.stack([-tangent[:, 1], tangent[:, 0]], 1) / np.linalg.norm(tangent, axis=1)[:, None]
        offsets.append(edge_offsets(image, outline, normals).mean())
        skews.append(np.abs(np.sum((outline - at_once) * normals, axis=1)).max())
    # As for a frame at once; the edges' mean, so that the phase of the pixels cancels. They are skewed by a pixel.
    assert np.abs(offsets).max() < 0.01
    assert max(skews) > 0.8


def test_truth_of_a_rolling_frame_is_that_of_the_stamp():
    scenario = replace(TINY, sensor=replace(TINY.sensor, readout=READOUT))
    frames = [next(render_frames(case, noise=False, start=40)) for case in (TINY, scenario)]
    assert frames[0].stamp_ns == frames[1].stamp_ns
    for marker_id, corners in frames[0].corners_px.items():
        np.testing.assert_array_equal(frames[1].corners_px[marker_id], corners)
    assert np.any(frames[0].counts != frames[1].counts)


# --- scene --------------------------------------------------------------------------------------------


def test_fog_attenuates_and_glows():
    plate = hole(180.0, 0.0, 0.0, (3.0, 0.0, 1.2), 2.0)
    image = renderer([plate], fog=Fog(0.4, 0.3, 0.0)).frame(0.0)
    u, v = 80, 64
    ray = np.append(LENS.slopes(np.array([u, v])), 1.0)
    direction = T_BODY_CAMERA[:3, :3] @ ray
    distance = np.linalg.norm(ray) * 3.0 / direction[0]
    through = np.exp(-0.4 * distance)
    # Single precision.
    assert image[v, u] == pytest.approx(through * 1.0 + (1 - through) * 0.3, abs=1e-4)


def test_nearer_things_hide_farther_ones():
    far, near = hole(position=(3.0, 0.0, 1.2), size=1.0), hole(position=(2.0, 0.0, 1.2), size=0.3)
    near.hot = 5.0
    for plates in ([far, near], [near, far]):
        image = renderer(plates).frame(0.0)
        assert image.max() == pytest.approx(5.0, abs=1e-5)
    assert near.hides(
        np.array([0.0, 0.0, 1.2]), np.array([[3.0, 0.0, 1.2], [3.0, 1.0, 1.2], [1.0, 0.0, 1.2]])
    ).tolist() == [
        True,
        False,
        False,
    ]


def test_a_face_is_seen_from_its_front_only():
    image = renderer([hole(0.0)]).frame(0.0)
    assert image.max() == 0.0


def test_a_plate_that_reaches_behind_the_camera_is_drawn():
    pipe = clutter_plate(Clutter('pipe', (0.0, 1.5, 1.25), -90.0, 40.0, 0.4, 10.0))
    whole = renderer([pipe], LENSES['equidistant'], samples=23).frame(0.0)
    short = clutter_plate(Clutter('pipe', (10.25, 1.5, 1.25), -90.0, 19.5, 0.4, 10.0))
    front = renderer([short], LENSES['equidistant'], samples=23).frame(0.0)
    assert (whole > 1.0).sum() > 200
    # Beside their gradients the two are the same pixels.
    assert ((whole > 1.0) != (front > 1.0)).mean() < 1e-3


def test_inverted_polarity_swaps_the_cells():
    marker = TINY.markers[0]
    normal = marker_plate(marker, TINY.aruco_dictionary, ACRYLIC)
    inverted = marker_plate(marker, TINY.aruco_dictionary, replace(ACRYLIC, inverted=True))
    np.testing.assert_array_equal(normal.levels[1:-1, 1:-1], 1.0 - inverted.levels[1:-1, 1:-1])


def test_acrylic_warms_up():
    acrylic = Acrylic(contrast=20.0, steady=0.5, warm_up_time=100.0, age=0.0)
    assert acrylic.sheet(0.0) == 0.0
    assert acrylic.sheet(100.0) == pytest.approx(10.0 * (1 - np.exp(-1)))
    assert acrylic.sheet(1e4) == pytest.approx(10.0)


def test_same_seed_same_frames_whatever_was_rendered_before():
    whole = {frame.stamp_ns: frame.counts for frame in render_frames(TINY, seed=3, stop=CHUNK + 4)}
    chunk = list(render_frames(TINY, seed=3, start=CHUNK, stop=CHUNK + 4))
    assert len(chunk) == 4
    assert all(np.array_equal(frame.counts, whole[frame.stamp_ns]) for frame in chunk)
    other = next(render_frames(TINY, seed=4, start=CHUNK))
    assert np.any(other.counts != chunk[0].counts)


def test_refuses_an_unknown_lattice():
    with pytest.raises(InputError, match='samples'):
        renderer([], samples=7)
