"""Base of the four nodes: topics that count, parameters, a guard round each callback, diagnostics once a second.

A node lives on whatever it is given: a message that cannot be used raises :class:`InputError` in the conversion or in
the core, the guard turns it into a warning and a diagnostic. The counts make diagnostics, and tell a lock-step replay
when everything that was published has been received.
"""

from collections.abc import Callable
import traceback
from typing import Any, Generic, TypeVar

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node
from rclpy.qos import QoSProfile

from thermal_fiducial.errors import InputError, INTERNAL_ERROR
from thermal_fiducial.ros import convert, params, qos

Config = TypeVar('Config')
Made = TypeVar('Made')

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR


class Output:
    """A publisher that counts."""

    def __init__(self, publisher: Any) -> None:
        self.topic: str = publisher.topic_name
        self.count = 0
        self._publisher = publisher

    def send(self, message: Any) -> None:
        """Publish a message, or the bytes of one."""
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
        #: messages that were taken, or left for newer ones
        self.count = 0
        #: messages that were left because a newer one had come when their turn was
        self.left = 0
        self._subscription: Any = None

    def attach(self, subscription: Any) -> None:
        """Remember the subscription that counts here."""
        self._subscription = subscription

    @property
    def publishers(self) -> int:
        """Number of matched publishers."""
        return int(self._subscription.get_publisher_count())


class CountingNode(Node):
    """A node that knows how much came in and went out on each of its topics."""

    def __init__(self, name: str, **kwargs: Any) -> None:
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
        """Call ``callback`` with every message (its bytes if ``raw``)."""
        source = Input(self.resolve_topic_name(topic))

        def receive(message: Any) -> None:
            source.count += 1
            self.guard(callback, message)

        source.attach(self.create_subscription(kind, topic, receive, profile, raw=raw))
        self.inputs.append(source)
        return source

    def subscribe_newest(self, kind: type, topic: str, callback: Callable[[Any], None], profile: QoSProfile) -> Input:
        """Call ``callback`` with the newest message that has come; what is older by then is left and counted.

        The executor takes a task after the messages that were waiting before it, so the task finds the last of them.
        Executors that take turns otherwise go through all that ``profile`` keeps.
        """
        waiting: list[Any] = []

        def work() -> None:
            source.count += 1
            self.guard(callback, waiting.pop())

        def receive(message: Any) -> None:
            if waiting:
                source.count += 1
                source.left += 1
                waiting[:] = [message]
                return
            waiting.append(message)
            if self.executor is None:
                work()
            else:
                self.executor.create_task(work)

        source = Input(self.resolve_topic_name(topic))
        source.attach(self.create_subscription(kind, topic, receive, profile))
        self.inputs.append(source)
        return source

    def guard(self, callback: Callable[[Any], None], message: Any) -> None:
        """Call ``callback``; what a node makes of unusable input is its own matter."""
        callback(message)


class StageNode(CountingNode, Generic[Config]):
    """A node round one stage of the pipeline.

    Parameters
    ----------
    name : of the node
    kind : config dataclass; its fields become the node's parameters
    live : diagnostics by the wall clock; a replay in lock-step calls :meth:`diagnose` itself, by the bag's clock, and
        has background work done in the foreground
    **kwargs : of :class:`rclpy.node.Node`

    Raises
    ------
    InputError
        A parameter that no node has, of the wrong type, out of range, or not among the choices.
    """

    def __init__(self, name: str, kind: type[Config], *, live: bool = True, **kwargs: Any) -> None:
        super().__init__(name, **kwargs)
        self.live = live
        #: of its process under SCHED_FIFO; 0: ordinary
        self.realtime_priority = 0
        try:
            self.config = params.declare(self, kind)
        except InputError:
            self.destroy_node()
            raise
        #: what was configured and cannot be used, in words; the node does without it
        self.faults: list[str] = []
        self._refused = 0
        self._refusal = ''
        self._diagnosed_inputs: dict[str, int] = {}
        self._diagnosed_refused = 0
        #: times in a row that the main input was silent, and what the console had last
        self._silent, self._said = 0, ''
        self._diagnostics = self.advertise(DiagnosticArray, '/diagnostics')
        params.follow(self, kind, self.configure)
        if live:
            self.create_timer(1.0, self._on_timer, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def configure(self, config: Config) -> None:
        """Take over a config with other live parameters."""
        self.config = config

    def attempt(self, make: Callable[[], Made], default: Made) -> Made:
        """What ``make`` makes of something configured; ``default``, and a fault, if that cannot be used."""
        try:
            return make()
        except InputError as error:
            self.fault(str(error))
            return default

    def fault(self, reason: str) -> None:
        """Remember, log and report something configured that cannot be used."""
        self.faults.append(reason)
        self.get_logger().error(reason)

    def guard(self, callback: Callable[[Any], None], message: Any) -> None:
        """Call ``callback``; warn of unusable input and live on.

        What nobody foresaw is logged with its traceback: a node that dies in flight helps nobody find it.
        """
        try:
            callback(message)
        except InputError as error:
            self.refuse(str(error))
        except Exception as error:
            self.refuse(self._unforeseen(error))

    def serve(self, kind: Any, name: str, answer: Callable[[Any, Any], Any]) -> None:
        """A service; what ``answer`` cannot do is said in the response, which has ``success`` and ``message``."""

        def guarded(request: Any, response: Any) -> Any:
            try:
                return answer(request, response)
            except InputError as error:
                response.message = str(error)
            except Exception as error:
                response.message = self._unforeseen(error)
            response.success = False
            return response

        self.create_service(kind, name, guarded)

    def _unforeseen(self, error: Exception) -> str:
        """Log an error that nobody foresaw, and say it in a line."""
        self.get_logger().error(traceback.format_exc(), throttle_duration_sec=1.0)
        return f'{INTERNAL_ERROR}: {type(error).__name__}: {error}'

    def refuse(self, reason: str) -> None:
        """Count a message that could not be used; the first and then one a second is logged."""
        if self._refused == self._diagnosed_refused:
            self.get_logger().warning(reason)
        self._refused += 1
        self._refusal = reason

    def state(self) -> tuple[bytes, str]:
        """Level and reason in words of a stage that gets usable input."""
        return OK, 'ok'

    def headline(self) -> str:
        """What a pilot must know of the stage, in few words without numbers: a change of it goes to the console."""
        return ''

    def figures(self) -> dict[str, object]:
        """Numbers of the stage for the diagnostics."""
        return {}

    def close(self) -> None:
        """Last work before the node is destroyed: save what must be saved."""

    def diagnose(self, stamp_ns: int) -> None:
        """Publish the diagnostics of the time since the last call."""
        level, reason = self._level()
        self._say(level)
        counts: dict[str, object] = {f'received {source.topic}': source.count for source in self.inputs}
        counts |= {f'left {source.topic}': source.left for source in self.inputs if source.left}
        counts |= {
            f'published {output.topic}': output.count for output in self.outputs if output.topic != '/diagnostics'
        }
        values = {**self.figures(), 'refused messages': self._refused, 'last refusal': self._refusal, **counts}
        name = self.get_fully_qualified_name().lstrip('/')
        self._diagnostics.send(convert.diagnostics(name, level, reason, values, stamp_ns))
        self._diagnosed_inputs = {source.topic: source.count for source in self.inputs}
        self._diagnosed_refused = self._refused

    def _level(self) -> tuple[bytes, str]:
        if self.faults:
            return ERROR, '; '.join(self.faults)
        if self._refused > self._diagnosed_refused:
            return WARN, self._refusal
        source = self.inputs[0] if self.inputs else None
        if source is not None and source.count == self._diagnosed_inputs.get(source.topic, 0):
            # A shutter takes half a second; whoever gets nothing for two, and had something, does nothing any more.
            self._silent += 1
            return ERROR if self._stopped else WARN, f'no {source.topic.lstrip("/")}'
        self._silent = 0
        return self.state()

    @property
    def _stopped(self) -> bool:
        return self._silent > 1 and self.inputs[0].count > 0

    def _say(self, level: bytes) -> None:
        """A line on the console where what a pilot must know has changed: one a second at most, as it is looked at."""
        words, topic = self.headline(), self.inputs[0].topic.lstrip('/') if self.inputs else ''
        if topic and not self.inputs[0].count:
            words = f'waiting for {topic}'
        elif topic and self._stopped:
            words = f'{topic} has stopped'
        if words == self._said:
            return
        self._said = words
        # Two lines of code, as rclpy takes no two severities from one.
        if words and level == OK:
            self.get_logger().info(words)
        elif words:
            self.get_logger().warning(words)

    def _on_timer(self) -> None:
        self.guard(self.diagnose, self.get_clock().now().nanoseconds)
