"""Base of the nodes: parameters, error handling of callbacks, diagnostics and console lines once a second.

Unusable input never ends a node: it raises :class:`InputError` in the conversion or in the core, which the guard turns
into a warning and a diagnostic.
"""

from collections.abc import Callable, Iterable
from dataclasses import replace
import time
import traceback
from typing import Any, Generic, TypeVar

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.clock import Clock
from rclpy.clock_type import ClockType

from thermal_fiducial.config import Config, without_effect
from thermal_fiducial.errors import InputError, INTERNAL_ERROR
from thermal_fiducial.files.reading import one_line
from thermal_fiducial.ros.base import params
from thermal_fiducial.ros.base.console import Console
from thermal_fiducial.ros.base.counting import CountingNode
from thermal_fiducial.ros.base.input_rates import InputRates
from thermal_fiducial.ros.base.replaced_ports import replaced_ports
from thermal_fiducial.ros.messages import convert

Made = TypeVar('Made')

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR


#: Parameters with frames of the robot, which get the namespace as a prefix; the map frame is common to all robots.
_ROBOT_FRAMES = ('base_frame', 'camera_frame', 'odom_frame', 'frame_id')
#: Parameters for the expected rate of a node's main input.
_RATES = ('image_rate', 'imu_rate')
#: Longest error message [characters] on console and in diagnostics: it may quote input of any length.
_LONGEST_REASON = 400
#: Diagnostics, one a second, after which the console repeats why messages are refused if it is still the same.
_REPEATED_AFTER = 30
#: Diagnostics after which a second node of the same name, or publisher, counts as alive: DDS takes 20 s to forget one
#: that was killed.
_TWIN_AFTER = 30


class StageNode(CountingNode, Generic[Config]):
    """A node for one stage of the pipeline.

    Parameters
    ----------
    name : of the node
    kind : config dataclass; its fields become the node's parameters
    live : diagnostics run on a wall-clock timer; a lock-step replay passes False, calls :meth:`diagnose` by the bag's
        clock, and gets background work done synchronously
    **kwargs : passed to :class:`rclpy.node.Node`

    Raises
    ------
    InputError
        A parameter that no node has, of the wrong type, out of range, or not among the choices.
    """

    #: number of stages before this one: later stages have a higher priority
    stage = 0

    def __init__(self, name: str, kind: type[Config], *, live: bool = True, **kwargs: Any) -> None:
        super().__init__(name, **kwargs)
        self.live = live
        try:
            self.config = params.declare(self, kind)
        except InputError:
            self.destroy_node()
            raise
        #: called before the node is destroyed
        self.endings: list[Callable[[], None]] = []
        #: called before that at the end of a flight: not when the node is to start again, or has crashed
        self.completions: list[Callable[[], None]] = []
        #: parameter values overridden by the node, for example by TF
        self._derived: dict[str, Any] = {}
        #: prefix of the names of the robot's frames
        self.frame_prefix = ''
        if getattr(self.config, 'prefix_frames', False):
            self.frame_prefix = f'{self.get_namespace()}/'.lstrip('/')
            frames = {name: getattr(self.config, name, '') for name in _ROBOT_FRAMES}
            self.derive(**{name: self.frame_prefix + frame for name, frame in frames.items() if frame})
        asked = int(getattr(self.config, 'realtime_priority', 0))
        #: SCHED_RR priority of the process; 0: ordinary scheduling
        self.realtime_priority = asked + self.stage if asked else 0
        #: messages on faults of the configuration; the node runs without the parts concerned
        self.faults: list[str] = []
        self.refused = 0
        self.last_refusal = ''
        self._diagnosed_refused = 0
        # What the console has said of refusals, and how many diagnostics ago.
        self._logged_refusal, self._since_logged = '', 0
        self._rates = InputRates(self.inputs, _expected_rate(self.config))
        #: why the node cannot go on in this process; see ``run``
        self.deaf = ''
        # Diagnostics in a row for which there has been a second node of this name, or publisher of the main input.
        self._twin_for = self._shared_for = 0
        # That the missing main input has another type.
        self._other_type = ''
        #: console lines for a pilot
        self.console = Console(self.get_logger())
        #: warnings of the configuration, besides parameters that others keep from having an effect
        self.remarks: list[str] = []
        if getattr(self.config, 'prefix_frames', False) and not self.frame_prefix:
            self.remark(['parameter prefix_frames: no effect without a namespace'])
        for line in without_effect(self.config):
            self.get_logger().warning(line)
        self._diagnostics = self.advertise(DiagnosticArray, '/diagnostics')
        params.follow(self, kind, lambda config: self.configure(self._with_derived(config)))
        if live:
            self.create_timer(1.0, self._on_timer, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def derive(self, **values: Any) -> None:
        """Override parameters by ``values``, which also hold after later changes of the parameters.

        Raises
        ------
        InputError
            A value that is invalid for its parameter; none is changed.
        """
        self.config = replace(self._with_derived(self.config), **values)  # type: ignore[type-var]
        self._derived |= values

    def _with_derived(self, config: Config) -> Config:
        return replace(config, **self._derived)  # type: ignore[type-var]

    def configure(self, config: Config) -> None:
        """Apply a config with changed dynamic parameters."""
        self.config = config

    def remark(self, lines: Iterable[str]) -> None:
        """Log warnings of the configuration and keep them in the diagnostics."""
        for line in lines:
            self.remarks.append(line)
            self.get_logger().warning(line)

    def attempt(self, make: Callable[[], Made], default: Made) -> Made:
        """Result of ``make``; if it raises InputError, ``default``, and the error is reported as a fault."""
        try:
            return make()
        except InputError as error:
            self.fault(str(error))
            return default

    def fault(self, reason: str) -> None:
        """Log a fault of the configuration and keep it in the diagnostics."""
        self.faults.append(reason)
        self.get_logger().error(reason)

    def guard(self, callback: Callable[[Any], None], message: Any) -> None:
        """Call ``callback``; warn of unusable input, and log any other exception with its traceback."""
        try:
            callback(message)
        except InputError as error:
            self.refuse(one_line(error, _LONGEST_REASON))
        except Exception as error:
            # Publishing fails during shutdown, which is not an error of the node.
            if self.context.ok():
                self.refuse(self._unforeseen(error))

    def behind_others(self, act: Callable[[], None]) -> None:
        """Call ``act`` after all that the executor has queued; at once in a lock-step replay, which counts messages."""
        if self.live and self.executor is not None:
            self.executor.create_task(act)
        else:
            act()

    def serve(self, kind: Any, name: str, answer: Callable[[Any, Any], Any]) -> None:
        """Offer a service; errors of ``answer`` are reported in the response's ``success`` and ``message``."""

        def guarded(request: Any, response: Any) -> Any:
            try:
                return answer(request, response)
            except InputError as error:
                response.message = one_line(error, _LONGEST_REASON)
            except Exception as error:
                response.message = self._unforeseen(error)
            response.success = False
            return response

        self.create_service(kind, name, guarded)

    def _unforeseen(self, error: Exception) -> str:
        """Log an unexpected exception; returns it as one line."""
        self.get_logger().error(traceback.format_exc(), throttle_duration_sec=1.0)
        return f'{INTERNAL_ERROR}: {type(error).__name__}: {one_line(error)}'

    def refuse(self, reason: str) -> None:
        """Count a refused message; at most one between two diagnostics is logged, and the same one more seldom."""
        first = self.refused == self._diagnosed_refused
        if first and (reason != self._logged_refusal or self._since_logged >= _REPEATED_AFTER):
            self._logged_refusal, self._since_logged = reason, 0
            self.get_logger().warning(reason)
        self.refused += 1
        self.last_refusal = reason

    def state(self) -> tuple[bytes, str]:
        """Diagnostic level and message of the stage while its input is usable."""
        return OK, 'ok'

    def headline(self) -> str:
        """Short status for a pilot, without numbers, as changes of it are printed on the console."""
        return ''

    def figures(self) -> dict[str, object]:
        """Key-value pairs of the stage for the diagnostics."""
        return {}

    def finish(self) -> None:
        """Run the ``completions``: what a flight that ends leaves to do; one that fails is logged."""
        for complete in self.completions:
            try:
                complete()
            except Exception as error:  # the map is still to be saved, in all the time that it takes
                self._unforeseen(error)

    def close(self) -> None:
        """Run the ``endings`` before the node is destroyed, for example to save files."""
        for end in self.endings:
            end()

    def diagnose(self, stamp_ns: int) -> None:
        """Publish the diagnostics of the time since the last call, and print changes of the headline."""
        self.take_waiting()
        self._rates.look(stamp_ns if not self.live or self._on_sim_time else time.monotonic_ns())
        if self.live and not self.deaf:
            self._listen()
            self._look_for_doubles()
            self._other_type = self.other_type(self.inputs[0]) if self._rates.silent else ''
        level, reason = self._level()
        trouble = self._twin or self._other_type or self._rates.trouble()
        self.console.say(trouble or self.headline(), calm=level == OK)
        counts: dict[str, object] = {f'received {source.topic}': source.count for source in self.inputs}
        counts |= {f'left {source.topic}': source.left for source in self.inputs if source.left}
        counts |= {
            f'published {output.topic}': output.count for output in self.outputs if output.topic != '/diagnostics'
        }
        refusals = {'refused messages': self.refused, 'last refusal': self.last_refusal}
        values = {**self.figures(), **refusals, **self._rates.figures(), **counts}
        name = self.get_fully_qualified_name().lstrip('/')
        self._diagnostics.send(convert.diagnostics(name, level, reason, values, stamp_ns))
        self._diagnosed_refused = self.refused
        self._since_logged += 1

    @property
    def _on_sim_time(self) -> bool:
        """Whether ``use_sim_time`` is set: a bag that is played at half speed has its own rates on its own clock."""
        return bool(self.get_parameter('use_sim_time').value)

    def _listen(self) -> None:
        """While an input is missing, find out whether it cannot be heard in this process."""
        if (self._rates.silent or self._rates.stale) and (ports := replaced_ports()):
            self.deaf = f'deaf: port {", ".join(ports)} of the shared memory has been replaced'
            self.get_logger().error(f'{self.deaf}; the node starts again')

    def _look_for_doubles(self) -> None:
        """Count for how long another node has had this one's name, as when a launch file was started twice.

        And for how long the main input has had two publishers: two IMUs, say, which look like one of twice the rate.
        """
        same = self.get_node_names_and_namespaces().count((self.get_name(), self.get_namespace()))
        self._twin_for = self._twin_for + 1 if same > 1 else 0
        self._shared_for = self._shared_for + 1 if self.inputs and self.inputs[0].publishers > 1 else 0

    @property
    def _twin(self) -> str:
        """That a second node of this name publishes the same topics; empty if it is alone."""
        if self._twin_for < _TWIN_AFTER:
            return ''
        return f'a second node is named {self.get_fully_qualified_name()}: was the launch file started twice?'

    def _level(self) -> tuple[bytes, str]:
        """Level and message by precedence: deafness, faults, refused messages, then those of input and stage.

        A refused message hides no error: one among many says nothing of what the others have given.
        """
        if faults := [*filter(None, (self.deaf, self._twin)), *self.faults]:
            return ERROR, '; '.join(faults)
        level, reason = self._level_of_input_and_stage()
        if self.refused > self._diagnosed_refused:
            return (level, f'{self.last_refusal}; {reason}') if level == ERROR else (WARN, self.last_refusal)
        return level, reason

    def _level_of_input_and_stage(self) -> tuple[bytes, str]:
        """Level and message by precedence: missing main input, stage and rates."""
        if self._rates.silent:
            return ERROR if self._rates.stopped else WARN, self._other_type or f'nothing on {self._rates.main}'
        level, reason = self.state()
        shared = f'two publishers on {self._rates.main}' if self._shared_for >= _TWIN_AFTER else ''
        doubts = [*filter(None, [shared, self._rates.doubt()]), *without_effect(self.config), *self.remarks]
        return (max(level, WARN), '; '.join([reason, *doubts])) if doubts else (level, reason)

    def _on_timer(self) -> None:
        self.guard(self.diagnose, self.get_clock().now().nanoseconds)


def _expected_rate(config: object) -> float:
    return next((float(getattr(config, name)) for name in _RATES if hasattr(config, name)), 0.0)
