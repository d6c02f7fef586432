"""The landing pad as an autopilot gets it, through the node and through what mavros does with its message."""

from geometry_msgs.msg import PoseStamped
import numpy as np
import pytest
from support.messages import pose_with_covariance

from thermal_fiducial.core.geometry.se3 import inverse, quaternion_from_rotation, so3_exp, transform
from thermal_fiducial.core.measurements import MAP_DTYPE, MARKER_DTYPE
from thermal_fiducial.nodes.landing_target import LandingTarget
from thermal_fiducial.ros.base import qos
from thermal_fiducial.ros.base.node import ERROR, OK, WARN
from thermal_fiducial.ros.frames.landing_pad import from_mavros
from thermal_fiducial.ros.messages import clouds, convert

pytestmark = pytest.mark.ros
STAMP = 1_700_000_000_000_000_000
#: A camera below the robot that looks down: its x to the right, its y backward.
R_BODY_CAMERA = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
T_BODY_CAMERA = transform(R_BODY_CAMERA, [0.1, 0.02, -0.05])
EXTRINSICS = {
    'camera_position': T_BODY_CAMERA[:3, 3].tolist(),
    'camera_orientation': quaternion_from_rotation(R_BODY_CAMERA).tolist(),
}
T_MAP_BODY = transform(so3_exp(np.array([0.05, -0.1, 0.7])), [3.0, -2.0, 2.5])
#: Two markers that lie on the ground; their z is up, each turned by another angle.
T_MAP_MARKERS = {
    7: transform(so3_exp(np.array([0.0, 0.0, 0.3])), [3.2, -1.6, 0.0]),
    8: transform(so3_exp(np.array([0.0, 0.0, -1.0])), [3.6, -1.6, 0.1]),
}
PAD = np.array([3.4, -1.6, 0.05])
#: T_new_old of a map that has not moved.
AT_HOME = np.eye(4)


@pytest.fixture
def graph(graph):
    graph.listen(PoseStamped, 'landing_target')
    return graph


def marker_map(ids=(7, 8), quarantined=(), T_new_old=AT_HOME):
    rows = np.zeros(len(ids), MAP_DTYPE)
    for row, marker_id in zip(rows, ids, strict=True):
        T = T_new_old @ T_MAP_MARKERS[marker_id]
        row['id'], row['size'], row['trusted'] = marker_id, 0.3, marker_id not in quarantined
        row['x'], row['y'], row['z'] = T[:3, 3]
        row['qx'], row['qy'], row['qz'], row['qw'] = quaternion_from_rotation(T[:3, :3])
    return clouds.cloud(rows, convert.header(STAMP, 'map'))


def markers(*ids, stamp=STAMP):
    rows = np.zeros(len(ids), MARKER_DTYPE)
    for row, marker_id in zip(rows, ids, strict=True):
        T_camera_marker = inverse(T_MAP_BODY @ T_BODY_CAMERA) @ T_MAP_MARKERS.get(marker_id, np.eye(4))
        row['id'] = marker_id
        row['x'], row['y'], row['z'] = T_camera_marker[:3, 3]
        row['qx'], row['qy'], row['qz'], row['qw'] = quaternion_from_rotation(T_camera_marker[:3, :3])
        for corner in range(4):
            row[f'c{corner}uu'] = row[f'c{corner}vv'] = 0.01
    return clouds.cloud(rows, convert.header(stamp, 'thermal_camera_optical'))


def camera_pose(stamp=STAMP, frame='map'):
    head = convert.header(stamp, frame)
    return pose_with_covariance(T_MAP_BODY @ T_BODY_CAMERA, np.diag([1e-6] * 6), head)


def mavros_ned(message):
    """Position and attitude of the MAVLink message that mavros makes of it (plugin landing_target, frame_tf)."""
    T = convert.transform_of(message.pose)
    ned_enu = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    return ned_enu @ T[:3, 3], ned_enu @ T[:3, :3] @ np.diag([1.0, -1.0, -1.0])


def heard(graph, count=1):
    graph.spin_until(lambda: len(graph.heard['landing_target']) >= count)
    return graph.heard['landing_target']


def test_ardupilot_gets_the_pad_in_forward_right_down(graph):
    node = graph.add(LandingTarget, landing_pad=[7, 8], **EXTRINSICS)
    graph.send('marker_map', marker_map(), profile=qos.LATCHED)
    graph.send('markers', markers(8))
    graph.send('camera_pose', camera_pose())
    (message,) = heard(graph)
    forward, left, up = inverse(T_MAP_BODY)[:3, :3] @ (PAD - T_MAP_BODY[:3, 3])
    position, attitude = mavros_ned(message)
    # 1e-6: poses of markers travel as float32
    np.testing.assert_allclose(position, [forward, -left, -up], atol=1e-6)
    frd = np.diag([1.0, -1.0, -1.0])
    R_body_pad = T_MAP_BODY[:3, :3].T @ T_MAP_MARKERS[7][:3, :3]
    np.testing.assert_allclose(attitude, frd @ R_body_pad @ frd, atol=1e-6)
    assert position[2] > 2.0
    assert message.header.frame_id == 'base_link_rfu'
    assert convert.stamp_ns(message.header.stamp) == STAMP
    received = np.array([[message.pose.position.x, message.pose.position.y, message.pose.position.z]])
    np.testing.assert_allclose(from_mavros(received), [[forward, left, up]], atol=1e-6)
    assert graph.diagnose(node)[:2] == (OK, 'ok')


def test_px4_gets_it_in_the_map_that_its_odometry_is_in(graph):
    graph.add(LandingTarget, landing_pad=[7, 8], landing_target_frame='map', **EXTRINSICS)
    graph.send('marker_map', marker_map(), profile=qos.LATCHED)
    graph.send('markers', markers(7, 8))
    graph.send('camera_pose', camera_pose())
    (message,) = heard(graph)
    assert message.header.frame_id == 'map'
    np.testing.assert_allclose(convert.transform_of(message.pose)[:3, 3], PAD, atol=1e-6)


@pytest.mark.parametrize('target_frame', ['body', 'map'])
def test_a_camera_pose_in_another_frame_is_refused(graph, target_frame):
    """Of another localizer on the same images, say: the pad went out where it is seen from that one's origin."""
    node = graph.add(LandingTarget, landing_pad=[7, 8], landing_target_frame=target_frame, **EXTRINSICS)
    graph.send('marker_map', marker_map(), profile=qos.LATCHED)
    graph.send('markers', markers(8))
    graph.send('camera_pose', camera_pose(frame='odom'))
    level, reason, _ = graph.diagnose(node)
    assert (level, "camera_pose in frame 'odom'" in reason) == (WARN, True)
    assert not graph.heard['landing_target']
    graph.send('camera_pose', camera_pose())
    assert len(heard(graph)) == 1


def test_a_frame_from_before_a_correction_of_the_map_has_the_pad_where_it_is(graph):
    """Its camera pose is one in the map as of its stamp, also where it comes after the corrected map."""
    graph.add(LandingTarget, landing_pad=[7, 8], **EXTRINSICS)
    T_new_old = transform(so3_exp([0.0, 0.0, 0.3]), [1.0, 2.0, 0.0])
    graph.send('marker_map', marker_map(), profile=qos.LATCHED)
    graph.send('markers', markers(7))
    graph.send('map_correction', convert.transform_message(T_new_old, STAMP, 'map', 'map_before'))
    graph.send('marker_map', marker_map(T_new_old=T_new_old), profile=qos.LATCHED)
    graph.send('camera_pose', camera_pose())
    (message,) = heard(graph)
    forward, left, up = inverse(T_MAP_BODY)[:3, :3] @ (PAD - T_MAP_BODY[:3, 3])
    # 1e-6: poses of markers travel as float32
    np.testing.assert_allclose(mavros_ned(message)[0], [forward, -left, -up], atol=1e-6)


def test_a_marker_of_the_pad_in_quarantine_is_named(graph):
    node = graph.add(LandingTarget, landing_pad=[7, 8], **EXTRINSICS)
    graph.send('markers', markers())
    graph.send('marker_map', marker_map(quarantined=[8]), profile=qos.LATCHED)
    assert graph.diagnose(node)[:2] == (WARN, 'the pad is not in the map: marker 8 in quarantine')
    graph.send('marker_map', marker_map(), profile=qos.LATCHED)
    graph.send('markers', markers())
    assert graph.diagnose(node)[:2] == (OK, 'the pad is not in view')


def test_it_is_silent_while_the_pad_is_not_in_view(graph):
    node = graph.add(LandingTarget, landing_pad=[7], **EXTRINSICS)
    graph.send('marker_map', marker_map(), profile=qos.LATCHED)
    graph.send('markers', markers(8))
    graph.send('camera_pose', camera_pose())
    assert graph.diagnose(node)[:2] == (OK, 'the pad is not in view')
    graph.send('markers', markers(7, stamp=STAMP + 1))
    graph.send('camera_pose', camera_pose(), camera_pose(STAMP + 1))
    assert convert.stamp_ns(heard(graph)[0].header.stamp) == STAMP + 1


def test_a_pad_of_one_marker_needs_no_map(graph):
    node = graph.add(LandingTarget, landing_pad=[7], **EXTRINSICS)
    graph.send('markers', markers(7, 3))
    (message,) = heard(graph)
    expected = inverse(T_MAP_BODY)[:3, :3] @ (T_MAP_MARKERS[7][:3, 3] - T_MAP_BODY[:3, 3])
    np.testing.assert_allclose(mavros_ned(message)[0], expected * [1.0, -1.0, -1.0], atol=1e-6)
    assert graph.diagnose(node)[:2] == (OK, 'ok')


@pytest.mark.parametrize('pad', [[7], [7, 8]])
def test_frames_without_a_camera_pose_are_reported_and_a_pad_of_one_marker_goes_on(graph, pad):
    """The mapper has ended, say, on the way down: the target came no more, and the node said that it was well."""
    node = graph.add(LandingTarget, landing_pad=pad, **EXTRINSICS)
    graph.send('marker_map', marker_map(), profile=qos.LATCHED)
    for k in range(15):
        graph.send('markers', markers(7, stamp=STAMP + k))
    assert graph.diagnose(node)[:2] == (WARN, 'the pad is in view, but its frames have no camera_pose')
    sent = [convert.stamp_ns(message.header.stamp) - STAMP for message in graph.heard['landing_target']]
    # Ten frames wait for theirs.
    assert sent == ([10, 11, 12, 13, 14] if len(pad) == 1 else [])
    graph.send('camera_pose', camera_pose(STAMP + 9), camera_pose(STAMP + 12))
    graph.send('markers', markers(7, stamp=STAMP + 15))
    graph.send('camera_pose', camera_pose(STAMP + 15))
    assert graph.diagnose(node)[:2] == (OK, 'ok')
    # None of one stamp twice, and none older than one before it.
    count = 6 if len(pad) == 1 else 3
    again = [convert.stamp_ns(message.header.stamp) - STAMP for message in heard(graph, count)]
    assert again == ([*sent, 15] if len(pad) == 1 else [9, 12, 15])


@pytest.mark.parametrize('quaternion', [(0.0, 0.0, 0.0, 0.0), (np.nan, 0.0, 0.0, 1.0)])
def test_a_marker_whose_detector_has_no_pose_of_it_is_no_target(graph, quaternion):
    """The autopilot would get numbers that are none."""
    graph.add(LandingTarget, landing_pad=[7], **EXTRINSICS)
    rows = clouds.markers(markers(7)).copy()
    rows['qx'], rows['qy'], rows['qz'], rows['qw'] = quaternion
    graph.send('markers', clouds.cloud(rows, convert.header(STAMP, 'thermal_camera_optical')))
    graph.send('markers', markers(7, stamp=STAMP + 1))
    assert convert.stamp_ns(heard(graph)[0].header.stamp) == STAMP + 1


@pytest.mark.parametrize('parameters', [{'landing_pad': [7, 8]}, {'landing_pad': [7], 'landing_target_frame': 'map'}])
def test_a_pad_that_needs_the_map_is_reported_as_missing_without_one(graph, parameters):
    node = graph.add(LandingTarget, **parameters, **EXTRINSICS)
    graph.send('marker_map', marker_map([8]), profile=qos.LATCHED)
    graph.send('markers', markers(7, 8))
    graph.send('camera_pose', camera_pose())
    assert graph.diagnose(node)[:2] == (WARN, 'the pad is not in the map: marker 7 missing')
    assert not graph.heard['landing_target']


def test_no_pad_is_a_fault(graph):
    level, reason, _ = graph.diagnose(graph.add(LandingTarget))
    assert level == ERROR
    assert 'landing_pad' in reason
