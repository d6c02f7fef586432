"""The four nodes one by one: what they publish, say and survive."""

from copy import deepcopy
from dataclasses import replace
import sys
import time

import cv2
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import Odometry, Path
import numpy as np
import pytest
from rcl_interfaces.srv import DescribeParameters, SetParameters
from rclpy.context import Context
from rclpy.parameter import Parameter
from rclpy.serialization import serialize_message
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, Imu, PointCloud2
from std_srvs.srv import SetBool, Trigger
from support import small_bag
from support.messages import frames, imu, info, pose
from support.ros_graph import ros_graph

from thermal_fiducial.core.filter.state import POSITION
from thermal_fiducial.core.geometry.se3 import so3_exp, transform
from thermal_fiducial.core.mapping.mapper import MarkerMapper
from thermal_fiducial.core.measurements import MAP_DTYPE, MARKER_DTYPE
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.camera_info import save_camera
from thermal_fiducial.files.images import image_to_array
from thermal_fiducial.files.innovations import innovations_of
from thermal_fiducial.files.marker_map import load_map, save_map
from thermal_fiducial.nodes.aruco_detector import ArucoDetector
from thermal_fiducial.nodes.marker_mapper import MarkerMapperNode
from thermal_fiducial.nodes.pose_ekf import PoseEkfNode
from thermal_fiducial.nodes.tau2_camera import Tau2Camera
from thermal_fiducial.ros.base import qos
from thermal_fiducial.ros.base.counting import CountingNode
from thermal_fiducial.ros.base.node import ERROR, OK, WARN
from thermal_fiducial.ros.mapper_node.map_refinement import MapRefinement
from thermal_fiducial.ros.messages import clouds, convert, message_bytes

pytestmark = pytest.mark.ros
START = small_bag.START_NS


# --- tau2_camera --------------------------------------------------------------------------------------


def test_clean_frames_go_out_with_their_stamp_and_frozen_ones_do_not(graph):
    node = graph.add(Tau2Camera)
    graph.listen(Image, 'thermal/image')
    first, second = frames(2)
    frozen = convert.image(image_to_array(first), convert.header(START + 2, 'camera'))
    graph.send('thermal/image_raw', first, frozen)
    level, reason, figures = graph.diagnose(node)
    assert (level, reason, figures['withheld: frozen']) == (WARN, 'frozen', '1')
    graph.send('thermal/image_raw', second)
    graph.spin_until(lambda: len(graph.heard['thermal/image']) == 2)
    assert [message.header.stamp for message in graph.heard['thermal/image']] == [
        first.header.stamp,
        second.header.stamp,
    ]
    assert graph.heard['thermal/image'][0].header.frame_id == 'thermal_camera_optical'
    assert graph.diagnose(node)[:2] == (OK, 'ok')


def test_a_driver_that_repeats_the_frames_of_a_slow_camera_is_no_fault(graph):
    """Each frame is sent three or four times, as of 8.6 Hz at 30 Hz; the last one that came is a repeated one."""
    node, ticks = graph.add(Tau2Camera), [int(k * 60 / 7 / 30) for k in range(45)]
    pictures = [image_to_array(message) for message in frames(ticks[-1] + 1)]
    stream = [convert.image(pictures[n], convert.header(START + k * 33_333_333, 'camera')) for k, n in enumerate(ticks)]
    graph.send('thermal/image_raw', *stream)
    level, reason, figures = graph.diagnose(node)
    assert (level, reason, figures['withheld: frozen']) == (OK, 'ok', str(len(ticks) - len(pictures)))


def test_compressed_frames_are_those_that_were_compressed(graph):
    node = graph.add(Tau2Camera, image_transport='compressed')
    graph.listen(Image, 'thermal/image')
    (raw,) = frames(1)
    data = cv2.imencode('.png', image_to_array(raw))[1].tobytes()
    graph.send(
        'thermal/image_raw/compressed',
        CompressedImage(header=raw.header, format='mono16; png compressed ', data=data),
        CompressedImage(header=raw.header, format='mono16; jpeg compressed ', data=b'\xff\xd8\xff\xe0'),
    )
    graph.spin_until(lambda: graph.heard['thermal/image'])
    np.testing.assert_array_equal(image_to_array(graph.heard['thermal/image'][0]), image_to_array(raw))
    level, reason, figures = graph.diagnose(node)
    assert (level, figures['refused messages']) == (WARN, '1')
    assert 'only PNG' in reason


def test_frames_of_8_bits_are_used_with_a_note_on_accuracy(graph):
    node = graph.add(Tau2Camera)
    graph.listen(Image, 'thermal/image')
    (raw,) = frames(1)
    shown = convert.image((image_to_array(raw) // 64).astype(np.uint8), raw.header)
    graph.send('thermal/image_raw', shown)
    graph.spin_until(lambda: graph.heard['thermal/image'])
    assert graph.heard['thermal/image'][0].encoding == 'mono16'
    level, reason, _ = graph.diagnose(node)
    assert level == OK
    assert '8-bit images' in reason


def test_a_late_frame_goes_out_and_is_counted(graph):
    node = graph.add(Tau2Camera)
    graph.listen(Image, 'thermal/image')
    first, second, third = frames(3)
    graph.send('thermal/image_raw', first, third, second)
    graph.spin_until(lambda: len(graph.heard['thermal/image']) == 3)
    sent = [message.header.stamp for message in graph.heard['thermal/image']]
    assert sent == [message.header.stamp for message in (first, third, second)]
    level, reason, figures = graph.diagnose(node)
    assert (level, reason, figures['late']) == (OK, 'ok', '1')


def test_the_8_bit_view_is_made_only_for_somebody(graph):
    node = graph.add(Tau2Camera)
    first, second = frames(2)
    graph.send('thermal/image_raw', first)
    assert graph.diagnose(node)[2]['published /thermal/image_mono8'] == '0'
    graph.listen(Image, 'thermal/image_mono8')
    graph.spin_until(lambda: graph.output(node, 'thermal/image_mono8').listeners == 1)
    graph.send('thermal/image_raw', second)
    graph.spin_until(lambda: graph.heard['thermal/image_mono8'])
    assert graph.heard['thermal/image_mono8'][0].encoding == 'mono8'


def test_a_truncated_image_is_refused_and_the_next_one_taken(graph):
    node = graph.add(Tau2Camera)
    good, broken = frames(2)
    broken.data = broken.data[:1000]
    graph.send('thermal/image_raw', broken)
    level, reason, figures = graph.diagnose(node)
    assert level == WARN
    assert '640x512' in reason
    assert '1000' in reason
    assert figures['refused messages'] == '1'
    graph.send('thermal/image_raw', good)
    level, _, figures = graph.diagnose(node)
    assert (level, figures['published /thermal/image']) == (OK, '1')


def test_a_reason_that_stays_the_same_is_logged_once_in_half_a_minute(graph, capfd):
    """A driver of the wrong encoding wrote a line a second, for as long as it ran."""
    node = graph.add(Tau2Camera)
    (color,) = frames(1)
    color.encoding = 'bgr8'
    (short,) = frames(1)
    short.data = short.data[:1000]
    for message in [color] * 32 + [short]:
        graph.send('thermal/image_raw', message)
        graph.diagnose(node)
    lines = [line for line in capfd.readouterr().err.splitlines() if '[tau2_camera]' in line]
    assert ['bgr8' in line for line in lines] == [True, True, False]


def test_an_unexpected_exception_is_reported_and_the_next_image_used(graph, monkeypatch):
    node = graph.add(Tau2Camera)
    first, second = frames(2)
    with monkeypatch.context() as fault:
        fault.setattr(node.cleaner, 'process', lambda *_: np.linalg.inv(np.zeros((2, 2))))
        graph.send('thermal/image_raw', first)
        assert 'internal error: LinAlgError' in graph.diagnose(node)[2]['last refusal']
    graph.send('thermal/image_raw', second)
    assert graph.diagnose(node)[2]['published /thermal/image'] == '1'


def test_a_calibration_file_is_published_with_each_image(graph, tmp_path):
    save_camera(tmp_path / 'tau2.yaml', small_bag.CAMERA)
    graph.add(Tau2Camera, calibration_file=str(tmp_path / 'tau2.yaml'))
    graph.listen(CameraInfo, 'thermal/camera_info')
    graph.send('thermal/image_raw', *frames(1))
    graph.spin_until(lambda: graph.heard['thermal/camera_info'])
    message = graph.heard['thermal/camera_info'][0]
    assert convert.camera(message).matches(small_bag.CAMERA)
    assert convert.stamp_ns(message.header.stamp) == START


@pytest.mark.parametrize('parameter', ['calibration_file', 'bad_pixel_file'])
def test_a_file_that_is_not_there_is_a_fault_and_the_node_lives(graph, parameter):
    node = graph.add(Tau2Camera, **{parameter: '/nowhere/file'})
    graph.send('thermal/image_raw', *frames(1))
    level, reason, figures = graph.diagnose(node)
    assert level == ERROR
    assert '/nowhere/file' in reason
    assert figures['published /thermal/image'] == '1'


# --- aruco_detector -----------------------------------------------------------------------------------


def test_markers_come_as_rows_of_the_contract(graph):
    graph.add(ArucoDetector, marker_size=small_bag.SIZE)
    graph.listen(PointCloud2, 'markers')
    graph.send('thermal/camera_info', info())
    empty = convert.image(np.full((512, 640), 7000, np.uint16), convert.header(START + 1, 'camera'))
    graph.send('thermal/image', *frames(1), empty)
    graph.spin_until(lambda: len(graph.heard['markers']) == 2)
    full, none = graph.heard['markers']
    assert [field.name for field in full.fields[:4]] == ['x', 'y', 'z', 'id']
    assert full.point_step == MARKER_DTYPE.itemsize
    rows = clouds.markers(full)
    assert rows['id'].tolist() == [0, 1, 2, 3]
    # Flat pictures at 2.4 m: a few centimetres.
    np.testing.assert_allclose(rows['z'], 2.4, atol=0.1)
    assert (none.width, len(none.data)) == (0, 0)


def test_an_input_of_another_type_is_named(graph, capfd):
    """Of compressed images on the topic of images DDS says nothing: it was waited for them."""
    node = graph.add(Tau2Camera, live=True)
    said = 'thermal/image_raw is of sensor_msgs/msg/CompressedImage, and not sensor_msgs/msg/Image'
    # A participant has one type on a topic.
    context = Context()
    context.init()
    driver = CountingNode('driver', context=context)
    try:
        output = driver.advertise(CompressedImage, 'thermal/image_raw')
        graph.spin_until(lambda: node.get_publishers_info_by_topic(output.topic))
        assert graph.diagnose(node)[:2] == (WARN, said)
        assert said in capfd.readouterr().err
    finally:
        driver.destroy_node()
        context.try_shutdown()
    graph.send('thermal/image_raw', *frames(1))
    assert graph.diagnose(node)[1] != said


def test_a_missing_camera_info_is_reported_until_it_comes(graph):
    node = graph.add(ArucoDetector)
    first, second = frames(2)
    graph.send('thermal/image', first)
    assert graph.diagnose(node)[:2] == (WARN, 'no camera_info')
    graph.send('thermal/camera_info', info())
    graph.send('thermal/image', second)
    level, _, figures = graph.diagnose(node)
    assert (level, figures['published /markers']) == (OK, '1')


@pytest.mark.parametrize('kind', [ArucoDetector, MarkerMapperNode])
def test_a_calibration_that_was_sent_once_before_the_node_began_is_taken(graph, kind):
    """Of a latched publisher: a detector that was started again in flight never had one any more."""
    graph.tester.advertise(CameraInfo, 'thermal/camera_info', qos.LATCHED).send(info())
    node = graph.add(kind, live=True)
    graph.spin_until(lambda: node.take_waiting() or node.figures()['calibrations'] == 1)
    # The subscription that it takes for this says nothing of a driver that repeats its own.
    assert [source.regular for source in node.inputs if source.topic == '/thermal/camera_info'] == [True, False]


def test_a_map_that_rests_and_a_view_without_markers_are_no_doubts_of_the_detector(graph):
    """A map that has changed in each of five seconds, and the clock offset, which comes with poses, stop."""
    node = graph.add(ArucoDetector)
    for second in range(8):
        for source in node.inputs:
            source.count += second < 5 or source.topic not in ('/marker_map', '/camera_clock')
        node.diagnose(START + second * 1_000_000_000)
    assert graph.diagnose(node)[2]['stale inputs'] == ''


def test_an_uncalibrated_camera_info_does_not_replace_a_good_one(graph):
    node = graph.add(ArucoDetector)
    graph.send('thermal/camera_info', info(), CameraInfo(width=640, height=512))
    assert 'not calibrated' in graph.diagnose(node)[2]['last refusal']
    graph.send('thermal/image', *frames(1))
    assert graph.diagnose(node)[2]['published /markers'] == '1'


def test_an_image_of_another_size_than_the_calibration_is_refused(graph):
    node = graph.add(ArucoDetector)
    graph.send('thermal/camera_info', info())
    graph.send('thermal/image', convert.image(np.zeros((256, 320), np.uint16), convert.header(START, 'camera')))
    assert graph.diagnose(node)[:2] == (WARN, 'image of 320x256, camera_info of 640x512 pixels')


def test_a_calibration_of_another_resolution_is_doubted(graph):
    node = graph.add(ArucoDetector, marker_size=small_bag.SIZE)
    K = small_bag.CAMERA.K * [[0.5], [0.5], [1.0]]
    graph.send('thermal/camera_info', info(replace(small_bag.CAMERA, K=K)))
    graph.send('thermal/image', frames(1)[0])
    level, words, _ = graph.diagnose(node)
    assert level == WARN
    assert 'principal point (160, 128) in images of 640x512 pixels: is the calibration of another resolution?' in words


def test_a_doubt_of_a_calibration_ends_with_it(graph):
    node = graph.add(ArucoDetector, marker_size=small_bag.SIZE)
    doubtful = replace(small_bag.CAMERA, K=small_bag.CAMERA.K * [[0.5], [0.5], [1.0]])
    graph.send('thermal/camera_info', info(doubtful))
    assert 'another resolution' in ' '.join(node.remarks)
    graph.send('thermal/camera_info', info())
    graph.send('thermal/image', frames(1)[0])
    level, words, figures = graph.diagnose(node)
    assert (level, words, figures['calibrations']) == (OK, '4 markers', '2')


@pytest.mark.parametrize('kind', [ArucoDetector, MarkerMapperNode])
def test_two_calibrations_in_turns_give_no_pose(graph, capfd, kind):
    """Of a driver beside calibration_file: each frame had one of them, and poses were 0.1 to 0.4 m off."""
    node = graph.add(kind, marker_size=small_bag.SIZE)
    other = info(replace(small_bag.CAMERA, K=small_bag.CAMERA.K * [[1.1], [1.1], [1.0]]))
    # A calibration that changes once, in one that never was the first again, is used.
    graph.send('thermal/camera_info', other, other, info())
    node.take_waiting()
    assert node.camera().matches(small_bag.CAMERA)
    for _ in range(5):
        graph.send('thermal/camera_info', other, info())
        graph.diagnose(node)
    with pytest.raises(
        InputError, match='two calibrations in turns, of two drivers, or of one beside calibration_file'
    ):
        node.camera()
    # The first change is logged, those that have no effect are not.
    assert capfd.readouterr().err.count('camera_info has changed') == 1
    # It is over when one of them has been alone for ten seconds.
    graph.send('thermal/camera_info', *[info()] * 300)
    node.take_waiting()
    assert node.camera().matches(small_bag.CAMERA)


def test_parameters_that_do_nothing_are_warned_of_while_the_detector_works(graph):
    node = graph.add(ArucoDetector, whitelist=[3, 77])
    dynamic = [Parameter('guided', value=False), Parameter('guided_min_margin', value=0.1)]
    assert all(result.successful for result in node.set_parameters(dynamic))
    graph.send('thermal/camera_info', info())
    graph.send('thermal/image', frames(1)[0])
    assert graph.diagnose(node)[:2] == (
        WARN,
        '1 marker; parameter guided_min_margin: no effect without guided; '
        'parameter whitelist: DICT_4X4_50 has no marker 77',
    )


def test_a_detector_that_cannot_keep_up_takes_the_newest_image_and_counts_the_others(graph):
    node = graph.add(ArucoDetector, marker_size=small_bag.SIZE)
    graph.listen(PointCloud2, 'markers')
    graph.send('thermal/camera_info', info())
    output = graph.tester.advertise(Image, 'thermal/image')
    graph.spin_until(lambda: output.listeners == 1 and graph.input(node, 'thermal/image').publishers == 1)
    images = frames(22)
    for so_far, burst in ((2, images[:2]), (22, images[2:])):
        for image in burst:
            output.send(image)  # it has arrived, and none is looked at
        graph.spin_until(lambda so_far=so_far: graph.input(node, 'thermal/image').count == so_far)
    graph.spin_until(lambda: len(graph.heard['markers']) == 2)
    stamps = [convert.stamp_ns(message.header.stamp) for message in graph.heard['markers']]
    assert stamps == [convert.stamp_ns(images[k].header.stamp) for k in (1, 21)]
    _, reason, figures = graph.diagnose(node)
    # Most of them did not fit into the queue.
    assert figures['left /thermal/image'] == '20'
    assert '20 older images skipped' in reason


def test_images_of_two_publishers_are_not_taken_for_one_stream_with_losses(graph):
    node = graph.add(ArucoDetector)
    graph.send('thermal/camera_info', info())
    outputs = [graph.tester.advertise(Image, 'thermal/image') for _ in range(2)]
    source = graph.input(node, 'thermal/image')
    graph.spin_until(lambda: all(output.listeners == 1 for output in outputs) and source.publishers == 2)
    for k, image in enumerate(frames(12)):
        # The first one has published three times as much as the other.
        outputs[k % 4 == 3].send(image)
        if k % 2:
            graph.spin_until(lambda k=k: source.count == k + 1)
    assert source.left == 6


def test_an_opencv_that_is_too_old_is_refused_with_the_version_needed(graph, monkeypatch):
    monkeypatch.setattr('cv2.__version__', '4.5.4')
    with pytest.raises(InputError, match=r'OpenCV 4\.5\.4: 4\.6 or newer is needed'):
        graph.add(ArucoDetector)


def test_an_opencv_without_aruco_is_refused_with_the_package_that_has_it(graph, monkeypatch):
    """As pip's opencv-python-headless 4.6; launch would start a node that crashes again and again."""
    monkeypatch.delattr('cv2.aruco')
    with pytest.raises(InputError, match=r'without aruco: take opencv-contrib-python-headless'):
        graph.add(ArucoDetector)


@pytest.mark.parametrize('name', ['DICT_9X9_9', 'a' * 300])
def test_an_unknown_dictionary_is_a_fault_and_the_node_lives(graph, name):
    node = graph.add(ArucoDetector, dictionary=name)
    graph.send('thermal/camera_info', info())
    graph.send('thermal/image', *frames(1))
    level, reason, figures = graph.diagnose(node)
    assert level == ERROR
    assert name[:200] in reason
    assert figures['published /markers'] == '0'


def test_the_annotated_image_is_made_for_a_listener(graph):
    node = graph.add(ArucoDetector, marker_size=small_bag.SIZE)
    graph.listen(Image, 'thermal/image_markers')
    graph.spin_until(lambda: graph.output(node, 'thermal/image_markers').listeners == 1)
    graph.send('thermal/camera_info', info())
    graph.send('thermal/image', *frames(1))
    graph.spin_until(lambda: graph.heard['thermal/image_markers'])
    message = graph.heard['thermal/image_markers'][0]
    picture = np.frombuffer(message.data, np.uint8).reshape(512, 640, 3)
    assert message.encoding == 'bgr8'
    # Four outlines in red are some thousand pixels that are not grey.
    assert np.count_nonzero(picture[..., 2] != picture[..., 0]) > 1000


# --- marker_mapper ------------------------------------------------------------------------------------


def markers(k=0):
    """The detector's answer to a frame."""
    with ros_graph('-r', '__ns:=/aside') as graph:
        graph.add(ArucoDetector, marker_size=small_bag.SIZE)
        graph.listen(PointCloud2, 'markers')
        graph.send('thermal/camera_info', info())
        graph.send('thermal/image', frames(k + 1)[k])
        graph.spin_until(lambda: graph.heard['markers'])
        return graph.heard['markers'][0]


@pytest.fixture
def map_file(tmp_path):
    return small_bag.side_files(tmp_path)[0]


def test_the_map_is_latched_and_the_camera_found(graph, map_file):
    node = graph.add(MarkerMapperNode, map_file=str(map_file))
    graph.listen(PointCloud2, 'marker_map', qos.LATCHED)
    graph.spin_until(lambda: graph.heard['marker_map'])
    rows = clouds.cloud_rows(graph.heard['marker_map'][0], MAP_DTYPE)
    assert (rows['id'].tolist(), rows['fixed'].tolist()) == ([0], [1])
    graph.listen(PoseWithCovarianceStamped, 'camera_pose')
    graph.listen(PoseWithCovarianceStamped, 'camera_pose/map_error')
    graph.send('thermal/camera_info', info())
    graph.send('markers', markers())
    graph.spin_until(lambda: graph.heard['camera_pose'] and graph.heard['camera_pose/map_error'])
    found = message_bytes.camera_pose(serialize_message(graph.heard['camera_pose'][0]))
    error = message_bytes.map_error(serialize_message(graph.heard['camera_pose/map_error'][0]))
    np.testing.assert_array_equal(error.T_map_camera, found.T_map_camera)
    # 0.3 % of 2.4 m by the size of the marker, 0.2 % by the focal length: within a fifth, as the view is oblique.
    assert np.sqrt(np.trace(error.covariance[:3, :3])) == pytest.approx(np.hypot(0.003, 0.002) * 2.4, rel=0.2)
    assert np.all(np.linalg.eigvalsh(found.covariance - error.covariance) > 0.0)
    true = small_bag.true_pose(0.0) @ small_bag.T_BODY_CAMERA
    # One flat picture of a marker at 2.4 m: a decimetre.
    assert np.linalg.norm(found.T_map_camera[:3, 3] - true[:3, 3]) < 0.1
    assert np.all(np.linalg.eigvalsh(found.covariance) > 0.0)
    assert graph.diagnose(node)[2]['markers in map'] == '1'


def test_a_mapper_that_cannot_keep_up_takes_the_newest_frame_and_counts_the_others(graph, map_file):
    node = graph.add(MarkerMapperNode, map_file=str(map_file))
    graph.listen(PointCloud2, 'markers', qos.RESULT)
    graph.listen(PoseWithCovarianceStamped, 'camera_pose')
    graph.send('thermal/camera_info', info())
    seen = markers()
    output = graph.tester.advertise(PointCloud2, 'markers')
    graph.spin_until(lambda: output.listeners == 2 and all(source.publishers for source in node.inputs[:1]))
    for k in range(6):
        output.send(restamped(seen, k))  # it has arrived, and none is looked at
    graph.spin_until(lambda: graph.heard['camera_pose'])
    graph.spin_until(lambda: len(graph.heard['markers']) == 6)
    assert convert.stamp_ns(graph.heard['camera_pose'][0].header.stamp) == START + 5 * 33_333_333
    _, reason, figures = graph.diagnose(node)
    assert (len(graph.heard['camera_pose']), figures['left /markers']) == (1, '5')
    assert reason == '5 older frames skipped'


def test_a_refinement_that_fails_keeps_no_change_of_the_map_back(graph, map_file, monkeypatch):
    def failed(*_):
        raise InputError('its process ended')

    learn = MarkerMapper.learn
    monkeypatch.setattr(MapRefinement, 'step', failed)
    monkeypatch.setattr(MarkerMapper, 'learn', lambda self, frame: replace(learn(self, frame), map_changed=True))
    graph.add(MarkerMapperNode, map_file=str(map_file))
    graph.listen(PointCloud2, 'marker_map', qos.LATCHED)
    graph.spin_until(lambda: graph.heard['marker_map'])
    graph.send('thermal/camera_info', info())
    graph.send('markers', markers())
    graph.spin_until(lambda: len(graph.heard['marker_map']) == 2)


def test_services_save_freeze_and_reset(graph, map_file):
    node = graph.add(MarkerMapperNode, map_file=str(map_file))
    before = map_file.read_bytes()
    map_file.unlink()
    saved = graph.call(Trigger, 'marker_mapper/save', Trigger.Request())
    assert saved.success
    assert load_map(map_file).markers.keys() == {0}
    assert map_file.read_bytes() == before
    assert graph.call(SetBool, 'marker_mapper/freeze', SetBool.Request(data=True)).message == 'map frozen'
    assert node.mapper.frozen
    assert graph.call(SetBool, 'marker_mapper/freeze', SetBool.Request(data=False)).success
    assert not node.mapper.frozen
    assert graph.call(Trigger, 'marker_mapper/reset', Trigger.Request()).success


def test_a_broken_map_file_is_a_fault_and_never_overwritten(graph, map_file):
    map_file.write_text('format: thermal_fiducial/marker_map\nmarkers: [{id: 1, posi')
    node = graph.add(MarkerMapperNode, map_file=str(map_file))
    level, reason, _ = graph.diagnose(node)
    assert level == ERROR
    assert str(map_file) in reason
    broken = map_file.read_bytes()
    assert graph.call(Trigger, 'marker_mapper/save', Trigger.Request()).success
    node.close()
    assert map_file.read_bytes() == broken
    assert load_map(map_file.with_name('map.new.yaml')).markers == {}


def test_saving_nowhere_is_refused(graph):
    graph.add(MarkerMapperNode)
    response = graph.call(Trigger, 'marker_mapper/save', Trigger.Request())
    assert not response.success
    assert 'map_file' in response.message


def test_mapping_saves_on_shutdown_and_localization_does_not(graph, map_file):
    for mode, expected in (('localization', False), ('mapping', True)):
        node = graph.add(MarkerMapperNode, map_file=str(map_file), mode=mode)
        content = map_file.read_bytes()
        map_file.unlink()
        node.close()
        assert map_file.exists() == expected
        map_file.write_bytes(content)


def test_a_cloud_that_is_no_markers_is_refused(graph, map_file):
    node = graph.add(MarkerMapperNode, map_file=str(map_file))
    graph.send('thermal/camera_info', info())
    graph.send('markers', PointCloud2(point_step=16, height=1))
    assert 'cloud without field' in graph.diagnose(node)[1]


# --- pose_ekf -----------------------------------------------------------------------------------------


def fly(graph, messages):
    for message in messages:
        graph.send('imu/data' if isinstance(message, Imu) else 'camera_pose', message)


def test_the_error_of_the_map_widens_the_covariance_and_moves_no_pose(graph):
    node = graph.add(PoseEkfNode, camera_position=[0.1, 0.0, 0.0])
    error = pose(0)
    error.pose.covariance = (0.04 * np.eye(6)).ravel()
    for k in range(60):
        if k % 6 == 5:
            seen = pose(k - 4)
            error.header.stamp = seen.header.stamp
            seen.pose.covariance = (np.array(seen.pose.covariance) + error.pose.covariance).ravel()
            graph.send('camera_pose/map_error', error)
            graph.send('camera_pose', seen)
        graph.send('imu/data', imu(k))
    graph.published(node, 'pose')
    state = node.filter.estimate
    assert state is not None
    assert np.sqrt(np.trace(state.covariance[POSITION, POSITION])) < 0.1
    graph.listen(Odometry, 'odometry')
    graph.send('imu/data', imu(60))
    graph.spin_until(lambda: graph.heard['odometry'])
    claimed = np.array(graph.heard['odometry'][0].pose.covariance).reshape(6, 6)
    assert np.all(np.diag(claimed)[:3] >= 0.04)
    # 0.2 m on each axis: by 0.3 m the pose is lost.
    figures = node.filter.diagnostics()
    assert figures['position std'] > 0.2 * np.sqrt(3.0)
    assert figures['usable for'] == 0.0


def test_one_pose_and_one_odometry_for_each_imu_message(graph):
    node = graph.add(PoseEkfNode, camera_position=[0.1, 0.0, 0.0])
    for kind, topic in ((PoseWithCovarianceStamped, 'pose'), (Odometry, 'odometry')):
        graph.listen(kind, topic)
    fly(graph, [message for k in range(60) for message in ([imu(k), pose(k - 4)] if k % 6 == 5 else [imu(k)])])
    started = graph.published(node, 'pose')
    assert 30 < started < 60
    fly(graph, [imu(k) for k in range(60, 80)])
    assert graph.published(node, 'pose') == graph.published(node, 'odometry') == started + 20
    graph.spin_until(lambda: len(graph.heard['pose']) == len(graph.heard['odometry']) == started + 20)
    message = graph.heard['odometry'][-1]
    assert convert.stamp_ns(message.header.stamp) == START + 79 * 5_000_000
    assert (message.header.frame_id, message.child_frame_id) == ('map', 'base_link')
    # At rest at the origin: what is left is noise of the made-up poses' floor.
    np.testing.assert_allclose(convert.transform_of(message.pose.pose), np.eye(4), atol=0.01)
    level, reason, figures = graph.diagnose(node)
    assert (level, reason, figures['lost']) == (OK, 'tracking', 'False')
    # Of ten poses three start the filter; each is published once.
    innovations = innovations_of(figures['innovations'])
    assert list(innovations.stamps_ns) == [START + k * 5_000_000 for k in range(19, 60, 6)]
    assert innovations.accepted.all()
    assert graph.diagnose(node)[2]['innovations'] == ''


def test_nan_in_the_imu_is_refused_and_the_next_sample_taken(graph):
    node = graph.add(PoseEkfNode)
    fly(graph, [imu(0), imu(1, force=(np.nan, 0.0, 9.8))])
    level, _, figures = graph.diagnose(node)
    assert (figures['refused messages'], 'not finite' in figures['last refusal']) == ('1', True)
    assert level != OK
    fly(graph, [imu(2)])
    assert graph.diagnose(node)[2]['refused messages'] == '1'


def test_an_overloaded_filter_reports_the_delay_of_its_poses(graph):
    """Nobody spins it for a third of a second."""
    node = graph.add(PoseEkfNode, live=True)
    driver = graph.tester.advertise(Imu, 'imu/data')
    graph.spin_until(lambda: driver.listeners and graph.input(node, 'imu/data').publishers)
    node.diagnose(0)
    assert 'overloaded' not in node.state()[1]
    for k in range(3):
        driver.send(imu(k))
        time.sleep(0.1)
    node.diagnose(0)
    level, words = node.state()
    assert level == ERROR
    assert float(words.partition('overloaded: IMU messages wait for ')[2].removesuffix(' s')) >= 0.3
    assert 'poses are late' in node.headline()
    graph.spin_until(lambda: graph.input(node, 'imu/data').count == 3)
    node.diagnose(0)
    assert 'overloaded' not in node.state()[1]


def test_a_queue_of_imu_messages_is_taken_in_at_once_with_one_pose_at_the_newest(graph):
    node = graph.add(PoseEkfNode, live=True)
    driver = graph.tester.advertise(Imu, 'imu/data')
    graph.spin_until(lambda: driver.listeners and graph.input(node, 'imu/data').publishers)
    for k in range(40):
        driver.send(imu(k))
    time.sleep(0.1)  # they wait for longer than a node takes them in one by one
    node.diagnose(0)
    graph.spin_until(lambda: graph.input(node, 'imu/data').count == 40)
    # All but the one that was looked at, whose turn shows how late they are.
    assert node.figures()['IMU messages without a pose'] == 39
    driver.send(imu(40))
    graph.spin_until(lambda: graph.input(node, 'imu/data').count == 41)
    assert node.figures()['IMU messages without a pose'] == 39


def test_stamps_that_go_back_are_reported_and_the_next_ones_used(graph):
    node = graph.add(PoseEkfNode, camera_position=[0.1, 0.0, 0.0])
    fly(graph, [imu(10), imu(11), imu(9)])
    level, reason, _ = graph.diagnose(node)
    assert level != OK
    assert reason
    fly(graph, [imu(12)])
    assert graph.diagnose(node)[1] == 'waiting for markers'


def test_an_invalid_camera_pose_is_refused(graph):
    node = graph.add(PoseEkfNode)
    broken = pose(0)
    broken.pose.pose.orientation.w = broken.pose.pose.orientation.x = 0.0
    broken.pose.pose.orientation.y = broken.pose.pose.orientation.z = 0.0
    fly(graph, [imu(0), broken])
    assert 'unit quaternion' in graph.diagnose(node)[1]


def test_a_refused_message_hides_no_error(graph):
    """One in a second among 200 samples made a warning of a filter without a pose to fly on, and of a silent IMU."""
    node = graph.add(PoseEkfNode, camera_position=[0.1, 0.0, 0.0])
    broken = imu(5)
    broken.linear_acceleration.z = float('nan')
    fly(graph, [imu(k) for k in range(5)] + [broken])
    assert graph.diagnose(node)[:2] == (ERROR, 'IMU message that is not finite; waiting for markers')
    lying = pose(0)
    lying.pose.pose.orientation.w = 2.0
    for _ in range(2):
        fly(graph, [lying])
        level, reason, _ = graph.diagnose(node)
    assert (level, reason.partition('; ')[2]) == (ERROR, 'nothing on imu/data')


@pytest.mark.parametrize(
    ('frame', 'map_frame', 'taken'),
    [('map', 'map', True), ('/map', 'map', True), ('', 'hall', True), ('odom', 'map', False), ('map', 'hall', False)],
)
def test_a_camera_pose_in_another_frame_is_refused(graph, frame, map_frame, taken):
    """Of another localizer, say: poses in its frame went out as poses in the map."""
    node = graph.add(PoseEkfNode, camera_position=[0.1, 0.0, 0.0], map_frame=map_frame)
    sent = [message for k in range(60) for message in ([imu(k), pose(k - 4)] if k % 6 == 5 else [imu(k)])]
    for message in sent:
        message.header.frame_id = message.header.frame_id if isinstance(message, Imu) else frame
    fly(graph, sent)
    said = f"camera_pose in frame '{frame}', and not in that of the map: map_frame is '{map_frame}'"
    reason = graph.diagnose(node)[1]
    assert (reason == 'tracking', said in reason) == (taken, not taken)


def test_reset_starts_anew(graph):
    node = graph.add(PoseEkfNode, camera_position=[0.1, 0.0, 0.0])
    fly(graph, [message for k in range(60) for message in ([imu(k), pose(k - 4)] if k % 6 == 5 else [imu(k)])])
    assert graph.diagnose(node)[1] == 'tracking'
    assert graph.diagnose(node)[2]['jumps'] == '1'
    assert graph.call(Trigger, 'pose_ekf/reset', Trigger.Request()).success
    fly(graph, [imu(60)])
    assert graph.diagnose(node)[1] == 'waiting for markers'
    fly(graph, [m for k in range(61, 120) for m in ([imu(k), pose(k - 4)] if k % 6 == 5 else [imu(k)])])
    # Whoever keeps the last pose must know that the next one is not its continuation.
    assert graph.diagnose(node)[2]['jumps'] == '2'


def test_poses_that_have_stopped_are_not_taken_for_another_clock(graph):
    node = graph.add(PoseEkfNode, camera_position=[0.1, 0.0, 0.0])
    fly(graph, [message for k in range(60) for message in ([imu(k), pose(k - 4)] if k % 6 == 5 else [imu(k)])])
    assert graph.call(Trigger, 'pose_ekf/reset', Trigger.Request()).success
    # Three seconds on.
    fly(graph, [imu(k) for k in range(60, 680, 20)])
    assert graph.diagnose(node)[1] == 'waiting for markers'


# --- parameters ---------------------------------------------------------------------------------------


def test_an_input_without_messages_is_reported(graph):
    node = graph.add(PoseEkfNode)
    assert graph.diagnose(node)[:2] == (WARN, 'nothing on imu/data')


def test_an_input_that_stops_is_an_error_after_two_seconds(graph):
    node = graph.add(PoseEkfNode, camera_position=[0.1, 0.0, 0.0])
    fly(graph, [imu(0)])
    levels = [graph.diagnose(node)[:2] for _ in range(3)]
    assert levels[1:] == [(WARN, 'nothing on imu/data'), (ERROR, 'nothing on imu/data')]
    fly(graph, [imu(1)])
    assert graph.diagnose(node)[1] == levels[0][1] == 'waiting for markers'


def test_the_console_has_a_line_for_each_change_that_a_pilot_must_know(graph, capfd):
    node = graph.add(PoseEkfNode, camera_position=[0.1, 0.0, 0.0])
    graph.diagnose(node)
    flight = [message for k in range(60) for message in ([imu(k), pose(k - 4)] if k % 6 == 5 else [imu(k)])]
    for message in flight:
        fly(graph, [message])
        if convert.stamp_ns(message.header.stamp) % 50_000_000 == 0:
            graph.diagnose(node)
    graph.diagnose(node)
    graph.diagnose(node)
    fly(graph, [imu(k) for k in range(60, 240)])
    for _ in range(3):
        graph.diagnose(node)
    said = [line.partition('[pose_ekf]: ')[2] for line in capfd.readouterr().err.splitlines()]
    assert [line for k, line in enumerate(said) if line not in said[:k]] == [
        'waiting for imu/data', 'waiting for markers', 'initialising', 'initialised: tracking', 'coasting',
        'imu/data has stopped',
    ]  # fmt: skip


def test_a_parameter_that_is_changed_in_flight_is_logged(graph, capfd):
    """That the pose is lost beyond another limit from here on left no trace."""
    node = graph.add(PoseEkfNode, lost_position_std=0.3)
    for value in (0.3, 2.0, -1.0):
        node.set_parameters([Parameter('lost_position_std', value=value)])
    lines = [line.partition('[pose_ekf]: ')[2] for line in capfd.readouterr().err.splitlines()]
    assert [line for line in lines if 'parameter' in line] == ['parameter lost_position_std: 2.0, before 0.3']


def test_a_reset_is_logged_with_its_reason_and_then_the_recovery(graph, capfd):
    node = graph.add(PoseEkfNode, camera_position=[0.1, 0.0, 0.0], reset_after=0.1)
    moved = transform(np.eye(3), [0.5, 0.0, 0.0]) @ small_bag.T_BODY_CAMERA
    for begin, T in ((0, None), (60, moved)):
        flight = range(begin, begin + 60)
        fly(graph, [m for k in flight for m in ([imu(k), pose(k - 4, T)] if k % 6 == 5 else [imu(k)])])
        graph.diagnose(node)
    assert graph.call(Trigger, 'pose_ekf/reset', Trigger.Request()).success
    fly(graph, [imu(120)])
    graph.diagnose(node)
    fly(graph, [m for k in range(121, 180) for m in ([imu(k), pose(k - 4)] if k % 6 == 5 else [imu(k)])])
    graph.diagnose(node)
    lines = [line.partition('[pose_ekf]: ')[2] for line in capfd.readouterr().err.splitlines()]
    assert lines == [
        'initialised: tracking',
        'reset: the poses contradict the estimate and agree with each other; if in fast motion: camera_time_offset, '
        'readout_time, bolometer_lag? if again and again: axes, sign, units of the IMU, camera_position, '
        'camera_orientation, marker_size?',
        'reset: on request',
        'waiting for markers',
        'recovered: tracking',
    ]


def test_a_camera_that_repeats_one_frame_is_reported_as_stalled(graph, capfd):
    node = graph.add(Tau2Camera)
    (first,) = frames(1)
    same = [convert.image(image_to_array(first), convert.header(START + k * 33_333_333, 'camera')) for k in range(1, 7)]
    for message in (first, *same):
        graph.send('thermal/image_raw', message)
        graph.diagnose(node)
    graph.send('thermal/image_raw', *frames(10)[-2:])
    graph.diagnose(node)
    lines = [line.partition(': ')[2] for line in capfd.readouterr().err.splitlines() if 'stalled' in line]
    assert lines == ['camera stalled: frozen', 'over: camera stalled: frozen']


def test_a_lost_pose_is_not_published_unless_asked_for(graph):
    quiet = graph.add(PoseEkfNode, camera_position=[0.1, 0.0, 0.0], lost_position_std=0.001)
    fly(graph, [m for k in range(60) for m in ([imu(k), pose(k - 4)] if k % 6 == 5 else [imu(k)])])
    assert quiet.filter.lost
    assert (graph.published(quiet, 'pose'), graph.published(quiet, 'odometry') > 20) == (0, True)
    with ros_graph('-r', '__ns:=/aside') as other:
        node = other.add(PoseEkfNode, camera_position=[0.1, 0.0, 0.0], lost_position_std=0.001, publish_lost=True)
        for message in [m for k in range(60) for m in ([imu(k), pose(k - 4)] if k % 6 == 5 else [imu(k)])]:
            other.send('imu/data' if isinstance(message, Imu) else 'camera_pose', message)
        assert other.published(node, 'aside/pose') == other.published(node, 'aside/odometry') > 20


@pytest.mark.parametrize(
    ('rule', 'reason'),
    [
        ('marker_size:=-1.0', 'marker_size'),
        ('marker_size:=big', 'marker_size'),
        ('camera_position:=[1.0, 2.0]', 'camera_position: 2 values, not 3'),
        ('marker_size_overrides:=["7"]', '"ID:SIZE"'),
        ('min_contarst:=0.5', 'parameter min_contarst: no node has it; did you mean min_contrast?'),
    ],
)
def test_an_unusable_parameter_is_one_line(rule, reason):
    with ros_graph('-p', rule) as graph:
        try:
            said = graph.add(ArucoDetector).faults
        except InputError as error:
            said = [str(error)]
    assert len(said) == 1
    assert reason in said[0]


def test_overrides_of_the_quality_of_service_are_named_as_ignored(capfd):
    with ros_graph('-p', 'qos_overrides./thermal/image_raw.subscription.depth:=1') as graph:
        node = graph.add(Tau2Camera)
        assert graph.input(node, 'thermal/image_raw').subscription.qos_profile.depth == qos.CAMERA_INPUT.depth
    assert 'parameters qos_overrides.*: ignored' in capfd.readouterr().err


def test_rates_are_those_of_a_simulated_clock(graph):
    """As of a bag that is played much faster than it was recorded."""
    node = graph.add(Tau2Camera, live=True, use_sim_time=True)
    for timer in node.timers:
        timer.cancel()
    output = graph.output(node, 'diagnostics')
    graph.spin_until(lambda: output.listeners == 1)
    for k, image in enumerate(frames(12)):
        graph.send('thermal/image_raw', image)
        node.diagnose(START + k * 500_000_000)
    heard = graph.heard['/diagnostics']
    graph.spin_until(lambda: len(heard) == 12)
    assert {item.key: item.value for item in heard[-1].status[0].values}['rate /thermal/image_raw [Hz]'] == '2'


def test_parameters_of_the_other_nodes_are_neither_refused_nor_declared():
    with ros_graph('-p', 'gate:=30.0', '-p', 'min_contrast:=0.5', '-p', 'whitelist:=[]') as graph:
        node = graph.add(ArucoDetector)
        assert node.config.min_contrast == 0.5
        assert node.config.whitelist == ()
        assert not node.has_parameter('gate')


def test_parameters_are_described(graph):
    graph.add(PoseEkfNode)
    request = DescribeParameters.Request(names=['imu.gyroscope_noise_density', 'gravity', 'map_frame'])
    noise, gravity, frame = graph.call(DescribeParameters, 'pose_ekf/describe_parameters', request).descriptors
    assert 'rad/s/sqrt(Hz)' in noise.description
    assert noise.floating_point_range[0].from_value == 0.0
    assert (gravity.floating_point_range[0].from_value, gravity.floating_point_range[0].to_value) == (9.7, 9.9)
    assert frame.read_only


def test_live_parameters_take_effect(graph):
    node = graph.add(Tau2Camera)
    parameter = Parameter('settle_frames', value=7).to_parameter_msg()
    request = SetParameters.Request(parameters=[parameter])
    (result,) = graph.call(SetParameters, 'tau2_camera/set_parameters', request).results
    assert result.successful
    assert node.cleaner.config.settle_frames == node.view.config.settle_frames == 7


def test_live_parameters_of_the_filter_reach_it(graph, monkeypatch):
    node = graph.add(PoseEkfNode)
    taken = []
    monkeypatch.setattr(node.filter, 'configure', taken.append)
    request = SetParameters.Request(parameters=[Parameter('gate', value=50.0).to_parameter_msg()])
    (result,) = graph.call(SetParameters, 'pose_ekf/set_parameters', request).results
    assert result.successful
    assert [config.gate for config in taken] == [50.0]


def test_names_are_relative(graph, monkeypatch):
    monkeypatch.setitem(sys.modules, 'tf2_msgs.msg', None)
    with ros_graph('-r', '__ns:=/drone', '-r', 'pose:=vision/pose') as other:
        node = other.add(PoseEkfNode)
        topics = {output.topic for output in node.outputs} | {source.topic for source in node.inputs}
    assert topics == {
        '/diagnostics', '/drone/vision/pose', '/drone/odometry', '/drone/path', '/drone/imu/data', '/drone/camera_pose',
        '/drone/camera_pose/map_error', '/drone/camera_clock', '/drone/map_correction', '/drone/robot_description',
    }  # fmt: skip


# --- the map moves ------------------------------------------------------------------------------------


def correction(k, T_new_old):
    return convert.transform_message(T_new_old, START + k * 5_000_000, 'map', 'map_before')


def test_the_estimate_moves_with_the_map(graph):
    node = graph.add(PoseEkfNode, camera_position=[0.1, 0.0, 0.0])
    fly(graph, [message for k in range(60) for message in ([imu(k), pose(k - 4)] if k % 6 == 5 else [imu(k)])])
    T_new_old = transform(so3_exp([0.0, 0.0, 0.3]), [1.0, 2.0, 0.0])
    graph.send('map_correction', correction(57, T_new_old))
    # The pose of an earlier frame that comes after the word of the correction is still one of the old map.
    fly(graph, [pose(56), imu(60), pose(59, T_new_old @ small_bag.T_BODY_CAMERA), imu(61)])
    np.testing.assert_allclose(node.filter.state.T_map_body, T_new_old, atol=0.01)
    assert graph.diagnose(node)[:2] == (OK, 'tracking')


def test_a_path_has_no_poses_in_the_map_before(graph):
    graph.listen(Path, 'path')
    node = graph.add(PoseEkfNode, camera_position=[0.1, 0.0, 0.0])
    fly(graph, [message for k in range(60) for message in ([imu(k), pose(k - 4)] if k % 6 == 5 else [imu(k)])])
    graph.send('map_correction', correction(57, transform(np.eye(3), [7.0, 0.0, 0.0])))
    fly(graph, [imu(60)])
    graph.diagnose(node)
    graph.spin_until(lambda: graph.heard['path'])
    (newest,) = graph.heard['path'][-1].poses
    # The robot is at rest in the origin of the map before; the filter knows that to a centimetre by then.
    assert newest.pose.position.x == pytest.approx(7.0, abs=0.01)


def test_a_late_frame_from_before_a_correction_is_published_in_the_map_of_its_stamp(graph, tmp_path):
    """The filter takes every pose that is stamped before the correction for one of the old map, and moves it."""
    whole = small_bag.side_files(tmp_path, ids=(0, 1, 2, 3))[0]
    graph.listen(PoseWithCovarianceStamped, 'camera_pose')
    node = graph.add(MarkerMapperNode, map_file=str(whole))
    with ros_graph('-r', '__ns:=/aside') as other:
        other.add(ArucoDetector, marker_size=small_bag.SIZE)
        other.listen(PointCloud2, 'markers')
        other.send('thermal/camera_info', info())
        other.send('thermal/image', *frames(4))
        other.spin_until(lambda: len(other.heard['markers']) == 4)
    first, late, newest, after = other.heard['markers']
    T_new_old = transform(np.eye(3), [1.0, 2.0, 0.0])
    graph.send('thermal/camera_info', info())
    graph.send('markers', first, newest)
    save_map(whole, _moved(node.mapper.map, T_new_old))
    assert graph.call(Trigger, 'marker_mapper/load', Trigger.Request()).success
    graph.send('markers', late, after)
    graph.spin_until(lambda: len(graph.heard['camera_pose']) == 4)
    found = [convert.transform_of(message.pose.pose) for message in graph.heard['camera_pose']]
    truth = [small_bag.true_pose(k / 30) @ small_bag.T_BODY_CAMERA for k in (0, 2, 1, 3)]
    truth[3] = T_new_old @ truth[3]
    # The flat pictures are good to a centimetre.
    np.testing.assert_allclose(found, truth, atol=0.05)


def _moved(marker_map, T_new_old):
    copy = marker_map.copy()
    for key, marker in copy.markers.items():
        copy.markers[key] = replace(marker, T_map_marker=T_new_old @ marker.T_map_marker)
    return copy


def restamped(message, k):
    """The message as one of frame ``k``."""
    later = deepcopy(message)
    later.header.stamp = convert.header(START + k * 33_333_333, '').stamp
    return later


def test_a_live_mapper_refines_in_the_background(graph, map_file):
    graph.listen(TransformStamped, 'map_correction')
    graph.listen(PoseWithCovarianceStamped, 'camera_pose')
    node = graph.add(MarkerMapperNode, live=True, map_file=str(map_file), refinement_period=0.1)
    try:
        with ros_graph('-r', '__ns:=/aside') as other:
            other.add(ArucoDetector, marker_size=small_bag.SIZE)
            other.listen(PointCloud2, 'markers')
            other.send('thermal/camera_info', info())
            other.send('thermal/image', *frames(40))
            other.spin_until(lambda: len(other.heard['markers']) == 40)
        graph.send('thermal/camera_info', info())
        asked, sent = False, 0
        # The background process takes seconds to start, or less time than thirty frames: until both were seen each
        # frame asks again.
        while not (asked and node.mapper.resets):
            graph.send('markers', restamped(other.heard['markers'][sent % 40], sent))
            sent += 1
            asked = asked or (sent > 30 and graph.call(Trigger, 'marker_mapper/refine', Trigger.Request()).success)
        # A pose for every frame; the last one may still be on its way.
        graph.spin_until(lambda: len(graph.heard['camera_pose']) == sent)
    finally:
        node.close()
    # Poses move with the map by no more than they claimed: whoever stands on them follows by itself.
    assert not graph.heard['map_correction']
