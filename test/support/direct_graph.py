"""The real nodes, joined by calls instead of by DDS: what one publishes the others receive at once."""

from collections import defaultdict
from collections.abc import Callable
from functools import partial
from typing import Any

from rclpy.parameter import Parameter
from rclpy.serialization import deserialize_message, serialize_message

_LATCHED = ('/marker_map', '/thermal/camera_info')


class DirectGraph:
    """Nodes in one process with every check, conversion and guard of theirs; only the transport is left out."""

    def __init__(self, context: Any) -> None:
        self._context = context
        self.nodes: dict[str, Any] = {}
        self._readers: dict[str, list[tuple[str, Any, Callable[[Any], None]]]] = defaultdict(list)
        self._heard: dict[str, list[Callable[[Any], None]]] = defaultdict(list)
        self._latched: dict[str, Any] = {}

    def start(self, kind: type, namespace: str = '', **parameters: Any) -> Any:
        """Make a node; parameters with a double underscore for the dot."""
        overrides = [Parameter(name.replace('__', '.'), value=value) for name, value in parameters.items()]
        node = self._joined(kind)(
            live=False,
            context=self._context,
            namespace=namespace or None,
            parameter_overrides=overrides,
            enable_rosout=False,
            start_parameter_services=False,
        )
        name = node.get_fully_qualified_name().lstrip('/')
        self.nodes[name] = node
        callbacks = [(subscription, subscription.callback) for subscription in node.subscriptions]
        # What would wait until a frame wants it comes at once.
        callbacks += [(subscription, partial(node.guard, subscription.callback)) for subscription in node.lazy]
        for subscription, callback in callbacks:
            topic = subscription.topic_name
            self._readers[topic].append((name, subscription, callback))
            if topic in self._latched:
                _deliver(subscription, callback, self._latched[topic])
        return node

    def _joined(self, kind: type) -> type:
        """The class of a node whose outputs send through here from the first message on."""

        def advertise(node: Any, message_kind: type, *arguments: Any) -> Any:
            output = kind.advertise(node, message_kind, *arguments)
            output.send = lambda sent: self.send(output.topic, _message(sent, message_kind))
            return output

        return type(kind.__name__, (kind,), {'advertise': advertise})

    def kill(self, name: str) -> None:
        """End a node at once, without its farewell."""
        for topic, readers in self._readers.items():
            self._readers[topic] = [reader for reader in readers if reader[0] != name]
        self.nodes.pop(name).destroy_node()

    def listen(self, topic: str, callback: Callable[[Any], None]) -> None:
        """Call ``callback`` with each message of a topic, while it is being sent, and the last of a latched one."""
        if topic in self._latched:
            callback(self._latched[topic])
        self._heard[topic].append(callback)

    def send(self, topic: str, message: Any) -> None:
        """Hand a message to all that subscribe to its topic."""
        if topic in _LATCHED:
            self._latched[topic] = message
        for callback in self._heard[topic]:
            callback(message)
        for _, subscription, callback in self._readers[topic]:
            _deliver(subscription, callback, message)

    def send_encoded(self, topic: str, kind: type, data: bytes) -> None:
        """Hand the bytes of a message to all that subscribe to its topic; nothing else hears of it."""
        for _, subscription, callback in self._readers[topic]:
            callback(data if subscription.raw else deserialize_message(data, kind))

    def close(self) -> None:
        """End all nodes."""
        for name in list(self.nodes):
            self.kill(name)


def _message(sent: Any, kind: type) -> Any:
    """What a node sends, as others read it: nodes also publish the bytes of a message."""
    return deserialize_message(bytes(sent), kind) if isinstance(sent, (bytes, bytearray)) else sent


def _deliver(subscription: Any, callback: Callable[[Any], None], message: Any) -> None:
    callback(serialize_message(message) if subscription.raw else message)
