"""How long a node that is killed in flight takes to be back: ``make restart``.

The four nodes in real time, one process each; one after another is killed and started again at once. What counts is the
time until the next pose that goes through it: of the camera for camera front end, detector and mapper, of the robot for
the filter.
"""

import argparse
from functools import partial
import os
from pathlib import Path
import statistics
import tempfile
import time

from geometry_msgs.msg import PoseWithCovarianceStamped
import psutil
from rclpy.context import Context
from soak.laps import lap, Laps, TOPICS

from thermal_fiducial.config import NODES
from thermal_fiducial.files.bags import CAMERA_POSE_TOPIC
from thermal_fiducial.files.images import header_stamp_ns
from thermal_fiducial.replay.children import NodeProcesses
from thermal_fiducial.replay.domain import own_domain
from thermal_fiducial.replay.topics import PLAYED
from thermal_fiducial.ros.base import qos
from thermal_fiducial.ros.base.counting import CountingNode
from thermal_fiducial.ros.messages import convert
from thermal_fiducial.ros.process.run import initialise, make_executor

#: Undisturbed flight before each kill, with which the filter has come into its own again [s].
_BEFORE = 6.0
#: Nobody waits longer than this [s].
_LONGEST = 60.0


class Flight:
    """Plays laps in real time to nodes of its own, and notes when poses come."""

    def __init__(self, context: Context, laps: Laps) -> None:
        self._node = CountingNode('player', context=context, use_global_arguments=False)
        self._executor = make_executor(context)
        self._executor.add_node(self._node)
        #: stamp of the last pose on each topic [ns]
        self.came = dict.fromkeys((CAMERA_POSE_TOPIC, 'pose'), 0)
        #: newest of the messages that were sent, when it was taken [ns]; images are older than the samples before them
        self.stamp_ns = laps.start_ns
        for topic in self.came:
            self._node.subscribe(PoseWithCovarianceStamped, topic, partial(self._note, topic), qos.RESULT)
        self._outputs = {topic: self._node.advertise(PLAYED[topic][0], topic, PLAYED[topic][1]) for topic in TOPICS}
        self._messages, self._ahead = laps.messages(TOPICS), time.monotonic() - laps.start_ns * 1e-9

    def _note(self, topic: str, message: PoseWithCovarianceStamped) -> None:
        self.came[topic] = convert.stamp_ns(message.header.stamp)

    def fly(self, done) -> None:
        """Go on until ``done()``."""
        while not done():
            message = next(self._messages)
            while (left := message.stamp_ns * 1e-9 + self._ahead - time.monotonic()) > 0:
                self._executor.spin_once(timeout_sec=left)
            self._executor.spin_once(timeout_sec=0.0)
            self._outputs[message.topic].send(message.cdr)
            self.stamp_ns = max(self.stamp_ns, header_stamp_ns(message.cdr))

    def close(self) -> None:
        """Leave the graph."""
        self._executor.shutdown()
        self._node.destroy_node()


def back_after(flight: Flight, nodes: NodeProcesses, name: str) -> float:
    """Seconds from the kill of node ``name`` to the next pose."""
    topic = 'pose' if name == 'pose_ekf' else CAMERA_POSE_TOPIC
    begin, begin_ns = time.monotonic(), flight.stamp_ns
    flight.fly(lambda: time.monotonic() - begin > _BEFORE and min(flight.came.values()) > begin_ns)
    nodes.crash(name)
    # Poses of what was under way come still.
    killed, killed_ns = time.monotonic(), flight.stamp_ns
    flight.fly(lambda: flight.came[topic] > killed_ns or time.monotonic() > killed + _LONGEST)
    return time.monotonic() - killed


def measured(rounds: int) -> dict[str, list[float]]:
    """Seconds of each node in each round."""
    context, found = Context(), {name: [] for name in NODES}
    with tempfile.TemporaryDirectory() as folder, own_domain() as domain:
        os.environ['ROS_HOME'] = folder
        initialise(None, context, domain)
        with Laps(Path(folder), lap(small=True), 3600.0) as laps:
            arguments = ['--params-file', f'{laps.folder}/params.yaml', '-p', 'mode:=localization']
            arguments += ['-p', f'map_file:={laps.folder}/map_true.yaml']
            with NodeProcesses(domain, NODES, arguments, Path(folder)) as nodes:
                flight = Flight(context, laps)
                for _ in range(rounds):
                    for name in NODES:
                        found[name].append(back_after(flight, nodes, name))
                flight.close()
        context.try_shutdown()
    return found


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--rounds', type=int, default=3)
    rounds = parser.parse_args().rounds
    print('| node | back with poses after, median / worst [s] |\n|---|---|')
    for name, seconds in measured(rounds).items():
        print(f'| `{name}` | {statistics.median(seconds):.1f} / {max(seconds):.1f} |')
    print(f'load of the machine meanwhile: {psutil.getloadavg()[0]:.1f}')


if __name__ == '__main__':
    main()
