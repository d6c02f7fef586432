"""The parameter file of the package is the one that the config dataclasses make."""

from pathlib import Path
import re

import pytest
from support.empty_stage import finished
from support.small_bag import side_files
import yaml

from thermal_fiducial.config import from_mapping, NODES, OPTIONAL_NODES, parameters
from thermal_fiducial.errors import InputError
from thermal_fiducial.replay.settings import read_settings
from thermal_fiducial.ros.base import params
from thermal_fiducial.ros.parameter_file import parameter_file

#: A section that all nodes have.
OURS = {'/**': {'ros__parameters': {'marker_size': 0.3}}}
FILE = Path(__file__).resolve().parents[3] / 'config' / 'thermal_fiducial.yaml'


def test_the_file_is_up_to_date():
    # python -m thermal_fiducial.ros.parameter_file > config/thermal_fiducial.yaml
    assert FILE.read_text() == parameter_file()


def test_the_file_holds_every_default():
    values = yaml.safe_load(FILE.read_text())['/**']['ros__parameters']
    for kind in (NODES | OPTIONAL_NODES).values():
        assert from_mapping(kind, values) == kind()
        assert {name for name, _, _ in parameters(kind)} <= set(values)


def test_a_parameter_of_several_nodes_has_one_default():
    seen = {}
    for kind in (NODES | OPTIONAL_NODES).values():
        for name, _, default in parameters(kind):
            assert seen.setdefault(name, default) == default


def test_a_replay_takes_the_file():
    settings = read_settings(FILE, {'mode': 'localization'})
    assert settings.warnings == ()
    assert settings.marker_mapper.mode == 'localization'


@pytest.mark.parametrize('section', ['/**', '/pose_ekf', '/drone/pose_ekf'])
def test_an_unknown_name_is_refused_in_a_section_of_ours(tmp_path, section):
    file = tmp_path / 'rig.yaml'
    file.write_text(yaml.safe_dump({section: {'ros__parameters': {'imu': {'gyroscope_noise': 1e-3}}}}))
    with pytest.raises(InputError, match=r'rig\.yaml: parameter imu\.gyroscope_noise: no node has it'):
        read_settings(file, {})


@pytest.mark.parametrize('number', ['1e-4', '1.0e-4', '.1e-3', '1E-04', '1.e-4', '0.0001'])
def test_numbers_are_what_ros_takes_for_numbers(tmp_path, number):
    """A replay refused 1e-4, with which the nodes fly: PyYAML takes it for a text."""
    file = tmp_path / 'rig.yaml'
    file.write_text(f'/**: {{ros__parameters: {{imu.gyroscope_noise_density: {number}}}}}')
    assert read_settings(file, {}).pose_ekf.imu.gyroscope_noise_density == 1e-4
    file.write_text(f'/**: {{ros__parameters: {{imu.gyroscope_noise_density: "{number}"}}}}')
    with pytest.raises(InputError, match='is not a number'):
        read_settings(file, {})


@pytest.mark.parametrize(('value', 'due'), [('1', '1.0'), ('[0, 0.5, 1.0]', '[0.0, 0.5, 1.0]'), ('1.0', '')])
def test_whole_numbers_that_a_node_would_refuse_are_warned_of(tmp_path, value, due):
    """A rig file that served a replay ended the nodes of the robot."""
    name = 'camera_position' if ',' in value else 'marker_size'
    file = tmp_path / 'rig.yaml'
    others = '/camera_driver: {ros__parameters: {gravity: 9}}'
    file.write_text(f'/**: {{ros__parameters: {{{name}: {value}, bits: 14}}}}\n{others}')
    words = f'{file}: parameter {name}: on a robot ROS refuses whole numbers here, write {due}'
    assert list(read_settings(file, {}).warnings) == [words] * bool(due)


def test_sections_of_other_nodes_are_not_checked(tmp_path):
    file = tmp_path / 'rig.yaml'
    theirs = {'/mavros': {'ros__parameters': {'fcu_url': 'udp://'}}}
    file.write_text(yaml.safe_dump(theirs | {'/**': {'ros__parameters': {'marker_size': 0.3}}}))
    assert read_settings(file, {}).warnings == ()
    file.write_text(yaml.safe_dump(theirs))
    assert read_settings(file, {}).warnings == (f'{file}: nothing in it is for our nodes: it is for /mavros',)


@pytest.mark.parametrize('section', ['pose_efk', '/drone/pose_ekf_node', '/**/PoseEkf', 'drone/pose-ekf'])
def test_a_section_for_a_mistyped_node_is_warned_of(tmp_path, section):
    """Nothing was said, and the robot flew with the defaults."""
    file = tmp_path / 'rig.yaml'
    file.write_text(yaml.safe_dump({section: {'ros__parameters': {'gate': 30.0, 'use_sim_time': False}}, **OURS}))
    words = f'{file}: section {section}: no node of ours is called so; did you mean pose_ekf?'
    assert list(read_settings(file, {}).warnings) == [words]


@pytest.mark.parametrize(
    ('section', 'values'),
    [
        ('aruco_detect', {'dictionary': 7, 'fiducial_len': 0.14}),
        ('tau2_camera_driver', {'frame_rate': 30.0}),
        ('pose_ekf2', {'use_sim_time': True}),
        ('camera_driver', {'camera': '/dev/video0'}),
        ('pose_ekf', {'gate': 30.0}),
    ],
)
def test_nodes_of_others_may_have_names_like_ours(tmp_path, section, values):
    file = tmp_path / 'rig.yaml'
    file.write_text(yaml.safe_dump({section: {'ros__parameters': values}, **OURS}))
    assert read_settings(file, {}).warnings == ()


@pytest.mark.ros
def test_the_node_whose_section_is_mistyped_warns_of_it(tmp_path):
    file = tmp_path / 'rig.yaml'
    file.write_text(yaml.safe_dump({'pose_efk': {'ros__parameters': {'gate': 30.0}}}))
    (line,) = params.doubts_of_files('/pose_ekf', ['node', '--ros-args', '--params-file', str(file), '-r', 'a:=b'])
    assert line == f'{file}: section pose_efk: no node of ours is called so; did you mean pose_ekf?'
    assert not [*params.doubts_of_files('/tau2_camera', ['--ros-args', '--params-file', str(file)])]
    program = """
import os, signal, sys
from thermal_fiducial.nodes.pose_ekf import PoseEkfNode
from thermal_fiducial.ros.process import run

class Stopped(PoseEkfNode):
    def __init__(self):
        super().__init__()
        self.create_timer(0.01, self.stop)

    def stop(self):
        print(*self.remarks, flush=True)
        os.kill(os.getpid(), signal.SIGINT)

sys.exit(run.run(Stopped))
"""
    done = finished(program, '--ros-args', '--params-file', str(file))
    assert (done.returncode, line in done.stderr, line in done.stdout) == (0, True, True), done.stdout + done.stderr


@pytest.mark.ros
@pytest.mark.parametrize(
    ('added', 'what'),
    [
        ('    camera_position: [0.0, 0.0, 0.0]\n', "line 5: 'camera_position' is there twice"),
        ('/**:\n  ros__parameters:\n    gate: 30.0\n', "line 5: '/**' is there twice"),
        ('    imu: {gyroscope_noise_density: 0.001}\n', 'imu.gyroscope_noise_density is there twice, once nested'),
    ],
)
def test_a_node_warns_of_what_its_file_has_twice(tmp_path, added, what):
    """ROS takes the last of two without a word: a default from the copied file instead of a calibration, say."""
    file = tmp_path / 'rig.yaml'
    of_copy = '    camera_position: [0.12, 0.02, -0.04]\n    imu.gyroscope_noise_density: 0.00017\n'
    file.write_text(f'/**:\n  ros__parameters:\n{of_copy}{added}')
    (line,) = params.doubts_of_files('/pose_ekf', ['node', '--ros-args', '--params-file', str(file)])
    assert f'{file}: {what}: ROS reads the file all the same' in line
    with pytest.raises(InputError, match=f'{re.escape(what)}$'):
        read_settings(file, {})


@pytest.mark.parametrize(
    ('sections', 'apart'),
    [
        ({'pose_ekf': {'camera_position': [0.1, 0, 0]}}, ['aruco_detector', 'marker_mapper']),
        ({'/**': {'camera_position': [0.1, 0, 0]}, '/pose_ekf': {'camera_position': [0.1, 0.0, 0]}}, []),
        ({'/**': {'camera_position': [0.1, 0, 0]}, 'marker_mapper': {'dictionary': 'DICT_5X5_50'}}, ['aruco_detector']),
        ({'marker_mapper': {'second_camera': 'right'}, 'right/aruco_detector': {'camera_position': [0.1, 0, 0]}}, []),
        ({'pose_ekf': {'realtime_priority': 5, 'gate': 30.0}}, []),
    ],
)
def test_what_one_node_alone_has_of_shared_parameters_is_warned_of(tmp_path, sections, apart):
    """The mapper predicted with a camera in the IMU, as its place was in the section of the filter."""
    file = tmp_path / 'rig.yaml'
    file.write_text(yaml.safe_dump({section: {'ros__parameters': values} for section, values in sections.items()}))
    lines = list(read_settings(file, {}).warnings)
    assert [node for node in NODES for line in lines if f'other values than {node};' in line] == apart
    given = ['--ros-args', '--params-file', str(file)]
    assert [node for node in NODES for line in params.doubts_of_files(f'/{node}', given) if line in lines] == apart


def test_values_of_another_robot_in_the_same_file_are_its_own(tmp_path):
    file, given = tmp_path / 'rig.yaml', ['--ros-args', '--params-file', str(tmp_path / 'rig.yaml')]
    file.write_text(
        '/a/**: {ros__parameters: {camera_position: [0.1, 0, 0]}}\n'
        '/b/pose_ekf: {ros__parameters: {camera_position: [0.2, 0, 0]}}\n'
    )
    assert list(params.doubts_of_files('/a/marker_mapper', given)) == []
    (line,) = params.doubts_of_files('/b/marker_mapper', given)
    assert 'camera_position: pose_ekf has other values than marker_mapper' in line


def test_namespaces_may_be_nested_as_in_ros(tmp_path):
    """A replay refused a file with which the nodes fly."""
    file = tmp_path / 'rig.yaml'
    file.write_text(
        'drone: {deep: {pose_ekf: {ros__parameters: {gravity: 9.79}}}}\n/**: {ros__parameters: {gate: 30.0}}'
    )
    settings = read_settings(file, {})
    assert (settings.pose_ekf.gravity, settings.pose_ekf.gate) == (9.79, 30.0)


@pytest.mark.parametrize(
    'content', ['', '[]', '/**:', '/**: {}', 'drone: {pose_ekf: 1}', 'pose_ekf: {ros__parameters: 1}']
)
def test_what_is_no_parameter_file_is_refused(tmp_path, content):
    file = tmp_path / 'rig.yaml'
    file.write_text(content)
    with pytest.raises(InputError, match=r'rig\.yaml: not of the form NODE: \{ros__parameters: \{\.\.\.\}\}$'):
        read_settings(file, {})


def test_an_option_is_not_blamed_on_the_file():
    with pytest.raises(InputError, match=r"^parameter second_camera: '7' is not the name of a namespace"):
        read_settings(FILE, {}, second_camera='7')


def test_a_map_of_another_dictionary_is_warned_of(tmp_path):
    map_file, _ = side_files(tmp_path)
    map_file.write_text(map_file.read_text().replace('DICT_4X4_50', 'DICT_5X5_50'))
    (warning,) = read_settings(FILE, {'map_file': str(map_file)}).warnings
    assert 'DICT_5X5_50' in warning


@pytest.mark.parametrize(
    ('section', 'others', 'ignored'),
    [
        ('pose_ekf', {}, True),
        ('/pose_ekf', {'/drone/down/**': {'gate': 20.0}}, True),
        ('/**/pose_ekf', {}, False),
        ('drone/pose_ekf', {}, False),
        ('pose_ekf', {'/drone/**': {'gate': 20.0}}, False),
        ('pose_ekf', {'/**': {'second_camera': 'drone'}}, False),
    ],
)
def test_a_section_without_the_namespace_of_its_node_is_warned_of(tmp_path, section, others, ignored):
    """Nothing was said, and the robot flew with the defaults."""
    file = tmp_path / 'rig.yaml'
    sections = {section: {'gate': 30.0}, **others}
    file.write_text(yaml.safe_dump({name: {'ros__parameters': values} for name, values in sections.items()}))
    why = 'ROS ignores it, as it is for a node without a namespace'
    line = f'{file}: section {section}: {why}; for /drone/pose_ekf write /drone/pose_ekf or /**/pose_ekf'
    given = ['node', '--ros-args', '--params-file', str(file)]
    assert [*params.doubts_of_files('/drone/pose_ekf', given)] == [line] * ignored
    assert not [*params.doubts_of_files('/pose_ekf', given)]
    assert not [*params.doubts_of_files('/drone/tau2_camera', given)]


@pytest.mark.ros
@pytest.mark.parametrize('section', ['pose_ekf', '/**/pose_ekf', 'drone/pose_ekf'])
def test_ros_ignores_what_is_warned_of(tmp_path, section):
    file = tmp_path / 'rig.yaml'
    file.write_text(yaml.safe_dump({section: {'ros__parameters': {'gate': 30.0}}}))
    arguments = ['--ros-args', '--params-file', str(file), '-r', '__ns:=/drone']
    program = """
import os, signal, sys
from thermal_fiducial.nodes.pose_ekf import PoseEkfNode
from thermal_fiducial.ros.process import run

class Stopped(PoseEkfNode):
    def __init__(self):
        super().__init__()
        self.create_timer(0.01, self.stop)

    def stop(self):
        print(self.config.gate, len(self.remarks), flush=True)
        os.kill(os.getpid(), signal.SIGINT)

sys.exit(run.run(Stopped))
"""
    done = finished(program, *arguments)
    gate, remarks = done.stdout.split()
    assert done.returncode == 0
    assert (float(gate) == 30.0, int(remarks)) == ((False, 1) if section == 'pose_ekf' else (True, 0))
