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


#: Seconds for which the filter's words are awaited, and for which is listened: longer ones where a busy machine has not
#: come so far.
WAITS = (0.3, 1.5, 4.0)


def heard(monkeypatch, graph=None, filter_node=None, arguments=()):
    """Links and topics that a listener finds, with each of the waits, while the graph spins and its filter speaks."""
    for seconds in WAITS:
        monkeypatch.setattr(bridge_listener, 'SAID_S', seconds)
        topics = []

        def listen(seconds=seconds, announce=topics.append):
            ignored = [lambda *message: None] * 3
            return bridge_listener.listen(seconds, *ignored, announce=announce, ros_arguments=arguments)

        with ThreadPoolExecutor(1) as pool:
            links = pool.submit(listen)
            said = 0.0
            while graph and not links.done():
                graph.executor.spin_once(timeout_sec=0.05)
                # What it says wakes the graph again: as often as that it would take all of a processor.
                if time.monotonic() - said > 0.05:
                    filter_node.diagnose(0)
                    said = time.monotonic()
        yield links.result(), topics[0]


def found_links(monkeypatch, graph, filter_node, wanted):
    """Levels and words of the links, by what they check: the ``wanted`` ones as soon as a listener finds these."""
    for links, _ in heard(monkeypatch, graph, filter_node):
        found = {finding.check: (finding.level, finding.seen) for finding in check_links(links)}
        if wanted.items() <= found.items():
            break
    return found


def found_topics(wanted, *listener):
    """Topics that a listener finds: the ``wanted`` ones, by their names in it, as soon as these are among them."""
    for _, topics in heard(*listener):
        found = {name: getattr(topics, name) for name in wanted}
        if found == wanted:
            break
    return found


def test_one_sender_and_a_listener_are_in_order(monkeypatch):
    with ros_graph(*MAVROS) as graph:
        node = graph.add(PoseEkfNode, bridge_rate=30.0)
        graph.listen(Odometry, 'mavros/odometry/out')
        right = {'receivers': (Level.OK, '1 listen to /mavros/odometry/out')}
        assert found_links(monkeypatch, graph, node, right) == right


def test_of_two_robots_that_of_the_namespace_is_listened_to(monkeypatch):
    with ros_graph() as graph:
        for name in ('drone1', 'drone2'):
            for kind in (PoseEkfNode, LandingTarget):
                graph.added(kind(live=False, context=graph.context, namespace=name))
        for name in ('drone1', 'drone2'):
            right = {'sender': f'/{name}/pose_ekf', 'landing': f'/{name}/landing_target'}
            assert found_topics(right, monkeypatch, None, None, ['-r', f'__ns:=/{name}']) == right


def test_of_several_robots_one_must_be_named(monkeypatch):
    """It verified the first one that it found, without a word."""
    with ros_graph() as graph:
        for name in ('drone1', 'drone2'):
            graph.added(PoseEkfNode(live=False, context=graph.context, namespace=name))
        with pytest.raises(InputError, match='several robots, /drone1, /drone2: name one'):
            # Until both have been discovered.
            list(heard(monkeypatch))


@pytest.mark.parametrize(('bridge_rate', 'topic'), [(30.0, '/mavros/odometry/out'), (0.0, '/a/odom')])
def test_a_remapped_odometry_is_not_taken_for_that_of_the_autopilot(monkeypatch, bridge_rate, topic):
    """Whatever name came first in the alphabet was listened to."""
    with ros_graph(*MAVROS, '-r', 'odometry:=a/odom') as graph:
        node = graph.add(PoseEkfNode, bridge_rate=bridge_rate)
        assert found_topics({'odometry': topic}, monkeypatch, graph, node) == {'odometry': topic}


def test_two_publishers_and_a_missing_subscriber_are_reported(monkeypatch):
    with ros_graph(*MAVROS) as graph:
        node = graph.add(PoseEkfNode, bridge_rate=30.0)
        graph.tester.advertise(Odometry, 'mavros/odometry/out')
        right = {
            'senders': (Level.FAULT, '2 nodes send the odometry'),
            'receivers': (Level.WARNING, '0 listen to /mavros/odometry/out'),
        }
        assert found_links(monkeypatch, graph, node, right) == right


def test_px4_without_its_messages_is_a_fault_though_the_odometry_is_sound(monkeypatch):
    monkeypatch.setitem(sys.modules, 'px4_msgs.msg', None)
    with ros_graph() as graph:
        node = graph.add(PoseEkfNode, bridge_rate=50.0, px4=True)
        right = {'filter': (Level.FAULT, 'pose_ekf says: parameter px4: px4_msgs is not installed')}
        assert found_links(monkeypatch, graph, node, right).items() >= right.items()


def test_px4_is_listened_for_on_its_own_topic(monkeypatch):
    """px4_msgs, for which another message stands, is what PX4 gets; the odometry beside it is what is checked."""
    px4 = ModuleType('px4_msgs.msg')
    px4.VehicleOdometry = TwistStamped
    monkeypatch.setitem(sys.modules, 'px4_msgs', ModuleType('px4_msgs'))
    monkeypatch.setitem(sys.modules, 'px4_msgs.msg', px4)
    monkeypatch.setattr(bridge_listener, 'PX4_KIND', 'geometry_msgs/msg/TwistStamped')
    with ros_graph() as graph:
        node = graph.add(PoseEkfNode, bridge_rate=50.0, px4=True)
        right = {'receivers': (Level.WARNING, '0 listen to /fmu/in/vehicle_visual_odometry')}
        assert found_links(monkeypatch, graph, node, right).items() >= right.items()


def test_the_landing_target_of_another_robot_is_not_listened_to(monkeypatch):
    """That of any robot was taken: a pad that another drone sees passed for the one of the drone that is checked."""
    with ros_graph() as graph:
        for kind, name in ((LandingTarget, 'drone1'), (PoseEkfNode, 'drone2')):
            graph.added(kind(live=False, context=graph.context, namespace=name))
        right = {'sender': '/drone2/pose_ekf', 'landing': '/drone2/landing_target'}
        assert found_topics(right, monkeypatch) == right


def test_a_remapped_landing_target_is_listened_to(monkeypatch):
    with ros_graph('-r', 'landing_target:=mavros/landing_target/pose') as graph:
        for kind in (LandingTarget, PoseEkfNode):
            graph.add(kind)
        right = {'landing': '/mavros/landing_target/pose'}
        assert found_topics(right, monkeypatch) == right
