"""Detections in the messages of other packages, which stand-ins have the fields of."""

import inspect
import sys
from types import ModuleType, SimpleNamespace

import cv2
from geometry_msgs.msg import PoseArray, PoseWithCovariance
import numpy as np
import pytest
from sensor_msgs.msg import PointCloud2
from support import small_bag
from support.messages import frames, info, START
from support.ros_graph import ros_graph

from thermal_fiducial.core.measurements import corners_px, MARKER_DTYPE
from thermal_fiducial.nodes.aruco_detector import ArucoDetector
from thermal_fiducial.ros.base import qos
from thermal_fiducial.ros.camera_nodes import detections
from thermal_fiducial.ros.messages import clouds, convert
from thermal_fiducial.ros.messages.annotations import image_annotations

HEAD = convert.header(START, 'thermal_camera_optical')
CORNERS = np.array([[100.0, 80.0], [160.0, 82.0], [158.0, 141.0], [99.0, 140.0]])


def stand_in(**fields):
    """A message class: each of ``fields`` is made anew for each message."""
    return lambda: SimpleNamespace(**{name: make() for name, make in fields.items()})


def point():
    return SimpleNamespace(x=0.0, y=0.0)


APRILTAG = SimpleNamespace(
    AprilTagDetectionArray=stand_in(detections=list),
    AprilTagDetection=stand_in(
        centre=point, corners=lambda: [point() for _ in range(4)], homography=lambda: np.zeros(9)
    ),
)
ARUCO = SimpleNamespace(ArucoDetection=stand_in(markers=list, boards=list), MarkerPose=stand_in())
VISION = SimpleNamespace(
    Detection3DArray=stand_in(detections=list),
    Detection3D=stand_in(results=list, bbox=SimpleNamespace),
    ObjectHypothesisWithPose=stand_in(hypothesis=SimpleNamespace, pose=PoseWithCovariance),
)


FOXGLOVE = SimpleNamespace(
    ImageAnnotations=lambda: SimpleNamespace(timestamp=None, circles=[], points=[], texts=[]),
    PointsAnnotation=type('PointsAnnotation', (SimpleNamespace,), {'LINE_LOOP': 2}),
    CircleAnnotation=SimpleNamespace,
    TextAnnotation=SimpleNamespace,
    Point2=SimpleNamespace,
    Color=SimpleNamespace,
)


def rows():
    row = np.zeros(1, MARKER_DTYPE)
    row['id'], row['contrast_counts'] = 7, 250.0
    for name, value in zip(('x', 'y', 'z', 'qx', 'qw'), (0.1, -0.2, 2.5, 1.0, 0.0), strict=True):
        row[name] = value
    for corner, (u, v) in enumerate(CORNERS):
        row[f'u{corner}'], row[f'v{corner}'] = u, v
    return row


def test_aruco_opencv():
    message = detections.aruco_opencv(ARUCO, rows(), HEAD)
    (marker,) = message.markers
    assert (message.header, marker.marker_id) == (HEAD, 7)
    assert (marker.pose.position.z, marker.pose.orientation.x) == (2.5, 1.0)


def test_apriltag_goes_round_from_the_lower_left_and_its_homography_meets_the_corners():
    message = detections.apriltag(APRILTAG, rows(), HEAD, 'DICT_4X4_50')
    (tag,) = message.detections
    assert (tag.family, tag.id, tag.hamming, tag.decision_margin) == ('DICT_4X4_50', 7, 0, 250.0)
    np.testing.assert_array_equal([[p.x, p.y] for p in tag.corners], CORNERS[[3, 2, 1, 0]])
    square = np.array([[[-1.0, 1.0], [1.0, 1.0], [1.0, -1.0], [-1.0, -1.0]]])
    # float32 corners: a ten-thousandth of a pixel.
    mapped = cv2.perspectiveTransform(square, np.reshape(tag.homography, (3, 3)))[0]
    np.testing.assert_allclose(mapped, corners_px(rows())[0][[3, 2, 1, 0]], atol=1e-4)
    assert 125.0 < tag.centre.x < 135.0
    assert 105.0 < tag.centre.y < 115.0


def test_vision():
    message = detections.vision(VISION, rows(), HEAD, [0.3])
    (detection,) = message.detections
    (result,) = detection.results
    assert (detection.id, result.hypothesis.class_id, result.hypothesis.score) == ('7', '7', 1.0)
    assert result.pose.pose.position.z == detection.bbox.center.position.z == 2.5
    assert (detection.bbox.size.x, detection.bbox.size.y) == (0.3, 0.3)


@pytest.mark.ros
def test_boxes_have_the_sides_that_the_map_gives_as_the_poses_do(monkeypatch):
    sent = []
    monkeypatch.setattr(detections, 'vision', lambda messages, markers, head, sides: sent.append(sides) or PoseArray())
    monkeypatch.setitem(detections.KINDS, 'vision', ('geometry_msgs', 'PoseArray'))
    with ros_graph() as graph:
        graph.add(ArucoDetector, marker_size=2.0 * small_bag.SIZE, detections='vision')
        graph.send('thermal/camera_info', info())
        known = small_bag.map_of(small_bag.CENTRES).rows()
        graph.send('marker_map', clouds.cloud(known, convert.header(START, 'map')), profile=qos.LATCHED)
        graph.send('thermal/image', *frames(1))
        graph.spin_until(lambda: sent)
    assert sent[0] == pytest.approx([small_bag.SIZE] * 4)


def test_image_annotations():
    message = image_annotations(FOXGLOVE, rows(), HEAD)
    ((outline,), (circle,), (text,)) = (message.points, message.circles, message.texts)
    assert message.timestamp == outline.timestamp == HEAD.stamp
    assert outline.type == 2
    # Foxglove's own library: "the top-left corner of the top-left pixel of the image as the origin".
    assert np.allclose([(point.x, point.y) for point in outline.points], np.add(CORNERS, 0.5))
    assert (circle.position.x, circle.position.y) == tuple(np.add(CORNERS[0], 0.5))
    assert (text.text, text.position.x, text.position.y) == ('7', 160.5, 141.5)
    nothing = image_annotations(FOXGLOVE, rows()[:0], HEAD)
    assert (nothing.points, nothing.circles, nothing.texts) == ([], [], [])


def test_annotations_have_the_fields_that_foxglove_knows():
    library = pytest.importorskip('foxglove.messages')
    message = image_annotations(FOXGLOVE, rows(), HEAD)
    parts = {'Points': message.points[0], 'Circle': message.circles[0], 'Text': message.texts[0]}
    for name, part in parts.items():
        known = inspect.signature(getattr(library, f'{name}Annotation')).parameters
        assert vars(part).keys() <= known.keys(), name
    assert vars(message).keys() <= inspect.signature(library.ImageAnnotations).parameters.keys()
    assert int(library.PointsAnnotationType.LineLoop) == FOXGLOVE.PointsAnnotation.LINE_LOOP


@pytest.mark.ros
def test_annotations_without_foxglove_msgs_are_a_fault_that_names_the_picture(monkeypatch):
    monkeypatch.setitem(sys.modules, 'foxglove_msgs.msg', None)
    with ros_graph() as graph:
        node = graph.add(ArucoDetector, marker_size=small_bag.SIZE, image_annotations=True)
        (fault,) = node.faults
    assert 'foxglove_msgs is not installed; thermal/image_markers' in fault


@pytest.mark.ros
@pytest.mark.parametrize(('kind', 'package'), [(kind, package) for kind, (package, _) in detections.KINDS.items()])
def test_messages_that_are_not_installed_are_a_fault_and_markers_come_all_the_same(monkeypatch, kind, package):
    monkeypatch.setitem(sys.modules, f'{package}.msg', None)
    with ros_graph() as graph:
        node = graph.add(ArucoDetector, marker_size=small_bag.SIZE, detections=kind)
        assert node.faults == [f'parameter detections: {package} is not installed']
        graph.listen(PointCloud2, 'markers')
        graph.send('thermal/camera_info', info())
        graph.send('thermal/image', *frames(1))
        graph.spin_until(lambda: graph.heard['markers'])


@pytest.mark.ros
def test_markers_are_published_on_tf(monkeypatch):
    sent = []
    tf2_ros = ModuleType('tf2_ros')
    tf2_ros.TransformBroadcaster = lambda node: SimpleNamespace(sendTransform=sent.append)
    monkeypatch.setitem(sys.modules, 'tf2_ros', tf2_ros)
    with ros_graph() as graph:
        graph.add(ArucoDetector, marker_size=small_bag.SIZE, publish_marker_tf=True)
        graph.send('thermal/camera_info', info())
        graph.send('thermal/image', *frames(1))
        graph.spin_until(lambda: sent)
    (transforms,) = sent
    assert [t.child_frame_id for t in transforms] == ['marker_0', 'marker_1', 'marker_2', 'marker_3']
    assert {t.header.frame_id for t in transforms} == {'camera'}
    # Flat pictures at 2.4 m: a few centimetres.
    np.testing.assert_allclose([t.transform.translation.z for t in transforms], 2.4, atol=0.1)
