"""``check-bridge`` in a graph that runs: who sends, who listens, and what the filter itself complains of."""

from concurrent.futures import ThreadPoolExecutor
import sys
import time
from types import ModuleType

from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry
import pytest
from support.ros_graph import ros_graph

from thermal_fiducial.errors import InputError
from thermal_fiducial.nodes.landing_target import LandingTarget
from thermal_fiducial.nodes.pose_ekf import PoseEkfNode
from thermal_fiducial.report.bridge_check import Level
from thermal_fiducial.report.bridge_links import check_links
from thermal_fiducial.ros.watching import bridge_listener

pytestmark = pytest.mark.ros
MAVROS = ('-r', 'bridge/odometry:=mavros/odometry/out')


def listened(graph, filter_node, topics):
    """Levels and words of the links, by what they check; ``topics`` gets what was listened to."""

    def listen():
        return bridge_listener.listen(
            1.5, lambda message, arrival_ns: None, lambda message: None, lambda message: None, announce=topics.append
        )

    with ThreadPoolExecutor(1) as pool:
        links = pool.submit(listen)
        said = 0.0
        while not links.done():
            graph.executor.spin_once(timeout_sec=0.05)
            # What it says wakes the graph again: as often as that it would take all of a processor.
            if topics and time.monotonic() - said > 0.05:
                filter_node.diagnose(0)
                said = time.monotonic()
        return {finding.check: (finding.level, finding.seen) for finding in check_links(links.result())}


def test_one_sender_and_a_listener_are_in_order():
    with ros_graph(*MAVROS) as graph:
        node = graph.add(PoseEkfNode, bridge_rate=30.0)
        graph.listen(Odometry, 'mavros/odometry/out')
        topics = []
        found = listened(graph, node, topics)
        assert found == {'receivers': (Level.OK, '1 listen to /mavros/odometry/out')}
        assert topics[0].odometry == '/mavros/odometry/out'


def test_of_two_robots_that_of_the_namespace_is_listened_to():
    topics = []
    with ros_graph() as graph:
        for name in ('drone1', 'drone2'):
            for kind in (PoseEkfNode, LandingTarget):
                graph.added(kind(live=False, context=graph.context, namespace=name))
        for name in ('drone1', 'drone2'):
            arguments = ['-r', f'__ns:=/{name}']
            bridge_listener.listen(0.1, print, print, print, announce=topics.append, ros_arguments=arguments)
    assert [said.sender for said in topics] == ['/drone1/pose_ekf', '/drone2/pose_ekf']
    assert [said.landing for said in topics] == ['/drone1/landing_target', '/drone2/landing_target']


def test_of_several_robots_one_must_be_named():
    """It verified the first one that it found, without a word."""
    with ros_graph() as graph:
        for name in ('drone1', 'drone2'):
            graph.added(PoseEkfNode(live=False, context=graph.context, namespace=name))
        with pytest.raises(InputError, match='several robots, /drone1, /drone2: name one'):
            bridge_listener.listen(0.1, print, print, print)


@pytest.mark.parametrize(('bridge_rate', 'topic'), [(30.0, '/mavros/odometry/out'), (0.0, '/a/odom')])
def test_a_remapped_odometry_is_not_taken_for_that_of_the_autopilot(bridge_rate, topic):
    """Whatever name came first in the alphabet was listened to."""
    with ros_graph(*MAVROS, '-r', 'odometry:=a/odom') as graph:
        graph.add(PoseEkfNode, live=True, bridge_rate=bridge_rate)
        topics = []
        with ThreadPoolExecutor(1) as pool:
            done = pool.submit(bridge_listener.listen, 0.1, print, print, print, announce=topics.append)
            graph.spin_until(done.done)
        assert [said.odometry for said in topics] == [topic]


def test_two_publishers_and_a_missing_subscriber_are_reported():
    with ros_graph(*MAVROS) as graph:
        node = graph.add(PoseEkfNode, bridge_rate=30.0)
        graph.tester.advertise(Odometry, 'mavros/odometry/out')
        assert listened(graph, node, []) == {
            'senders': (Level.FAULT, '2 nodes send the odometry'),
            'receivers': (Level.WARNING, '0 listen to /mavros/odometry/out'),
        }


def test_px4_without_its_messages_is_a_fault_though_the_odometry_is_sound(monkeypatch):
    monkeypatch.setitem(sys.modules, 'px4_msgs.msg', None)
    with ros_graph() as graph:
        node = graph.add(PoseEkfNode, bridge_rate=50.0, px4=True)
        assert listened(graph, node, [])['filter'] == (
            Level.FAULT,
            'pose_ekf says: parameter px4: px4_msgs is not installed',
        )


def test_px4_is_listened_for_on_its_own_topic(monkeypatch):
    """px4_msgs, for which another message stands, is what PX4 gets; the odometry beside it is what is checked."""
    px4 = ModuleType('px4_msgs.msg')
    px4.VehicleOdometry = TwistStamped
    monkeypatch.setitem(sys.modules, 'px4_msgs', ModuleType('px4_msgs'))
    monkeypatch.setitem(sys.modules, 'px4_msgs.msg', px4)
    monkeypatch.setattr(bridge_listener, 'PX4_KIND', 'geometry_msgs/msg/TwistStamped')
    with ros_graph() as graph:
        node = graph.add(PoseEkfNode, bridge_rate=50.0, px4=True)
        assert listened(graph, node, [])['receivers'] == (Level.WARNING, '0 listen to /fmu/in/vehicle_visual_odometry')
