"""What ``make soak`` measures and how it judges."""

from dataclasses import replace
import os
import subprocess
import sys
import time
from types import SimpleNamespace

import numpy as np
import pytest
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import Image

pytest.importorskip('psutil')

from soak.flying import soak
from soak.laps import lap, Laps, Repeated
from soak.minutes import faults, Meter, Minute, node_processes
from support.tiny import TINY

from thermal_fiducial.errors import InputError
from thermal_fiducial.files.bags import IMAGE_TOPIC, IMU_TOPIC
from thermal_fiducial.replay.children import NodeProcesses
from thermal_fiducial.ros.messages import convert
from thermal_fiducial.sim.thermal_camera import plan, START_NS


@pytest.fixture(scope='module')
def laps(tmp_path_factory):
    # From 0.1 m of height marker 7 is seen from directions within 2.3 degrees: three, a degree apart, are chance.
    higher = replace(TINY.flight, height=0.3)
    still = replace(TINY, sensor=replace(TINY.sensor, ffc_period=0.0), flight=higher)
    with Laps(tmp_path_factory.mktemp('soak'), plan(still, 2.0, noise=False), 5.0, workers=1) as laps:
        yield laps


def test_laps_follow_each_other_without_a_gap(laps):
    frames = [deserialize_message(item.cdr, Image) for item in laps.messages([IMAGE_TOPIC])]
    stamps = [convert.stamp_ns(frame.header.stamp) - START_NS for frame in frames]
    # Of 5 s, less what a frame takes to arrive.
    assert stamps == pytest.approx([(k + 1) * 1e9 / 30 for k in range(149)], abs=2)
    assert frames[0].data == frames[60].data == frames[120].data
    arrivals = [item.stamp_ns for item in laps.messages()]
    assert arrivals == sorted(arrivals)
    assert sum(item.topic == IMU_TOPIC for item in laps.messages()) == laps.imu_count == 1000


def test_the_truth_comes_round(laps):
    np.testing.assert_array_equal(laps.truth(START_NS + 3_500_000_000), laps.truth(START_NS + 1_500_000_000))
    # It ends at rest where it began.
    path = Repeated(TINY.trajectory(7.0, 0), 7.0)
    before, after = path(np.array([6.995, 7.0])).T_map_body
    # The spline waves on by less than a micrometre where the path rests.
    np.testing.assert_allclose(before, after, atol=1e-4)


def minutes(memory, errors, poses=12_000):
    return [
        Minute({'pose_ekf': mb}, {'pose_ekf': 0.5 * mb}, {}, poses, error, 0.0)
        for mb, error in zip(memory, errors, strict=True)
    ]


@pytest.mark.parametrize(
    ('flown', 'expected'),
    [
        (minutes([90, 100, 101, 102], [9.0, 1.0, 1.1, 1.0]), []),
        (minutes([90, 100, 103, 106], [1.0, 1.0, 1.0, 1.0]), ['pose_ekf grew by 6.0 MB, 3.0 of it shared memory']),
        (minutes([100] * 9, [9.0, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 4.5]), ['the error grew by 3.5 mm']),
        (minutes([100] * 9, [9.0, 2.0, 4.0, 1.0, 5.0, 2.0, 4.0, 1.0, 5.0]), []),
        (minutes([100, 100], [1.0, 0.0], 6_000), ['12000 poses of 24000 samples of the IMU']),
    ],
)
def test_growth_trends_and_missing_poses_are_named(flown, expected):
    assert faults(flown, 12_000 * len(flown), []) == expected


class Swinging:
    """A process that holds 100 MB, ten more for each minute that it runs, and 14 MB for seconds now and then."""

    pid, now = os.getpid(), 0

    def memory_info(self):
        kept = 100 + 10 * (self.now // 60)
        return SimpleNamespace(rss=2**20 * (kept + 14 * (self.now % 20 in (0, 1, 7))))

    @staticmethod
    def cpu_times():
        return 1.0, 1.0


def test_memory_is_what_is_kept_not_what_an_instant_has():
    process, rows = Swinging(), []
    meter = Meter(SimpleNamespace(take=lambda: np.zeros(0)), lambda: {'node': process}, rows.append)
    for process.now in range(181):
        meter(process.now * 1_000_000_000)
    assert [minute.memory_mb for minute in meter.minutes] == [{'node': 100}, {'node': 110}, {'node': 120}]
    assert len(rows) == 3


def test_a_process_that_has_ended_is_no_node():
    ended = subprocess.Popen([sys.executable, '-c', ''])
    # It stays a child, without a command line, until somebody waits for it.
    os.waitid(os.P_PID, ended.pid, os.WEXITED | os.WNOWAIT)
    assert node_processes(['']) == {}
    ended.wait()


@pytest.mark.ros
def test_a_node_that_does_not_end_well_is_named(tmp_path):
    refused, domain = pytest.raises(InputError, match='image_rate'), int(os.environ['ROS_DOMAIN_ID'])
    with NodeProcesses(domain, ['tau2_camera'], ['-p', 'image_rate:=-1.0'], tmp_path) as nodes, refused:
        while True:
            nodes.check()
            time.sleep(0.02)
    assert nodes.unclean == ['tau2_camera: ended with status 2']


@pytest.mark.ros
@pytest.mark.nightly
def test_minutes_in_lock_step_leave_no_trace(tmp_path):
    """A twentieth of an hour, in small pictures: what grows with the messages shows in one process as in four."""
    with Laps(tmp_path, lap(small=True), 181.0) as laps:
        flown, said = soak(laps, tmp_path, print, lockstep=True)
        assert faults(flown, laps.imu_count, said) == []


@pytest.mark.nightly
@pytest.mark.ros
def test_four_processes_fly_in_real_time(laps, tmp_path):
    """Five seconds: enough for a map that is saved at the end, too short for a minute."""
    _, said = soak(laps, tmp_path, print)
    assert said == []
