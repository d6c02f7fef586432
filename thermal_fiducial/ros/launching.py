"""What the launch files share. Needs ROS's ``launch`` and ``launch_ros``, which a robot has and PyPI has not."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from ament_index_python.packages import get_package_share_directory
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.launch_context import LaunchContext
from launch.launch_description import LaunchDescription
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from thermal_fiducial.config import NODES

PACKAGE = 'thermal_fiducial'

_ARGUMENTS = {
    'params_file': ('', 'parameter file of the rig; default: the one of the package'),
    'map_file': ('', 'marker map; default: what the parameter file says'),
    'namespace': ('', 'namespace of all nodes and topics'),
    'use_sim_time': ('false', 'time from /clock; only diagnostics use it'),
    'rviz': ('false', 'start RViz with the view of the package'),
}


def describe(
    mode: str, remappings: Iterable[tuple[str, str]] = (), parameters: dict[str, Any] | None = None
) -> LaunchDescription:
    """The four nodes, one process each, started again if one ends.

    Parameters
    ----------
    mode : mapping or localization
    remappings : (from, to) for all nodes
    parameters : name to value, before those of the parameter file
    """

    def start(context: LaunchContext) -> list[Node]:
        return _nodes(context, mode, list(remappings), parameters or {})

    declared = [
        DeclareLaunchArgument(name, default_value=default, description=description)
        for name, (default, description) in _ARGUMENTS.items()
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=start)])


def _nodes(
    context: LaunchContext, mode: str, remappings: list[tuple[str, str]], parameters: dict[str, Any]
) -> list[Node]:
    given = {name: LaunchConfiguration(name).perform(context) for name in _ARGUMENTS}
    share = Path(get_package_share_directory(PACKAGE))
    overrides = {'mode': mode, 'use_sim_time': _is_true(given['use_sim_time']), **parameters}
    if given['map_file']:
        overrides['map_file'] = given['map_file']
    nodes = [
        Node(
            package=PACKAGE,
            executable=name,
            name=name,
            namespace=given['namespace'],
            parameters=[given['params_file'] or str(share / 'config' / f'{PACKAGE}.yaml'), overrides],
            remappings=remappings,
            output='screen',
            respawn=True,
            respawn_delay=1.0,
        )
        for name in NODES
    ]
    if _is_true(given['rviz']):
        view = str(share / 'config' / f'{PACKAGE}.rviz')
        nodes.append(Node(package='rviz2', executable='rviz2', namespace=given['namespace'], arguments=['-d', view]))
    return nodes


def _is_true(text: str) -> bool:
    return text.strip().lower() in ('true', '1', 'yes', 'on')
