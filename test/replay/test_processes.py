"""Replay with one process a node: what comes out, what is measured, how it ends."""

from contextlib import redirect_stderr
import json
from pathlib import Path
import re
from shutil import which
import subprocess
import sys

import numpy as np
import pytest
from support import small_bag
from support.empty_stage import environment
from support.waiting import until

from thermal_fiducial.cli.main import main
from thermal_fiducial.files.bags import BagReader
from thermal_fiducial.files.images import header_stamp_ns
from thermal_fiducial.files.marker_map import load_map
from thermal_fiducial.files.trajectory_file import load_tum
from thermal_fiducial.replay.latency import IMAGE_TO_CORRECTED_POSE, IMU_TO_POSE, LatencyMeter

pytestmark = [pytest.mark.ros, pytest.mark.slow]


FEW = 3


def lost_samples(stamps):
    return (stamps[-1] - stamps[0]) // 5_000_000 + 1 - len(stamps)


@pytest.fixture(scope='module')
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp('processes')
    bag = small_bag.recording(seconds=2.0).write(folder / 'bag')
    map_file, params = small_bag.side_files(folder)
    # Half speed: the machine that runs the tests may be busy with others.
    arguments = ['replay', bag, '--out', folder / 'run', '--params', params, '--map', map_file, '--no-report']
    for _ in range(3):
        with (folder / 'printed').open('w') as printed, redirect_stderr(printed):
            assert main([str(word) for word in (*arguments, '--transport', 'processes', '--rate', '0.5')]) == 0
        # Where another program could have listened to the nodes.
        said = r'in DDS domain (\d+) of this computer: listen with ROS_DOMAIN_ID=\1$'
        assert re.search(said, (folder / 'printed').read_text(), re.MULTILINE)
        # Best effort: what it loses on a machine that others take for a while says nothing of the nodes.
        if lost_samples(load_tum(folder / 'run' / 'fused.tum')[0]) <= FEW:
            break
    return folder / 'run'


def test_the_run_folder_is_that_of_lockstep_with_times(run):
    summary = json.loads((run / 'summary.json').read_text())
    assert summary['transport'] == 'processes'
    assert set(summary['cpu_percent']) == {'tau2_camera', 'aruco_detector', 'marker_mapper', 'pose_ekf'}
    assert all(0.0 < percent < 100.0 for percent in summary['cpu_percent'].values())
    for kind in (IMU_TO_POSE, IMAGE_TO_CORRECTED_POSE):
        assert 0.0 < summary['latency_ms'][kind]['median'] < 1000.0
    kinds = [line.split(',')[0] for line in (run / 'latency.csv').read_text().splitlines()]
    assert kinds.count(IMU_TO_POSE) == summary['messages_out']['pose']


def test_imu_messages_come_through(run):
    stamps, _, _ = load_tum(run / 'fused.tum')
    assert np.all(np.diff(stamps) > 0)
    # Best effort: none is lost on a machine that keeps up, single ones on one that tests starve.
    assert lost_samples(stamps) <= FEW
    assert small_bag.START_NS + 390 * 5_000_000 <= stamps[-1] <= small_bag.START_NS + 399 * 5_000_000


def test_the_map_is_saved_on_shutdown(run):
    assert sorted(load_map(run / 'marker_map.yaml').markers) == [0, 1, 2, 3]


def test_a_node_that_refuses_its_parameters_ends_the_replay(tmp_path, capfd):
    bag = small_bag.recording(seconds=0.2).write(tmp_path / 'bag')
    (tmp_path / 'params.yaml').write_text('/**: {ros__parameters: {marker_size: -1.0}}')
    arguments = ['replay', bag, '--out', tmp_path / 'run', '--params', tmp_path / 'params.yaml']
    assert main([str(word) for word in (*arguments, '--transport', 'processes')]) == 2
    assert 'marker_size' in capfd.readouterr().err


PROGRAM = """
from pathlib import Path
import os, sys, time
from thermal_fiducial.replay.children import NodeProcesses

with NodeProcesses(int(os.environ['ROS_DOMAIN_ID']), ['pose_ekf'], [], Path(sys.argv[1])) as nodes:
    print(*nodes.cpu_seconds(), flush=True)
    time.sleep(600.0)
"""


@pytest.mark.skipif(which('setpriv') is None, reason='setpriv (util-linux) is not installed')
def test_nodes_end_with_a_replay_that_is_killed(tmp_path):
    """They went on for ever, in a domain that the next replay took, which then waited for ever."""
    command = [sys.executable, '-c', PROGRAM, str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment()) as replay:
        assert replay.stdout.readline() == 'pose_ekf\n'
        (node,) = map(int, Path(f'/proc/{replay.pid}/task/{replay.pid}/children').read_text().split())
        until((tmp_path / 'pose_ekf.txt').read_text)
        replay.kill()
    until(lambda: not Path(f'/proc/{node}').exists())


def test_a_gap_of_years_is_played_as_a_minute(tmp_path):
    """A clock that was set during the recording; at 20 times real time, as a minute of waiting tests no more."""
    recording, gap_ns = small_bag.recording(seconds=4.0), 1_600_000_000_000_000_000
    set_ns = small_bag.START_NS + 2_000_000_000
    recording.events = [(at - gap_ns if at < set_ns else at, *event) for at, *event in recording.events]
    map_file, params = small_bag.side_files(tmp_path)
    arguments = ['replay', recording.write(tmp_path / 'bag'), '--out', tmp_path / 'run', '--params', params]
    arguments += ['--map', map_file, '--no-report', '--transport', 'processes', '--rate', '20']
    # On a busy machine the nodes may come to no pose at this rate, which is status 1.
    assert main([str(word) for word in arguments]) in (0, 1)
    with BagReader(tmp_path / 'run' / 'output') as output:
        early, late = [], []
        for message in output.messages(['markers']):
            (early if message.stamp_ns < set_ns - gap_ns + 20_000_000_000 else late).append(message.stamp_ns)
    # Each side has what the nodes took at that rate, with a second of ours for them.
    assert min(len(early), len(late)) > 0
    assert set_ns < late[0] <= late[-1] < set_ns + 22_000_000_000
    # A minute and four seconds of the bag, at that rate, are 3.2 s; what is measured is of that time.
    summary = json.loads((tmp_path / 'run' / 'summary.json').read_text())
    assert max(summary['cpu_percent'].values()) > 1.0


def test_latencies_are_paired_by_stamp():
    meter = LatencyMeter()
    meter.sent('image', 90, now_ns=0)
    meter.camera_pose(90, now_ns=4_000_000)  # starts the filter, corrects nothing
    meter.pose(95, now_ns=900_000_000)
    meter.sent('image', 100, now_ns=901_000_000)
    meter.sent('imu', 110, now_ns=903_000_000)
    meter.camera_pose(100, now_ns=905_000_000)
    meter.pose(110, now_ns=907_000_000)
    meter.pose(999, now_ns=909_000_000)
    summary = meter.summary()
    assert {kind: values['max'] for kind, values in summary.items()} == {
        'imu_to_pose': 4.0, 'image_to_camera_pose': 4.0, 'image_to_corrected_pose': 6.0
    }  # fmt: skip


@pytest.mark.parametrize(('order', 'flag'), [('little', 1), ('big', 0)])
def test_the_stamp_of_serialised_bytes(order, flag):
    data = bytes([0, flag, 0, 0]) + (1_700_000_000).to_bytes(4, order) + (123_456_789).to_bytes(4, order)
    assert header_stamp_ns(data) == 1_700_000_000_123_456_789
