"""The real messages of other packages, where these are installed; stand-ins of them are in the tests of each output."""

from functools import partial
import importlib

import numpy as np
import pytest
from support import small_bag
from support.messages import frames, imu, info, pose

from thermal_fiducial.nodes.aruco_detector import ArucoDetector
from thermal_fiducial.nodes.marker_mapper import MarkerMapperNode
from thermal_fiducial.nodes.pose_ekf import PoseEkfNode
from thermal_fiducial.ros.base import qos
from thermal_fiducial.ros.camera_nodes import detections
from thermal_fiducial.ros.messages import convert

pytestmark = pytest.mark.ros


def installed(package):
    """The messages of a package; the test is skipped without it."""
    pytest.importorskip(f'{package}.msg')
    return importlib.import_module(f'{package}.msg')


def look(graph):
    """A frame with four markers."""
    graph.send('thermal/camera_info', info())
    graph.send('thermal/image', *frames(1))


def fly(graph):
    """Half a second at rest, with a camera pose for each sixth sample."""
    for k in range(90):
        graph.send('imu/data', imu(k))
        if k % 6 == 5:
            graph.send('camera_pose', pose(k - 4))


@pytest.mark.parametrize('kind', detections.KINDS)
def test_detections_go_out_in_the_messages_of_others(graph, kind):
    package, name = detections.KINDS[kind]
    graph.listen(getattr(installed(package), name), 'detections')
    node = graph.add(ArucoDetector, marker_size=small_bag.SIZE, detections=kind)
    look(graph)
    graph.spin_until(lambda: graph.heard['detections'])
    (message,) = graph.heard['detections']
    assert node.faults == []
    assert message.header.frame_id == 'camera'
    found = message.markers if kind == 'aruco_opencv' else message.detections
    assert [int(getattr(item, 'marker_id', getattr(item, 'id', -1))) for item in found] == [0, 1, 2, 3]


def test_annotations_go_out_to_foxglove(graph):
    graph.listen(installed('foxglove_msgs').ImageAnnotations, 'thermal/image_annotations')
    node = graph.add(ArucoDetector, marker_size=small_bag.SIZE, image_annotations=True)
    graph.spin_until(lambda: graph.output(node, 'thermal/image_annotations').listeners == 1)
    look(graph)
    graph.spin_until(lambda: graph.heard['thermal/image_annotations'])
    (message,) = graph.heard['thermal/image_annotations']
    assert [text.text for text in message.texts] == ['0', '1', '2', '3']
    assert {outline.type for outline in message.points} == {type(message.points[0]).LINE_LOOP}


def test_px4_gets_its_odometry(graph):
    topic = 'fmu/in/vehicle_visual_odometry'
    graph.listen(installed('px4_msgs').VehicleOdometry, topic)
    graph.add(PoseEkfNode, camera_position=[0.1, 0.0, 0.0], px4=True, bridge_rate=50.0)
    fly(graph)
    graph.spin_until(lambda: len(graph.heard[topic]) > 5)
    message = graph.heard[topic][-1]
    assert (message.pose_frame, message.velocity_frame) == (message.POSE_FRAME_FRD, message.VELOCITY_FRAME_BODY_FRD)
    # At rest at the origin of the map, up to the noise of the IMU.
    np.testing.assert_allclose(message.position, 0.0, atol=1e-3)
    np.testing.assert_allclose(message.q, [1.0, 0.0, 0.0, 0.0], atol=1e-3)


def test_a_damaged_static_transform_changes_nothing_and_a_good_one_places_the_camera(graph):
    message = partial(_static, installed('tf2_msgs').TFMessage)
    nodes = [graph.add(kind, live=True) for kind in (PoseEkfNode, ArucoDetector, MarkerMapperNode)]
    before = nodes[0].config.camera_position
    try:
        for bad in ([np.nan, 0.0, 0.0], [1e308, 0.0, 0.0]):
            graph.send('/tf_static', message(bad), profile=qos.STATIC_TF)
        assert [node.config.camera_position for node in nodes] == [before] * 3
        assert all('/tf_static' in node.last_refusal for node in nodes)
        graph.send('/tf_static', message([0.3, 0.0, 0.1]), profile=qos.STATIC_TF)
        assert [node.config.camera_position for node in nodes] == [(0.3, 0.0, 0.1)] * 3
    finally:
        for node in nodes:
            node.close()


def _static(kind, position):
    T_base_camera = np.eye(4)
    T_base_camera[:3, 3] = position
    return kind(transforms=[convert.transform_message(T_base_camera, 0, 'base_link', 'thermal_camera_optical')])


def test_the_pose_is_on_tf_as_rep_105_has_it(graph):
    kind = installed('tf2_msgs').TFMessage
    pytest.importorskip('tf2_ros')
    graph.listen(kind, '/tf')
    graph.listen(kind, '/tf_static', qos.STATIC_TF)
    frames_of = {'publish_tf': True, 'odom_frame': 'odom', 'smoothing_time': 0.5}
    node = graph.add(PoseEkfNode, camera_position=[0.1, 0.0, 0.0], **frames_of)
    fly(graph)
    graph.spin_until(lambda: graph.heard['/tf'] and graph.heard['/tf_static'])
    assert node.faults == []
    moving, fixed = (
        [(item.header.frame_id, item.child_frame_id) for item in graph.heard[topic][-1].transforms]
        for topic in ('/tf', '/tf_static')
    )
    assert moving == [('map', 'odom'), ('odom', 'base_link')]
    assert fixed == [('base_link', 'thermal_camera_optical')]
