"""Each fault that a bridge may have is found and named; a sound one passes."""

from dataclasses import replace
import json
from types import SimpleNamespace

import numpy as np
import pytest
from rosbags.typesys import get_typestore, Stores
from support.commands import status
from support.empty_stage import finished
from support.flights import Motion

from thermal_fiducial.cli.check_bridge import exit_status
from thermal_fiducial.cli.main import main
from thermal_fiducial.core.geometry.se3 import quaternion_from_rotation, so3_exp
from thermal_fiducial.files.bag_writer import BagWriter
from thermal_fiducial.report.bridge_check import check_bridge, Finding, Level
from thermal_fiducial.report.bridge_record import BridgeRecord, BridgeRecorder

RATE = 40.0


def record_of(motion, seconds=8.0, live=True):
    """A perfect bridge at 40 Hz with the 200 Hz IMU beside it."""
    t, imu_t = np.arange(seconds * RATE) / RATE, np.arange(seconds * 200.0) / 200.0
    T, imu = motion.pose(t), motion.imu(imu_t)
    stamps = np.round(t * 1e9).astype(np.int64)
    return BridgeRecord(
        stamps_ns=stamps,
        arrivals_ns=stamps + 4_000_000,
        positions=T[:, :3, 3],
        quaternions=quaternion_from_rotation(T[:, :3, :3]),
        velocities=(motion.velocity(t)[:, None] @ T[:, :3, :3])[:, 0],
        rates=motion.imu(t)[:, :3],
        covariances=np.tile(np.diag([1e-6] * 3 + [1e-8] * 3), (len(t), 1, 1)),
        frames=(('map', 'base_link'),),
        imu_stamps_ns=np.round(imu_t * 1e9).astype(np.int64),
        imu=imu,
        live=live,
    )


@pytest.fixture(scope='module')
def flying():
    return record_of(Motion.random(np.random.default_rng(3)))


@pytest.fixture(scope='module')
def resting():
    return record_of(Motion.still())


def level_of(record, check):
    (finding,) = [finding for finding in check_bridge(record) if finding.check == check]
    assert finding.consequence or finding.level is Level.OK
    return finding.level


def test_a_sound_bridge_has_no_fault(flying, resting):
    assert {finding.level for finding in check_bridge(flying)} <= {Level.OK, Level.UNTESTED}
    assert level_of(flying, 'yaw') is Level.OK
    assert level_of(flying, 'velocity') is Level.OK
    assert level_of(resting, 'gravity') is Level.OK
    assert level_of(resting, 'yaw') is Level.UNTESTED
    assert level_of(resting, 'velocity') is Level.UNTESTED


def frd(record):
    """The same in NED and FRD: somebody has already converted."""
    flip = np.array([1.0, -1.0, -1.0])
    return replace(
        record,
        positions=record.positions * flip,
        quaternions=record.quaternions * np.array([1.0, -1.0, -1.0, 1.0]),
        velocities=record.velocities * flip,
    )


def upside_down(record):
    turned = record.rotations @ np.diag([1.0, -1.0, -1.0])
    return replace(record, quaternions=quaternion_from_rotation(turned))


def tilted(record):
    return replace(record, quaternions=quaternion_from_rotation(so3_exp([0.2, 0.0, 0.0]) @ record.rotations))


def velocity_in_map(record):
    return replace(record, velocities=(record.rotations @ record.velocities[..., None])[..., 0])


def thinned(record, keep):
    arrays = ('stamps_ns', 'arrivals_ns', 'positions', 'quaternions', 'velocities', 'rates', 'covariances')
    return replace(record, **{name: getattr(record, name)[keep] for name in arrays})


def jumping(record):
    positions = record.positions.copy()
    positions[100:] += [1.0, 0.0, 0.0]
    return replace(record, positions=positions)


def with_stamps(record, change):
    stamps = record.stamps_ns.copy()
    stamps[50] += change
    return replace(record, stamps_ns=stamps)


FAULTS = {
    'values': lambda record: replace(record, positions=record.positions * np.nan),
    'rate': lambda record: thinned(record, slice(None, None, 20)),
    'stamps': lambda record: with_stamps(record, -100_000_000),
    'age': lambda record: replace(record, arrivals_ns=record.stamps_ns + 400_000_000),
    'frame names': lambda record: replace(record, frames=(('world', 'base_link'),)),
    'yaw': frd,
    'velocity': velocity_in_map,
    'covariance': lambda record: replace(record, covariances=0.0 * record.covariances),
    'jumps': jumping,
}


@pytest.mark.parametrize('check', FAULTS)
def test_each_fault_is_found(flying, check):
    assert level_of(FAULTS[check](flying), check) is Level.FAULT


def turned_to_the_left(resting, bias):
    """Two seconds at rest, then two by 0.5 rad/s to the left, and the gyroscope is off by ``bias`` [rad/s]."""
    angles = 0.5 * np.clip(resting.stamps_ns * 1e-9 - 2.0, 0.0, 2.0)
    imu = resting.imu.copy()
    imu[:, 2] = bias + 0.5 * ((resting.imu_stamps_ns > 2_000_000_000) & (resting.imu_stamps_ns < 4_000_000_000))
    turns = quaternion_from_rotation(np.array([so3_exp([0.0, 0.0, angle]) for angle in angles]) @ resting.rotations)
    return replace(resting, quaternions=turns, imu=imu)


def test_a_bias_of_the_gyroscope_is_no_wrong_axis(resting):
    """A turn at 0.5 rad/s with a gyroscope that is off by 0.08 was 0.86 of what it says: axes are mixed up."""
    assert level_of(turned_to_the_left(resting, 0.08), 'yaw') is Level.OK
    assert level_of(frd(turned_to_the_left(resting, 0.08)), 'yaw') is Level.FAULT


def test_the_rate_of_our_own_launch_files_is_enough(flying):
    """30 Hz of mavros.launch.py, of samples at 200 Hz: 29.97 Hz in 4 s, of which it warned, as of 30.0."""
    stamps = np.ceil(np.arange(120) * 200.0 / 30.0).astype(np.int64) * 5_000_000
    stamps[-1] += 5_000_000
    assert level_of(replace(thinned(flying, slice(120)), stamps_ns=stamps), 'rate') is Level.OK
    # A third fewer are too few.
    assert level_of(replace(thinned(flying, slice(120)), stamps_ns=stamps * 3 // 2), 'rate') is Level.WARNING


def test_corrections_by_markers_are_no_wrong_velocity(flying):
    """Steps of 5 mm from message to message are 0.2 m/s at 40 Hz, and 10 mm/s over half a second."""
    steps = np.random.default_rng(1).normal(scale=0.005, size=flying.positions.shape)
    assert level_of(replace(flying, positions=flying.positions + steps), 'velocity') is Level.OK


@pytest.mark.parametrize('fault', [upside_down, tilted])
def test_a_wrong_vertical_is_found(resting, fault):
    assert level_of(fault(resting), 'gravity') is Level.FAULT


def test_where_a_flight_turns_back_is_no_rest():
    """Slow for an instant, at the largest acceleration: 0.9 m/s^2 would be a tilt of 5 degrees."""
    there_and_back = np.zeros((3, 1, 3))
    there_and_back[0] = (0.4, 1.5, 0.0)
    assert level_of(record_of(Motion(there_and_back, np.zeros((3, 1, 3)))), 'gravity') is Level.UNTESTED


def test_smaller_flaws_are_warnings(flying):
    gap = np.delete(np.arange(len(flying.stamps_ns)), np.arange(100, 110))
    assert level_of(thinned(flying, gap), 'rate') is Level.WARNING
    assert level_of(thinned(flying, slice(None, None, 2)), 'rate') is Level.WARNING
    repeated = with_stamps(flying, -round(1e9 / RATE))
    assert level_of(repeated, 'stamps') is Level.WARNING
    assert level_of(replace(flying, covariances=1e-10 * flying.covariances), 'covariance') is Level.WARNING
    assert level_of(replace(flying, arrivals_ns=flying.stamps_ns - 50_000_000), 'age') is Level.FAULT
    assert level_of(replace(flying, live=False), 'age') is Level.UNTESTED


def test_silence_is_a_fault():
    (finding,) = check_bridge(BridgeRecorder().record())
    assert finding.level is Level.FAULT
    assert 'nothing' in finding.consequence


def message(record, index):
    vector = lambda v: SimpleNamespace(**dict(zip('xyzw', map(float, v), strict=False)))  # noqa: E731
    stamp = SimpleNamespace(sec=int(record.stamps_ns[index]) // 10**9, nanosec=int(record.stamps_ns[index]) % 10**9)
    pose = SimpleNamespace(position=vector(record.positions[index]), orientation=vector(record.quaternions[index]))
    twist = SimpleNamespace(linear=vector(record.velocities[index]), angular=vector(record.rates[index]))
    return SimpleNamespace(
        header=SimpleNamespace(stamp=stamp, frame_id='map'),
        child_frame_id='base_link',
        pose=SimpleNamespace(pose=pose, covariance=record.covariances[index].ravel()),
        twist=SimpleNamespace(twist=twist),
    )


def test_messages_become_the_record(flying):
    recorder = BridgeRecorder(live=True)
    for index in range(len(flying.stamps_ns)):
        recorder.odometry(message(flying, index), int(flying.arrivals_ns[index]))
    record = recorder.record()
    for name in ('stamps_ns', 'arrivals_ns', 'positions', 'quaternions', 'velocities', 'rates', 'covariances'):
        np.testing.assert_array_equal(getattr(record, name), getattr(flying, name))
    assert record.frames == flying.frames


def test_the_command_wants_something_to_check(tmp_path, capsys):
    assert main(['check-bridge', str(tmp_path / 'nothing')]) == 2
    assert 'no such bag' in capsys.readouterr().err
    assert status(['check-bridge', '--seconds', '-1']) == 2


def test_a_recorded_run_is_checked(tmp_path, flying, capsys):
    """Written as messages of a bag, read back by the command; exit status 1 means a fault."""
    types = get_typestore(Stores.ROS2_JAZZY).types
    stamp_type, header_type = types['builtin_interfaces/msg/Time'], types['std_msgs/msg/Header']
    vector, point, quaternion = (types[f'geometry_msgs/msg/{name}'] for name in ('Vector3', 'Point', 'Quaternion'))
    with BagWriter(tmp_path / 'output') as bag:
        for index, stamp in enumerate(flying.stamps_ns):
            header = header_type(stamp_type(int(stamp) // 10**9, int(stamp) % 10**9), 'map')
            pose = types['geometry_msgs/msg/Pose'](
                point(*flying.positions[index]), quaternion(*flying.quaternions[index])
            )
            twist = types['geometry_msgs/msg/Twist'](vector(*flying.velocities[index]), vector(*flying.rates[index]))
            covariance = flying.covariances[index].ravel()
            odometry = types['nav_msgs/msg/Odometry'](
                header,
                'base_link',
                types['geometry_msgs/msg/PoseWithCovariance'](pose, covariance),
                types['geometry_msgs/msg/TwistWithCovariance'](twist, covariance),
            )
            bag.write('bridge/odometry', int(stamp), odometry)
    assert main(['check-bridge', str(tmp_path), '--json']) == 0
    findings = {entry['check']: entry for entry in json.loads(capsys.readouterr().out)}
    assert findings['yaw']['level'] == 'ok'
    assert findings['gravity']['level'] == 'not tested'
    assert main(['check-bridge', str(tmp_path), '--topic', 'nothing']) == 2


@pytest.mark.parametrize(
    ('levels', 'live', 'recorded'),
    [((), 0, 0), ((Level.WARNING,), 0, 0), ((Level.UNTESTED,), 3, 0), ((Level.UNTESTED, Level.FAULT), 1, 1)],
)
def test_a_live_check_that_lacked_its_motion_is_no_pass(levels, live, recorded):
    findings = [Finding('a check', level, '', '') for level in (Level.OK, *levels)]
    assert exit_status(findings, live=True) == live
    assert exit_status(findings, live=False) == recorded


def test_listening_needs_no_optional_package_and_takes_ros_arguments():
    program = """
import sys
for name in ('rich', 'matplotlib', 'scipy', 'rosbags', 'jinja2', 'ezdxf'):
    sys.modules[name] = None
from thermal_fiducial.cli.main import main
from thermal_fiducial.ros.watching import bridge_listener
bridge_listener.DISCOVERY_S, bridge_listener.SAID_S = 0.2, 0.1
sys.exit(main(['check-bridge', '--seconds', '0.1', '--ros-args', '-r', '__ns:=/drone', '-r', 'imu/data:=imu/raw']))
"""
    done = finished(program)
    assert done.returncode == 1
    assert 'Listening to /drone/bridge/odometry and /drone/imu/raw for' in done.stderr
    assert 'fault  messages: 0 messages' in done.stdout
