"""One process a node, in real time as on the robot; measures latencies and processor load."""

from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
import tempfile
import time
from typing import Any

from rclpy.context import Context

from thermal_fiducial.core.types import SECOND_NS
from thermal_fiducial.files.bags import (
    BagMessage,
    CAMERA_INFO_TOPIC,
    COMPRESSED_TOPIC,
    IMAGE_TOPIC,
    IMU_TOPIC,
)
from thermal_fiducial.files.images import header_stamp_ns
from thermal_fiducial.files.reading import naming
from thermal_fiducial.replay.children import NodeProcesses
from thermal_fiducial.replay.domain import own_domain
from thermal_fiducial.replay.job import LONGEST_GAP_NS, ReplayJob
from thermal_fiducial.replay.latency import LatencyMeter
from thermal_fiducial.replay.recorder import Recorder
from thermal_fiducial.replay.waiting import Wait
from thermal_fiducial.ros.base.counting import CountingNode
from thermal_fiducial.ros.process.low_latency import prompt
from thermal_fiducial.ros.process.run import initialise, make_executor, OF_A_COMMAND

#: Time for the nodes to match among themselves after both ends of each topic are in the graph [s].
_MATCHING_S = 0.7
#: The replay ends after this time without messages while all nodes are idle; polling period of that check [s].
_SILENCE_S, _GLANCE_S = 1.5, 0.05
#: Least time to the next message in which recorded messages are written to disk [ns].
_SPARE_NS = 2_000_000
#: SCHED_RR priority of the player, if the user may set one: the nodes must not delay its measurements.
_PRIORITY = 5
#: Number of messages read ahead; reading a chunk of a bag takes 25 ms.
_AHEAD = 60
_KINDS = {IMAGE_TOPIC: 'image', COMPRESSED_TOPIC: 'image', IMU_TOPIC: 'imu'}


def replay_processes(job: ReplayJob, rate: float, say: Callable[[str], None]) -> dict[str, Any]:
    """Play a bag through one process a node, at ``rate`` times real time.

    ``say`` is called with a line on the DDS domain of the nodes.

    Returns
    -------
    ``latency_ms`` and ``cpu_percent`` for the summary, and the player's largest delay.

    Raises
    ------
    InputError
        A parameter that a node refuses, or a damaged bag.
    RunError
        A node died.
    """
    context = Context()
    with own_domain() as domain:
        initialise(OF_A_COMMAND, context, domain)
        say(f'the nodes run in DDS domain {domain} of this computer: listen with ROS_DOMAIN_ID={domain}')
        try:
            with (
                tempfile.TemporaryDirectory(prefix='thermal_fiducial_') as folder,
                NodeProcesses(domain, job.nodes, job.ros_arguments, Path(folder)) as processes,
            ):
                player = _Player(context, job)
                try:
                    player.connect(processes)
                    with prompt(_PRIORITY):
                        timing = player.play(processes, rate)
                finally:
                    player.close()
            for fault in processes.unclean:
                job.warn(f'at the end, {fault}')
            return timing
        finally:
            context.try_shutdown()


@dataclass(frozen=True)
class _Clock:
    """Relates the time of a bag to the monotonic clock of this machine, from the moment at which it is made."""

    bag_start_ns: int
    #: seconds of the bag in a second
    rate: float
    start_ns: int = field(default_factory=time.monotonic_ns)

    def due_ns(self, stamp_ns: int) -> int:
        """When a message of the bag is due, by the monotonic clock."""
        return self.start_ns + round((stamp_ns - self.bag_start_ns) / self.rate)

    def bag_ns(self, now_ns: int) -> int:
        """The bag's time, not before its start."""
        return self.bag_start_ns + max(0, round((now_ns - self.start_ns) * self.rate))


class _Player:
    """Publishes the bag on time, and between its messages receives the nodes' outputs."""

    def __init__(self, context: Context, job: ReplayJob) -> None:
        quiet: dict[str, Any] = {
            'context': context,
            'use_global_arguments': False,
            'enable_rosout': False,
            'start_parameter_services': False,
        }
        self._job = job
        self._arrived: deque[tuple[str, bytes, int]] = deque()
        self._latency = LatencyMeter()
        self._player = CountingNode('player', **quiet)
        self._recorder = Recorder(self._take, job.recorded, **quiet)
        self._outputs = {
            topic: self._player.advertise(kind, topic, profile) for topic, (kind, profile) in job.played.items()
        }
        self._executor = make_executor(context)
        self._executor.add_node(self._player)
        self._executor.add_node(self._recorder)

    def connect(self, processes: NodeProcesses) -> None:
        """Wait until the nodes are connected."""
        # camera_info is read by the detector and by the mapper.
        readers = {CAMERA_INFO_TOPIC: len({'aruco_detector', 'marker_mapper'} & set(self._job.nodes))}
        wait = Wait(lambda: f'the nodes at {", ".join(missing)}', self._job.warn)
        while missing := [
            *(topic for topic, output in self._outputs.items() if output.listeners < readers.get(topic, 1)),
            *(source.topic for source in self._recorder.inputs if source.publishers < 1),
        ]:
            processes.check()
            self._job.check_interrupt()
            self._executor.spin_once(timeout_sec=0.05)
            wait.go_on(missing)
        deadline = time.monotonic() + _MATCHING_S
        while time.monotonic() < deadline:
            self._executor.spin_once(timeout_sec=0.05)

    def play(self, nodes: NodeProcesses, rate: float) -> dict[str, Any]:
        """Publish the bag; then wait for the last results."""
        bag = self._job.bag
        cpu = nodes.cpu_seconds()
        clock, late_ns, next_check = _Clock(bag.start_ns, rate), 0, 0
        begun_ns, last_ns = clock.start_ns, bag.start_ns
        for message in _read_ahead(bag.messages(self._outputs)):
            clock, last_ns = self._past_gap(clock, last_ns, message.stamp_ns), message.stamp_ns
            due_ns = clock.due_ns(message.stamp_ns)
            self._spin_until(due_ns, clock)
            self._job.check_interrupt()
            now = time.monotonic_ns()
            late_ns = max(late_ns, now - due_ns)
            if message.topic in _KINDS:
                with naming(f'{message.topic} at {message.stamp_ns}'):
                    self._latency.sent(_KINDS[message.topic], header_stamp_ns(message.cdr), now)
            self._outputs[message.topic].send(message.cdr)
            elapsed = message.stamp_ns - bag.start_ns
            if elapsed >= next_check:
                nodes.check()
                self._job.progress(elapsed)
                next_check = elapsed + SECOND_NS
        seconds = (time.monotonic_ns() - begun_ns) / SECOND_NS
        used = {node: total - cpu[node] for node, total in nodes.cpu_seconds().items()}
        self._drain(nodes, clock)
        self._latency.write(self._job.files.folder / 'latency.csv')
        return {
            'rate': rate,
            'latency_ms': self._latency.summary(),
            'cpu_percent': {node: 100.0 * value / seconds for node, value in used.items()},
            'player_late_ms': late_ns * 1e-6,
        }

    def _past_gap(self, clock: _Clock, last_ns: int, stamp_ns: int) -> _Clock:
        """The clock from the message at ``stamp_ns`` of the bag on, a minute at most after that at ``last_ns``."""
        end_ns = last_ns + LONGEST_GAP_NS
        if stamp_ns <= end_ns:
            return clock
        self._spin_until(clock.due_ns(end_ns), clock)
        self._file_all(clock)
        return replace(clock, start_ns=clock.start_ns - round((stamp_ns - end_ns) / clock.rate))

    def _drain(self, nodes: NodeProcesses, clock: _Clock) -> None:
        """Receive the remaining outputs until all topics are silent and all nodes idle; slow machines may take long."""
        heard, idle = -1, 0
        while idle * _GLANCE_S < _SILENCE_S:
            nodes.check()
            self._spin_until(time.monotonic_ns() + round(_GLANCE_S * SECOND_NS), clock)
            if heard != (heard := sum(source.count for source in self._results())):
                idle = 0
            idle += not nodes.working
        self._file_all(clock)

    def _results(self) -> list[Any]:
        """Recorded topics that fall silent after the bag's end, so without diagnostics."""
        return [source for source in self._recorder.inputs if source.topic != '/diagnostics']

    def _take(self, topic: str, data: bytes) -> None:
        now = time.monotonic_ns()
        self._arrived.append((topic, data, now))
        if topic == 'pose':
            self._latency.pose(header_stamp_ns(data), now)
        elif topic == 'camera_pose':
            self._latency.camera_pose(header_stamp_ns(data), now)

    def _spin_until(self, due_ns: int, clock: _Clock) -> None:
        while (left := due_ns - time.monotonic_ns()) > 0:
            self._job.check_interrupt()
            if self._arrived and left > _SPARE_NS:
                self._executor.spin_once(timeout_sec=0.0)
                self._file_one(clock)
            else:
                self._executor.spin_once(timeout_sec=left / SECOND_NS)

    def _file_all(self, clock: _Clock) -> None:
        while self._arrived:
            self._file_one(clock)

    def _file_one(self, clock: _Clock) -> None:
        topic, data, now = self._arrived.popleft()
        self._job.files.add(topic, clock.bag_ns(now), data)

    def close(self) -> None:
        """Destroy the player's nodes."""
        self._executor.shutdown()
        self._player.destroy_node()
        self._recorder.destroy_node()


def _read_ahead(messages: Iterator[BagMessage]) -> Iterator[BagMessage]:
    """``messages``, read ahead by another thread."""
    with ThreadPoolExecutor(1) as reader:
        ahead = deque(reader.submit(next, messages, None) for _ in range(_AHEAD))
        while (message := ahead.popleft().result()) is not None:
            ahead.append(reader.submit(next, messages, None))
            yield message
