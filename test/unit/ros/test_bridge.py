"""What leaves for a flight controller and for /tf: rates, axes, silence."""

import sys
from types import ModuleType

from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry as OdometryMessage
import numpy as np
import pytest
from support import small_bag
from support.messages import imu, pose_with_covariance
from support.ros_graph import ros_graph

from thermal_fiducial.core.geometry.se3 import rotation_from_quaternion, so3_exp, transform
from thermal_fiducial.core.measurements import Odometry
from thermal_fiducial.nodes.pose_ekf import PoseEkfNode
from thermal_fiducial.ros.base.node import ERROR, WARN
from thermal_fiducial.ros.filter_node.bridge import FlightControllerBridge, px4_odometry
from thermal_fiducial.ros.messages import convert

pytestmark = pytest.mark.ros
START = small_bag.START_NS


class VehicleOdometry:
    """Stand-in of px4_msgs/VehicleOdometry."""

    POSE_FRAME_FRD, VELOCITY_FRAME_BODY_FRD = 2, 3


def odometry(T=None, velocity=(0.0, 0.0, 0.0), rate=(0.0, 0.0, 0.0), covariance=None):
    covariance = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]) * 1e-4 if covariance is None else covariance
    T_map_body = np.eye(4) if T is None else T
    return Odometry(START + 123_456, T_map_body, np.array(velocity), np.array(rate), covariance, 2.0 * covariance)


# --- PX4 ----------------------------------------------------------------------------------------------


def test_px4_gets_forward_right_down():
    message = px4_odometry(
        VehicleOdometry, odometry(transform(np.eye(3), [1.0, 2.0, 3.0]), (4.0, 5.0, 6.0), (0.1, 0.2, 0.3)), resets=258
    )
    assert (message.pose_frame, message.velocity_frame) == (2, 3)
    np.testing.assert_array_equal(message.position, [1.0, -2.0, -3.0])
    np.testing.assert_array_equal(message.velocity, [4.0, -5.0, -6.0])
    np.testing.assert_array_equal(message.angular_velocity, np.float32([0.1, -0.2, -0.3]))
    np.testing.assert_array_equal(message.q, [1.0, 0.0, 0.0, 0.0])
    assert message.timestamp_sample == (START + 123_456) // 1000
    assert message.timestamp == 0
    assert message.reset_counter == 2
    assert message.q.dtype == np.float32


def test_px4_turns_right_for_a_right_turn():
    # To the left is a positive yaw in ENU and a negative one in NED and FRD.
    message = px4_odometry(VehicleOdometry, odometry(transform(so3_exp([0.0, 0.0, 0.5]), np.zeros(3))), 0)
    w, x, y, z = message.q.tolist()
    assert 2.0 * np.arctan2(z, w) == pytest.approx(-0.5, abs=1e-6)
    assert (x, y) == (0.0, 0.0)


def test_px4_attitude_is_the_same_rotation_in_other_axes():
    F = np.diag([1.0, -1.0, -1.0])
    R = so3_exp([0.3, -0.2, 0.9])
    w, x, y, z = px4_odometry(VehicleOdometry, odometry(transform(R, np.zeros(3))), 0).q.tolist()
    # Single precision.
    np.testing.assert_allclose(rotation_from_quaternion([x, y, z, w]), F @ R @ F, atol=1e-6)


def test_px4_variances_are_those_of_its_frames():
    R = so3_exp([0.0, 0.0, np.pi / 2])
    covariance = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    message = px4_odometry(VehicleOdometry, odometry(transform(R, np.zeros(3)), covariance=covariance), 0)
    np.testing.assert_allclose(message.position_variance, [1.0, 2.0, 3.0])
    # Of the orientation about the body's axes: x of the body is y of the map after a quarter turn.
    np.testing.assert_allclose(message.orientation_variance, [5.0, 4.0, 6.0], rtol=1e-6)
    np.testing.assert_allclose(message.velocity_variance, [2.0, 4.0, 6.0])


# --- in the node --------------------------------------------------------------------------------------


def fly(graph, samples, poses_until=10**9, step=0.0):
    """A robot at rest: IMU at 200 Hz, a pose every 30 ms, ``step`` [m] aside."""
    for k in samples:
        graph.send('imu/data', imu(k))
        if k % 6 == 5 and k < poses_until:
            head = convert.header(START + (k - 4) * 5_000_000, 'map')
            T_map_camera = transform(np.eye(3), [step, 0.0, 0.0]) @ small_bag.T_BODY_CAMERA
            covariance = np.diag([1e-6] * 3 + [1e-7] * 3)
            graph.send('camera_pose', pose_with_covariance(T_map_camera, covariance, head))


@pytest.mark.parametrize(('rate', 'expected'), [(30.0, 12), (50.0, 20), (1000.0, 80), (0.0, 0)])
def test_the_bridge_has_its_rate(rate, expected):
    with ros_graph() as graph:
        node = graph.add(PoseEkfNode, camera_position=[0.1, 0.0, 0.0], bridge_rate=rate)
        fly(graph, range(60))
        before = counts(node)
        fly(graph, range(60, 140))
        sent = {topic: count - before[topic] for topic, count in counts(node).items()}
    assert sent['/odometry'] == 80
    # 0.4 s; by its phase one more or less.
    assert abs(sent.get('/bridge/odometry', 0) - expected) <= 1
    assert sent.get('/bridge/pose', 0) == sent.get('/bridge/odometry', 0)


def counts(node):
    return {output.topic: output.count for output in node.outputs}


def test_the_bridge_is_silent_while_lost():
    with ros_graph() as graph:
        # Lost as soon as the position is known no better than 5 cm, which no pose for half a second brings about.
        node = graph.add(PoseEkfNode, camera_position=[0.1, 0.0, 0.0], bridge_rate=200.0, lost_position_std=0.05)
        fly(graph, range(100))
        assert not node.filter.lost
        fly(graph, range(100, 900), poses_until=0)
        assert node.filter.lost
        level, reason, _ = graph.diagnose(node)
        assert level == ERROR
        assert reason.startswith('lost')
        before = counts(node)
        fly(graph, range(900, 910), poses_until=0)
        sent = {topic: count - before[topic] for topic, count in counts(node).items()}
    assert (sent['/odometry'], sent['/bridge/odometry'], sent['/bridge/pose']) == (10, 0, 0)


def test_the_smooth_topic_is_another_one_and_feeds_the_bridge():
    with ros_graph() as graph:
        node = graph.add(PoseEkfNode, camera_position=[0.1, 0.0, 0.0], bridge_rate=1000.0, smoothing_time=0.1)
        for topic in ('odometry', 'odometry_smooth', 'bridge/odometry'):
            graph.listen(OdometryMessage, topic)
        graph.spin_until(lambda: all(output.listeners for output in node.outputs if 'odometry' in output.topic))
        fly(graph, range(60))
        fly(graph, range(60, 80), step=0.004)
        graph.spin_until(lambda: len(graph.heard['bridge/odometry']) == graph.published(node, 'odometry'))
        exact, smooth, bridged = (graph.heard[topic] for topic in ('odometry', 'odometry_smooth', 'bridge/odometry'))
    assert len(exact) == len(smooth) == len(bridged) > 20
    assert [message.pose.pose for message in smooth] == [message.pose.pose for message in bridged]
    steps = [np.abs(np.diff([m.pose.pose.position.x for m in messages])).max() for messages in (exact, smooth)]
    # A correction is spread over 100 ms, twenty IMU samples.
    assert 0.0 < steps[1] < 0.5 * steps[0]


@pytest.mark.parametrize(('smoothing', 'jumps'), [({}, 2), ({'smoothing_time': 1.0}, 1)])
def test_px4_hears_of_jumps_of_what_is_sent(monkeypatch, smoothing, jumps):
    """A correction of the map is a jump of the pose; where the pose glides there, none must be announced."""
    counted = []
    monkeypatch.setattr(FlightControllerBridge, 'send', lambda bridge, sent, written, resets: counted.append(resets))
    with ros_graph() as graph:
        graph.add(PoseEkfNode, camera_position=[0.1, 0.0, 0.0], bridge_rate=1000.0, **smoothing)
        fly(graph, range(60))
        T_new_old = transform(np.eye(3), [0.0, 0.05, 0.0])
        graph.send('map_correction', convert.transform_message(T_new_old, START + 60 * 5_000_000, 'map', 'map_before'))
        fly(graph, range(60, 90), poses_until=0)
    assert (counted[0], counted[-1]) == (1, jumps)


@pytest.mark.parametrize('reset', [False, True])
def test_the_smooth_output_does_not_continue_a_pose_that_was_lost(reset):
    """An autopilot has had no pose meanwhile, and would get one 0.6 m off for seconds, at the claim of the estimate."""
    with ros_graph() as graph:
        node = graph.add(PoseEkfNode, camera_position=[0.1, 0.0, 0.0], bridge_rate=1000.0, smoothing_time=10.0)
        graph.listen(OdometryMessage, 'bridge/odometry')
        graph.spin_until(lambda: all(output.listeners for output in node.outputs if output.topic == '/bridge/odometry'))
        fly(graph, range(100))
        before = counts(node)['/bridge/odometry']
        if reset:
            node.filter.reset()
        fly(graph, range(100, 400), step=0.6)
        graph.spin_until(lambda: len(graph.heard['bridge/odometry']) == graph.published(node, 'bridge/odometry'))
        x = np.array([message.pose.pose.position.x for message in graph.heard['bridge/odometry']])
    # At rest the filter knows its position to a few millimetres; an IMU message of 5 ms ends the old pose.
    assert np.abs(x[: before - 1]).max() < 0.02
    assert np.abs(x[-50:] - 0.6).max() < 0.02
    assert not np.any((x > 0.1) & (x < 0.5))


@pytest.mark.parametrize(
    ('parameters', 'line'),
    [
        ({'px4': True}, 'parameter px4: no effect without bridge_rate'),
        ({'odom_frame': 'odom'}, 'parameter odom_frame: no effect without publish_tf and smoothing_time'),
        ({'prefix_frames': True}, 'parameter prefix_frames: no effect without a namespace'),
    ],
)
def test_an_output_that_another_parameter_keeps_from_coming_is_a_warning(parameters, line):
    with ros_graph() as graph:
        node = graph.add(PoseEkfNode, **parameters)
        graph.listen(OdometryMessage, 'odometry')
        fly(graph, range(60))
        level, reason, _ = graph.diagnose(node)
    assert level == WARN
    # Behind the state of the filter, which a pilot wants to know first.
    assert reason.endswith(f'; {line}')


def test_px4_messages_that_are_not_installed_are_a_fault(monkeypatch):
    monkeypatch.setitem(sys.modules, 'px4_msgs.msg', None)
    with ros_graph() as graph:
        node = graph.add(PoseEkfNode, bridge_rate=50.0, px4=True)
        assert node.faults == ['parameter px4: px4_msgs is not installed']


class Broadcaster:
    """Stand-in of tf2_ros's broadcasters."""

    sent = ()

    def __init__(self, node):
        self.node = node

    def sendTransform(self, message):
        type(self).sent = (*type(self).sent, message)


class StaticBroadcaster(Broadcaster):
    """The same, of its own."""


def test_transforms_are_broadcast_where_tf2_is(monkeypatch):
    tf2_ros = ModuleType('tf2_ros')
    tf2_ros.TransformBroadcaster, tf2_ros.StaticTransformBroadcaster = Broadcaster, StaticBroadcaster
    monkeypatch.setitem(sys.modules, 'tf2_ros', tf2_ros)
    with ros_graph() as graph:
        graph.listen(PoseWithCovarianceStamped, 'pose')
        node = graph.add(PoseEkfNode, camera_position=[0.1, 0.0, 0.0], publish_tf=True)
        fly(graph, range(60))
        assert len(Broadcaster.sent) == graph.published(node, 'pose') > 20
    (static,) = StaticBroadcaster.sent
    assert (static.header.frame_id, static.child_frame_id) == ('base_link', 'thermal_camera_optical')
    assert static.transform.translation.x == 0.1
    last, pose = Broadcaster.sent[-1], graph.heard['pose'][-1]
    assert (last.header.frame_id, last.child_frame_id) == ('map', 'base_link')
    assert last.header == pose.header
    assert last.transform.rotation == pose.pose.pose.orientation
    assert last.transform.translation.z == pose.pose.pose.position.z


def test_with_an_odom_frame_the_smooth_pose_is_in_it_and_both_make_the_pose(monkeypatch):
    tf2_ros = ModuleType('tf2_ros')
    sent = []

    class Pairs(Broadcaster):
        def sendTransform(self, message):
            sent.append(message)

    tf2_ros.TransformBroadcaster, tf2_ros.StaticTransformBroadcaster = Pairs, StaticBroadcaster
    monkeypatch.setitem(sys.modules, 'tf2_ros', tf2_ros)
    with ros_graph() as graph:
        frames = {'publish_tf': True, 'odom_frame': 'odom', 'smoothing_time': 0.5}
        node = graph.add(PoseEkfNode, camera_position=[0.1, 0.0, 0.0], **frames)
        graph.listen(OdometryMessage, 'odometry_smooth')
        graph.spin_until(lambda: all(output.listeners for output in node.outputs if 'smooth' in output.topic))
        # To the sample behind a pose: what is published is of the samples.
        fly(graph, range(61))
        graph.spin_until(lambda: len(graph.heard['odometry_smooth']) == graph.published(node, 'odometry_smooth'))
        state = node.filter.state.T_map_body
    smooth = graph.heard['odometry_smooth'][-1].pose.pose
    map_to_odom, odom_to_base = sent[-1]
    assert (map_to_odom.header.frame_id, map_to_odom.child_frame_id) == ('map', 'odom')
    assert (odom_to_base.header.frame_id, odom_to_base.child_frame_id) == ('odom', 'base_link')
    assert map_to_odom.header.stamp == odom_to_base.header.stamp
    T_map_odom, T_odom_base = (convert.correction_of(message)[1] for message in sent[-1])
    # A quaternion in between: the last digits may differ.
    np.testing.assert_allclose(
        T_odom_base[:3, 3], [smooth.position.x, smooth.position.y, smooth.position.z], atol=1e-12
    )
    np.testing.assert_allclose(T_map_odom @ T_odom_base, state, atol=1e-12)


def test_tf2_that_is_not_installed_is_a_fault(monkeypatch):
    monkeypatch.setitem(sys.modules, 'tf2_ros', None)
    with ros_graph() as graph:
        node = graph.add(PoseEkfNode, publish_tf=True)
        assert node.faults == ['parameter publish_tf: tf2_ros is not installed']
