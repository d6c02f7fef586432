"""A node that counts received and published messages.

A lock-step replay compares the counts to know when every published message has been received.
"""

from collections.abc import Callable, Iterator
from typing import Any

from rclpy.node import Node
from rclpy.qos import QoSProfile

from thermal_fiducial.ros.base import qos


class Output:
    """A publisher that counts."""

    def __init__(self, publisher: Any) -> None:
        self.topic: str = publisher.topic_name
        self.count = 0
        self._publisher = publisher

    def send(self, message: Any) -> None:
        """Publish a message, serialised or not."""
        self.count += 1
        self._publisher.publish(message)

    @property
    def listeners(self) -> int:
        """Number of matched subscriptions."""
        return int(self._publisher.get_subscription_count())


class Input:
    """A subscription that counts."""

    def __init__(self, topic: str) -> None:
        self.topic = topic
        #: messages taken, and those replaced in the queue that are known of
        self.count = 0
        #: messages skipped because a newer one had arrived, here or in the queue of DDS
        self.left = self._left_before = 0
        # The publisher's number of the message that was taken last; 0: not known.
        self._number = 0
        #: of rclpy: what is counted
        self.subscription: Any = None
        #: whether it comes at a rate, and is missed when it stops; else when there is something new
        self.regular = True
        #: message that waits for :meth:`CountingNode.behind_others`
        self.pending: Any = None

    def newest(self, message: Any, at_most: int) -> Any:
        """The newest of a message that has been counted and those queued behind it, of which ``at_most`` are taken.

        Counts those skipped, and those that newer ones have replaced in the queue, which must hold two or more: the
        executor passes messages on without their numbers, so the number of the second one shows what is missing.
        """
        self._number += bool(self._number)
        for _ in range(at_most):
            taken = self.take()
            if taken is None:
                break
            message, info = taken
            replaced = self._replaced_before(info['publication_sequence_number'] or 0)
            self.count += replaced
            self.left += 1 + replaced
        return message

    def _replaced_before(self, number: int) -> int:
        """How many messages were replaced before the one with this number, of the only publisher; 0: not known."""
        before, self._number = self._number, number
        if before and number > before + 1 and self.publishers == 1:
            return number - before - 1
        return 0

    def left_since(self) -> int:
        """Number of messages skipped since the last call."""
        left, self._left_before = self.left - self._left_before, self.left
        return left

    def take(self) -> tuple[Any, dict[str, Any]] | None:
        """Take and count the oldest queued message; returns it and rclpy's information on it, None if there is none."""
        subscription = self.subscription
        with subscription.handle:
            taken = subscription.handle.take_message(subscription.msg_type, subscription.raw)
        if taken is None:
            return None
        self.count += 1
        message, info = taken
        return message, info

    def waiting(self, at_most: int) -> Iterator[Any]:
        """Take and count queued messages, ``at_most`` so many."""
        for _ in range(at_most):
            taken = self.take()
            if taken is None:
                return
            yield taken[0]

    @property
    def publishers(self) -> int:
        """Number of matched publishers."""
        return int(self.subscription.get_publisher_count())


class CountingNode(Node):
    """A node that counts messages on each of its topics."""

    def __init__(self, name: str, **kwargs: Any) -> None:
        #: subscriptions that the executor ignores: their messages stay queued until :meth:`take_waiting`
        self.lazy: dict[Any, Input] = {}
        super().__init__(name, **kwargs)
        self.inputs: list[Input] = []
        self.outputs: list[Output] = []

    def advertise(self, kind: type, topic: str, profile: QoSProfile = qos.RESULT) -> Output:
        """A publisher of messages of ``kind``."""
        output = Output(self.create_publisher(kind, topic, profile))
        self.outputs.append(output)
        return output

    def subscribe(
        self, kind: type, topic: str, callback: Callable[[Any], None], profile: QoSProfile, *, raw: bool = False
    ) -> Input:
        """Call ``callback`` with every message (serialised if ``raw``)."""
        source = Input(self.resolve_topic_name(topic))

        def receive(message: Any) -> None:
            source.count += 1
            self.guard(callback, message)

        source.subscription = self.create_subscription(kind, topic, receive, profile, raw=raw)
        self.inputs.append(source)
        return source

    def subscribe_newest(
        self, kind: type, topic: str, callback: Callable[[Any], None], profile: QoSProfile, *, raw: bool = False
    ) -> Input:
        """Call ``callback`` with the newest message; older ones are skipped and counted, also those beyond the queue.

        Lazy subscriptions (:meth:`subscribe_lazily`) are taken first. EventsExecutor queues an event for each message
        behind all others: where messages come faster than they are processed, timers and services would wait ever
        longer. So a message is only taken in its turn, and processed behind what has been queued until then.
        """
        source = Input(self.resolve_topic_name(topic))

        def process() -> None:
            message, source.pending = source.pending, None
            self.take_waiting()
            self.guard(callback, message)

        def receive(message: Any) -> None:
            source.count += 1
            queued = source.pending is not None
            source.left += queued
            source.pending = source.newest(message, profile.depth)
            if not queued:
                self.behind_others(process)

        source.subscription = self.create_subscription(kind, topic, receive, profile, raw=raw)
        self.inputs.append(source)
        return source

    def subscribe_lazily(self, kind: type, topic: str, callback: Callable[[Any], None], profile: QoSProfile) -> Input:
        """Leave messages in the queue of ``profile``; :meth:`take_waiting` passes them to ``callback``, serialised.

        They do not wake the executor, since they are needed with the next frame only.
        """
        source = Input(self.resolve_topic_name(topic))
        subscription = self.create_subscription(kind, topic, callback, profile, raw=True)
        source.subscription = subscription
        self.inputs.append(source)
        self.lazy[subscription] = source
        return source

    def other_type(self, source: Input) -> str:
        """That the topic of an input has messages of another type, which DDS keeps from it without a word; or empty."""
        kind = source.subscription.msg_type
        own = f'{kind.__module__.partition(".")[0]}/msg/{kind.__name__}'
        types = {publisher.topic_type for publisher in self.get_publishers_info_by_topic(source.topic)}
        return f'{source.topic.lstrip("/")} is of {min(types - {own})}, and not {own}' if types - {own} else ''

    @property
    def subscriptions(self) -> Iterator[Any]:
        """Subscriptions that the executor serves."""
        return (item for item in super().subscriptions if item not in self.lazy)

    def take_waiting(self) -> None:
        """Take all queued messages of the lazy subscriptions, in the order of subscription."""
        for subscription, source in self.lazy.items():
            for message in source.waiting(subscription.qos_profile.depth):
                self.guard(subscription.callback, message)

    def behind_others(self, act: Callable[[], None]) -> None:
        """Call ``act``; subclasses that share an executor with timers and services let these go first."""
        act()

    def guard(self, callback: Callable[[Any], None], message: Any) -> None:
        """Call ``callback``; subclasses handle its errors."""
        callback(message)
