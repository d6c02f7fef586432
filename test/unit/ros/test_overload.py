"""A node that gets messages faster than it can process them."""

from itertools import pairwise
import time

import pytest
from sensor_msgs.msg import CameraInfo

from thermal_fiducial.config import LandingTargetConfig
from thermal_fiducial.ros.base import qos
from thermal_fiducial.ros.base.node import StageNode

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
