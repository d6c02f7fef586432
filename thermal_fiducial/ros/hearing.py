"""Notices that a node no longer receives what another one publishes: its DDS participant has gone deaf.

Seen once, in an hour of flight beside other programs that were killed again and again: the mapper lived on but received
nothing for twelve minutes, while the detector published. Only a new participant helps, so the node starts again.
"""

from diagnostic_msgs.msg import DiagnosticArray

from thermal_fiducial.ros import qos
from thermal_fiducial.ros.counting import CountingNode, Input

#: Looks, one a second, without a message after which a node begins to listen for what others published.
_SUSPICIOUS = 3
#: Messages in succession that were published but not received: a second of frames, and more than a queue holds.
_MISSED = 31
#: Looks without anything of anybody, while DDS still counts others: it takes them off its list 20 s after their end.
_NOTHING = 30


class Hearing:
    """Compares what a node receives with what the diagnostics of others say that they publish.

    It subscribes to the diagnostics only while the first input of ``node``, once received, is silent.
    """

    def __init__(self, node: CountingNode) -> None:
        self._node = node
        self._diagnostics: Input | None = None
        self._count = self._looks = 0
        # How many messages each publisher had published when it was heard first.
        self._published: dict[str, int] = {}

    def look(self) -> str:
        """Call it once a second; why the node is deaf, empty if it is not."""
        if not self._node.inputs:
            return ''
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
        if any(self._missed(message, source.topic) for message in self._diagnostics.waiting(qos.RESULT.depth)):
            return f'deaf: {source.topic} is published but does not arrive'
        lonely = not self._published and self._diagnostics.publishers > 1
        return 'deaf: nothing arrives from any node' if lonely and self._looks > _NOTHING else ''

    def _missed(self, message: DiagnosticArray, topic: str) -> bool:
        """Whether diagnostics of another node say that it has published much since they were first received."""
        for status in message.status:
            if status.name == self._node.get_fully_qualified_name().lstrip('/'):
                continue
            values = {item.key: item.value for item in status.values}
            text = values.get(f'published {topic}', '0')
            published = int(text) if text.isdecimal() else 0
            if published - self._published.setdefault(status.name, published) >= _MISSED:
                return True
        return False

    def _stop(self) -> None:
        if self._diagnostics is not None:
            self._node.ignore(self._diagnostics)
        self._diagnostics, self._published = None, {}
