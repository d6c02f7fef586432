"""The live view: what it says of each state, and that it hears real messages."""

from contextlib import contextmanager
import fcntl
import io
from pathlib import Path
import threading
import time

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
import numpy as np
import pytest
from rclpy.context import Context
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2
from support.commands import status
from support.waiting import PATIENCE_S

from thermal_fiducial.cli import watch as command
from thermal_fiducial.cli.main import main
from thermal_fiducial.core.measurements import MARKER_DTYPE
from thermal_fiducial.replay.domain import own_domain
from thermal_fiducial.ros.base import qos
from thermal_fiducial.ros.messages import clouds, convert
from thermal_fiducial.ros.watching.live_status import Advice, LiveStatus, STAGES
from thermal_fiducial.ros.watching.watcher import watch

FIGURES = {'time offset': '0.0182', 'time offset std': '0.0004', 'usable for': '9.75', 'lost': 'False'}


def flying(seconds=4.0, **said):
    """A status after ``seconds`` of healthy flight; ``said``: node to its last level and words."""
    status = LiveStatus()
    for k in range(round(200 * seconds)):
        status.odometry(k * 0.005, 0.002, 0.004, 0.05)
    for k in range(round(30 * seconds)):
        status.camera_pose(k / 30, 0.04)
        status.markers(k / 30, [7, 3])
    words = dict.fromkeys(STAGES, (0, 'ok')) | said
    for node, (level, message) in words.items():
        status.diagnostic(seconds - 0.5, node, level, message, FIGURES if node == 'pose_ekf' else {})
    return status


def test_all_is_well():
    snapshot = flying().snapshot(4.0)
    assert (snapshot.advice, snapshot.headline) == (Advice.FLY, 'The pose may be flown on')
    readings = {reading.name: (reading.value, reading.unit) for reading in snapshot.readings}
    assert readings == {
        'markers in view': ('2 (3 7)', ''),
        'poses': ('200', 'Hz'),
        'camera poses': ('30', 'Hz'),
        'latency': ('2', 'ms'),
        'camera latency': ('40', 'ms'),
        'sigma': ('4.0', 'mm'),
        'sigma of attitude': ('0.05', 'deg'),
        'clock offset': ('18.2 +- 0.4', 'ms'),
        'usable without markers': ('9.8', 's'),
    }
    assert 'clock offset 18.2 +- 0.4 ms' in snapshot.line
    assert '\n' not in snapshot.line


STATES = [
    ({'tau2_camera': (1, 'FFC')}, Advice.FLY, ''),
    ({'tau2_camera': (1, 'frozen')}, Advice.FLY, ''),
    ({'tau2_camera': (1, 'camera stalled: frozen')}, Advice.CARE, 'tau2_camera: camera stalled: frozen'),
    ({'pose_ekf': (1, 'coasting: 1.2 s without a pose')}, Advice.CARE, 'coasting: 1.2 s without a pose'),
    ({'marker_mapper': (1, 'quarantined: 7')}, Advice.CARE, 'marker_mapper: quarantined: 7'),
    ({'tau2_camera': (2, 'frozen')}, Advice.CARE, 'tau2_camera: frozen'),
    ({'pose_ekf': (2, 'lost: position known to 0.41 m')}, Advice.STOP, 'lost: position known to 0.41 m'),
]


@pytest.mark.parametrize(('said', 'advice', 'words'), STATES)
def test_what_the_nodes_say_decides(said, advice, words):
    snapshot = flying(**said).snapshot(4.0)
    assert snapshot.advice is advice
    assert words in snapshot.headline


def test_figures_of_a_silent_filter_are_not_shown():
    def shown(at):
        return {reading.name: reading.value for reading in flying().snapshot(at).readings}

    assert [shown(4.0)[name] for name in ('clock offset', 'usable without markers')] == ['18.2 +- 0.4', '9.8']
    assert [shown(8.0)[name] for name in ('clock offset', 'usable without markers', 'sigma')] == ['', '', '']
    assert [shown(8.0)[name] for name in ('latency', 'camera latency')] == ['', '']


def test_silence_is_no_pose():
    assert LiveStatus().snapshot(1.0).headline == 'The pose must not be flown on: nothing is heard of pose_ekf'
    snapshot = flying().snapshot(5.0)
    assert (snapshot.advice, snapshot.reasons) == (Advice.STOP, ('no odometry for 1.0 s',))
    waiting = LiveStatus()
    waiting.diagnostic(0.0, 'pose_ekf', 1, 'waiting for markers', {})
    assert waiting.snapshot(0.5).reasons[0] == 'waiting for markers'
    unheard = LiveStatus()
    unheard.diagnostic(0.0, 'pose_ekf', 0, 'tracking', {'lost': 'False'})
    assert unheard.snapshot(0.5).reasons[0] == 'no odometry is heard, but pose_ekf says: tracking'


def test_odometry_alone_is_no_pose_to_fly_on():
    """It is published while the pose is lost, too, as only the filter's diagnostics say."""
    status = LiveStatus()
    for k in range(800):
        status.odometry(k * 0.005, 0.002, 0.004, 0.05)
    snapshot = status.snapshot(4.0)
    assert (snapshot.advice, snapshot.reasons[0]) == (Advice.STOP, 'pose_ekf says nothing')
    assert 'markers' not in snapshot.line, 'a topic that is not heard shows no 0'
    mute = flying()
    for k in range(800, 1600):
        mute.odometry(k * 0.005, 0.002, 0.004, 0.05)
    assert mute.snapshot(8.0).headline.startswith('The pose must not be flown on: pose_ekf says nothing')


def test_what_keeps_the_pose_away_is_named_beside_it():
    """It said that the pose is lost, but not that the camera was unplugged."""
    said = {'pose_ekf': (2, 'lost: position known to 0.41 m'), 'tau2_camera': (2, 'nothing on thermal/image_raw')}
    assert flying(**said).snapshot(4.0).reasons == (
        'lost: position known to 0.41 m',
        'tau2_camera: nothing on thermal/image_raw',
    )


def test_stamps_of_another_clock_give_no_latency():
    status = LiveStatus()
    for k in range(100):
        status.odometry(k * 0.005, 86_400.0, 0.004, 0.05)
    assert {r.name: r.value for r in status.snapshot(0.5).readings}['latency'] == ''


def test_the_last_refusals_come_first_and_grow_old():
    status = flying()
    for second, words in ((4.0, '7.1 sigma'), (5.0, '9.3 sigma')):
        status.diagnostic(second, 'pose_ekf', 1, 'tracking', FIGURES | {'last refused pose': f'refused: {words}'})
    for count in ('1', '2'):
        figures = {'refused messages': count, 'last refusal': 'encoding rgb8'}
        status.diagnostic(6.0, 'tau2_camera', 1, 'encoding rgb8', figures)
    assert status.snapshot(6.0).refusals == (
        (0.0, 'tau2_camera: encoding rgb8'),
        (1.0, 'pose refused: 9.3 sigma'),
        (2.0, 'pose refused: 7.1 sigma'),
    )
    assert status.snapshot(500.0).refusals == ()


def test_a_refusal_that_the_filter_repeats_while_no_poses_come_is_no_new_one():
    status = flying()
    refused = FIGURES | {'last refused pose': 'refused: 7.1 sigma'}
    for second in (4.0, 5.0, 6.0):
        status.diagnostic(second, 'pose_ekf', 1, 'coasting', refused)
    assert status.snapshot(6.0).refusals == ((2.0, 'pose refused: 7.1 sigma'),)
    status.camera_pose(6.5, 0.04)
    status.diagnostic(7.0, 'pose_ekf', 1, 'tracking', refused)
    assert status.snapshot(7.0).refusals == ((0.0, 'pose refused: 7.1 sigma'),)


def test_a_node_that_starts_again_has_refused_nothing():
    status = flying()
    for second, count, reason in ((4.0, '5', 'encoding rgb8'), (5.0, '0', '')):
        status.diagnostic(second, 'tau2_camera', 0, 'ok', {'refused messages': count, 'last refusal': reason})
    assert [why for _, why in status.snapshot(5.0).refusals] == ['tau2_camera: encoding rgb8']


def test_other_robots_do_not_count():
    status = LiveStatus('/drone1')
    status.diagnostic(0.0, 'drone2/pose_ekf', 0, 'tracking', {})
    status.diagnostic(0.0, 'pose_ekf', 0, 'tracking', {})
    elsewhere = 'nothing is heard of pose_ekf, but in /drone2: --ros-args -r __ns:=/drone2'
    assert status.snapshot(0.1).reasons == (elsewhere,)
    status.diagnostic(0.0, 'drone1/pose_ekf', 1, 'waiting for IMU', {})
    assert status.snapshot(0.1).reasons[0] == 'waiting for IMU'


def test_the_screen_shows_all_that_the_line_shows():
    from rich.console import Console

    status = flying(pose_ekf=(1, 'coasting: 1.2 s without a pose; pose refused: 7.1 sigma'))
    console = Console(width=100, file=io.StringIO())
    console.print(command.screen(status.snapshot(4.0)))
    text = console.file.getvalue()
    for words in (
        'with care',
        'coasting: 1.2 s without a pose',
        '2 (3 7)',
        '18.2 +- 0.4',
        'marker_mapper',
        'pose refused: 7.1',
    ):
        assert words in text


@pytest.mark.ros
def test_messages_of_real_nodes_are_heard_in_their_namespace():
    with own_domain() as domain:
        context = Context()
        context.init(args=['--ros-args', '-r', '__ns:=/drone1'], domain_id=domain)
        robot = Node('robot', context=context, enable_rosout=False, start_parameter_services=False)
        ending = threading.Event()
        speaking = threading.Thread(target=speak, args=(robot, ending))
        speaking.start()
        seen = []

        def show(status):
            seen.append(status.snapshot(time.monotonic()))
            return seen[-1].advice is Advice.FLY or len(seen) > 10 * PATIENCE_S

        try:
            watch(show, 0.1, ['-r', '__ns:=/drone1', '-r', 'odometry:=state'], domain)
        finally:
            ending.set()
            speaking.join()
            robot.destroy_node()
            context.try_shutdown()
    assert seen[-1].headline == 'The pose may be flown on'
    readings = {reading.name: reading.value for reading in seen[-1].readings}
    assert readings['markers in view'] == '1 (5)'
    assert readings['sigma'] == '17.3'
    assert float(readings['latency']) < 1000.0


def speak(node, ending):
    """What a healthy robot publishes, its odometry under another name, and a pose with an impossible stamp."""
    odometry = node.create_publisher(Odometry, 'state', qos.IMU_RATE_RESULT)
    markers = node.create_publisher(PointCloud2, 'markers', qos.RESULT)
    diagnostics = node.create_publisher(DiagnosticArray, '/diagnostics', qos.IMU_RATE_RESULT)
    poses = node.create_publisher(PoseWithCovarianceStamped, 'camera_pose', qos.RESULT)
    impossible = PoseWithCovarianceStamped()
    impossible.header.stamp.sec = -1
    rows = np.zeros(1, MARKER_DTYPE)
    rows['id'], rows['qw'], rows['aqw'], rows['z'], rows['az'], rows['sigma_px'] = 5, 1.0, 1.0, 2.0, 2.0, 0.05
    for corner, (u, v) in enumerate(((10, 10), (50, 10), (50, 50), (10, 50))):
        rows[f'u{corner}'], rows[f'v{corner}'] = u, v
        rows[f'c{corner}uu'] = rows[f'c{corner}vv'] = 0.01
    while not ending.wait(0.02):
        now = node.get_clock().now().nanoseconds
        message = Odometry(header=convert.header(now, 'map'))
        message.pose.covariance[0] = message.pose.covariance[7] = message.pose.covariance[14] = 1e-4
        odometry.publish(message)
        poses.publish(impossible)
        markers.publish(clouds.cloud(rows, convert.header(now, 'camera')))
        figures = [KeyValue(key=key, value=value) for key, value in FIGURES.items()]
        status = [
            DiagnosticStatus(level=DiagnosticStatus.OK, name=f'drone1/{name}', message='ok', values=figures)
            for name in STAGES
        ]
        diagnostics.publish(DiagnosticArray(header=convert.header(now, ''), status=status))


@pytest.mark.ros
def test_once_prints_one_line_if_no_node_runs(capfd, monkeypatch):
    """Fast DDS put lines of its own before it, where a port of shared memory was still locked by another process."""
    with own_domain() as domain, locked_port(domain):
        monkeypatch.setenv('ROS_DOMAIN_ID', str(domain))
        assert main(['watch', '--once', '--wait', '0.3']) == 1
    printed, said = capfd.readouterr()
    assert printed.startswith('The pose must not be flown on: nothing is heard of pose_ekf')
    assert printed.count('\n') == 1
    assert 'open_and_lock_file failed' in said


@contextmanager
def locked_port(domain):
    """Let another process, as it seems, hold the first port of shared memory of a domain, which it has deleted."""
    port = Path(f'/dev/shm/fastrtps_port{7400 + 250 * domain + 11}')
    port.unlink(missing_ok=True)
    with port.with_name(f'{port.name}_el').open('w') as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


@pytest.mark.parametrize('wait', ['0', '-1', 'nan'])
def test_an_impossible_wait_is_refused(capsys, wait):
    assert status(['watch', '--once', f'--wait={wait}']) == 2
    assert f"argument --wait: '{wait}' is not a number" in capsys.readouterr().err
