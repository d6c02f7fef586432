"""Node ``thermal_source`` on recorded pictures and without a camera."""

import cv2
import numpy as np
import pytest
from sensor_msgs.msg import CameraInfo, Image
from support.small_bag import CAMERA

from thermal_fiducial.cameras.choice import unused_parameters
from thermal_fiducial.config import ThermalSourceConfig
from thermal_fiducial.files.camera_info import save_camera
from thermal_fiducial.files.images import image_to_array
from thermal_fiducial.nodes.tau2_camera import Tau2Camera
from thermal_fiducial.nodes.thermal_source import ThermalSource
from thermal_fiducial.ros.base.node import ERROR, OK
from thermal_fiducial.ros.messages import convert

pytestmark = pytest.mark.ros
PICTURES = [np.random.default_rng(k).integers(6000, 9000, (48, 64), dtype=np.uint16) for k in range(40)]


@pytest.fixture
def graph(graph):
    yield graph
    for node in graph.nodes:
        if isinstance(node, ThermalSource):
            node.close()


@pytest.fixture
def folder(tmp_path):
    (tmp_path / 'pictures').mkdir()
    for k, counts in enumerate(PICTURES):
        cv2.imwrite(str(tmp_path / 'pictures' / f'{k:03}.png'), counts)
    return str(tmp_path / 'pictures')


def test_counts_and_calibration_go_out_with_one_stamp(graph, folder, tmp_path):
    save_camera(tmp_path / 'camera.yaml', CAMERA)
    graph.listen(Image, 'thermal/image_raw')
    graph.listen(CameraInfo, 'thermal/camera_info')
    node = graph.add(ThermalSource, camera=folder, frame_rate=50.0, calibration_file=str(tmp_path / 'camera.yaml'))
    images, infos = graph.heard['thermal/image_raw'], graph.heard['thermal/camera_info']
    graph.spin_until(lambda: len(images) >= 5 and len(infos) >= 5)
    assert images[0].encoding == 'mono16'
    assert images[0].header.frame_id == 'thermal_camera_optical'
    assert any(np.array_equal(image_to_array(images[0]), counts) for counts in PICTURES)
    stamps = [convert.stamp_ns(message.header.stamp) for message in images]
    assert np.all(np.diff(stamps) > 0)
    assert set(stamps) & {convert.stamp_ns(message.header.stamp) for message in infos}
    assert convert.camera(infos[0]).matches(CAMERA)
    level, reason, figures = graph.diagnose(node)
    assert (level, reason, figures['reconnections']) == (OK, 'ok', '0')


def test_parameters_that_the_driver_lacks_are_named(graph, folder):
    node = graph.add(ThermalSource, camera=folder, image_width=640, image_height=512)
    lines = [f'parameter image_{side}: no effect with camera {folder}' for side in ('width', 'height')]
    assert node.remarks == lines
    device = graph.add(ThermalSource, camera='/dev/video_that_is_not_there', repeat=False, frame_rate=25.0)
    assert device.remarks == ['parameter repeat: no effect with camera /dev/video_that_is_not_there']
    grabber = ThermalSourceConfig(camera='teax:7', repeat=False, frame_rate=25.0, image_width=640)
    assert unused_parameters(grabber) == [
        f'parameter {name}: no effect with camera teax:7' for name in ('frame_rate', 'repeat')
    ]
    assert unused_parameters(ThermalSourceConfig(image_width=640)) == []


def test_tau2_camera_takes_its_frames(graph, folder):
    graph.listen(Image, 'thermal/image')
    graph.add(Tau2Camera)
    graph.add(ThermalSource, camera=folder, frame_rate=50.0)
    graph.spin_until(lambda: len(graph.heard['thermal/image']) >= 3)
    clean = image_to_array(graph.heard['thermal/image'][0])
    # But for the few pixels that are filled in.
    assert any(np.mean(clean == counts) > 0.99 for counts in PICTURES)


def test_without_a_camera_the_node_waits_and_reports_it(graph):
    node = graph.add(ThermalSource, camera='/dev/video_that_is_not_there')
    graph.spin_until(lambda: 'No such file' in node.state()[1])
    level, reason, _ = graph.diagnose(node)
    assert (level, reason) == (ERROR, '/dev/video_that_is_not_there: No such file or directory')


@pytest.mark.parametrize(
    ('camera', 'words'), [('', 'parameter camera'), ('/nowhere/pictures', 'neither the name of a driver')]
)
def test_an_impossible_camera_is_a_fault(graph, camera, words):
    node = graph.add(ThermalSource, camera=camera)
    level, reason, _ = graph.diagnose(node)
    assert level == ERROR
    assert words in reason


def test_an_unexpected_frame_does_not_end_the_node(graph, folder):
    node = graph.add(ThermalSource, camera=folder, frame_rate=100.0)
    graph.spin_until(lambda: node.state()[0] == OK)
    # What the camera's thread calls with a frame, called with none.
    node.on_frame(None)
    graph.listen(Image, 'thermal/image_raw')
    graph.spin_until(lambda: graph.heard['thermal/image_raw'])
    assert 'internal error' in graph.diagnose(node)[2]['last refusal']
