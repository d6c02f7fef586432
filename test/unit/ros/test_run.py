"""The run loop: transport profile, arguments, parameters that change while a node runs."""

from dataclasses import dataclass
import os
import re
import signal
import subprocess
import sys
import xml.etree.ElementTree as ElementTree

import cv2
import pytest
from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.context import Context
from rclpy.parameter import Parameter
from sensor_msgs.msg import Imu
from support.empty_stage import environment, finished
from support.ros_graph import ros_graph
from support.waiting import PATIENCE_S

from thermal_fiducial.cli.main import main
from thermal_fiducial.config import group, param
from thermal_fiducial.errors import InputError
from thermal_fiducial.ros.base import qos
from thermal_fiducial.ros.base.node import StageNode
from thermal_fiducial.ros.process import run

pytestmark = pytest.mark.ros


@dataclass(frozen=True)
class Inner:
    gain: float = param(1.0, 'Gain.', unit='1/s', minimum=0.0, maximum=5.0, dynamic=True)


@dataclass(frozen=True)
class Parameters:
    """One of every kind."""

    name: str = param('a', 'Name.', choices=('a', 'b'), dynamic=True)
    count: int = param(3, 'Count.', minimum=1)
    sizes: tuple[str, ...] = param((), 'Sizes.')
    weights: tuple[float, ...] = param((), 'Weights.', dynamic=True)
    place: tuple[float, ...] = param((0.0, 0.0), 'Place.')
    inner: Inner = group(Inner)  # noqa: RUF009


class Stage(StageNode[Parameters]):
    def __init__(self, **kwargs):
        super().__init__('stage', Parameters, **kwargs)
        self.subscribe(Imu, 'imu/data', lambda message: None, qos.IMU_INPUT)


def test_parameters_of_every_kind_come_from_the_command_line():
    with ros_graph('-p', 'sizes:=["7:0.5"]', '-p', 'weights:=[1.0, 2.0]', '-p', 'inner.gain:=2.0') as graph:
        node = graph.add(Stage)
        assert node.config == Parameters(sizes=('7:0.5',), weights=(1.0, 2.0), inner=Inner(2.0))


def test_parameters_come_from_a_file(tmp_path):
    file = tmp_path / 'params.yaml'
    file.write_text('/**: {ros__parameters: {name: b, sizes: [], inner: {gain: 0.5}, gravity: 9.8}}')
    with ros_graph('--params-file', str(file)) as graph:
        assert graph.add(Stage).config == Parameters(name='b', inner=Inner(0.5))


@pytest.mark.parametrize(
    ('rule', 'words'),
    [
        ('count:=0', 'count'),
        ('count:=1.5', 'count'),
        ('name:=c', "'c' is not one of a, b"),
        ('inner.gain:=9.0', 'inner.gain'),
        ('inner.gain:=2', 'ROS refuses whole numbers here, write 2.0'),
        ('place:=[1, 0]', r'ROS refuses whole numbers here, write \[1.0, 0.0\]'),
        ('place:=1', 'expecting type'),
        ('sizes:=[1, 2]', 'sizes'),
    ],
)
def test_a_refused_parameter_is_an_input_error(rule, words):
    with ros_graph('-p', rule) as graph, pytest.raises(InputError, match=f'parameter .*{words}'):
        graph.add(Stage)


def test_every_parameter_has_a_value_also_an_empty_list():
    """``ros2 param dump`` asks for all at once, and gets nothing if one of them is not set."""
    with ros_graph('-p', 'weights:=[1.0]') as graph:
        graph.add(Stage)
        names = ['name', 'count', 'sizes', 'weights', 'inner.gain']
        values = graph.call(GetParameters, 'stage/get_parameters', GetParameters.Request(names=names)).values
        assert [value.type for value in values] == [4, 2, 9, 8, 3]
        assert (list(values[2].string_array_value), list(values[3].double_array_value)) == ([], [1.0])
        assert set_parameter(graph, 'sizes', ['7:0.5']) == (False, 'Trying to set a read-only parameter: sizes.')
        assert set_parameter(graph, 'weights', [2.0]) == (True, '')


def test_a_node_works_on_one_thread_unless_the_user_wants_more():
    program = """
import thermal_fiducial.nodes.aruco_detector
from thermal_fiducial.ros.process.run import limit_opencv
import cv2, os
limit_opencv()
print(cv2.getNumThreads(), os.environ['OPENBLAS_NUM_THREADS'])
"""
    limits = ('OPENBLAS_NUM_THREADS', 'OMP_NUM_THREADS', 'MKL_NUM_THREADS', 'OPENCV_FOR_THREADS_NUM')
    bare = {name: value for name, value in os.environ.items() if name not in limits}
    for limited, said in ((bare, '1 1'), ({**bare, 'OPENBLAS_NUM_THREADS': '3'}, '1 3')):
        done = subprocess.run(
            [sys.executable, '-c', program],
            env=limited,
            capture_output=True,
            text=True,
            timeout=PATIENCE_S,
            check=False,
        )
        assert done.stdout.strip() == said, done.stderr


def test_an_opencv_that_reads_no_environment_is_limited_too(monkeypatch):
    before = cv2.getNumThreads()
    try:
        for wanted, threads in (('', 1), ('2', 2)):
            monkeypatch.setenv('OPENCV_FOR_THREADS_NUM', wanted)
            cv2.setNumThreads(4)
            run.limit_opencv()
            assert cv2.getNumThreads() == threads
    finally:
        cv2.setNumThreads(before)


def set_parameter(graph, name, value):
    request = SetParameters.Request(parameters=[Parameter(name, value=value).to_parameter_msg()])
    (result,) = graph.call(SetParameters, 'stage/set_parameters', request).results
    return result.successful, result.reason


def test_dynamic_parameters_can_be_set_and_others_not():
    with ros_graph() as graph:
        node = graph.add(Stage)
        assert set_parameter(graph, 'inner.gain', 3.0) == (True, '')
        assert set_parameter(graph, 'name', 'b') == (True, '')
        assert node.config == Parameters(name='b', inner=Inner(3.0))
        assert set_parameter(graph, 'name', 'c')[0] is False
        assert set_parameter(graph, 'inner.gain', 7.0)[0] is False
        assert set_parameter(graph, 'count', 4)[0] is False
        assert node.config == Parameters(name='b', inner=Inner(3.0))
        (value,) = graph.call(GetParameters, 'stage/get_parameters', GetParameters.Request(names=['inner.gain'])).values
        assert value.double_value == 3.0


def test_the_profile_is_used_unless_the_user_has_one(monkeypatch):
    for name in ('FASTRTPS_DEFAULT_PROFILES_FILE', 'FASTDDS_DEFAULT_PROFILES_FILE'):
        monkeypatch.delenv(name, raising=False)
    run.use_transport_profile()
    assert os.environ['FASTRTPS_DEFAULT_PROFILES_FILE'] == str(run.PROFILE)
    monkeypatch.setenv('FASTRTPS_DEFAULT_PROFILES_FILE', '/my/profile.xml')
    run.use_transport_profile()
    assert os.environ['FASTRTPS_DEFAULT_PROFILES_FILE'] == '/my/profile.xml'


def test_the_profile_takes_an_image_whole():
    root = ElementTree.parse(run.PROFILE).getroot()
    sizes = {
        element.tag.rpartition('}')[2]: int(element.text) for element in root.iter() if (element.text or '').isdigit()
    }
    # A 640x514 frame of 16 bits and its header; a segment smaller than a message loses messages silently.
    assert sizes['maxMessageSize'] > 640 * 514 * 2 + 1000
    assert sizes['segment_size'] >= 4 * sizes['maxMessageSize']


@pytest.mark.parametrize('arguments', [['--params-file', '/nowhere.yaml'], ['-p', 'x'], ['-r', 'bad']])
def test_arguments_that_ros_cannot_read_are_an_input_error(arguments):
    with pytest.raises(InputError) as caught:
        run.initialise(['--ros-args', *arguments], Context())
    assert '\n' not in str(caught.value)
    assert arguments[1] in str(caught.value)


@pytest.mark.parametrize(
    ('arguments', 'remedy'),
    [
        (['-p', 'place:=[0, 0.5]'], ': among decimal numbers write 0.0 for 0'),
        (['-r', '__ns:=drone1'], ': a namespace begins with a slash, as /drone1'),
    ],
)
def test_errors_in_the_words_of_ros_have_a_remedy(arguments, remedy):
    with pytest.raises(InputError, match=re.escape(remedy)):
        run.initialise(['--ros-args', *arguments], Context())


@pytest.mark.parametrize(
    ('arguments', 'words'),
    [
        (('-r', '__ns:=/drone/'), 'a namespace is as /drone1, without a slash at its end'),
        (('-r', f'__ns:=/{230 * "a"}'), 'a namespace or another name is too long'),
        (('-r', f'imu/data:=/{250 * "a"}'), 'a namespace or another name is too long'),
        (('-p', 'use_sim_time:="true"'), "'use_sim_time' to 'true' of type 'STRING', expecting type 'BOOL'"),
    ],
)
def test_what_rclpy_refuses_of_a_node_ends_it_for_good(arguments, words):
    """With a traceback and status 1 launch would have started it again every second."""
    program = 'import sys; from thermal_fiducial.nodes import pose_ekf; sys.exit(pose_ekf.main())'
    done = finished(program, '--ros-args', *arguments)
    assert (done.returncode, 'Traceback' in done.stderr) == (2, False)
    assert words in done.stderr


@pytest.mark.parametrize('command', ['watch', 'check-bridge'])
def test_what_rclpy_refuses_of_a_node_is_one_line_of_a_command(command, capfd):
    """It ended with a traceback."""
    assert main([command, '--ros-args', '-r', '__ns:=/drone/']) == 2
    assert capfd.readouterr().err.splitlines()[-1].endswith('a namespace is as /drone1, without a slash at its end')


def without_a_home(program, *arguments):
    """What a program says and its exit status where ROS cannot write its logs."""
    home = {name: value for name, value in environment().items() if name != 'ROS_LOG_DIR'} | {'ROS_HOME': '/proc/here'}
    command = [sys.executable, '-c', program, *arguments]
    return subprocess.run(command, env=home, capture_output=True, text=True, timeout=PATIENCE_S, check=False)


def test_a_node_runs_without_a_log_file():
    """On a disk that has become read-only a node that crashed in flight ended with status 2, and stayed down."""
    program = """
import os, signal, sys
from support.empty_stage import EmptyStage
from thermal_fiducial.ros.process import run

class Stage(EmptyStage):
    def __init__(self):
        super().__init__()
        self.create_timer(0.01, lambda: os.kill(os.getpid(), signal.SIGINT))

    def finish(self):
        self.get_logger().info('finished')

sys.exit(run.run(Stage))
"""
    done = without_a_home(program)
    # Behind the last line ROS says that it does not reach /rosout any more.
    first, last, *_ = done.stderr.splitlines()
    assert done.returncode == 0
    assert 'WARN' in first
    assert "no log file: failed to initialize logging: Failed to create log directory '/proc/here/log'" in first
    assert first.endswith('; ROS_LOG_DIR names another folder')
    assert last.endswith('[stage]: finished')


def test_a_command_needs_no_log_file():
    program = 'import sys; from thermal_fiducial.cli.main import main; sys.exit(main())'
    done = without_a_home(program, 'watch', '--once', '--wait', '0.1')
    assert (done.returncode, done.stderr) == (1, '')


def secured(tmp_path, keystore, module, *arguments):
    """Exit status, and last line of the errors, of a program whose keystore has an enclave without keys."""
    (tmp_path / 'keys' / 'enclaves' / 'empty').mkdir(parents=True)
    environment = {
        'ROS_SECURITY_ENABLE': 'true',
        'ROS_SECURITY_STRATEGY': 'Enforce',
        'ROS_SECURITY_KEYSTORE': keystore and str(tmp_path / keystore),
    }
    done = subprocess.run(
        [sys.executable, '-m', f'thermal_fiducial{module}', *arguments],
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    return done.returncode, done.stderr.splitlines()[-1]


@pytest.mark.parametrize(
    ('keystore', 'enclave', 'words'),
    [
        ('', '/drone', 'ROS_SECURITY_KEYSTORE is not set'),
        ('keys', '/drone', "enclaves/drone' does not exist"),
        ('keys', '/empty', 'error creating node'),
    ],
)
def test_a_node_refused_by_security_reports_it_and_is_not_restarted(tmp_path, keystore, enclave, words):
    """Without a keystore, without its enclave, and with one that has no keys (or a middleware without security)."""
    status, last = secured(tmp_path, keystore, '.nodes.landing_target', '--ros-args', '--enclave', enclave)
    assert (status, last.partition(':')[0]) == (2, 'landing_target.py')
    assert words in last


@pytest.mark.parametrize('command', [['watch', '--once'], ['check-bridge', '--seconds', '1']])
def test_a_command_refused_by_security_reports_it(tmp_path, command):
    """It ended with a traceback."""
    status, last = secured(tmp_path, 'keys', '', *command, '--ros-args', '--enclave', '/empty')
    assert status == 2
    assert last.startswith(f'thermal-fiducial {command[0]}: ROS_SECURITY_ENABLE is true: error creating node')


def test_arguments_that_ros_leaves_are_named():
    """One letter missing, and the parameters behind it would be nobody's."""
    command = [sys.executable, '-m', 'thermal_fiducial.nodes.landing_target', '--ros-arg', '-p', 'landing_pad:=[1]']
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    assert done.returncode == 2
    assert done.stderr.startswith('landing_target.py: argument --ros-arg: ')


@pytest.mark.parametrize('ending', ['os.kill(os.getpid(), signal.SIGINT)', 'rclpy.shutdown()'])
def test_a_node_interrupted_in_its_constructor_stops_silently(ending):
    program = f"""
import os, signal, sys
import rclpy
from thermal_fiducial.nodes.marker_mapper import MarkerMapperNode
from thermal_fiducial.ros.process.run import run

class Stopped(MarkerMapperNode):
    def declare_parameter(self, *args, **kwargs):
        {ending}
        return super().declare_parameter(*args, **kwargs)

sys.exit(run(Stopped))
"""
    done = finished(program)
    assert (done.returncode, done.stdout + done.stderr) == (0, '')


@pytest.mark.parametrize(
    ('executable', 'quiet'),
    [('-m', True), ('/opt/rig/lib/thermal_fiducial/pose_ekf', True), ('thermal-fiducial', False), ('', False)],
)
def test_a_node_interrupted_in_its_imports_stops_silently_and_commands_are_unaffected(executable, quiet):
    # Where the tests run in the background of a shell, SIGINT is ignored from the start.
    program = (
        'import os, signal, sys\nsignal.signal(signal.SIGINT, signal.default_int_handler)\n'
        f'sys.argv = [{executable!r}]\nimport thermal_fiducial.nodes\n'
        'os.kill(os.getpid(), signal.SIGINT)'
    )
    done = finished(program)
    assert done.returncode == -signal.SIGINT
    assert ('KeyboardInterrupt' in done.stderr) is not quiet


ENDED = """
import os, re, signal, sys, time
from diagnostic_msgs.msg import DiagnosticArray
from support.empty_stage import EmptyStage
from thermal_fiducial.ros.process import run, stopping

class Stage(EmptyStage):
    def __init__(self):
        super().__init__()
        self.output = self.advertise(DiagnosticArray, 'results')
        self.create_timer(0.01, lambda: self.guard(self.work, None))

    def work(self, _):
        os.kill(os.getpid(), signal.SIGINT)
        %s

    def finish(self):
        print('finished', flush=True)

    def close(self):
        print('saved', flush=True)

    def destroy_node(self):
        %s
        super().destroy_node()

class Late:
    def __del__(self, os=os, signal=signal):
        %s

sys.modules['late'] = Late()
stopping.%s
sys.exit(run.run(Stage))
"""
PUBLISHES = """
        while self.context.ok():
            time.sleep(0.01)
        self.output.send(DiagnosticArray())"""
LONG = 'LEAVING_S = stopping.LEAVING_CPU_S = 600.0'
SHORT = 'LEAVING_CPU_S = stopping.CRASHED_S = 0.1'
CRASHES = """
def crash(*_):
    raise RuntimeError('as no guard catches')
run._spin = crash
sys.exit(run.run(Stage))"""
IS_DEAF = """
def go_deaf(node, *_):
    node.deaf = 'deaf'
run._spin = go_deaf
sys.exit(run.run(Stage))"""
HOLDS_THE_INTERPRETER = "re.match('(a+)+$', 64 * 'a' + 'b')"


@pytest.mark.parametrize(
    ('at_work', 'while_destroyed', 'while_python_ends', 'limit', 'status'),
    [
        (PUBLISHES, 'pass', 'pass', LONG, 0),
        ('pass', 'pass', 'os.kill(os.getpid(), signal.SIGTERM)', LONG, 0),
        ('pass', HOLDS_THE_INTERPRETER, 'pass', 'LEAVING_CPU_S = 0.1', -signal.SIGPROF),
        ('pass', 'time.sleep(60)', 'pass', 'LEAVING_S = 0.1', -signal.SIGALRM),
    ],
)
def test_a_node_stops_silently(at_work, while_destroyed, while_python_ends, limit, status):
    """Stopped in a callback that publishes, again while the interpreter ends, and with a library that never returns.

    What a flight leaves to do is done each time.
    """
    program = ENDED % (at_work, while_destroyed, while_python_ends, limit)
    done = finished(program)
    assert (done.returncode, done.stdout.splitlines(), done.stderr) == (status, ['finished', 'saved'], '')


def test_what_fails_at_the_end_is_logged_and_the_rest_is_done_in_its_time():
    """It went by without a word, and the time for leaving the graph began before the map was saved."""
    program = """
import os, signal, sys
from support.empty_stage import EmptyStage
from thermal_fiducial.ros.process import run

class Stage(EmptyStage):
    def __init__(self):
        super().__init__()
        self.completions += [lambda: 1 / 0, lambda: print('finished', flush=True)]
        self.endings.append(lambda: print('saved, limit', signal.getitimer(signal.ITIMER_PROF)[0], flush=True))
        self.create_timer(0.01, lambda: os.kill(os.getpid(), signal.SIGINT))

sys.exit(run.run(Stage))
"""
    done = finished(program)
    assert (done.returncode, done.stdout.splitlines()) == (0, ['finished', 'saved, limit 0.0'])
    assert 'ZeroDivisionError' in done.stderr


@pytest.mark.parametrize('ending', [CRASHES, IS_DEAF])
def test_a_node_that_crashes_or_is_deaf_and_does_not_end_is_no_stopped_one(ending):
    """It is to be started again: SIGPROF would say that it was asked to stop."""
    program = ENDED.replace('sys.exit(run.run(Stage))', ending) % ('pass', HOLDS_THE_INTERPRETER, 'pass', SHORT)
    done = finished(program)
    assert (done.returncode, done.stdout.splitlines()) == (-signal.SIGALRM, ['saved'])


@pytest.mark.parametrize(('at_the_end', 'after'), [('pass', ['again']), ('os.kill(os.getpid(), signal.SIGINT)', [])])
def test_a_deaf_node_that_is_asked_to_stop_while_it_saves_does_not_start_again(at_the_end, after):
    program = f"""
import os, signal, sys
from support.empty_stage import EmptyStage
from thermal_fiducial.ros.process import run

class Stage(EmptyStage):
    def close(self):
        {at_the_end}
        print('saved', flush=True)

def go_deaf(node, *_):
    node.deaf = 'deaf'

run._spin, run._start_again = go_deaf, lambda: print('again', flush=True)
sys.exit(run.run(Stage))
"""
    done = finished(program)
    assert (done.returncode, done.stdout.splitlines(), done.stderr) == (0, ['saved', *after], '')


CRASHED = "raise RuntimeError('as no guard catches')"


@pytest.mark.parametrize(
    ('in_flight', 'status', 'last'),
    [
        (CRASHED, 1, 'RuntimeError: as no guard catches'),
        ("node.deaf = 'deaf'", 0, 'again'),
        ('os.kill(os.getpid(), signal.SIGINT)', 2, '-c: the map is not saved: the disk is full'),
    ],
)
def test_a_map_that_cannot_be_saved_keeps_no_crashed_or_deaf_node_from_starting_again(in_flight, status, last):
    """Status 2 is that of refused parameters: launch files would not start it again, in flight."""
    program = f"""
import os, signal, sys
from support.empty_stage import EmptyStage
from thermal_fiducial.errors import InputError
from thermal_fiducial.ros.process import run

class Stage(EmptyStage):
    def close(self):
        raise InputError('the map is not saved: the disk is full')

def spin(node, *_):
    {in_flight}

run._spin, run._start_again = spin, lambda: print('again', file=sys.stderr)
sys.exit(run.run(Stage))
"""
    done = finished(program)
    lines = done.stderr.splitlines()
    assert (done.returncode, lines[-1]) == (status, last)
    assert sum('the map is not saved: the disk is full' in line for line in lines) == 1
