"""Lock-step: the real nodes in one process, over real DDS, deterministic, as fast as they go.

After each message of the bag the executor runs until every published message has been received: each subscription's
count equals that of the publishers on its topic. So no queue ever holds more than one step, nothing is lost or
reordered, and the result does not depend on timing.
"""

from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

from rclpy.context import Context
from rclpy.serialization import deserialize_message

from thermal_fiducial.core.types import SECOND_NS
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.bags import BagMessage
from thermal_fiducial.nodes.aruco_detector import ArucoDetector
from thermal_fiducial.nodes.marker_mapper import MarkerMapperNode
from thermal_fiducial.nodes.pose_ekf import PoseEkfNode
from thermal_fiducial.nodes.tau2_camera import Tau2Camera
from thermal_fiducial.replay.domain import own_domain
from thermal_fiducial.replay.job import LONGEST_GAP_NS, ReplayJob
from thermal_fiducial.replay.own_namespace import kind_of, own_arguments
from thermal_fiducial.replay.recorder import Recorder
from thermal_fiducial.replay.waiting import Wait
from thermal_fiducial.ros.base.counting import CountingNode
from thermal_fiducial.ros.base.node import StageNode
from thermal_fiducial.ros.process.run import initialise, make_executor, OF_A_COMMAND

_KINDS: dict[str, type[StageNode[Any]]] = {
    'tau2_camera': Tau2Camera,
    'aruco_detector': ArucoDetector,
    'marker_mapper': MarkerMapperNode,
    'pose_ekf': PoseEkfNode,
}
#: Longest sleep of the executor [s]: lazy subscriptions (``take_waiting``) do not wake it.
_POLL_S = 0.002


def replay_lockstep(job: ReplayJob) -> dict[str, Any]:
    """Play a bag through the nodes in this process, as fast as they go.

    Returns
    -------
    An empty dictionary: a lock-step replay has no timing for the summary.

    Raises
    ------
    InputError
        A parameter that a node refuses, a fault of the configuration, or a damaged bag.
    """
    context = Context()
    with own_domain() as domain:
        initialise([*OF_A_COMMAND, *job.ros_arguments], context, domain)
        graph = None
        try:
            graph = _Graph(context, job)
            graph.play()
        finally:
            if graph is not None:
                graph.close()
            context.try_shutdown()
    return {}


class _Graph:
    """The nodes, a player and a recorder in one executor."""

    def __init__(self, context: Context, job: ReplayJob) -> None:
        self._job = job
        self._arrived: list[tuple[str, bytes]] = []
        self._order = {topic: index for index, topic in enumerate(job.recorded)}
        quiet: dict[str, Any] = {'context': context, 'enable_rosout': False, 'start_parameter_services': False}
        self._stages: list[StageNode[Any]] = []
        for name in job.nodes:
            make: Callable[..., StageNode[Any]] = _KINDS[kind_of(name)]
            self._stages.append(make(live=False, cli_args=['--ros-args', *own_arguments(name)], **quiet))
        player = CountingNode('player', use_global_arguments=False, **quiet)
        self._played = {topic: player.advertise(kind, topic, profile) for topic, (kind, profile) in job.played.items()}
        recorder = Recorder(self._take, job.recorded, use_global_arguments=False, **quiet)
        self._nodes: list[CountingNode] = [*self._stages, player, recorder]
        self._inputs = [source for node in self._nodes for source in node.inputs]
        self._outputs = [output for node in self._nodes for output in node.outputs]
        topics = Counter(source.topic for source in self._inputs)
        #: outputs that somebody receives, and how many do
        self._received = [(output, topics[output.topic]) for output in self._outputs if output.topic in topics]
        self._executor = make_executor(context)
        for node in self._nodes:
            self._executor.add_node(node)

    def play(self) -> None:
        """Play the bag, with diagnostics once a second of the bag's time."""
        faults = [fault for stage in self._stages for fault in stage.faults]
        if faults:
            raise InputError('; '.join(faults))
        self._connect()
        bag = self._job.bag
        self._settle(bag.start_ns)
        next_diagnosis = bag.start_ns + SECOND_NS
        last_ns = bag.start_ns
        for message in bag.messages(self._played):
            next_diagnosis = max(next_diagnosis, message.stamp_ns - LONGEST_GAP_NS)
            while message.stamp_ns >= next_diagnosis:
                self._diagnose(next_diagnosis)
                self._job.progress(next_diagnosis - bag.start_ns)
                next_diagnosis += SECOND_NS
            _check(message, self._job.played[message.topic][0])
            self._played[message.topic].send(message.cdr)
            self._settle(message.stamp_ns)
            last_ns = message.stamp_ns
        # At the last message, not a full second later: rates would include the time after the end.
        self._diagnose(max(last_ns, next_diagnosis - SECOND_NS + 1))
        for stage in self._stages:
            stage.finish()

    def _diagnose(self, time_ns: int) -> None:
        for stage in self._stages:
            stage.diagnose(time_ns)
        self._settle(time_ns)

    def _take(self, topic: str, data: bytes) -> None:
        self._arrived.append((topic, data))

    def _connect(self) -> None:
        """Wait until DDS has matched publishers and subscriptions at both ends."""
        readers, writers = (Counter(end.topic for end in ends) for ends in (self._inputs, self._outputs))
        self._wait(lambda: [output.topic for output in self._outputs if output.listeners != readers[output.topic]])
        self._wait(lambda: [source.topic for source in self._inputs if source.publishers != writers[source.topic]])

    def _settle(self, time_ns: int) -> None:
        """Run callbacks until no message is in transit; record the received ones in a fixed order of topics."""
        self._wait(self._under_way)
        self._arrived.sort(key=lambda entry: self._order[entry[0]])
        for topic, data in self._arrived:
            self._job.files.add(topic, time_ns, data)
        self._arrived.clear()

    def _under_way(self) -> list[str]:
        """Topics with messages in transit; none if the sums are equal, as no topic receives more than was sent."""
        sent = sum([output.count * readers for output, readers in self._received])
        if sent == sum([source.count for source in self._inputs]):
            return []
        left: Counter[str] = Counter()
        for output, readers in self._received:
            left[output.topic] += output.count * readers
        for source in self._inputs:
            left[source.topic] -= source.count
        return [topic for topic, count in left.items() if count]

    def _wait(self, missing: Callable[[], list[str]]) -> None:
        """Run callbacks until ``missing`` returns nothing, however long one callback takes."""
        wait = Wait(lambda: f'messages on {", ".join(missing())}', self._job.warn)
        while missing():
            self._job.check_interrupt()
            self._executor.spin_once(timeout_sec=_POLL_S)
            for stage in self._stages:
                stage.take_waiting()
            wait.go_on(sum([source.count for source in self._inputs]))

    def close(self) -> None:
        """Close the nodes (which saves the map) and destroy all of them, even if one fails to close."""
        with ExitStack() as ending:
            for node in reversed(self._nodes):
                ending.callback(node.destroy_node)
            ending.callback(self._executor.shutdown)
            for stage in reversed(self._stages):
                ending.callback(stage.close)


def _check(message: BagMessage, kind: type) -> None:
    """Raise InputError for a message that is no ``kind``, which DDS would drop silently."""
    try:
        deserialize_message(message.cdr, kind)
    except Exception:  # rclpy's own error class is private
        raise InputError(f'message on {message.topic} recorded at {message.stamp_ns} cannot be decoded') from None
