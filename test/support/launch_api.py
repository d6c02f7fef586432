"""Stand-in of ``launch`` and ``launch_ros``, of which there are no wheels: their interface, and what they make of it.

Constructors take the keywords of the originals and no others. :class:`Launch` runs a description: one process a node,
with the command line that ``launch_ros`` gives it.
"""

from contextlib import contextmanager
from dataclasses import dataclass, field
import os
import signal
import subprocess
import sys
import threading
import time
from types import ModuleType, SimpleNamespace

import yaml

from support.waiting import PATIENCE_S


class LaunchContext:
    """Command line, configurations, and whether launch is ending."""

    def __init__(self, argv=()):
        self.argv = list(argv)
        self.launch_configurations = {}
        self.is_shutdown = False


class LaunchDescription:
    def __init__(self, initial_entities=None):
        self.entities = list(initial_entities or [])


class LaunchConfiguration:
    def __init__(self, variable_name, *, default=None):
        self.variable_name, self.default = variable_name, default

    def perform(self, context):
        return context.launch_configurations[self.variable_name]


@dataclass
class DeclareLaunchArgument:
    name: str
    default_value: str | None = field(default=None, kw_only=True)
    description: str | None = field(default=None, kw_only=True)


@dataclass(kw_only=True)
class OpaqueFunction:
    function: object


@dataclass(kw_only=True)
class LogInfo:
    msg: str


@dataclass(kw_only=True)
class TimerAction:
    period: float
    actions: list


class PushLaunchConfigurations:
    pass


class PopLaunchConfigurations:
    pass


@dataclass(kw_only=True)
class Node:
    """``launch_ros.actions.Node`` with those keywords of ``ExecuteProcess`` that are in use."""

    executable: str
    package: str | None = None
    name: str | None = None
    namespace: str | None = None
    parameters: list | None = None
    remappings: list | None = None
    ros_arguments: list | None = None
    arguments: list | None = None
    additional_env: dict | None = None
    output: str = 'log'
    on_exit: object = None

    def full_namespace(self, context):
        """Namespace of the node behind the one that was pushed, unless it is absolute."""
        pushed, own = context.launch_configurations.get('ros_namespace', ''), self.namespace or ''
        joined = own if own.startswith('/') else f'{pushed}/{own}'
        return '/' + joined.strip('/')

    def command_line(self, context, folder):
        """Arguments behind the executable, in the order of launch_ros; dictionaries are written to files."""
        namespace = self.full_namespace(context)
        words = [*(self.arguments or []), '--ros-args', *(self.ros_arguments or [])]
        words += ['--ros-args', '-r', f'__node:={self.name}', '-r', f'__ns:={namespace}']
        for number, item in enumerate(self.parameters or []):
            if isinstance(item, dict):
                file = folder / f'{namespace.replace("/", "_")}_{self.name}_{number}.yaml'
                full_name = f'{namespace.rstrip("/")}/{self.name}'
                file.write_text(yaml.dump({full_name: {'ros__parameters': item}}))
                item = file
            words += ['--params-file', str(item)]
        for source, target in self.remappings or []:
            words += ['-r', f'{source}:={target}']
        return words


class PackageNotFoundError(KeyError):
    """Of ament_index_python."""


def prefix(package):
    """``get_package_prefix`` where only ours is installed."""
    if package != 'thermal_fiducial':
        raise PackageNotFoundError(package)
    return f'/prefix/{package}'


@contextmanager
def installed(monkeypatch, share, also=()):
    """Modules of launch, launch_ros and ament_index_python: our ``share`` folder, other packages ``also`` there."""
    contents = {
        'launch': {'LaunchDescription': LaunchDescription},
        'launch.launch_context': {'LaunchContext': LaunchContext},
        'launch.launch_description': {'LaunchDescription': LaunchDescription},
        'launch.actions': {
            kind.__name__: kind
            for kind in (
                DeclareLaunchArgument,
                OpaqueFunction,
                LogInfo,
                TimerAction,
                PushLaunchConfigurations,
                PopLaunchConfigurations,
            )
        },
        'launch.substitutions': {'LaunchConfiguration': LaunchConfiguration},
        'launch_ros': {},
        'launch_ros.actions': {'Node': Node},
        'ament_index_python': {},
        'ament_index_python.packages': {
            'get_package_share_directory': lambda _: str(share),
            'get_package_prefix': lambda name: f'/prefix/{name}' if name in also else prefix(name),
            'PackageNotFoundError': PackageNotFoundError,
        },
    }
    for name, content in contents.items():
        module = ModuleType(name)
        module.__dict__.update(content)
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.delitem(sys.modules, 'thermal_fiducial.ros.launching', raising=False)
    yield
    sys.modules.pop('thermal_fiducial.ros.launching', None)


def declared(description):
    """Argument to default, as the launch file declares them."""
    return {item.name: item.default_value for item in description.entities if isinstance(item, DeclareLaunchArgument)}


def started(description, context):
    """Actions of a launch file, with the configurations from its declarations and the command line."""
    given = dict(word.split(':=', 1) for word in context.argv)
    context.launch_configurations |= declared(description) | given
    (opaque,) = (item for item in description.entities if isinstance(item, OpaqueFunction))
    return opaque.function(context)


def started_in_turn(actions, context):
    """Nodes of actions, each while ``context`` is as when launch would start it; it is left as it was."""
    stack = []
    for action in actions:
        if isinstance(action, PushLaunchConfigurations):
            stack.append(dict(context.launch_configurations))
        elif isinstance(action, PopLaunchConfigurations):
            context.launch_configurations = stack.pop()
        elif isinstance(action, OpaqueFunction):
            assert action.function(context) is None
        else:
            yield action
    assert not stack


class Launch:
    """Runs actions: a process for each node, and what its ``on_exit`` asks for."""

    def __init__(self, actions, context, folder):
        self.context, self._folder = context, folder
        #: node name to its processes so far
        self.processes = {}
        #: messages of LogInfo
        self.said = []
        self._threads = []
        self._do_all(actions)

    def _do_all(self, actions):
        for action in started_in_turn(actions, self.context):
            self._do(action)

    def _do(self, action):
        if isinstance(action, LogInfo):
            self.said.append(action.msg)
        elif isinstance(action, TimerAction):
            threading.Timer(action.period, self._do_all, [action.actions]).start()
        elif not self.context.is_shutdown:
            self._start(action)

    def _start(self, node):
        command = [sys.executable, '-m', f'thermal_fiducial.nodes.{node.executable}']
        command += node.command_line(self.context, self._folder)
        with (self._folder / f'{node.name}.log').open('a') as log:
            process = subprocess.Popen(command, env=os.environ | node.additional_env, stdout=log, stderr=log)
        name = f'{node.full_namespace(self.context).rstrip("/")}/{node.name}'
        self.processes.setdefault(name, []).append(process)
        thread = threading.Thread(target=self._wait, args=(node, process))
        thread.start()
        self._threads.append(thread)

    def _wait(self, node, process):
        process.wait()
        self._do_all(node.on_exit(SimpleNamespace(returncode=process.returncode), self.context) or [])

    def running(self, name):
        """The newest process of a node."""
        return self.processes[name][-1]

    def log(self, name):
        """What a node has printed."""
        return (self._folder / f'{name}.log').read_text()

    def end(self, between_s=0.01):
        """SIGINT twice, as from a terminal and from launch; exit status by node."""
        self.context.is_shutdown = True
        running = {name: processes[-1] for name, processes in self.processes.items() if processes[-1].poll() is None}
        for pause in (between_s, 0.0):
            for process in running.values():
                process.send_signal(signal.SIGINT)
            time.sleep(pause)
        try:
            return {name: process.wait(PATIENCE_S) for name, process in running.items()}
        finally:
            self.kill()

    def kill(self):
        """End whatever still runs."""
        self.context.is_shutdown = True
        for processes in self.processes.values():
            processes[-1].kill()
        for thread in self._threads:
            thread.join()
