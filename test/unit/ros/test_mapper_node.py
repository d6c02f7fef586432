"""Node ``marker_mapper``: edits taken over in flight, history, what RViz is shown."""

from dataclasses import replace

from geometry_msgs.msg import TransformStamped
import numpy as np
import pytest
from scipy.spatial import cKDTree
from sensor_msgs.msg import PointCloud2
from std_srvs.srv import Trigger
from support import small_bag, walls
from support.messages import info, odometry, START
from visualization_msgs.msg import Marker, MarkerArray

from thermal_fiducial.cli.main import main
from thermal_fiducial.core.detection.detector import rows_from_corners
from thermal_fiducial.core.geometry.reprojection import corners_in_map
from thermal_fiducial.core.geometry.se3 import apply, inverse, so3_exp, transform
from thermal_fiducial.core.mapping.map_data import MapMarker, MapperResult, MarkerMap
from thermal_fiducial.core.mapping.undeclared_readout import ReadoutEstimate
from thermal_fiducial.core.measurements import MARKER_DTYPE
from thermal_fiducial.files.map_history import entries
from thermal_fiducial.files.marker_map import save_map
from thermal_fiducial.files.point_cloud import save_alignment
from thermal_fiducial.files.records import camera
from thermal_fiducial.nodes.marker_mapper import MarkerMapperNode
from thermal_fiducial.ros.base import qos
from thermal_fiducial.ros.base.node import ERROR, WARN
from thermal_fiducial.ros.messages import clouds, convert, display

pytestmark = pytest.mark.ros


def test_edits_of_the_file_are_loaded_and_undone_in_flight(graph, map_file):
    """What ``thermal-fiducial map`` does to the file (here: move) the running node takes over, and the filter hears."""
    graph.listen(TransformStamped, 'map_correction')
    graph.listen(PointCloud2, 'marker_map', qos.LATCHED)
    node = graph.add(MarkerMapperNode, map_file=str(map_file))
    before = node.mapper.map.markers[0].T_map_marker
    position = [str(v) for v in before[:3, 3] + [0.5, 0.0, 0.0]]
    assert main(['map', 'move', str(map_file), '0', '--position', *position]) == 0
    assert graph.call(Trigger, 'marker_mapper/load', Trigger.Request()).success
    graph.spin_until(lambda: graph.heard['map_correction'] and len(graph.heard['marker_map']) == 2)
    _, T_new_old = convert.correction_of(graph.heard['map_correction'][0])
    np.testing.assert_allclose(T_new_old[:3, 3], [0.5, 0.0, 0.0], atol=1e-9)
    assert 'move 0' in graph.call(Trigger, 'marker_mapper/undo', Trigger.Request()).message
    np.testing.assert_allclose(node.mapper.map.markers[0].T_map_marker, before, atol=1e-9)
    assert node.mapper.resets == 2
    response = graph.call(Trigger, 'marker_mapper/undo', Trigger.Request())
    assert (response.success, 'no earlier version' in response.message) == (False, True)
    node.mapper.frozen = True
    assert graph.call(Trigger, 'marker_mapper/load', Trigger.Request()).message == 'the map is frozen'


def test_loading_a_map_is_logged(graph, map_file, capfd):
    graph.add(MarkerMapperNode, map_file=str(map_file))
    assert f'map of 1 marker from {map_file}' in capfd.readouterr().err


def test_a_map_of_another_dictionary_is_used_and_warned_of(graph, map_file, capfd):
    """Most likely the file's label is wrong: a drone that flies is not left without its map for that."""
    map_file.write_text(map_file.read_text().replace('DICT_4X4_50', 'DICT_5X5_50'))
    node = graph.add(MarkerMapperNode, map_file=str(map_file))
    level, reason = node.state()
    assert (len(node.mapper.map.markers), level) == (1, WARN)
    assert 'DICT_5X5_50' in reason
    # The console says it at the start, where one looks who wonders why nothing is seen.
    assert 'has markers of DICT_5X5_50, but dictionary is DICT_4X4_50' in capfd.readouterr().err


@pytest.mark.parametrize(
    ('parameters', 'said'),
    [
        ({}, ''),
        ({'marker_size': 0.15}, 'marker 0 is 0.3 m in the map, 0.15 m by marker_size\n'),
        ({'marker_size_overrides': ['0:0.984']}, '0.3 m in the map, 0.984 m by marker_size_overrides'),
        ({'marker_size': 0.15, 'marker_size_overrides': ['0:0.3']}, ''),
    ],
)
def test_a_map_without_any_side_of_the_parameters_is_doubted(graph, map_file, capfd, parameters, said):
    """In feet, sides included, poses went out that the accelerometer contradicted again and again."""
    graph.add(MarkerMapperNode, map_file=str(map_file), **parameters)
    printed = capfd.readouterr().err
    assert ('no marker has the side of the parameters' in printed, said in printed) == (bool(said), True)


def test_a_flight_that_leaves_markers_out_of_the_map_ends_with_why(graph, map_file, capfd):
    """With another side than theirs in marker_size none entered, and console and diagnostics were "ok"."""
    node = graph.add(MarkerMapperNode, map_file=str(map_file))
    graph.send('thermal/camera_info', info())
    markers = small_bag.map_of([0, 1]).markers
    ids, sizes = np.array(list(markers)), np.full(len(markers), small_bag.SIZE)
    points = corners_in_map(np.stack([marker.T_map_marker for marker in markers.values()]), sizes)
    corners = small_bag.CAMERA.project(apply(inverse(small_bag.true_pose(0.0) @ small_bag.T_BODY_CAMERA), points))
    noise = np.tile(0.05**2 * np.eye(2), (len(ids), 4, 1, 1))
    rows = rows_from_corners(ids, corners, noise, sizes, small_bag.CAMERA)
    graph.send('markers', clouds.cloud(rows, convert.header(START, 'camera')))
    node.finish()
    assert 'not in the map: marker 1 needs views from more directions' in capfd.readouterr().err


@pytest.mark.parametrize('focal', [1.0, 1.05])
def test_a_calibration_that_does_not_fit_the_map_is_doubted(graph, tmp_path, focal):
    """Before markers of different distances; those of one wall fit any focal length."""
    centres = {key: (x + key, y, z) for key, (x, y, z) in small_bag.CENTRES.items()}
    markers = {
        key: MapMarker(key, small_bag.SIZE, True, transform(small_bag.R_MAP_MARKER, centre))
        for key, centre in centres.items()
    }
    save_map(tmp_path / 'map.yaml', MarkerMap(markers))
    node = graph.add(MarkerMapperNode, map_file=str(tmp_path / 'map.yaml'))
    K = small_bag.CAMERA.K * [[focal, 1.0, 1.0], [1.0, focal, 1.0], [1.0, 1.0, 1.0]]
    wrong = replace(small_bag.CAMERA, K=K)
    graph.send('thermal/camera_info', info(wrong))
    ids, sizes = np.array(list(markers)), np.full(len(markers), small_bag.SIZE)
    points = corners_in_map(np.stack([marker.T_map_marker for marker in markers.values()]), sizes)
    noise = np.tile(0.05**2 * np.eye(2), (len(ids), 4, 1, 1))
    for k in range(30):
        T_camera_map = inverse(small_bag.true_pose(k / 30) @ small_bag.T_BODY_CAMERA)
        corners = small_bag.CAMERA.project(apply(T_camera_map, points))
        rows = rows_from_corners(ids, corners, noise, sizes, wrong)
        graph.send('markers', clouds.cloud(rows, convert.header(START + k * 33_333_333, 'camera')))
    level, reason, figures = graph.diagnose(node)
    doubted = focal > 1.0
    assert ('corners are not where map and calibration have them' in reason, level == WARN) == (doubted, doubted)
    assert (float(figures['misfit [sigma]']) > 1.5) == doubted


@pytest.mark.parametrize('at', [0.0, 2.0], ids=['two poses', 'no pose'])
@pytest.mark.parametrize('unit', [1.0, 1.0 / 0.0254])
def test_a_map_in_other_units_is_doubted_though_frames_allow_two_poses_or_none(graph, tmp_path, capfd, unit, at):
    """Only located frames counted: of a map in inches the console was silent, and poses were 140 m off."""
    rng = np.random.default_rng(2)
    poses = walls.wall(rng)
    written = {key: transform(T[:3, :3], unit * T[:3, 3]) for key, T in poses.items()}
    markers = {key: MapMarker(key, walls.SIZE, True, T) for key, T in written.items()}
    save_map(tmp_path / 'map.yaml', MarkerMap(markers))
    node = graph.add(MarkerMapperNode, map_file=str(tmp_path / 'map.yaml'), mode='localization')
    graph.send('thermal/camera_info', info(walls.CAMERA))
    for k in range(30):
        rows = walls.see(walls.flight(at), poses, 0.05, rng)
        graph.send('markers', clouds.cloud(rows, convert.header(START + k * 33_333_333, 'camera')))
    # As of a map in centimetres.
    node.mapper.readout.adopt(ReadoutEstimate(-0.1, 0.001))
    level, reason, _ = graph.diagnose(node)
    said = 'corners are not where map and calibration have them'
    printed = capfd.readouterr().err
    assert (said in reason, said in printed, level) == (unit > 1.0, unit > 1.0, WARN)
    assert ('rows are read over' in reason) == (unit == 1.0)
    # Whether no pose is found or one of two, the markers are not where the map has them.
    assert ('distances in the map are 39.4 times those seen' in printed) == (unit > 1.0)


def test_a_rolling_shutter_that_is_not_as_declared_is_named(graph, map_file):
    node = graph.add(MarkerMapperNode, map_file=str(map_file))
    assert node.headline() == ''
    node.mapper.readout.adopt(ReadoutEstimate(0.0147, 0.0015))
    said = 'rows are read over 14.7 +- 1.5 ms more than readout_time says: add 0.0147'
    level, reason = node.state()
    assert (level, node.headline(), said in reason) == (WARN, said, True)


def test_a_rolling_shutter_of_the_second_camera_is_named_as_its_own(graph, tmp_path):
    rng, here = np.random.default_rng(5), {'position': [0.0, 0.0, 0.0], 'orientation': [0.0, 0.0, 0.0, 1.0]}
    poses = walls.wall(rng)
    save_map(tmp_path / 'map.yaml', MarkerMap({key: MapMarker(key, walls.SIZE, True, T) for key, T in poses.items()}))
    mounts = {f'{camera}_{what}': value for camera in ('camera', 'second_camera') for what, value in here.items()}
    node = graph.add(MarkerMapperNode, map_file=str(tmp_path / 'map.yaml'), second_camera='down', **mounts)
    graph.send('down/thermal/camera_info', info(walls.CAMERA))
    for k in range(0, 30, 2):
        graph.send('odometry', odometry(walls.odometry(walls.brisk, k, rng)))
        seen = walls.read_row_by_row(walls.brisk, k / 30, poses, 0.016, rng)
        graph.send('down/markers', clouds.cloud(seen, convert.header(walls.stamp(k), 'camera')))
    level, reason = node.state()
    assert 'down: rows are read over 1' in reason
    assert level == WARN
    # The first camera has seen nothing.
    assert node.mapper.readout.doubt == ''


def test_saving_keeps_the_previous_file_in_the_history(graph, map_file):
    graph.add(MarkerMapperNode, map_file=str(map_file))
    before = map_file.read_text()
    # As long as nothing has changed there is nothing to keep.
    assert graph.call(Trigger, 'marker_mapper/save', Trigger.Request()).success
    assert entries(map_file) == []
    assert graph.call(Trigger, 'marker_mapper/reset', Trigger.Request()).success
    assert graph.call(Trigger, 'marker_mapper/save', Trigger.Request()).success
    (earlier,) = entries(map_file)
    assert earlier.path.read_text().endswith(before)


def test_the_point_cloud_of_the_place_is_shown_in_the_map(graph, tmp_path, map_file):
    pytest.importorskip('plyfile')
    points = np.random.default_rng(0).uniform(-3.0, 3.0, (100_000, 3))
    header = 'ply\nformat binary_little_endian 1.0\nelement vertex 100000\n'
    header += ''.join(f'property float {axis}\n' for axis in 'xyz') + 'end_header\n'
    (tmp_path / 'hall.ply').write_bytes(header.encode() + points.astype('<f4').tobytes())
    T_cloud_map = transform(so3_exp([0.0, 0.0, 0.5]), [1.0, 2.0, 3.0])
    save_alignment(tmp_path / 'T.yaml', T_cloud_map, 'hall.ply', 'map')
    files = {'cloud_file': str(tmp_path / 'hall.ply'), 'cloud_alignment_file': str(tmp_path / 'T.yaml')}
    graph.listen(PointCloud2, 'marker_map/cloud', qos.LATCHED)
    graph.add(MarkerMapperNode, map_file=str(map_file), **files)
    graph.spin_until(lambda: graph.heard['marker_map/cloud'])
    (message,) = graph.heard['marker_map/cloud']
    rows = clouds.cloud_rows(message, np.dtype([(axis, '<f4') for axis in 'xyz']))
    assert message.header.frame_id == 'map'
    assert 20_000 < len(rows) <= 60_000
    shown = np.stack([rows[axis] for axis in 'xyz'], axis=-1).astype(float)
    # Every point shown is one of the cloud's, put where the map has it: the cube, turned and moved.
    back = apply(T_cloud_map, shown)
    assert np.abs(back).max() < 3.0 + 1e-5
    assert cKDTree(points).query(back)[0].max() < 1e-5


def test_a_cloud_that_cannot_be_read_is_a_fault(graph, tmp_path, map_file):
    node = graph.add(MarkerMapperNode, map_file=str(map_file), cloud_file=str(tmp_path / 'none.ply'))
    level, reason, _ = graph.diagnose(node)
    assert level == ERROR
    assert 'none.ply' in reason


@pytest.mark.parametrize('in_view', [False, True])
def test_a_marker_in_quarantine_is_red_whether_it_is_in_view_or_not(in_view):
    """One in view looked like all others in view, which were red."""
    markers = {i: MapMarker(i, 0.3, True, transform(np.eye(3), [i, 0.0, 0.0]), trusted=i != 1) for i in range(2)}
    rows = MarkerMap(markers).rows(frozenset(markers) if in_view else frozenset())
    drawn = display.map_markers(rows, convert.header(0, 'map'))
    good, bad = (marker.color for marker in drawn.markers if marker.ns == 'plates')
    assert bad.r > 2.0 * bad.g
    assert (good.g > 2.0 * good.r) == in_view
    assert good.r <= good.g


def test_each_drawing_of_the_map_is_complete(graph, tmp_path, monkeypatch):
    """Of a recorded flight, Foxglove showed those markers alone that had changed colour last before where it began."""
    path = tmp_path / 'map.yaml'
    save_map(path, MarkerMap({i: MapMarker(i, 0.3, True, transform(np.eye(3), [i, 0.0, 0.0])) for i in range(3)}))
    node = graph.add(MarkerMapperNode, map_file=str(path))
    graph.listen(MarkerArray, 'marker_map/markers', qos.LATCHED)
    heard = graph.heard['marker_map/markers']
    (drawing,) = (output for output in node.outputs if output.topic == '/marker_map/markers')
    graph.spin_until(lambda: heard and drawing.listeners == 1)
    graph.diagnose(node)
    graph.spin_until(lambda: len(heard) == 2)
    plates = [[m.id for m in message.markers if m.ns == 'plates'] for message in heard]
    assert plates[-1] == [0, 1, 2]
    assert heard[-1].markers[0].action == Marker.DELETEALL
    monkeypatch.setattr(node.mapper, 'learn', lambda _: MapperResult(1, None, '', in_view=frozenset({1})))
    graph.send('thermal/camera_info', info())
    graph.send('markers', clouds.cloud(np.zeros(0, MARKER_DTYPE), convert.header(1, 'camera')))
    graph.diagnose(node)
    graph.spin_until(lambda: len(heard) == 3)
    green = {m.id: m.color.g > m.color.r for m in heard[2].markers if m.ns == 'plates'}
    assert green == {0: False, 1: True, 2: False}
    assert [m.text for m in heard[2].markers if m.ns == 'ids'] == ['0', '1', '2']
    assert heard[2].markers[0].action == Marker.DELETEALL
    assert {m.header.stamp.nanosec for m in heard[2].markers} == {1}
    # Nothing has changed: nothing is drawn. Another map: all of it is.
    graph.diagnose(node)
    assert graph.call(Trigger, 'marker_mapper/reset', Trigger.Request()).success
    graph.diagnose(node)
    graph.spin_until(lambda: len(heard) == 4)
    assert len(heard[3].markers) == 7


def test_a_subscriber_in_place_of_another_is_drawn_all_markers(graph, tmp_path):
    """A display that is added to RViz by hand is volatile: what is latched does not reach it."""
    path = tmp_path / 'map.yaml'
    save_map(path, MarkerMap({i: MapMarker(i, 0.3, True, transform(np.eye(3), [i, 0.0, 0.0])) for i in range(3)}))
    node = graph.add(MarkerMapperNode, map_file=str(path))
    topic, drawing = 'marker_map/markers', graph.output(node, 'marker_map/markers')
    first = graph.tester.create_subscription(MarkerArray, topic, lambda _: None, qos.RESULT)
    graph.spin_until(lambda: drawing.listeners == 1)
    graph.diagnose(node)
    graph.tester.destroy_subscription(first)
    graph.spin_until(lambda: drawing.listeners == 0)
    graph.listen(MarkerArray, topic, qos.RESULT)
    heard = graph.heard[topic]
    graph.spin_until(lambda: drawing.listeners == 1)
    graph.diagnose(node)
    graph.spin_until(lambda: heard)
    assert [m.id for m in heard[0].markers if m.ns == 'plates'] == [0, 1, 2]


def test_a_calibration_that_a_second_camera_repeats_is_validated_once(graph, map_file, monkeypatch, capfd):
    """0.26 ms with each frame, while the pose of the first camera waited."""
    validated = []
    monkeypatch.setattr(convert, 'camera', lambda message: validated.append(message) or camera(message))
    node = graph.add(MarkerMapperNode, map_file=str(map_file), second_camera='down')
    graph.send('down/markers', clouds.cloud(np.zeros(0, MARKER_DTYPE), convert.header(1, 'camera')))
    assert graph.diagnose(node)[2]['last refusal'] == 'no camera_info of down'
    for stamp in range(2, 6):
        repeated = info()
        repeated.header.stamp.nanosec = stamp
        graph.send('down/thermal/camera_info', repeated)
        graph.send('down/markers', clouds.cloud(np.zeros(0, MARKER_DTYPE), convert.header(stamp, 'camera')))
    assert len(validated) == 1
    changed = info()
    changed.k[0] *= 1.1
    graph.send('down/thermal/camera_info', changed)
    graph.diagnose(node)
    assert 'camera_info of down has changed' in capfd.readouterr().err
