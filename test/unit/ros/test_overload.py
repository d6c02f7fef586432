"""A node that gets messages faster than it can process them, and one that is not alone."""

from itertools import pairwise
import time

import pytest
from sensor_msgs.msg import CameraInfo, Imu
from support.messages import imu

from thermal_fiducial.config import LandingTargetConfig
from thermal_fiducial.nodes.landing_target import LandingTarget
from thermal_fiducial.nodes.pose_ekf import PoseEkfNode
from thermal_fiducial.ros.base import qos
from thermal_fiducial.ros.base.node import ERROR, StageNode

pytestmark = pytest.mark.ros


class Overloaded(StageNode):
    """While it processes a message two more arrive."""

    def __init__(self, **kwargs):
        super().__init__('overloaded', LandingTargetConfig, **kwargs)
        self.more = self.advertise(CameraInfo, 'frames', qos.IMAGE_OUTPUT)
        self.source = self.subscribe_newest(CameraInfo, 'frames', self._process, qos.IMAGE_INPUT, raw=True)
        self.processed, self.before_ticks = 0, []
        self.create_timer(0.001, lambda: self.before_ticks.append(self.processed))

    def _process(self, _):
        self.processed += 1
        self.more.send(CameraInfo())
        self.more.send(CameraInfo())
        time.sleep(0.01)


def test_a_second_node_of_the_same_name_is_reported(graph, capfd):
    """A launch file that was started twice gave two nodes of each, whose poses an autopilot got in turns."""
    first = graph.add(LandingTarget, live=True, landing_pad=[7])
    graph.diagnose(first)
    second = graph.add(LandingTarget, live=True, landing_pad=[7])
    words = 'a second node is named /landing_target: was the launch file started twice?'
    graph.spin_until(lambda: first.get_node_names_and_namespaces().count(('landing_target', '/')) == 2)
    # Not before DDS has forgotten one that was killed, after 20 s: it is just so at a restart in flight.
    for _ in range(20):
        first.diagnose(0)
    assert words not in capfd.readouterr().err
    for _ in range(10):
        first.diagnose(0)
    assert words in capfd.readouterr().err
    heard = graph.heard['/diagnostics']
    graph.spin_until(lambda: any((s.level, s.message) == (ERROR, words) for array in heard for s in array.status))
    graph.nodes.remove(second)
    second.destroy_node()
    graph.spin_until(lambda: first.get_node_names_and_namespaces().count(('landing_target', '/')) == 1)
    assert words not in graph.diagnose(first)[1]


def test_two_imus_on_one_topic_are_named(graph):
    """They were taken for one of twice the rate, whose axes, sign and units were doubted."""
    node = graph.add(PoseEkfNode, live=True)
    graph.send('imu/data', imu(0))
    second = graph.tester.create_publisher(Imu, 'imu/data', qos.RESULT)
    graph.spin_until(lambda: graph.input(node, 'imu/data').publishers == 2)
    words = 'two publishers on imu/data'
    # Not before DDS has forgotten a driver that was killed, after 20 s.
    for _ in range(20):
        node.diagnose(0)
    graph.send('imu/data', imu(1))
    assert words not in graph.diagnose(node)[1]
    for _ in range(10):
        node.diagnose(0)
    graph.send('imu/data', imu(2))
    assert words in graph.diagnose(node)[1]
    graph.tester.destroy_publisher(second)
    graph.spin_until(lambda: graph.input(node, 'imu/data').publishers == 1)
    node.diagnose(0)
    graph.send('imu/data', imu(3))
    assert words not in graph.diagnose(node)[1]


def test_timers_have_their_turn_in_an_overload(graph):
    """They waited behind an event for each message: a slow detector's diagnostics came seconds apart, then never."""
    node = graph.add(Overloaded, live=True, landing_pad=[7])
    graph.spin_until(lambda: node.more.listeners == 1 and node.source.publishers == 1)
    node.more.send(CameraInfo())
    graph.spin_until(lambda: node.processed >= 60)
    # A tick waits for the message in progress and one before it; more where a busy machine delays the thread of ticks.
    # Behind an event for each message it waited for half of all that had been processed until then.
    ticks = [0, *node.before_ticks, node.processed]
    assert max(after - before for before, after in pairwise(ticks)) <= 10
    assert node.source.left >= 40
