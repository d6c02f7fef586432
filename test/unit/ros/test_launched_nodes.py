"""The launch files run: real processes with the command lines, the files and the restarts that launch gives them."""

from pathlib import Path
import runpy

import pytest
from rcl_interfaces.srv import GetParameters
from support import launch_api, small_bag
from support.empty_stage import STOPPED
from support.ros_graph import ros_graph
import yaml

from thermal_fiducial.files.marker_map import load_map

ROOT = Path(__file__).resolve().parents[3]
NAMES = ('left', 'right')
NODES = ('tau2_camera', 'aruco_detector', 'marker_mapper', 'pose_ekf')
pytestmark = [pytest.mark.ros, pytest.mark.slow]


@pytest.fixture
def launch(monkeypatch, tmp_path):
    """Run a launch file with arguments, as ``ros2 launch`` does; ended with the test."""
    running = []

    def run(file, **arguments):
        description = runpy.run_path(str(ROOT / 'launch' / file))['generate_launch_description']()
        context = launch_api.LaunchContext(f'{name}:={value}' for name, value in arguments.items())
        running.append(launch_api.Launch(launch_api.started(description, context), context, tmp_path))
        return running[-1]

    with launch_api.installed(monkeypatch, ROOT):
        yield run
    for launched in running:
        launched.kill()


def wait_for(graph, nodes, topics):
    """Until nodes and topics are known by their full names; returns all topics."""

    def known():
        pairs = graph.tester.get_node_names_and_namespaces()
        return {f'{space.rstrip("/")}/{name}' for name, space in pairs} | all_topics()

    def all_topics():
        return {name for name, _ in graph.tester.get_topic_names_and_types()}

    graph.spin_until(lambda: {*nodes, *topics} <= known())
    return all_topics()


def value_of(graph, node, name):
    """A parameter of a node in another process."""
    answer = graph.call(GetParameters, f'{node}/get_parameters', GetParameters.Request(names=[name]))
    return answer.values[0]


def test_a_drone_in_a_namespace_with_two_cameras(launch, tmp_path):
    """Names, parameters, remaps, and an orderly end at two interrupts 10 ms apart."""
    map_file, rig = small_bag.side_files(tmp_path)
    own = {'/one/down/**': {'ros__parameters': {'camera_position': [0.0, 0.0, -0.1]}}}
    rig.write_text(yaml.safe_dump(yaml.safe_load(rig.read_text()) | own))
    arguments = {'params_file': rig, 'map_file': map_file, 'prefix_frames': 'true', 'log_level': 'error'}
    one = launch('mavros.launch.py', namespace='one', second_camera='down', **arguments)
    expected = [
        '/one/mavros/imu/data', '/one/mavros/odometry/out', '/one/down/markers', '/one/odometry', '/one/marker_map',
    ]  # fmt: skip
    with ros_graph() as graph:
        topics = wait_for(graph, [*(f'/one/{node}' for node in NODES), '/one/down/aruco_detector'], expected)
        assert not {'/one/imu/data', '/one/bridge/odometry', '/one/down/odometry', '/one/down/marker_map'} & topics
        assert value_of(graph, '/one/marker_mapper', 'mode').string_value == 'localization'
        assert value_of(graph, '/one/marker_mapper', 'map_file').string_value == str(map_file)
        first, second = (value_of(graph, f'/one/{at}aruco_detector', 'camera_position') for at in ('', 'down/'))
        assert list(first.double_array_value) == pytest.approx(small_bag.PARAMETERS['camera_position'])
        assert list(second.double_array_value) == [0.0, 0.0, -0.1]
    assert set(one.end().values()) <= STOPPED
    assert one.said == []


@pytest.mark.nightly
def test_two_drones_side_by_side(launch, tmp_path):
    map_file, rig = small_bag.side_files(tmp_path)
    arguments = {'params_file': rig, 'map_file': map_file, 'log_level': 'error'}
    drones = [launch('mapping.launch.py', namespace=name, imu_topic='/imu/data', **arguments) for name in NAMES]
    with ros_graph() as graph:
        nodes = [f'/{name}/{node}' for name in NAMES for node in NODES]
        topics = wait_for(graph, nodes, [f'/{name}/camera_pose' for name in NAMES])
        assert not {'/camera_pose', '/pose', '/markers'} & topics
        # A node's name is known before its subscriptions are.
        graph.spin_until(lambda: graph.tester.count_subscribers('/imu/data') == len(NAMES))
    assert all(set(drone.end().values()) <= STOPPED for drone in drones)
    assert load_map(map_file).markers.keys() == {0}


def test_a_node_that_crashes_comes_back_and_one_that_refuses_its_parameters_does_not(launch, tmp_path):
    map_file, rig = small_bag.side_files(tmp_path)
    settings = yaml.safe_load(rig.read_text())
    rig.write_text(yaml.safe_dump(settings | {'/pose_ekf': {'ros__parameters': {'gravity': 1.6}}}))
    launched = launch('localization.launch.py', params_file=rig, map_file=map_file)
    with ros_graph() as graph:
        wait_for(graph, ['/marker_mapper'], [])
        launched.running('/marker_mapper').kill()
        graph.spin_until(lambda: len(launched.processes['/marker_mapper']) == 2)
        graph.spin_until(lambda: len(launched.said) == 2)
    assert sorted(launched.said) == [
        'marker_mapper: ended with status -9; it is started again',
        'pose_ekf: unusable parameters or arguments (see above); it is not started again',
    ]
    assert 'gravity' in launched.log('pose_ekf')
    assert len(launched.processes['/pose_ekf']) == 1
