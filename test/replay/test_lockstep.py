"""Replay in lock-step: complete, deterministic, equal to the offline pipeline, robust against bad bags."""

import json
import os
import signal
import sys
import time

import numpy as np
import pytest
from rclpy.executors import SingleThreadedExecutor
from rclpy.serialization import deserialize_message
from support import small_bag
import yaml

from thermal_fiducial.cli.main import main
from thermal_fiducial.core.geometry.se3 import inverse, rotation_angle, transform_from_quaternion
from thermal_fiducial.core.mapping.mapper import MarkerMapper
from thermal_fiducial.core.measurements import CORNER_FIELDS
from thermal_fiducial.core.pipeline import Pipeline, PipelineConfig
from thermal_fiducial.files.bags import BagReader, CAMERA_INFO_TOPIC, IMAGE_TOPIC, IMU_TOPIC
from thermal_fiducial.files.dictionary import load_dictionary
from thermal_fiducial.files.marker_map import load_map, save_map
from thermal_fiducial.files.trajectory_file import load_tum, tum_line
from thermal_fiducial.replay import lockstep, recorder, waiting
from thermal_fiducial.replay.recorder import RunFiles
from thermal_fiducial.ros.messages import convert

pytestmark = pytest.mark.ros


#: Of the flight: all four markers are in the map, and half of the frames are still to come.
SECONDS, FRAMES, SAMPLES = 2.0, 60, 400


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    """A bag with its parameters and a map of one marker."""
    folder = tmp_path_factory.mktemp('small')
    small_bag.recording(SECONDS).write(folder / 'bag')
    small_bag.side_files(folder)
    return folder


def replay(bag, out, folder, *extra):
    """Exit status of the command."""
    given = ['--params', folder / 'params.yaml', '--map', folder / 'map.yaml', '--no-report']
    return main([str(word) for word in ('replay', bag, '--out', out, *given, *extra)])


@pytest.fixture(scope='module')
def run(folder):
    assert replay(folder / 'bag', folder / 'run', folder) == 0
    return folder / 'run'


def test_every_imu_message_after_the_start_has_its_pose(run):
    stamps, _, _ = load_tum(run / 'fused.tum')
    imu_ns = small_bag.START_NS + 5_000_000 * np.arange(SAMPLES)
    expected = imu_ns[imu_ns >= stamps[0]]
    np.testing.assert_array_equal(stamps, expected)
    # The filter starts with its third pose, a tenth of a second in.
    assert stamps[0] - small_bag.START_NS < 300_000_000


@pytest.fixture(scope='module')
def short(folder):
    """A bag of two thirds of a second, and its run."""
    recording = small_bag.recording(2 / 3)
    recording.write(folder / 'short')
    assert replay(folder / 'short', folder / 'short_run', folder) == 0
    return recording, folder / 'short_run'


def test_compressed_images_give_the_same_poses(folder, short):
    recording, of_raw = short
    bag = recording.compressed().renamed(lambda topic: f'/drone/{topic}').write(folder / 'compressed_bag')
    assert replay(bag, folder / 'compressed_run', folder) == 0
    for name in ('fused.tum', 'detections.csv'):
        assert (folder / 'compressed_run' / name).read_text() == (of_raw / name).read_text()


def test_poses_are_those_of_the_flight(run):
    # Three times what comes out: 1.7 and 2.5 mm, most of it before the second, third and fourth marker are known.
    for name, tolerance in (('fused.tum', 0.005), ('fiducial.tum', 0.008)):
        stamps, positions, quaternions = load_tum(run / name)
        t = (stamps - small_bag.START_NS) * 1e-9
        error = inverse(small_bag.true_pose(t)) @ transform_from_quaternion(positions, quaternions)
        assert np.sqrt(np.mean(np.sum(error[:, :3, 3] ** 2, axis=1))) < tolerance
        assert np.sqrt(np.mean(rotation_angle(error[:, :3, :3]) ** 2)) < 0.02


def test_unknown_markers_enter_the_map(run):
    found, true = load_map(run / 'marker_map.yaml').markers, small_bag.map_of(range(4)).markers
    assert sorted(found) == [0, 1, 2, 3]
    for key, marker in found.items():
        # As above.
        assert np.linalg.norm(marker.T_map_marker[:3, 3] - true[key].T_map_marker[:3, 3]) < 0.005


def test_the_run_folder_is_complete(run):
    summary = json.loads((run / 'summary.json').read_text())
    assert summary['messages_in'] == {IMAGE_TOPIC: FRAMES, CAMERA_INFO_TOPIC: FRAMES, IMU_TOPIC: SAMPLES}
    assert summary['messages_out']['markers'] == FRAMES
    assert summary['frames_with_markers'] == FRAMES
    lines = (run / 'detections.csv').read_text().splitlines()
    assert lines[0] == 'stamp_ns,id,u0,v0,u1,v1,u2,v2,u3,v3,sigma_px'
    # All four, but where a guided search looked only for what was in the map as yet.
    assert 0.9 * 4 * FRAMES < len(lines) - 1 <= 4 * FRAMES
    with BagReader(run / 'output') as bag:
        assert bag.message_count(['pose']) == len((run / 'fused.tum').read_text().splitlines())
        assert bag.message_count(['diagnostics']) == 4 * 2  # four nodes; a whole second and the end


def assert_same_files(one, other):
    files = sorted(path.relative_to(one) for path in one.rglob('*') if path.is_file())
    assert len(files) >= 8
    assert files == sorted(path.relative_to(other) for path in other.rglob('*') if path.is_file())
    for file in files:
        assert (one / file).read_bytes() == (other / file).read_bytes(), file


def test_frames_that_swap_places_on_the_way_lose_nothing(folder, short, tmp_path):
    recording, run = small_bag.Recording(list(short[0].events)), short[1]
    images = [index for index, event in enumerate(recording.events) if event[1] == IMAGE_TOPIC]
    for first, second in zip(images[10::4], images[11::4], strict=False):
        ahead, behind = recording.events[first], recording.events[second]
        # The first one arrives a little after its successor.
        recording.events[first] = (behind[0] + 1, *ahead[1:])
    bag = recording.write(tmp_path / 'bag')
    assert replay(bag, tmp_path / 'run', folder) == 0
    in_order, swapped = (load_tum(path / 'fiducial.tum') for path in (run, tmp_path / 'run'))
    np.testing.assert_array_equal(swapped[0], in_order[0])
    assert json.loads((tmp_path / 'run' / 'summary.json').read_text())['warnings'] == {}
    # What a frame's motion is guessed from differs, and so do corners by hundredths of a pixel: millimetres (0.8, 1.1),
    # in a second in which the filter claims centimetres.
    assert np.sqrt(np.mean(np.sum((swapped[1] - in_order[1]) ** 2, axis=1))) < 0.002
    fused = [load_tum(path / 'fused.tum') for path in (run, tmp_path / 'run')]
    np.testing.assert_array_equal(fused[0][0], fused[1][0])
    assert np.sqrt(np.mean(np.sum((fused[0][1] - fused[1][1]) ** 2, axis=1))) < 0.002


def test_two_replays_give_the_same_bytes(short, folder):
    assert replay(folder / 'short', folder / 'again', folder) == 0
    assert_same_files(short[1], folder / 'again')


def test_a_replay_says_that_it_replaces_an_earlier_one(short, folder, tmp_path, capfd):
    for said in (0, 1):
        assert replay(folder / 'short', tmp_path / 'run', folder) == 0
        assert capfd.readouterr().out.count(f'{tmp_path / "run"}: replacing the earlier run there') == said
    # Not where it is refused, and the earlier one stays.
    assert replay(folder / 'nothing', tmp_path / 'run', folder) == 2
    assert 'replacing' not in capfd.readouterr().out
    assert (tmp_path / 'run' / 'summary.json').exists()


def test_a_folder_into_which_another_replay_writes_is_left_alone(folder, tmp_path, capfd):
    out = tmp_path / 'run'
    out.mkdir()
    (out / 'parameters.yaml').touch()
    with RunFiles(out, np.eye(4), {}):
        before = sorted(path.name for path in out.iterdir())
        assert replay(folder / 'bag', out, folder) == 2
        assert capfd.readouterr().err == f'thermal-fiducial replay: {out}: another replay is writing there\n'
        assert sorted(path.name for path in out.iterdir()) == before


def test_the_executor_does_not_matter(short, folder, monkeypatch):
    # Where rclpy has no EventsExecutor: another order of callbacks, the same results.
    monkeypatch.setattr(lockstep, 'make_executor', lambda context: SingleThreadedExecutor(context=context))
    assert replay(folder / 'short', folder / 'single', folder) == 0
    assert_same_files(short[1], folder / 'single')


class Timed:
    """An executor that adds up the timeouts that ran out [s]."""

    def __init__(self, executor):
        self._executor, self.slept = executor, 0.0

    def __getattr__(self, name):
        return getattr(self._executor, name)

    def spin_once(self, timeout_sec):
        begin = time.monotonic()
        self._executor.spin_once(timeout_sec=timeout_sec)
        self.slept += timeout_sec * (time.monotonic() - begin >= timeout_sec)


def test_inputs_that_do_not_wake_the_executor_cost_no_time(folder, tmp_path, monkeypatch):
    executors, make = [], lockstep.make_executor

    def timed(context):
        executors.append(Timed(make(context)))
        return executors[-1]

    monkeypatch.setattr(lockstep, 'make_executor', timed)
    small_bag.recording(seconds=0.3).write(tmp_path / 'bag')
    assert replay(tmp_path / 'bag', tmp_path / 'run', folder) == 0
    # Measured 0.1 s, connecting included; with timeouts of 0.1 s it was 0.9 s.
    assert executors[0].slept < 0.5


def test_lockstep_equals_the_pipeline(run, folder):
    pipeline = Pipeline(
        PipelineConfig.from_mapping(small_bag.PARAMETERS),
        load_dictionary('DICT_4X4_50'),
        load_map(folder / 'map.yaml'),
        small_bag.CAMERA,
    )
    fused, corners = [], []
    with BagReader(folder / 'bag') as bag:
        for recorded in bag.messages([IMAGE_TOPIC, IMU_TOPIC]):
            message = recorded.message
            stamp = convert.stamp_ns(message.header.stamp)
            if recorded.topic == IMU_TOPIC:
                odometry = pipeline.add_imu(convert.imu_sample(message))
                fused += [] if odometry is None else [(odometry.stamp_ns, odometry.T_map_body)]
            else:
                counts = message.data.view('<u2').reshape(message.height, message.width)
                corners += [_cells(stamp, row) for row in pipeline.add_image(stamp, counts).markers]
    assert [_line(*pose) for pose in fused] == (run / 'fused.tum').read_text().splitlines()
    rows = [line.split(',')[:10] for line in (run / 'detections.csv').read_text().splitlines()[1:]]
    assert corners == rows
    pipeline.finish()
    save_map(folder / 'pipeline.yaml', pipeline.mapper.map)
    assert (folder / 'pipeline.yaml').read_bytes() == (run / 'marker_map.yaml').read_bytes()


def _line(stamp, T):
    pose = convert.pose(T)
    p, q = pose.position, pose.orientation
    return tum_line(stamp, (p.x, p.y, p.z), (q.x, q.y, q.z, q.w))


def _cells(stamp, row):
    return [str(stamp), str(row['id']), *(f'{row[name]:.5f}' for name in CORNER_FIELDS)]


def test_a_callback_of_any_length_ends_nothing(folder, tmp_path, monkeypatch, capfd):
    """As a refinement of minutes: it is waited for."""
    monkeypatch.setattr(waiting, 'PATIENCE_S', 0.05)
    learn = MarkerMapper.learn
    monkeypatch.setattr(MarkerMapper, 'learn', lambda *frame: (time.sleep(0.2), learn(*frame))[1])
    small_bag.recording(seconds=0.3).write(tmp_path / 'bag')
    assert replay(tmp_path / 'bag', tmp_path / 'run', folder) == 0
    summary = json.loads((tmp_path / 'run' / 'summary.json').read_text())
    assert summary['messages_out']['markers'] == summary['messages_in'][IMAGE_TOPIC] == 9
    assert 'Traceback' not in capfd.readouterr().err


def test_a_rig_that_publishes_for_others_needs_none_of_their_packages_in_a_replay(tmp_path, monkeypatch):
    """Where tf2 is, its publisher on /tf_static was not counted: the replay waited for ever."""
    for package in ('tf2_ros', 'vision_msgs.msg', 'foxglove_msgs.msg', 'px4_msgs.msg'):
        monkeypatch.setitem(sys.modules, package, None)
    bag = small_bag.recording(seconds=0.3).write(tmp_path / 'bag')
    map_file, rig = small_bag.side_files(tmp_path)
    tf = {'publish_tf': True, 'odom_frame': 'odom', 'smoothing_time': 0.5, 'publish_marker_tf': True}
    others = {'detections': 'vision', 'image_annotations': True, 'px4': True, 'bridge_rate': 30.0}
    rig.write_text(yaml.safe_dump({'/**': {'ros__parameters': small_bag.PARAMETERS | tf | others}}))
    arguments = ['replay', bag, '--out', tmp_path / 'run', '--params', rig, '--map', map_file, '--no-report']
    assert main([str(word) for word in arguments]) == 0
    assert json.loads((tmp_path / 'run' / 'summary.json').read_text())['warnings'] == {}


def test_a_recording_that_goes_on_after_its_imu_names_it(folder, capfd):
    recording = small_bag.recording(SECONDS)
    ends_ns = small_bag.START_NS + 1_200_000_000
    recording.events = [event for event in recording.events if event[1] != IMU_TOPIC or event[0] < ends_ns]
    bag = recording.write(folder / 'silent_imu')
    given = ['--params', folder / 'params.yaml', '--map', folder / 'map.yaml']
    assert main([str(word) for word in ('replay', bag, '--out', folder / 'silent_imu_run', *given)]) == 0
    assert 'must not be flown on' in capfd.readouterr().out
    page = (folder / 'silent_imu_run' / 'report.html').read_text()
    # Of 2 s; the first message lies 1 ms behind the start of the flight, the last one 5 ms before the IMU's end.
    assert 'the IMU was silent from 1.2 s on' in page


def test_an_interrupt_while_a_message_is_converted_is_one_line_and_leaves_no_half_a_run(
    folder, tmp_path, monkeypatch, capfd
):
    """rclpy makes a TypeError of the KeyboardInterrupt that would be raised there."""

    def interrupted(data, kind):
        try:
            os.kill(os.getpid(), signal.SIGINT)
        except KeyboardInterrupt:
            raise TypeError('Unable to convert function return value') from None
        return deserialize_message(data, kind)

    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        monkeypatch.setattr(recorder, 'deserialize_message', interrupted)
        assert replay(folder / 'bag', tmp_path / 'run', folder) == 130
    finally:
        signal.signal(signal.SIGINT, before)
    assert capfd.readouterr().err.splitlines()[-1] == 'thermal-fiducial replay: interrupted'
    left = {path.name for path in (tmp_path / 'run').iterdir()}
    assert left <= {'parameters.yaml', 'marker_map.yaml', 'marker_map.yaml.history'}
