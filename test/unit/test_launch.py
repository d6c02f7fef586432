"""The launch files, run against stand-ins: ``launch`` itself is on the robot only."""

from pathlib import Path
import runpy
import sys
from types import ModuleType, SimpleNamespace

import pytest
import yaml

from thermal_fiducial import config
from thermal_fiducial.config import NODES as PARAMETERS

ROOT = Path(__file__).resolve().parents[2]
NODES = ['tau2_camera', 'aruco_detector', 'marker_mapper', 'pose_ekf']


def _record(kind):
    return lambda *args, **kwargs: SimpleNamespace(kind=kind, args=args, **kwargs)


class Configuration:
    """Stand-in of LaunchConfiguration: the context is a dict."""

    def __init__(self, name):
        self.name = name

    def perform(self, context):
        return context[self.name]


@pytest.fixture
def launched(monkeypatch):
    """Run a launch file with arguments: its declared arguments (name to default) and its nodes."""
    stand_ins = {
        'launch': {'LaunchDescription': list},
        'launch.launch_context': {'LaunchContext': dict},
        'launch.launch_description': {'LaunchDescription': list},
        'launch.actions': {'DeclareLaunchArgument': _record('argument'), 'OpaqueFunction': _record('function')},
        'launch.substitutions': {'LaunchConfiguration': Configuration},
        'launch_ros': {},
        'launch_ros.actions': {'Node': _record('node')},
        'ament_index_python': {},
        'ament_index_python.packages': {'get_package_share_directory': lambda package: f'/share/{package}'},
    }
    for name, content in stand_ins.items():
        module = ModuleType(name)
        module.__dict__.update(content)
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.delitem(sys.modules, 'thermal_fiducial.ros.launching', raising=False)

    def launch(file, **arguments):
        actions = runpy.run_path(str(ROOT / 'launch' / file))['generate_launch_description']()
        declared = {action.args[0]: action.default_value for action in actions if action.kind == 'argument'}
        (start,) = [action.function for action in actions if action.kind == 'function']
        return declared, start({**declared, **arguments})

    yield launch
    sys.modules.pop('thermal_fiducial.ros.launching', None)


@pytest.mark.parametrize('mode', ['mapping', 'localization'])
def test_four_nodes_with_the_parameters_of_the_package(launched, mode):
    declared, nodes = launched(f'{mode}.launch.py')
    assert declared == {
        'params_file': '', 'map_file': '', 'namespace': '', 'use_sim_time': 'false', 'rviz': 'false'
    }  # fmt: skip
    assert [node.executable for node in nodes] == NODES
    for node in nodes:
        assert node.package == 'thermal_fiducial'
        assert node.parameters == [
            '/share/thermal_fiducial/config/thermal_fiducial.yaml', {'mode': mode, 'use_sim_time': False}
        ]  # fmt: skip


def test_arguments_reach_the_nodes(launched):
    _, nodes = launched(
        'localization.launch.py',
        params_file='rig.yaml',
        map_file='hall.yaml',
        namespace='drone',
        use_sim_time='True',
        rviz='true',
    )
    assert [node.executable for node in nodes] == [*NODES, 'rviz2']
    assert {node.namespace for node in nodes} == {'drone'}
    for node in nodes[:4]:
        assert node.parameters[0] == 'rig.yaml'
        assert node.parameters[1] == {'mode': 'localization', 'use_sim_time': True, 'map_file': 'hall.yaml'}
    view = Path(nodes[4].arguments[1])
    assert (ROOT / view.relative_to('/share/thermal_fiducial')).is_file()


@pytest.mark.parametrize(
    ('file', 'parameters', 'remappings'),
    [
        ('mavros', {'bridge_rate': 30.0}, [('bridge/odometry', 'mavros/odometry/out')]),
        ('ardupilot', {'bridge_rate': 20.0}, [('bridge/odometry', 'mavros/odometry/out')]),
        ('px4', {'bridge_rate': 50.0, 'px4': True}, []),
    ],
)
def test_flight_controllers_get_their_output(launched, file, parameters, remappings):
    _, nodes = launched(f'{file}.launch.py')
    known = {name: item for kind in PARAMETERS.values() for name, item, _ in config.parameters(kind)}
    for node in nodes:
        assert node.remappings == remappings
        assert node.parameters[1] == {'mode': 'localization', 'use_sim_time': False, **parameters}
    for name, value in parameters.items():
        assert config.checked(name, known[name], value) == value


def test_the_view_shows_what_the_nodes_publish():
    view = yaml.safe_load((ROOT / 'config' / 'thermal_fiducial.rviz').read_text())
    topics = {display['Topic']['Value'] for display in view['Visualization Manager']['Displays'] if 'Topic' in display}
    assert topics == {'marker_map/markers', 'odometry', 'path', 'camera_pose', 'thermal/image_markers'}
