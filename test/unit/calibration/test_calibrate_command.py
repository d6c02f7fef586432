"""``calibrate`` on bags: reading, choosing views, refusing."""

from dataclasses import replace
from pathlib import Path
import re

from builtin_interfaces.msg import Time
import cv2
from geometry_msgs.msg import Vector3
import numpy as np
import pytest
from std_msgs.msg import Header
from support.boards import chessboard_levels, plate_pose, random_view, render
from support.small_bag import (
    CAMERA,
    camera_info,
    image,
    Raw,
    Recording,
    recording,
    replaced,
    side_files,
    START_NS,
    T_BODY_CAMERA,
)
import yaml

from thermal_fiducial.calibration import camera_imu
from thermal_fiducial.calibration.camera_imu import CameraImuCalibration
from thermal_fiducial.calibration.sources import recorded_camera
from thermal_fiducial.calibration.targets import Chessboard
from thermal_fiducial.cli import calibrate_intrinsics
from thermal_fiducial.cli.board_views import BoardViews
from thermal_fiducial.cli.calibrate_intrinsics import mapped_detector
from thermal_fiducial.cli.main import main
from thermal_fiducial.core.detection.detector import rows_from_corners
from thermal_fiducial.core.geometry import se3
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.geometry.reprojection import corners_in_map
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.bags import BagReader, CAMERA_INFO_TOPIC, IMAGE_TOPIC, IMU_TOPIC, MARKERS_TOPIC
from thermal_fiducial.files.camera_info import load_camera, save_camera
from thermal_fiducial.files.dictionary import load_dictionary, PACKAGED
from thermal_fiducial.files.images import image_to_array, stamp_to_ns
from thermal_fiducial.files.marker_map import load_map, save_map
from thermal_fiducial.ros.messages.clouds import MARKER_CLOUDS
from thermal_fiducial.sim.lens import Lens

#: A quarter of a Tau 2's pixels: a board is found in a quarter of the time.
SMALL = Lens((382.0, 381.0), (161.0, 126.0), width=320, height=256)


def calibrated(bag, marker_map, out):
    """Parameters that ``calibrate camera-imu`` finds from four seconds, with the right rotation and clock."""
    assert main(['calibrate', 'camera-imu', str(bag), '--map', str(marker_map), '--out', str(out)]) == 0
    found = yaml.safe_load(out.read_text())['/**']['ros__parameters']
    R = se3.rotation_from_quaternion(found['camera_orientation'])
    # Four seconds of gentle motion: enough for the rotation and the clock, hardly for the lever arm.
    assert np.degrees(se3.rotation_angle(R.T @ T_BODY_CAMERA[:3, :3])) < 1.0
    # These frames have no lag, but the detector undoes the 10 ms that a bolometer has.
    assert 0.0 < found['camera_time_offset'] < 0.02
    return found


def test_camera_against_imu(tmp_path, capsys):
    bag = recording(seconds=4.2).write(tmp_path / 'bag')
    marker_map, _ = side_files(tmp_path, ids=(0, 1, 2, 3))
    found = calibrated(bag, marker_map, tmp_path / 'extrinsics.yaml')
    printed = capsys.readouterr()
    assert '+-' in printed.out
    # What the recording leaves open goes on to the filter, which would otherwise take 2 mm and 2 mrad.
    left_mm = [float(value) for value in _axes_of(printed.out, 'camera_position')]
    left_deg = [float(value) for value in _axes_of(printed.out, 'camera_orientation')]
    assert max(left_mm) > 2.0
    # Tolerances: the digits that are printed.
    assert 1e3 * found['extrinsics_position_std'] == pytest.approx(max(left_mm), abs=0.01)
    assert np.degrees(found['extrinsics_orientation_std']) == pytest.approx(
        max([*left_deg, np.degrees(0.002)]), abs=1e-4
    )
    readout_ms = float(re.search(r'readout_time: \S+  # \+- (\S+) ms', printed.out)[1])
    assert 1e3 * found['readout_time_std'] == pytest.approx(max(readout_ms, 0.5), abs=0.001)
    assert 'turns about all three axes' in printed.err


def test_camera_against_imu_by_the_lag_of_the_rig(tmp_path):
    """With the usual lag taken out of frames that have none, the clock offset was 14 ms off."""
    bag = recording(seconds=4.2).write(tmp_path / 'bag')
    marker_map, _ = side_files(tmp_path, ids=(0, 1, 2, 3))
    words = ['calibrate', 'camera-imu', str(bag), '--map', str(marker_map), '--bolometer-lag', '0']
    assert main([*words, '--out', str(tmp_path / 'extrinsics.yaml')]) == 0
    found = yaml.safe_load((tmp_path / 'extrinsics.yaml').read_text())['/**']['ros__parameters']
    assert abs(found['camera_time_offset']) < 0.002


def test_one_pose_far_off_does_not_make_the_error_that_is_printed(tmp_path, capsys, monkeypatch):
    """Of 431 poses 0.1 mm off, one, of a marker taken for its mirror image, 2.2 m: an "rms" of 105 mm was printed."""
    residuals = np.zeros((431, 6))
    residuals[:, 0] = 1e-4
    residuals[274, 0] = 2.188
    found = CameraImuCalibration(
        T_BODY_CAMERA, 0.0, 1e-8 * np.eye(7), 0.0, 1e-4, 0.0, np.zeros(3), np.zeros(6), 0.0, 1e-3,
        np.zeros(15), np.zeros(15), residuals, len(residuals), 1.0,
    )  # fmt: skip
    monkeypatch.setattr(camera_imu, 'calibrate_rolling_camera_imu', lambda *_: found)
    bag = recording(seconds=1.0).write(tmp_path / 'bag')
    marker_map, _ = side_files(tmp_path, ids=(0, 1, 2, 3))
    words = ['calibrate', 'camera-imu', str(bag), '--map', str(marker_map), '--out', str(tmp_path / 'extrinsics.yaml')]
    assert main(words) == 0
    assert '# 431 camera poses, off the motion by 0.10 mm in the median, 2188.00 mm at worst' in capsys.readouterr().out


def with_corners_instead_of_images(images, marker_map):
    """A recording in which detections stand for the images, as in those of ``import``."""
    detector, corners = mapped_detector(load_map(marker_map), marker_map.parent), images.without(IMAGE_TOPIC)
    for message in images.of(IMAGE_TOPIC):
        stamp_ns = stamp_to_ns(message.header.stamp)
        rows = detector.detect(stamp_ns, image_to_array(message), CAMERA)
        head = Header(stamp=Time(sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9))
        data = MARKER_CLOUDS.message(rows, head)
        corners.events.append((stamp_ns, MARKERS_TOPIC, Raw('sensor_msgs/msg/PointCloud2', data)))
    return corners


def test_camera_against_imu_by_recorded_corners(tmp_path):
    marker_map, _ = side_files(tmp_path, ids=(0, 1, 2, 3))
    bag = with_corners_instead_of_images(recording(seconds=4.2), marker_map).write(tmp_path / 'bag')
    calibrated(bag, marker_map, tmp_path / 'extrinsics.yaml')


def test_camera_against_imu_leaves_out_markers_in_quarantine(tmp_path):
    marker_map, _ = side_files(tmp_path, ids=(0, 1, 2))
    bag = with_corners_instead_of_images(recording(seconds=4.2), marker_map).write(tmp_path / 'bag')
    known, found = load_map(marker_map), []
    moved = se3.transform(np.eye(3), [0.0, 0.3, 0.0]) @ known.markers[2].T_map_marker
    quarantined = replace(known.markers[2], T_map_marker=moved, trusted=False)
    for others in ({}, {2: quarantined}):
        save_map(marker_map, replace(known, markers={key: known.markers[key] for key in (0, 1)} | others))
        found.append(calibrated(bag, marker_map, tmp_path / f'{len(others)}.yaml'))
    assert found[0] == found[1]


def test_camera_against_imu_names_the_dictionary_that_no_frame_shows(tmp_path, capsys):
    bag = recording(seconds=0.2).write(tmp_path / 'bag')
    marker_map, _ = side_files(tmp_path, ids=(0, 1))
    out = tmp_path / 'extrinsics.yaml'
    marker_map.write_text(marker_map.read_text().replace('DICT_4X4_50', 'DICT_5X5_100'))
    assert main(['calibrate', 'camera-imu', str(bag), '--map', str(marker_map), '--out', str(out)]) == 2
    assert f'no frame shows a marker of {marker_map}, which are of DICT_5X5_100' in capsys.readouterr().err


def test_camera_against_imu_refuses_a_calibration_of_another_size(tmp_path, capsys):
    bag = recording(seconds=0.2).write(tmp_path / 'bag')
    marker_map, _ = side_files(tmp_path, ids=(0, 1, 2, 3))
    lens, out = tmp_path / 'lens.yaml', tmp_path / 'extrinsics.yaml'
    save_camera(lens, Camera(320, 256, np.array([[400.0, 0.0, 160.0], [0.0, 400.0, 128.0], [0.0, 0.0, 1.0]])))
    words = ['calibrate', 'camera-imu', str(bag), '--map', str(marker_map), '--calibration', str(lens)]
    assert main([*words, '--out', str(out)]) == 2
    assert 'lens.yaml: a calibration of 320x256 pixels, the bag of 640x512' in capsys.readouterr().err


@pytest.mark.parametrize(
    ('topic', 'fields', 'words'),
    [
        (CAMERA_INFO_TOPIC, {'k': np.zeros(9)}, 'camera_info: camera matrix without a focal length'),
        (CAMERA_INFO_TOPIC, {'binning_x': 2}, 'camera_info of a binned or cropped image'),
        (IMAGE_TOPIC, {'encoding': 'bgr8'}, "image of encoding 'bgr8'"),
        (CAMERA_INFO_TOPIC, {'width': 320, 'height': 256}, 'image of 640x512, camera_info of 320x256'),
        # Without turn rates the adjustment has no solution.
        (IMU_TOPIC, {'angular_velocity': Vector3()}, 'an axis of the IMU says the same all the time'),
    ],
)
def test_camera_against_imu_names_the_bag_of_what_it_cannot_use(tmp_path, topic, fields, words, capsys):
    recorded = recording(seconds=0.2).changed(topic, lambda message: replaced(message, **fields))
    marker_map, _ = side_files(tmp_path, ids=(0, 1, 2, 3))
    command = ['calibrate', 'camera-imu', str(recorded.write(tmp_path / 'bag')), '--map', str(marker_map)]
    assert main([*command, '--out', str(tmp_path / 'extrinsics.yaml')]) == 2
    assert f'{tmp_path}/bag: {words}' in capsys.readouterr().err


@pytest.mark.parametrize('name', ['', 'radtan'])
def test_the_camera_of_a_bag_is_read_as_the_nodes_read_it(tmp_path, name):
    """A model without a name was refused, which a replay takes for plumb_bob."""
    recorded = recording(seconds=0.1).changed(CAMERA_INFO_TOPIC, lambda info: replaced(info, distortion_model=name))
    with BagReader(recorded.write(tmp_path / 'bag')) as bag:
        assert recorded_camera(bag).matches(CAMERA)


def _axes_of(text, name):
    """The standard deviations of the three axes behind the parameter ``name``."""
    line = next(line for line in text.splitlines() if f'{name}:' in line)
    return line.partition('+- [')[2].partition(']')[0].split(',')


@pytest.mark.parametrize('missing', [IMU_TOPIC, IMAGE_TOPIC, CAMERA_INFO_TOPIC, 'bag', 'map', 'time'])
def test_camera_against_imu_refuses(tmp_path, missing, capsys):
    seconds = 1.0 if missing == 'time' else 0.2
    bag = recording(seconds=seconds).without(missing).write(tmp_path / 'bag')
    marker_map, _ = side_files(tmp_path, ids=(0, 1, 2, 3))
    source = tmp_path / 'none' if missing == 'bag' else bag
    marker_map = tmp_path / 'none.yaml' if missing == 'map' else marker_map
    out = tmp_path / 'extrinsics.yaml'
    assert main(['calibrate', 'camera-imu', str(source), '--map', str(marker_map), '--out', str(out)]) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1
    assert not out.exists()


def test_intrinsics_from_a_bag(tmp_path, capsys):
    lens, board, rng = SMALL, Chessboard(8, 6, 0.05), np.random.default_rng(6)
    camera = Camera(lens.width, lens.height, lens.matrix)
    events = []
    for view in range(8):
        plate = plate_pose(random_view(lens, board.points, rng), np.array([0.175, 0.125]))
        still = render(lens, plate, chessboard_levels(8, 6), 0.55, 0.45, 8.0, view, samples=23)
        # Two frames of each view, as of a board that is held still: a count more noise in the second.
        for repeat in range(2):
            stamp = START_NS + (2 * view + repeat) * 33_333_333
            counts = still + rng.integers(0, 1 + repeat, still.shape, dtype=still.dtype)
            events += [
                (stamp, CAMERA_INFO_TOPIC, camera_info(stamp, camera)),
                (stamp, IMAGE_TOPIC, image(stamp, counts)),
            ]
    bag = Recording(events).write(tmp_path / 'bag')
    out = tmp_path / 'camera.yaml'
    arguments = ['--every', '1', '--models', 'plumb_bob', '--out', str(out), '--report', str(tmp_path / 'r.html')]
    assert main(['calibrate', 'intrinsics', str(bag), *arguments]) == 0
    assert capsys.readouterr().out.count('cells covered') >= 7
    # Seven views in place of forty.
    assert load_camera(out).K[0, 0] == pytest.approx(lens.focal[0], rel=3e-3)


def recorded_views(lens, known, count, bent):
    """A bag of the corners of markers in views from all around, each a frame, of a board with ``bent`` (P, 3) added."""
    sizes = np.array([marker.size for marker in known])
    corners = corners_in_map(np.stack([marker.T_map_marker for marker in known]), sizes)
    # Boards have y down.
    T_map_board = known[0].T_map_marker @ np.diag([1.0, -1.0, -1.0, 1.0])
    points = se3.apply(se3.inverse(T_map_board), (corners + bent.reshape(corners.shape)).reshape(-1, 3))
    camera, rng, recorded = Camera(lens.width, lens.height, lens.matrix), np.random.default_rng(2), Recording([])
    ids = np.array([marker.id for marker in known])
    sigma_px = 0.03
    for view in range(count):
        stamp = START_NS + view * 33_333_333
        pixels = lens.project(se3.apply(random_view(lens, points, rng), points)) + rng.normal(
            0.0, sigma_px, (len(points), 2)
        )
        covariances = np.tile(sigma_px**2 * np.eye(2), (*corners.shape[:2], 1, 1))
        rows = rows_from_corners(ids, pixels.reshape(-1, 4, 2), covariances, sizes, camera)
        cloud = MARKER_CLOUDS.message(rows, Header(stamp=Time(sec=stamp // 10**9, nanosec=stamp % 10**9)))
        recorded.events += [
            (stamp, CAMERA_INFO_TOPIC, camera_info(stamp, camera)),
            (stamp, MARKERS_TOPIC, Raw('sensor_msgs/msg/PointCloud2', cloud)),
        ]
    return recorded


def test_intrinsics_from_recorded_corners(tmp_path, capsys):
    """Of a flight, before a wall that is not as its map says, and whose origin lies behind the camera."""
    marker_map, _ = side_files(tmp_path, ids=(0, 1, 2, 3))
    known = list(load_map(marker_map).markers.values())
    bent = 2e-3 * np.random.default_rng(1).standard_normal((16, 3))
    bag, out = tmp_path / 'bag', tmp_path / 'camera.yaml'
    recorded_views(SMALL, known, 40, bent).write(bag)
    words = ['calibrate', 'intrinsics', str(bag), '--target', 'markers', '--board', str(marker_map), '--out', str(out)]
    words += ['--every', '1', '--models', 'plumb_bob']
    # A flight is never at rest as a board is that is held still.
    assert main(words) == 2
    assert re.search(r'the board moves by \d+\.\d px until the next frame \(--most-motion\)', capsys.readouterr().err)
    assert main([*words, '--plate-thickness', '0.003']) == 2
    assert '--plate-thickness has no effect' in capsys.readouterr().err
    found = tmp_path / 'found.yaml'
    assert main([*words, '--most-motion', '100', '--board-out', str(found)]) == 0
    printed = capsys.readouterr()
    # Three coordinates of 2 mm each; the tolerance is three standard deviations by chance of 48 of them.
    rms_mm = float(re.search(r'the points of the board are ([\d.]+) mm', printed.out)[1])
    assert rms_mm == pytest.approx(2.0 * np.sqrt(3.0), rel=0.3)
    assert 'more than 0.5 mm allow: measure it, or give --board-std' in printed.err
    known_to = yaml.safe_load(out.with_name('camera_covariance.yaml').read_text())['sigma'][0]
    assert abs(load_camera(out).K[0, 0] - SMALL.focal[0]) < 3.0 * known_to
    # Forty views of sixteen points; as exact as that 2 mm leave 0.5 %.
    assert known_to < 2e-3 * SMALL.focal[0]
    # A square moves by the mean of its corners, half of 2 mm. Found to less than half of that.
    moved = np.array([load_map(found).markers[one.id].T_map_marker[:3, 3] for one in known])
    truth = np.array([one.T_map_marker[:3, 3] for one in known]) + bent.reshape(4, 4, 3).mean(axis=1)
    left = se3.apply(se3.rigid_alignment(truth, moved), moved) - truth
    assert np.sqrt(np.mean(left**2)) < 0.5e-3


def test_a_board_of_plates_has_their_thickness(tmp_path, monkeypatch):
    """Taken for printed ones, a dozen plates of 130 x 130 x 3 mm made the focal length 0.6 % too long."""
    given = []

    def noted(board, folder, thickness=0.0):
        given.append(thickness)
        raise InputError('enough')

    monkeypatch.setattr(calibrate_intrinsics, 'mapped_detector', noted)
    marker_map, _ = side_files(tmp_path)
    words = ['calibrate', 'intrinsics', str(tmp_path), '--target', 'markers', '--board', str(marker_map)]
    assert main([*words, '--plate-thickness', '0.003', '--out', str(tmp_path / 'lens.yaml')]) == 2
    assert given == [0.003]


def test_a_board_has_its_dictionary_file_beside_it(tmp_path, monkeypatch):
    """Calibration looked for it where it was started; the board, as any map, names it from its own folder."""
    own = PACKAGED / 'STENCIL_4X4_16.yaml'
    (tmp_path / 'mine.yaml').write_text(own.read_text())
    monkeypatch.chdir(tmp_path)
    words = ['markers', 'board', 'markers', '--dictionary', 'mine.yaml', '--grid', '2', '1', '--formats', 'svg']
    assert main([*words, '--out', 'board']) == 0
    assert main(['map', 'check', 'board/board.yaml']) == 0
    (tmp_path / 'mine.yaml').unlink()
    board = load_map(tmp_path / 'board' / 'board.yaml')
    assert np.array_equal(load_dictionary(tmp_path / 'board' / 'mine.yaml').bits, load_dictionary(own).bits)
    assert mapped_detector(board, tmp_path / 'board') is not None
    # A map from elsewhere opens nothing but its neighbours.
    with pytest.raises(InputError, match='neither a name nor a file beside the map'):
        mapped_detector(replace(board, dictionary='/etc/passwd'), tmp_path)


def test_unreadable_pictures_and_those_of_another_size_are_named(tmp_path, capsys):
    board = Chessboard(8, 6, 0.05)
    plate = plate_pose(random_view(SMALL, board.points, np.random.default_rng(6)), np.array([0.175, 0.125]))
    counts = render(SMALL, plate, chessboard_levels(8, 6), 0.55, 0.45, 8.0, 1, samples=23)
    cv2.imwrite(str(tmp_path / 'a.png'), counts)
    cv2.imwrite(str(tmp_path / 'b.png'), counts[:200])
    (tmp_path / 'd.png').write_bytes(b'no picture')
    cv2.imwrite(str(tmp_path / 'e.png'), counts)
    cv2.imwrite(str(tmp_path / 'f.tif'), np.zeros((256, 320)))
    assert main(['calibrate', 'intrinsics', str(tmp_path), '--out', str(tmp_path / 'c.yaml')]) == 2
    out, err = capsys.readouterr()
    assert 'b.png: not used: 320x200 pixels, the views before it have 320x256' in out
    assert 'd.png: not used: not a readable picture' in out
    # The page of the refused run has the reason of each, and those that can be shown; no report is replaced by it.
    page = (tmp_path / 'c_refused.html').read_text()
    assert f'see {tmp_path / "c_refused.html"}' in err
    assert not (tmp_path / 'c.html').exists()
    for words in ('2 of 5 frames are usable', '<td>d.png</td><td>not a readable picture', 'b.png: 320x200 pixels'):
        assert words in page
    assert page.count('<figure>') == page.count('data:image/jpeg') == 3
    # The rest is looked at, and the line that ends it says what was wrong with which.
    assert 'e.png: 48 points' in out
    assert '2 of 5 frames are usable views' in err
    assert 'b.png: 320x200 pixels' in err
    assert 'd.png: not a readable picture' in err
    assert 'f.tif: a picture of float64, not of 8 or 16 bit' in err


def test_reasons_that_differ_in_a_figure_are_one_in_the_error():
    """Fourteen views of a board with another diameter gave a line of fourteen reasons, in all ways to round 2.02."""
    views = BoardViews()
    for k in range(14):
        views.leave(f'v{k}.png', f'the circles are {2.01 + 0.01 * (k % 3):.2f} times as wide', np.zeros((32, 32)))
    for name, reason in (('dark', 'too faint'), ('broken', 'not a readable picture'), ('grey', 'too faint')):
        views.leave(f'{name}.png', reason)
    # Of those alike the report shows three.
    assert [frame.counts is not None for frame in views.unusable] == 3 * [True] + 14 * [False]
    with pytest.raises(InputError) as refused:
        views.require(Path('views'))
    assert str(refused.value) == (
        'views: 0 of 17 frames are usable views, a calibration needs 6; v0.png, v1.png, v2.png and 11 more: the '
        'circles are 2.01 times as wide; dark.png, grey.png: too faint; broken.png: not a readable picture'
    )


@pytest.fixture
def undrawn(monkeypatch):
    """For tests of what is printed: half of their time goes into drawings, which test_calibration_plots.py looks at."""
    monkeypatch.setattr('thermal_fiducial.calibration.report.drawings', lambda *_: '')


@pytest.mark.usefixtures('undrawn')
@pytest.mark.parametrize(('tilt_deg', 'warns'), [(6.0, True), (35.0, False)])
def test_a_focal_length_that_flat_views_leave_open_is_named(tmp_path, capsys, tilt_deg, warns):
    """The mapper takes 0.2 % where nothing else is said; twelve views tilted by up to 6 degrees leave 1.2 %."""
    assert ('focal_length_std: 0.' in _calibrated(tmp_path, capsys, tilt_deg)) == warns


@pytest.mark.usefixtures('undrawn')
@pytest.mark.parametrize(('shrunk', 'warns'), [(1, False), (4, True)])
def test_a_principal_point_that_may_turn_the_camera_is_named(tmp_path, capsys, shrunk, warns):
    """Twelve views leave 0.8 px: 1.1 mrad at 760 px of focal length, 4 at 190 px. The filter takes 2 mrad."""
    err = _calibrated(tmp_path, capsys, 35.0, shrunk)
    assert ('extrinsics_orientation_std: 0.0' in err) == warns


def _calibrated(tmp_path, capsys, tilt_deg, shrunk=1):
    """Warnings of a calibration from twelve views of a board, tilted by up to an angle, by a camera of 640x512."""
    width, height = 640 // shrunk, 512 // shrunk
    points = tmp_path / 'points.csv'
    points.write_text('\n'.join(_measured_views(tilt_deg, shrunk)))
    words = ['calibrate', 'intrinsics', str(points), '--size', str(width), str(height), '--models', 'plumb_bob']
    assert main([*words, '--out', str(tmp_path / 'lens.yaml')]) == 0
    return capsys.readouterr().err


def _measured_views(tilt_deg, shrunk=1):
    """Lines of a CSV file of measured points."""
    rng = np.random.default_rng(1)
    K = np.array([[760.0, 0.0, 319.5], [0.0, 760.0, 255.5], [0.0, 0.0, 1.0]])
    K[:2] /= shrunk
    board = np.array([(0.05 * x, 0.05 * y, 0.0) for y in range(6) for x in range(8)])
    lines = ['view,point,u,v,x,y']
    for view in range(12):
        turn = np.radians(rng.uniform(-tilt_deg, tilt_deg, 3))
        place = np.array([rng.uniform(-0.3, -0.05), rng.uniform(-0.25, 0.0), rng.uniform(0.75, 1.1)])
        pixels = cv2.projectPoints(board, turn, place, K, None)[0][:, 0] + rng.normal(0.0, 0.05, (len(board), 2))
        for point, ((u, v), (x, y, _)) in enumerate(zip(pixels, board, strict=True)):
            if 0.0 < u < 640 // shrunk - 1 and 0.0 < v < 512 // shrunk - 1:
                lines.append(f'{view},{point},{u:.4f},{v:.4f},{x:.4f},{y:.4f}')
    return lines


@pytest.mark.usefixtures('undrawn')
def test_a_calibration_that_is_there_is_kept_unless_forced(tmp_path, capsys):
    """A second run, of worse views say, replaced the calibration that the robot flies on."""
    source, out = tmp_path / 'points.csv', tmp_path / 'lens.yaml'
    source.write_text('\n'.join(_measured_views(35.0)))
    words = ['calibrate', 'intrinsics', str(source), '--size', '640', '512', '--models', 'plumb_bob', '--out', str(out)]
    for name in ('lens.yaml', 'lens_covariance.yaml', 'lens.html'):
        place = tmp_path / name
        place.write_text('kept')
        assert main(words) == 2
        assert f'{place}: the file exists; --force overwrites it' in capsys.readouterr().err
        assert place.read_text() == 'kept'
        place.unlink()
    out.write_text('kept')
    assert main([*words, '--force']) == 0
    assert 'plumb_bob' in out.read_text()


@pytest.mark.parametrize('action', ['camera-imu', 'imu'])
def test_calibrated_parameters_that_are_there_are_kept(tmp_path, capsys, action):
    out = tmp_path / 'found.yaml'
    out.write_text('kept')
    options = ['--map', str(tmp_path / 'map.yaml')] if action == 'camera-imu' else []
    assert main(['calibrate', action, str(tmp_path / 'bag'), *options, '--out', str(out)]) == 2
    assert f'{out}: the file exists; --force overwrites it' in capsys.readouterr().err
    assert out.read_text() == 'kept'


@pytest.mark.usefixtures('undrawn')
@pytest.mark.parametrize('points', [(40,), (0, 1, 2), (0, 1, 2, 3, 4, 5, 6), (0, 1, 2, 8)])
def test_views_of_too_few_measured_points_are_named(tmp_path, capsys, points):
    """One of three was refused as "The number of points in the view #5 is < 4", one of a line without its name."""
    head, *lines = _measured_views(35.0)
    named = {(view, int(point)): line for line in lines for view, point in [line.split(',')[:2]]}
    kept = [line for (view, point), line in named.items() if view != '7' or point in points]
    source = tmp_path / 'points.csv'
    source.write_text('\n'.join([head, *kept]))
    words = ['calibrate', 'intrinsics', str(source), '--size', '640', '512', '--models', 'plumb_bob']
    assert main([*words, '--out', str(tmp_path / 'lens.yaml')]) == 0
    number = '1 point' if len(points) == 1 else f'{len(points)} points'
    assert f'\n7: not used: {number}, where a view needs four' in '\n' + capsys.readouterr().out
