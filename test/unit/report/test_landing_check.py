"""check-bridge on a landing target: a sound one passes, each way to get it wrong is named."""

from dataclasses import replace

import numpy as np
import pytest
from rosbags.typesys import get_typestore, Stores

from thermal_fiducial.cli.main import main
from thermal_fiducial.core.geometry.se3 import so3_exp
from thermal_fiducial.files.bag_writer import BagWriter
from thermal_fiducial.report.bridge_check import Level
from thermal_fiducial.report.bridge_record import BridgeRecord, LandingRecord
from thermal_fiducial.report.landing_check import check_landing

RATE, SECONDS = 30.0, 10.0
PAD = np.array([1.0, -2.0, 0.0])
T = np.arange(RATE * SECONDS) / RATE
STAMPS = np.round(T * 1e9).astype(np.int64)
POSITIONS = np.stack([1.0 + np.sin(T), -2.0 + 0.5 * np.cos(T), 3.0 - 0.2 * T], axis=1)
ANGLES = np.stack([0.1 * np.sin(2 * T), 0.1 * np.cos(T), 0.3 * T], axis=1)
ROTATIONS = so3_exp(ANGLES)


def quaternions():
    half = 0.5 * np.linalg.norm(ANGLES, axis=1, keepdims=True)
    return np.concatenate([ANGLES * np.sinc(half / np.pi) * 0.5, np.cos(half)], axis=1)


def record(body=True):
    """A descent that sways above a pad."""
    in_body = (PAD - POSITIONS)[:, None] @ ROTATIONS
    forward, left, up = in_body[:, 0].T
    given = np.stack([-left, forward, up], axis=1) if body else np.tile(PAD, (len(T), 1))
    empty = np.zeros((len(T), 3))
    return BridgeRecord(
        stamps_ns=STAMPS,
        arrivals_ns=STAMPS,
        positions=POSITIONS,
        quaternions=quaternions(),
        velocities=empty,
        rates=empty,
        covariances=np.zeros((len(T), 6, 6)),
        frames=(('map', 'base_link'),),
        imu_stamps_ns=np.zeros(0, np.int64),
        imu=np.zeros((0, 6)),
        landing=LandingRecord(STAMPS + 1_000_000, given, ('base_link_rfu' if body else 'map',)),
    )


def levels(given, **changes):
    findings = check_landing(replace(given, landing=replace(given.landing, **changes)))
    return {finding.check: finding.level for finding in findings}


def test_the_attitudes_are_those_of_the_quaternions():
    # of this file's own making
    np.testing.assert_allclose(record().rotations, ROTATIONS, atol=1e-12)


@pytest.mark.parametrize('body', [True, False])
def test_a_sound_target_has_no_fault(body):
    assert levels(record(body)) == {'landing target rate': Level.OK, 'landing target': Level.OK}


def test_without_a_target_there_is_nothing_to_say():
    given = record()
    assert check_landing(replace(given, landing=BridgeRecord.landing)) == []


def test_each_mistake_is_named():
    given = record()
    p = given.landing.positions
    assert levels(given, positions=p[:, [1, 0, 2]])['landing target'] is Level.FAULT  # forward, left for right, forward
    assert levels(given, positions=p * [1.0, 1.0, -1.0])['landing target'] is Level.FAULT  # down for up
    assert levels(given, positions=p * np.nan)['landing target'] is Level.FAULT
    assert levels(given, frames=('base_link_rfu', 'map'))['landing target'] is Level.FAULT
    # a camera that is 5 deg askew: 26 cm at 3 m, round the pad as the drone turns
    askew = p @ so3_exp(np.radians([5.0, 0.0, 0.0]))
    assert levels(given, positions=askew)['landing target'] is Level.WARNING
    keep = (T < 4.0) | (T > 6.0)
    seldom = {'stamps_ns': given.landing.stamps_ns[keep], 'positions': p[keep]}
    assert levels(given, **seldom)['landing target rate'] is Level.WARNING
    assert levels(given, stamps_ns=given.landing.stamps_ns + 10**12)['landing target'] is Level.UNTESTED


@pytest.mark.parametrize('robot', ['', '/drone1/'])
def test_the_command_reads_it_from_a_bag(tmp_path, capsys, robot):
    """That of a robot with a namespace was not looked for, and topics as ROS writes them were not found."""
    types = get_typestore(Stores.ROS2_JAZZY).types
    given = record()

    def header(stamp, frame):
        seconds, nanoseconds = divmod(int(stamp), 10**9)
        time = types['builtin_interfaces/msg/Time'](sec=seconds, nanosec=nanoseconds)
        return types['std_msgs/msg/Header'](stamp=time, frame_id=frame)

    def pose(position, quaternion):
        return types['geometry_msgs/msg/Pose'](
            position=types['geometry_msgs/msg/Point'](*map(float, position)),
            orientation=types['geometry_msgs/msg/Quaternion'](*map(float, quaternion)),
        )

    vector = types['geometry_msgs/msg/Vector3']
    still = types['geometry_msgs/msg/Twist'](linear=vector(0.0, 0.0, 0.0), angular=vector(0.0, 0.0, 0.0))
    with BagWriter(tmp_path / 'bag') as bag:
        for k, stamp in enumerate(STAMPS):
            place = types['geometry_msgs/msg/PoseWithCovariance'](
                pose=pose(given.positions[k], given.quaternions[k]), covariance=np.eye(6).ravel() * 1e-4
            )
            odometry = types['nav_msgs/msg/Odometry'](
                header=header(stamp, 'map'),
                child_frame_id='base_link',
                pose=place,
                twist=types['geometry_msgs/msg/TwistWithCovariance'](twist=still, covariance=np.eye(6).ravel()),
            )
            target = pose(given.landing.positions[k], (0.0, 0.0, 0.0, 1.0))
            bag.write(f'{robot}bridge/odometry', int(stamp), odometry)
            bag.write(
                f'{robot}landing_target',
                int(stamp),
                types['geometry_msgs/msg/PoseStamped'](header=header(stamp, 'base_link_rfu'), pose=target),
            )
    main(['check-bridge', str(tmp_path / 'bag'), *(['--topic', f'{robot}bridge/odometry'] if robot else [])])
    assert 'ok  landing target: in the body (ArduPilot, BODY_FRD), 2.' in capsys.readouterr().out
