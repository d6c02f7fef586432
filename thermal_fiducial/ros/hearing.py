"""Notices that a node no longer receives what another one publishes: its DDS participant has gone deaf.

A node that hardly got the processor for seconds is taken for dead by whoever opens its port of shared memory then, and
Fast DDS puts a new one in its place: the node goes on to listen to the old one, which others no longer find. Only a new
participant helps, so the node starts again.
"""

from pathlib import Path

from diagnostic_msgs.msg import DiagnosticArray

from thermal_fiducial.ros import qos
from thermal_fiducial.ros.counting import CountingNode, Input

#: Looks, one a second, without a message after which a node begins to listen for what others published.
_SUSPICIOUS = 3
#: Messages in succession that were published but not received: a second of frames, and more than a queue holds.
_MISSED = 31
#: Looks without diagnostics of anybody, while DDS still counts others: it takes them off its list 20 s after their end.
_NOTHING = 28
#: Names of the threads that listen to a port of shared memory, and of the ports' files; a number follows.
_LISTENER, _PORT = 'dds.shm.', '/dev/shm/fastrtps_port'
_DELETED = ' (deleted)'


class Hearing:
    """Compares what a node receives with what the diagnostics of others say that they publish.

    It subscribes to the diagnostics only while the first input of ``node``, once received, is silent.
    """

    def __init__(self, node: CountingNode) -> None:
        self._node = node
        self._diagnostics: Input | None = None
        self._count = self._looks = 0
        # Looks at the diagnostics since those of another node arrived.
        self._nothing = 0
        # How many messages each publisher had published when it was heard first.
        self._published: dict[str, int] = {}

    def look(self, *, stopped: bool) -> str:
        """Call it once a second; why the node is deaf, empty if it is not.

        Parameters
        ----------
        stopped : whether an input that was steady has stopped
        """
        if not self._node.inputs:
            return ''
        if stopped and (ports := replaced_ports()):
            return f'deaf: port {", ".join(ports)} of the shared memory has been replaced'
        source = self._node.inputs[0]
        if source.count != self._count or not source.count:
            self._count, self._looks = source.count, 0
            self._stop()
            return ''
        self._looks += 1
        if self._looks < _SUSPICIOUS:
            return ''
        if self._diagnostics is None:
            self._diagnostics = self._node.observe(DiagnosticArray, '/diagnostics', qos.RESULT)
        self._nothing += 1
        if any(self._missed(message, source.topic) for message in self._diagnostics.waiting(qos.RESULT.depth)):
            return f'deaf: {source.topic} is published but does not arrive'
        lonely = self._nothing > _NOTHING and self._diagnostics.publishers > 1
        return 'deaf: nothing arrives from any node' if lonely else ''

    def _missed(self, message: DiagnosticArray, topic: str) -> bool:
        """Whether diagnostics of another node say that it has published much since they were first received."""
        for status in message.status:
            if status.name == self._node.get_fully_qualified_name().lstrip('/'):
                continue
            self._nothing = 0
            values = {item.key: item.value for item in status.values}
            text = values.get(f'published {topic}', '0')
            published = int(text) if text.isdecimal() else 0
            if published - self._published.setdefault(status.name, published) >= _MISSED:
                return True
        return False

    def _stop(self) -> None:
        if self._diagnostics is not None:
            self._node.ignore(self._diagnostics)
        self._diagnostics, self._published, self._nothing = None, {}, 0


def replaced_ports() -> list[str]:
    """Numbers of the ports of shared memory to which this process listens although others would open new ones."""
    threads = [thread.read_text().strip() for thread in Path('/proc/self/task').glob('*/comm')]
    numbers = [name.removeprefix(_LISTENER) for name in threads if name.startswith(_LISTENER)]
    mapped = {line.partition(_PORT)[2] for line in Path('/proc/self/maps').read_text().splitlines() if _PORT in line}
    return sorted(number for number in numbers if number + _DELETED in mapped and number not in mapped)
