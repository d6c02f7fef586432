"""A second camera, whose poses stand in for those of the first."""

from geometry_msgs.msg import PoseWithCovarianceStamped
import numpy as np
import pytest
from support import small_bag
from support.messages import frames, info
from support.ros_graph import ros_graph

from thermal_fiducial.config import ArucoDetectorConfig
from thermal_fiducial.core.detection.detector import MarkerDetector
from thermal_fiducial.core.geometry.se3 import inverse, so3_exp, transform
from thermal_fiducial.core.measurements import CameraPose, seen_from
from thermal_fiducial.files.dictionary import load_dictionary
from thermal_fiducial.files.images import image_to_array
from thermal_fiducial.nodes.marker_mapper import MarkerMapperNode
from thermal_fiducial.replay.settings import read_settings
from thermal_fiducial.ros import clouds, convert

T_BODY_FIRST = small_bag.T_BODY_CAMERA
#: Beside the first, turned by half a radian.
T_BODY_SECOND = T_BODY_FIRST @ transform(so3_exp([0.0, 0.5, 0.0]), [0.2, 0.0, 0.0])


def test_the_covariance_follows_the_lever_arm():
    """Against numbers: the second camera's small errors, seen at the first."""
    T, T_there = T_BODY_SECOND, inverse(T_BODY_SECOND) @ T_BODY_FIRST
    A = np.random.default_rng(1).normal(size=(6, 6))
    found = seen_from(CameraPose(0, T, A @ A.T), T_there).covariance
    J, step = np.empty((6, 6)), 1e-6
    for k, d in enumerate(step * np.eye(6)):
        moved = transform(so3_exp(d[3:]) @ T[:3, :3], T[:3, 3] + d[:3]) @ T_there
        J[:, k] = np.r_[(moved - T @ T_there)[:3, 3], d[3:]] / step
    # Differences over 1e-6 are good to 1e-6 of numbers of about 10.
    np.testing.assert_allclose(found, J @ A @ A.T @ J.T, rtol=0, atol=1e-4)


def test_parameters_in_the_second_cameras_namespace_are_its_own(tmp_path):
    path = tmp_path / 'rig.yaml'
    path.write_text(
        '/**: {ros__parameters: {second_camera: down, camera_position: [0.1, 0.0, 0.0]}}\n'
        '/down/**: {ros__parameters: {camera_position: [0.0, 0.0, -0.1]}}\n'
    )
    assert read_settings(path, {}).aruco_detector.camera_position == (0.1, 0.0, 0.0)


@pytest.fixture
def graph():
    with ros_graph() as graph:
        yield graph


@pytest.mark.ros
def test_the_mapper_reads_both_and_goes_on_with_the_second_alone(graph, tmp_path):
    """Twice the same camera: frames 0 and 1 of both, frames 4 and 8 of the second alone."""
    detector = MarkerDetector(ArucoDetectorConfig(marker_size=small_bag.SIZE), load_dictionary('DICT_4X4_50'))
    seen = [
        clouds.cloud(
            detector.detect(convert.stamp_ns(image.header.stamp), image_to_array(image), small_bag.CAMERA), image.header
        )
        for image in frames(9)
    ]
    place = {f'{name}camera_position': list(T_BODY_FIRST[:3, 3]) for name in ('', 'second_')}
    whole = small_bag.side_files(tmp_path, ids=(0, 1, 2, 3))[0]
    node = graph.add(MarkerMapperNode, map_file=str(whole), second_camera='down', **place)
    graph.listen(PoseWithCovarianceStamped, 'camera_pose')
    graph.send('down/markers', seen[0])
    assert 'no camera_info of down' in graph.diagnose(node)[2]['last refusal']
    for topic in ('thermal/camera_info', 'down/thermal/camera_info'):
        graph.send(topic, info())
    for topic, k in (('markers', 0), ('down/markers', 1), ('markers', 1), ('down/markers', 4), ('down/markers', 8)):
        graph.send(topic, seen[k])
    # Frame 4 is 100 ms after the first camera's last: it might still come.
    graph.spin_until(lambda: len(graph.heard['camera_pose']) == 3)
    figures = graph.diagnose(node)[2]
    assert figures['second camera: alone'] == '1'
    stamps = [convert.stamp_ns(message.header.stamp) for message in graph.heard['camera_pose']]
    assert stamps == [convert.stamp_ns(seen[k].header.stamp) for k in (0, 1, 8)]
    for message, k in zip(graph.heard['camera_pose'], (0, 1, 8), strict=True):
        truth = small_bag.true_pose(k / 30) @ T_BODY_FIRST
        # Flat pictures are good to a centimetre or two.
        np.testing.assert_allclose(convert.transform_of(message.pose.pose)[:3, 3], truth[:3, 3], atol=0.05)
