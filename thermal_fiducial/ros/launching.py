"""Common code of the launch files. Needs ROS's ``launch`` and ``launch_ros``, which are not on PyPI."""

from collections.abc import Iterable, Mapping
import difflib
import os
from pathlib import Path
import signal
from typing import Any

from ament_index_python.packages import get_package_prefix, get_package_share_directory, PackageNotFoundError
from launch.actions import (
    DeclareLaunchArgument,
    LogInfo,
    OpaqueFunction,
    PopLaunchConfigurations,
    PushLaunchConfigurations,
    TimerAction,
)
from launch.launch_context import LaunchContext
from launch.launch_description import LaunchDescription
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from thermal_fiducial.config import local_path, NODES, OF_CAMERA, SHARED_WITH_SECOND_CAMERA
from thermal_fiducial.errors import InputError

PACKAGE = 'thermal_fiducial'
#: Delay before a crashed node is restarted [s].
_RESPAWN_DELAY = 1.0
_LEVELS = ('debug', 'info', 'warn', 'error', 'fatal')
#: Exit status of a node that was asked to stop, whether DDS let go of it or not (``stopping.limit_the_end``), or that
#: refuses its parameters: neither is restarted.
_STOPPED, _REFUSED = (0, -signal.SIGPROF), 2

_ARGUMENTS = {
    'params_file': ('', 'parameter file of the rig; default: the one of the package'),
    'map_file': ('', 'marker map; default: what the parameter file says'),
    'camera': ('', 'start thermal_source with this camera: /dev/video0, a folder, ...; default: another driver runs'),
    'second_camera': ('', 'name of a second camera, the namespace of its images and detector; default: none'),
    'second_camera_device': (
        '',
        'start thermal_source for the second camera with this device, as camera does; default: another driver runs',
    ),
    'landing_pad': ('', 'start landing_target with these markers as the pad: 7, or 7,8,9; default: none'),
    'image_topic': ('thermal/image_raw', 'raw images of the camera'),
    'camera_info_topic': ('thermal/camera_info', 'calibration of the camera'),
    'imu_topic': ('imu/data', 'IMU, in the frame of the robot'),
    'namespace': ('', 'namespace of all nodes and topics'),
    'prefix_frames': ('false', 'put the namespace before the frames of the robot'),
    'use_sim_time': ('false', 'time from /clock; only diagnostics use it'),
    'log_level': ('info', f'one of {", ".join(_LEVELS)}'),
    'discovery_range': (
        '',
        'LOCALHOST or SUBNET: who finds the nodes; default: as the environment says, or LOCALHOST',
    ),
    'enclave': ('', 'SROS2 enclave of all nodes, as /thermal_fiducial; default: none'),
    'rviz': ('false', 'start RViz with the view of the package'),
}
_DISCOVERY = 'ROS_AUTOMATIC_DISCOVERY_RANGE'
#: Its values; OFF is for static peers, SYSTEM_DEFAULT for settings of the middleware itself.
_RANGES = ('LOCALHOST', 'SUBNET', 'OFF', 'SYSTEM_DEFAULT')
_TOPICS = ('image_topic', 'camera_info_topic', 'imu_topic')


def describe(
    mode: str,
    remappings: Iterable[tuple[str, str]] = (),
    parameters: Mapping[str, Any] | None = None,
    defaults: Mapping[str, str] | None = None,
) -> LaunchDescription:
    """Launch description of the nodes, one process each, restarted after a crash.

    Parameters
    ----------
    mode : mapping or localization
    remappings : (from, to) for all nodes
    parameters : name to value, which override the parameter file
    defaults : launch argument to its default, if it differs from the common one
    """

    def start(context: LaunchContext) -> list[Any]:
        return _actions(context, mode, list(remappings), dict(parameters or {}))

    declared = [
        DeclareLaunchArgument(name, default_value=(defaults or {}).get(name, default), description=description)
        for name, (default, description) in _ARGUMENTS.items()
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=start)])


def _actions(
    context: LaunchContext, mode: str, remappings: list[tuple[str, str]], parameters: dict[str, Any]
) -> list[Any]:
    given = {name: LaunchConfiguration(name).perform(context) for name in _ARGUMENTS}
    actions: list[Any] = _unknown_arguments(context)
    share = Path(get_package_share_directory(PACKAGE))
    overrides = {'mode': mode, 'use_sim_time': _is_true('use_sim_time', given), **parameters}
    overrides |= {'prefix_frames': True} if _is_true('prefix_frames', given) else {}
    overrides |= {name: given[name] for name in ('map_file', 'camera', 'second_camera') if given[name]}
    settings = {
        'package': PACKAGE,
        'namespace': given['namespace'],
        'parameters': [_params_file(given['params_file'], share), overrides],
        'remappings': [*remappings, *_topics(given)],
        'ros_arguments': ['--log-level', _log_level(given['log_level'])],
        # With what a group has set, for restarts after its end.
        'additional_env': {**os.environ, _DISCOVERY: _discovery_range(given['discovery_range'])},
        'output': 'screen',
    }
    if given['enclave']:
        settings['ros_arguments'] += ['--enclave', given['enclave']]
    if given['landing_pad']:
        overrides['landing_pad'] = _ids(given['landing_pad'])
    names = ['thermal_source', *NODES] if given['camera'] else list(NODES)
    names += ['landing_target'] if given['landing_pad'] else []
    scope = dict(context.launch_configurations)
    actions += [_node(name, settings, scope) for name in names]
    actions += _second_camera(given, settings, scope)
    if _is_true('rviz', given):
        actions.append(_rviz(given['namespace'], share))
    return actions


def _node(name: str, settings: dict[str, Any], scope: dict[str, Any]) -> Node:
    def after(event: Any, context: LaunchContext) -> list[Any]:
        """Restart after a crash, but not after refused parameters, which would be refused again."""
        if context.is_shutdown or event.returncode in _STOPPED:
            return []
        if event.returncode == _REFUSED:
            return [LogInfo(msg=f'{name}: unusable parameters or arguments (see above); it is not started again')]
        message = LogInfo(msg=f'{name}: ended with status {event.returncode}; it is started again')
        return [message, TimerAction(period=_RESPAWN_DELAY, actions=_within(scope, _node(name, settings, scope)))]

    return Node(executable=name, name=name, on_exit=after, **settings)


def _within(scope: dict[str, Any], node: Node) -> list[Any]:
    """Actions that start a node in the ``scope`` of its first start: the group that set it has long been left.

    Parameters
    ----------
    scope : launch configurations, where PushRosNamespace, SetRemap and SetParameter keep what they set, too
    """

    def enter(context: LaunchContext) -> None:
        context.launch_configurations.update(scope)

    return [PushLaunchConfigurations(), OpaqueFunction(function=enter), node, PopLaunchConfigurations()]


def _namespace(own: str, scope: dict[str, Any]) -> str:
    """Absolute namespace of the nodes: behind that of PushRosNamespace, unless ``own`` is absolute itself."""
    joined = own if own.startswith('/') else f'{scope.get("ros_namespace", "")}/{own}'
    return '/' + joined.strip('/')


def _second_camera(given: dict[str, str], settings: dict[str, Any], scope: dict[str, Any]) -> list[Node]:
    """Front end and detector of a second camera; map and odometry are those of the others."""
    name, device = given['second_camera'], given['second_camera_device']
    if not name:
        if device:
            raise InputError('second_camera_device: no effect without second_camera')
        return []
    own = _namespace(given['namespace'], scope).rstrip('/')
    shared = [(topic, f'{own}/{topic}') for topic in SHARED_WITH_SECOND_CAMERA]
    parameters = [*settings['parameters'], *([{'camera': device}] if device else [])]
    changes = {'namespace': f'{own}/{name}', 'remappings': shared, 'parameters': parameters}
    nodes = ['thermal_source', *OF_CAMERA] if device else OF_CAMERA
    return [_node(node, settings | changes, scope) for node in nodes]


def _unknown_arguments(context: LaunchContext) -> list[Any]:
    """Warnings of unknown arguments on the command line; one that resembles a known argument is refused.

    Only a warning, since a launch file that includes this one may declare more.
    """
    given = [argument.partition(':=')[0] for argument in context.argv if ':=' in argument]
    warnings = []
    for name in given:
        if name in _ARGUMENTS:
            continue
        close = difflib.get_close_matches(name, _ARGUMENTS, 1, cutoff=0.75)
        if close:
            raise InputError(f'launch argument {name}: there is none; did you mean {close[0]}?')
        warnings.append(LogInfo(msg=f'launch argument {name}: {PACKAGE} has none; see --show-args'))
    return warnings


def _ids(text: str) -> list[int]:
    try:
        return [int(marker_id) for marker_id in text.split(',')]
    except ValueError:
        raise InputError(f'landing_pad {text}: IDs of markers, as in 7,8,9') from None


def _params_file(path: str, share: Path) -> str:
    # Shells replace the ~ at the beginning of a word only, not behind params_file:=
    path = local_path(path)
    if path and not Path(path).is_file():
        raise InputError(f'params_file {path}: no such file')
    return path or str(share / 'config' / f'{PACKAGE}.yaml')


def _topics(given: dict[str, str]) -> list[tuple[str, str]]:
    ours = {name: _ARGUMENTS[name][0] for name in _TOPICS}
    return [(topic, given[name]) for name, topic in ours.items() if given[name] != topic]


def _log_level(level: str) -> str:
    if level.lower() not in _LEVELS:
        raise InputError(f'log_level {level}: not one of {", ".join(_LEVELS)}')
    return level.lower()


def _discovery_range(given: str) -> str:
    """The discovery range; LOCALHOST by default, as any participant could reset the filter and send poses."""
    asked = given or os.environ.get(_DISCOVERY, '') or _RANGES[0]
    if asked.upper() not in _RANGES:
        raise InputError(f'discovery_range {asked}: not one of {", ".join(_RANGES)}')
    return asked.upper()


def _rviz(namespace: str, share: Path) -> Any:
    try:
        get_package_prefix('rviz2')
    except PackageNotFoundError:
        return LogInfo(msg='rviz:=true: the package rviz2 is not installed (ros-jazzy-rviz2); the nodes run without it')
    view = str(share / 'config' / f'{PACKAGE}.rviz')
    return Node(package='rviz2', executable='rviz2', namespace=namespace, arguments=['-d', view])


def _is_true(name: str, given: dict[str, str]) -> bool:
    text = given[name].strip().lower()
    if text not in ('true', '1', 'yes', 'on', 'false', '0', 'no', 'off'):
        raise InputError(f'{name} {given[name]}: true or false')
    return text in ('true', '1', 'yes', 'on')
