"""The launch files, run against stand-ins: ``launch`` itself is on the robot only."""

from pathlib import Path
import re
import runpy
import signal
import sys
from types import SimpleNamespace

import pytest
from support import launch_api
import yaml

from thermal_fiducial import config
from thermal_fiducial.config import NODES as PARAMETERS
from thermal_fiducial.config import OPTIONAL_NODES
from thermal_fiducial.errors import InputError

ROOT = Path(__file__).resolve().parents[3]
NODES = ['tau2_camera', 'aruco_detector', 'marker_mapper', 'pose_ekf']


MAVROS = [
    ('bridge/odometry', 'mavros/odometry/out'),
    ('landing_target', 'mavros/landing_target/pose'),
    ('imu/data', 'mavros/imu/data'),
]
PARAMETER_FILE = '/share/thermal_fiducial/config/thermal_fiducial.yaml'
ARGUMENTS = {
    'params_file': '', 'map_file': '', 'camera': '', 'landing_pad': '', 'image_topic': 'thermal/image_raw',
    'camera_info_topic': 'thermal/camera_info', 'imu_topic': 'imu/data', 'namespace': '', 'use_sim_time': 'false',
    'second_camera': '', 'second_camera_device': '', 'log_level': 'info', 'rviz': 'false', 'prefix_frames': 'false',
    'discovery_range': '', 'enclave': '',
}  # fmt: skip


@pytest.fixture
def launched(monkeypatch):
    """Run a launch file with arguments: its declared arguments (name to default) and its actions."""

    def launch(file, pushed='', **arguments):
        description = runpy.run_path(str(ROOT / 'launch' / file))['generate_launch_description']()
        context = launch_api.LaunchContext(f'{name}:={value}' for name, value in arguments.items())
        context.launch_configurations['ros_namespace'] = pushed
        return launch_api.declared(description), launch_api.started(description, context)

    with launch_api.installed(monkeypatch, '/share/thermal_fiducial', also=('rviz2',)):
        yield launch


@pytest.mark.parametrize('mode', ['mapping', 'localization'])
def test_four_nodes_with_the_parameters_of_the_package(launched, mode):
    declared, nodes = launched(f'{mode}.launch.py')
    assert declared == ARGUMENTS
    assert [node.executable for node in nodes] == NODES
    for node in nodes:
        assert node.package == 'thermal_fiducial'
        assert node.parameters == [PARAMETER_FILE, {'mode': mode, 'use_sim_time': False}]
        assert node.remappings == []


def test_arguments_reach_the_nodes(launched, tmp_path):
    rig = tmp_path / 'rig.yaml'
    rig.touch()
    _, nodes = launched(
        'localization.launch.py',
        params_file=str(rig),
        map_file='hall.yaml',
        namespace='drone',
        prefix_frames='true',
        use_sim_time='True',
        image_topic='tau2/image_raw',
        imu_topic='/mavros/imu/data',
        log_level='WARN',
        rviz='true',
    )
    assert [node.executable for node in nodes] == [*NODES, 'rviz2']
    assert {node.namespace for node in nodes} == {'drone'}
    for node in nodes[:4]:
        assert node.parameters[0] == str(rig)
        assert node.parameters[1] == {
            'mode': 'localization',
            'use_sim_time': True,
            'map_file': 'hall.yaml',
            'prefix_frames': True,
        }
        assert node.remappings == [('thermal/image_raw', 'tau2/image_raw'), ('imu/data', '/mavros/imu/data')]
        assert node.ros_arguments == ['--log-level', 'warn']
    view = Path(nodes[4].arguments[1])
    assert (ROOT / view.relative_to('/share/thermal_fiducial')).is_file()


@pytest.mark.parametrize(
    ('asked', 'environment', 'expected'),
    [('', '', 'LOCALHOST'), ('', 'SUBNET', 'SUBNET'), ('subnet', 'LOCALHOST', 'SUBNET'), ('OFF', '', 'OFF')],
)
def test_nodes_are_visible_only_on_this_computer_by_default(launched, monkeypatch, asked, environment, expected):
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', environment)
    _, nodes = launched('mapping.launch.py', discovery_range=asked, enclave='/drone')
    assert [node.additional_env['ROS_AUTOMATIC_DISCOVERY_RANGE'] for node in nodes] == [expected] * 4
    assert all(node.ros_arguments[2:] == ['--enclave', '/drone'] for node in nodes)


def test_a_discovery_range_that_does_not_exist_is_refused(launched):
    with pytest.raises(InputError, match='discovery_range LAN: not one of LOCALHOST'):
        launched('mapping.launch.py', discovery_range='LAN')


def test_a_camera_is_started_with_the_nodes(launched):
    _, nodes = launched('mapping.launch.py', camera='/dev/video0')
    assert [node.executable for node in nodes] == ['thermal_source', *NODES]
    assert nodes[0].parameters[1]['camera'] == '/dev/video0'


def test_a_second_camera_has_its_own_front_end_and_the_others_map_and_odometry(launched):
    _, nodes = launched('localization.launch.py', namespace='drone', second_camera='down', second_camera_device='teax')
    assert [node.executable for node in nodes] == [*NODES, 'thermal_source', 'tau2_camera', 'aruco_detector']
    assert nodes[2].parameters[1]['second_camera'] == 'down'
    assert {node.namespace for node in nodes[4:]} == {'/drone/down'}
    assert nodes[4].parameters[-1] == {'camera': 'teax'}
    assert ('odometry', '/drone/odometry') in nodes[6].remappings
    _, nodes = launched('localization.launch.py', second_camera='down')
    assert [(node.executable, node.namespace) for node in nodes[4:]] == [
        ('tau2_camera', '/down'),
        ('aruco_detector', '/down'),
    ]
    assert ('marker_map', '/marker_map') in nodes[5].remappings


@pytest.mark.parametrize(
    ('namespace', 'expected'), [('', '/fleet'), ('drone', '/fleet/drone'), ('/drone', '/drone'), ('/', '/')]
)
def test_a_second_camera_follows_the_nodes_into_a_namespace_that_was_pushed(launched, namespace, expected):
    """PushRosNamespace, for example of a launch file for many drones."""
    context = launch_api.LaunchContext()
    context.launch_configurations['ros_namespace'] = 'fleet'
    _, nodes = launched('localization.launch.py', pushed='fleet', namespace=namespace, second_camera='down')
    assert {node.full_namespace(context) for node in nodes[:4]} == {expected}
    root = expected.rstrip('/')
    assert {node.full_namespace(context) for node in nodes[4:]} == {f'{root}/down'}
    assert ('odometry', f'{root}/odometry') in nodes[5].remappings


def test_a_parameter_file_may_lie_at_home(launched, tmp_path, monkeypatch):
    monkeypatch.setenv('HOME', str(tmp_path))
    (tmp_path / 'rig.yaml').touch()
    _, nodes = launched('localization.launch.py', params_file='~/rig.yaml')
    assert nodes[0].parameters[0] == str(tmp_path / 'rig.yaml')


def test_a_landing_pad_is_reported_where_one_is_named(launched):
    _, nodes = launched('ardupilot.launch.py', landing_pad='7,8,9')
    assert [node.executable for node in nodes] == [*NODES, 'landing_target']
    assert nodes[-1].parameters[1]['landing_pad'] == [7, 8, 9]
    assert ('landing_target', 'mavros/landing_target/pose') in nodes[-1].remappings


@pytest.mark.parametrize(
    ('arguments', 'words'),
    [
        ({'params_file': '/nowhere/rig.yaml'}, 'params_file /nowhere/rig.yaml: no such file'),
        ({'map_fil': 'hall.yaml'}, 'launch argument map_fil: there is none; did you mean map_file'),
        ({'landing_pad': 'H'}, 'landing_pad H: IDs'),
        ({'log_level': 'loud'}, 'log_level loud: not one of debug'),
        ({'rviz': 'maybe'}, 'rviz maybe: true or false'),
        ({'second_camera_device': 'teax'}, 'second_camera_device: no effect without second_camera'),
    ],
)
def test_impossible_launch_arguments_are_refused_with_a_reason(launched, arguments, words):
    with pytest.raises(InputError, match=words):
        launched('localization.launch.py', **arguments)


def test_arguments_of_others_are_named(launched):
    _, (log, *nodes) = launched('localization.launch.py', fcu_url='udp://:14540')
    assert 'fcu_url' in log.msg
    assert [node.executable for node in nodes] == NODES


def test_launches_in_the_documents_name_files_and_arguments_that_exist(launched):
    pages = [ROOT / 'README.md', *(ROOT / 'doc').rglob('*.md')]
    text = ' '.join(page.read_text(encoding='utf-8') for page in pages).replace('\\\n', ' ')
    calls = re.findall(r'ros2 launch thermal_fiducial (\S+\.launch\.py)((?: +\w+:=[^\s`]+)*)', text)
    assert len(calls) >= 8
    for file, words in calls:
        arguments = dict(word.split(':=', 1) for word in words.split())
        _, actions = launched(file, **(arguments | {'params_file': ''}))
        assert [action.msg for action in actions if isinstance(action, launch_api.LogInfo)] == []


def test_without_rviz_the_nodes_start_with_a_warning(launched, monkeypatch):
    monkeypatch.setattr(sys.modules['ament_index_python.packages'], 'get_package_prefix', launch_api.prefix)
    _, actions = launched('localization.launch.py', rviz='true')
    assert [action.executable for action in actions[:4]] == NODES
    assert 'rviz2 is not installed' in actions[4].msg


def test_a_crash_is_followed_by_another_start_and_refused_parameters_are_not(launched):
    _, nodes = launched('localization.launch.py')
    context = launch_api.LaunchContext()
    ekf = nodes[3]
    for status in (1, -11, -signal.SIGALRM, 134):
        log, timer = ekf.on_exit(SimpleNamespace(returncode=status), context)
        assert f'status {status}' in log.msg
        (again,) = launch_api.started_in_turn(timer.actions, context)
        assert (again.executable, again.parameters) == (ekf.executable, ekf.parameters)
        assert len(again.on_exit(SimpleNamespace(returncode=status), context)) == 2
    (log,) = ekf.on_exit(SimpleNamespace(returncode=2), context)
    assert 'not started again' in log.msg
    for status in (0, -signal.SIGPROF):
        assert ekf.on_exit(SimpleNamespace(returncode=status), context) == []
    context.is_shutdown = True
    assert ekf.on_exit(SimpleNamespace(returncode=-9), context) == []


def test_a_restart_after_a_crash_is_in_the_group_of_the_first_start(launched, monkeypatch):
    """Of a launch file for many drones; launch leaves a group once its nodes are started, as its maintainers explain.

    https://github.com/ros2/launch/issues/825
    """
    monkeypatch.setenv('ROS_DOMAIN_ID', '7')
    _, nodes = launched('localization.launch.py', pushed='fleet', second_camera='down')
    monkeypatch.setenv('ROS_DOMAIN_ID', '0')
    context = launch_api.LaunchContext()
    namespaces = []
    for node in nodes:
        _, timer = node.on_exit(SimpleNamespace(returncode=-11), context)
        for again in launch_api.started_in_turn(timer.actions, context):
            namespaces.append(again.full_namespace(context))
            assert again.additional_env['ROS_DOMAIN_ID'] == '7'
    assert namespaces == ['/fleet'] * 4 + ['/fleet/down'] * 2
    assert context.launch_configurations == {}


@pytest.mark.parametrize(
    ('file', 'parameters', 'remappings'),
    [
        ('mavros', {'bridge_rate': 30.0, 'landing_target_frame': 'map'}, MAVROS),
        ('ardupilot', {'bridge_rate': 20.0, 'landing_target_frame': 'body'}, MAVROS),
        ('px4', {'bridge_rate': 50.0, 'px4': True}, []),
    ],
)
def test_flight_controllers_get_their_output(launched, file, parameters, remappings):
    _, nodes = launched(f'{file}.launch.py')
    known = {name: item for kind in (PARAMETERS | OPTIONAL_NODES).values() for name, item, _ in config.parameters(kind)}
    for node in nodes:
        assert node.remappings == remappings
        assert node.parameters[1] == {'mode': 'localization', 'use_sim_time': False, **parameters}
    for name, value in parameters.items():
        assert config.checked(name, known[name], value) == value


def test_the_view_shows_what_the_nodes_publish():
    view = yaml.safe_load((ROOT / 'config' / 'thermal_fiducial.rviz').read_text())
    topics = {display['Topic']['Value'] for display in view['Visualization Manager']['Displays'] if 'Topic' in display}
    in_space = {'marker_map/markers', 'marker_map/cloud', 'odometry', 'path', 'camera_pose'}
    assert topics == {*in_space, 'thermal/image_markers'}
