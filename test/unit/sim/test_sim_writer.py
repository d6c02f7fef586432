from dataclasses import replace
import math
import multiprocessing
import os
from pathlib import Path
import shlex
import signal
import sys
import time

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.commands import status
from support.tiny import TINY
import yaml

from thermal_fiducial.cli import simulate_corners
from thermal_fiducial.cli.main import main
from thermal_fiducial.config import from_mapping, PoseEkfConfig
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.bags import BagReader
from thermal_fiducial.files.images import image_to_array, stamp_to_ns
from thermal_fiducial.files.marker_map import load_map
from thermal_fiducial.files.trajectory_file import load_tum
from thermal_fiducial.sim.corner_noise import CornerNoise
from thermal_fiducial.sim.render import Quality
from thermal_fiducial.sim.scenario import LENSES, SCENARIOS
from thermal_fiducial.sim.thermal_camera import plan, render_frames, simulate_imu
from thermal_fiducial.sim.writer import IMAGE_DELAY_NS, simulate, write_flight

SECONDS = 2.0
#: How finely a frame is sampled is nothing that a bag shows.
COARSE = Quality(sub_frames=1, warm_up=0)
#: A camera whose clock is behind that of the IMU.
BEHIND = replace(TINY, camera_time_offset=-0.02)


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    folder = tmp_path_factory.mktemp('bags') / 'tiny'
    write_flight(folder, plan(BEHIND, SECONDS, 3, quality=COARSE), workers=1)
    return folder


@pytest.fixture(scope='module')
def messages(bag):
    with BagReader(bag) as reader:
        return list(reader.messages())


def of(messages, topic):
    return [message.message for message in messages if message.topic == topic]


def test_topics_of_the_contract(bag):
    with BagReader(bag) as reader:
        assert reader.topics == {
            'thermal/image_raw': 'sensor_msgs/msg/Image',
            'thermal/camera_info': 'sensor_msgs/msg/CameraInfo',
            'imu/data': 'sensor_msgs/msg/Imu',
            'ground_truth/odometry': 'nav_msgs/msg/Odometry',
        }
        counts = [reader.message_count([topic]) for topic in reader.topics]
    assert sorted(counts) == [60, 60, 401, 401]


def test_frames_are_those_of_the_renderer(messages):
    rendered = render_frames(BEHIND, SECONDS, 3, quality=COARSE)
    for frame, message in zip(rendered, of(messages, 'thermal/image_raw'), strict=True):
        assert stamp_to_ns(message.header.stamp) == frame.stamp_ns
        np.testing.assert_array_equal(image_to_array(message), frame.counts)


def test_the_cameras_clock_is_off_by_the_offset(messages):
    arrivals = {m.stamp_ns: stamp_to_ns(m.message.header.stamp) for m in messages if m.topic == 'thermal/image_raw'}
    # t_imu = t_camera - 20 ms, and the bag's stamps are the IMU's clock; integers, rounded once.
    assert all(abs((arrived - IMAGE_DELAY_NS) - (stamp - 20_000_000)) <= 1 for arrived, stamp in arrivals.items())
    stamps = [message.stamp_ns for message in messages]
    assert stamps == sorted(stamps)


def test_imu_and_truth(messages):
    imu, record = of(messages, 'imu/data'), simulate_imu(TINY, SECONDS, 3)
    assert [stamp_to_ns(m.header.stamp) for m in imu] == record.stamps_ns.tolist()
    rates = [[m.angular_velocity.x, m.angular_velocity.y, m.angular_velocity.z] for m in imu]
    np.testing.assert_array_equal(rates, record.angular_velocity)
    truth = of(messages, 'ground_truth/odometry')
    assert [stamp_to_ns(m.header.stamp) for m in truth] == record.stamps_ns.tolist()
    motion = TINY.trajectory(SECONDS, 3)([1.0])
    position = truth[200].pose.pose.position
    np.testing.assert_allclose([position.x, position.y, position.z], motion.position[0], atol=1e-12)
    twist = truth[200].twist.twist.linear
    velocity = motion.rotation[0].inv().apply(motion.velocity[0])
    np.testing.assert_allclose([twist.x, twist.y, twist.z], velocity, atol=1e-12)


def test_camera_info_is_the_lens(messages):
    info = of(messages, 'thermal/camera_info')[0]
    assert (info.width, info.height, info.distortion_model) == (160, 128, 'plumb_bob')
    np.testing.assert_array_equal(info.k.reshape(3, 3), TINY.lens.matrix)
    np.testing.assert_array_equal(info.d, TINY.lens.distortion)
    assert info.header.frame_id == 'thermal_camera_optical'


def test_maps_truth_and_rig_beside_it(bag):
    true, one = load_map(bag / 'map_true.yaml'), load_map(bag / 'map_one.yaml')
    assert (set(true.markers), set(one.markers)) == ({5, 7}, {5})
    for marker in TINY.markers:
        np.testing.assert_allclose(true.markers[marker.id].T_map_marker, marker.T_map_marker, atol=1e-9)
        assert true.markers[marker.id].size == marker.size
    stamps, positions, _ = load_tum(bag / 'ground_truth.tum')
    assert len(stamps) == 401
    np.testing.assert_allclose(positions[0], positions[-1], atol=1e-5)
    parameters = yaml.safe_load((bag / 'params.yaml').read_text())['/**']['ros__parameters']
    assert parameters['marker_size_overrides'] == ['7:0.25'] or parameters['marker_size_overrides'] == ['5:0.3']
    flat = {f'imu.{name}': value for name, value in parameters['imu'].items()} | parameters
    config = from_mapping(PoseEkfConfig, {name: value for name, value in flat.items() if name != 'imu'})
    assert config.camera_position == TINY.camera_position
    assert config.camera_time_offset == -0.02
    assert math.isclose(config.imu.gyroscope_noise_density, 1.7e-4)


def test_a_rough_rig_is_named_as_calibrated_and_its_stamps_jitter_about_the_offset(tmp_path):
    scenario = replace(
        TINY,
        camera_time_offset=-0.02,
        stamp_jitter=0.002,
        sensor=replace(TINY.sensor, readout=0.016),
        imu=replace(TINY.imu, stamp_jitter=2e-4),
    )
    write_flight(tmp_path / 'bag', plan(scenario, SECONDS, 3, quality=COARSE))
    parameters = yaml.safe_load((tmp_path / 'bag' / 'params.yaml').read_text())['/**']['ros__parameters']
    assert parameters['readout_time'] == 0.016
    assert parameters['camera_time_offset'] == -0.02
    with BagReader(tmp_path / 'bag') as reader:
        entries = [(m.topic, m.stamp_ns, stamp_to_ns(m.message.header.stamp)) for m in reader.messages()]
    images = [stamp - (arrived - IMAGE_DELAY_NS) for topic, arrived, stamp in entries if topic == 'thermal/image_raw']
    # 60 stamps, 2 ms of deviation: their mean is known to 0.26 ms; none is earlier than the mean by more than that.
    assert abs(np.mean(images) - 20e6) < 1e6
    assert 1e6 < np.std(images) < 4e6
    assert min(images) >= 18e6
    truth, imu = ([s for topic, _, s in entries if topic == name] for name in ('ground_truth/odometry', 'imu/data'))
    assert set(np.diff(truth).tolist()) == {5_000_000}
    # A difference of two stamps of 0.2 ms.
    assert 0.2e6 < np.std(np.diff(imu)) < 0.4e6


@pytest.mark.parametrize('storage', ['mcap', pytest.param('sqlite3', marks=pytest.mark.nightly)])
def test_same_seed_same_bytes_with_any_number_of_workers(bag, tmp_path, storage):
    def written(folder, workers):
        folder.mkdir()
        write_flight(folder / bag.name, plan(BEHIND, SECONDS, 3, quality=COARSE), storage, workers)
        return folder / bag.name

    one = bag if storage == 'mcap' else written(tmp_path / 'one', 1)
    two = written(tmp_path / 'two', 2)
    files = sorted(path.name for path in one.iterdir())
    assert len(files) == 7
    for file in files:
        assert (one / file).read_bytes() == (two / file).read_bytes()


@pytest.fixture
def threads_wait():
    """A thread that computes gives way to no other."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(60.0)
    yield
    sys.setswitchinterval(before)


@pytest.mark.slow
@pytest.mark.usefixtures('threads_wait')
def test_workers_that_are_sending_frames_do_not_hold_up_an_error(tmp_path):
    """They block at full pipes meanwhile, and end all the same."""

    def full_disk(count):
        until = time.monotonic() + 2.0
        while time.monotonic() < until:
            # Meanwhile nobody reads what the workers send.
            pass
        raise InputError('no space left')

    with pytest.raises(InputError, match='no space left'):
        write_flight(tmp_path / 'bag', plan(BEHIND, 8.0, 3, quality=COARSE), workers=4, progress=full_disk)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
@pytest.mark.usefixtures('threads_wait')
@pytest.mark.timeout(600, method='thread')
def test_a_worker_that_is_killed_while_it_sends_frames_ends_the_command(tmp_path):
    """As for lack of memory: half a result is in its pipe, and the rest of it never comes."""

    workers = []

    def out_of_memory(count):
        if workers:
            return
        workers.extend(multiprocessing.active_children())
        until = time.monotonic() + 2.0
        while time.monotonic() < until:
            # Meanwhile the workers send, and nobody reads.
            pass
        for worker in workers:
            os.kill(worker.pid, signal.SIGKILL)

    with pytest.raises(InputError, match='a rendering process died, perhaps for lack of memory'):
        write_flight(tmp_path / 'bag', plan(BEHIND, 8.0, 3, quality=COARSE), workers=2, progress=out_of_memory)
    assert not list(tmp_path.iterdir())
    assert not multiprocessing.active_children()


def test_nothing_is_left_of_a_failed_flight(tmp_path):
    with pytest.raises(InputError, match='dictionary'):
        write_flight(tmp_path / 'bag', plan(replace(TINY, dictionary='DICT_9X9'), SECONDS))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ('given', 'words'),
    [
        ({'seconds': float('nan')}, 'a flight of nan s'),
        ({'seconds': float('inf')}, 'a flight of inf s'),
        ({'seconds': 0.0}, 'a flight of 0.0 s'),
        ({'seconds': '20'}, "a flight of '20' s"),
        ({'seed': -1}, 'seed -1'),
        ({'seed': 1.5}, 'seed 1.5'),
    ],
)
def test_a_flight_that_cannot_be_flown_is_refused(tmp_path, given, words):
    """0 s was the scenario's own length, the others were errors of numpy."""
    with pytest.raises(InputError, match=f'^{words}: it is to be'):
        simulate(tmp_path / 'bag', TINY, **given)
    assert not (tmp_path / 'bag').exists()


def test_what_a_killed_simulation_has_left_is_removed_by_the_next_one(tmp_path):
    (tmp_path / '.bag-abcdefgh' / 'bag').mkdir(parents=True)
    write_flight(tmp_path / 'bag', plan(TINY, SECONDS, 3, quality=COARSE))
    assert [path.name for path in tmp_path.iterdir()] == ['bag']


# --- the command --------------------------------------------------------------------------------------


@pytest.fixture
def tiny_scenario(monkeypatch):
    monkeypatch.setitem(SCENARIOS, 'tiny', replace(TINY, sensor=replace(TINY.sensor, frame_rate=10.0)))


def test_command_writes_a_bag_and_prints_how_to_replay_it(tiny_scenario, tmp_path, capsys):
    out = tmp_path / 'new bags' / 'bag'
    options = [
        '--scenario',
        'tiny',
        '--seconds',
        '2',
        '--contrast',
        '6',
        '--fog',
        '0.2',
        '--ffc',
        'never',
        '--readout',
        '0.01',
    ]
    assert main(['simulate', str(out), *options, '--storage', 'sqlite3', '--inverted', '--workers', '1']) == 0
    # As a shell reads it.
    words = shlex.split(capsys.readouterr().out.splitlines()[-1])
    assert words[words.index('replay', 1) :][:2] == ['replay', str(out)]
    assert str(out / 'params.yaml') in words
    with BagReader(out) as reader:
        assert reader.message_count(['thermal/image_raw']) == 20
    assert list(out.glob('*.db3'))
    assert 'readout_time: 0.01' in (out / 'params.yaml').read_text()


def test_the_printed_replay_of_a_board_is_one_with_its_map(tmp_path, capsys):
    assert main(['simulate', str(tmp_path / 'of a board'), '--scenario', 'april', '--seconds', '3']) == 0
    words = shlex.split(capsys.readouterr().out.splitlines()[-1])
    assert Path(words[words.index('--map') + 1]).is_file()
    assert words[words.index('--mode') + 1] == 'localization'


def test_command_takes_a_frame_rate(tiny_scenario, tmp_path):
    out = tmp_path / 'bag'
    options = ['--scenario', 'tiny', '--seconds', '2', '--ffc', 'never', '--frame-rate', '8.5', '--workers', '1']
    assert main(['simulate', str(out), *options]) == 0
    with BagReader(out) as reader:
        stamps = [stamp_to_ns(item.message.header.stamp) for item in reader.messages(['thermal/image_raw'])]
    # Stamps are rounded to nanoseconds.
    np.testing.assert_allclose(np.diff(stamps), 1e9 / 8.5, atol=1.0)
    assert len(stamps) == 17


def test_command_follows_a_trajectory(tiny_scenario, tmp_path):
    lines = [f'{n / 10} {0.01 * n} 0 0.7 0 0 0 1\n' for n in range(31)]
    (tmp_path / 'path.tum').write_text(''.join(lines))
    command = ['simulate', str(tmp_path / 'bag'), '--scenario', 'tiny', '--workers', '1']
    assert main([*command, '--trajectory', str(tmp_path / 'path.tum')]) == 0
    stamps, positions, _ = load_tum(tmp_path / 'bag' / 'ground_truth.tum')
    assert (stamps[-1] - stamps[0]) == 3_000_000_000
    # The spline goes through the poses; nine decimals are written.
    np.testing.assert_allclose(positions[-1], [0.3, 0.0, 0.7], atol=1e-8)


@pytest.mark.parametrize(
    ('unit', 'turn', 'says'),
    [
        (1000.0, '0 0 0 1', ' s, more than an IMU measures: positions must be in metres'),
        (1.0, '0 0 1 0', 'no frame shows a marker of april: poses must be of base_link in the map of the scenario'),
    ],
)
def test_a_trajectory_that_no_drone_flew_before_these_markers_is_refused(tmp_path, capsys, unit, turn, says):
    """In millimetres it made a bag, without a word, that ``replay`` refused for lack of images."""
    x = unit * (-2.0 + 0.25 * np.sin(np.arange(60) / 10.0))
    lines = [f'{0.1 * n:.1f} {place} 0 {0.7 * unit} {turn}\n' for n, place in enumerate(x)]
    (tmp_path / 'path.tum').write_text(''.join(lines))
    command = ['simulate', tmp_path / 'bag', '--scenario', 'april', '--trajectory', tmp_path / 'path.tum']
    assert status(command) == 2
    assert says in capsys.readouterr().err
    assert not (tmp_path / 'bag').exists()


@pytest.mark.parametrize(
    ('options', 'says'),
    [
        (['--scenario', 'moon'], 'moon'),
        (['--lens', '3mm'], '3mm'),
        (['--seconds', '1'], 'too short'),
        (['--seconds', 'nan'], "argument --seconds: 'nan' is not"),
        (['--seed', '-1'], "argument --seed: '-1' is not"),
        (['--time-offset', '2'], "argument --time-offset: '2' is not"),
        (['--frame-rate', '0'], "argument --frame-rate: '0' is not"),
        (['--trajectory', 'nowhere.tum'], 'nowhere.tum'),
    ],
)
def test_command_refuses_in_one_line(tmp_path, capsys, options, says):
    assert status(['simulate', tmp_path / 'bag', '--workers', '1', *options]) == 2
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert says in error
    assert list(tmp_path.iterdir()) == []


def test_command_does_not_overwrite_a_folder(tmp_path, capsys):
    assert main(['simulate', str(tmp_path)]) == 2
    assert 'exists already' in capsys.readouterr().err


def test_help_lists_scenarios_and_lenses(capsys):
    with pytest.raises(SystemExit):
        main(['simulate', '--help'])
    text = capsys.readouterr().out
    assert all(name in text for name in (*SCENARIOS, *LENSES))


def test_everything_beside_the_bag_describes_the_same_rig(bag, messages):
    """From the files alone: markers of the true map, through rig and true path, land on the true corners."""
    parameters = yaml.safe_load((bag / 'params.yaml').read_text())['/**']['ros__parameters']
    stamps, positions, quaternions = load_tum(bag / 'ground_truth.tum')
    corners = np.loadtxt(bag / 'ground_truth_corners.csv', delimiter=',', skiprows=1, dtype=str)
    markers, info = load_map(bag / 'map_true.yaml').markers, of(messages, 'thermal/camera_info')[0]
    offset_ns = round(parameters['camera_time_offset'] * 1e9)
    checked = 0
    for row in corners:
        # Frames at 30 Hz and samples at 200 Hz meet ten times a second.
        index = int(np.argmin(np.abs(stamps - (int(row[0]) + offset_ns))))
        if abs(int(stamps[index]) - int(row[0]) - offset_ns) > 1:
            continue
        R_map_body = Rotation.from_quat(quaternions[index])
        R_map_camera = R_map_body * Rotation.from_quat(parameters['camera_orientation'])
        camera = positions[index] + R_map_body.apply(parameters['camera_position'])
        marker = markers[int(row[1])]
        s = marker.size / 2
        square = np.array([[-s, s, 0, 1], [s, s, 0, 1], [s, -s, 0, 1], [-s, -s, 0, 1]])
        points = R_map_camera.inv().apply((square @ marker.T_map_marker.T)[:, :3] - camera)
        pixels = cv2.projectPoints(points, np.zeros(3), np.zeros(3), info.k.reshape(3, 3), info.d)[0][:, 0]
        # Nine decimals of the pose and four of the corners; the stamps agree to a nanosecond.
        np.testing.assert_allclose(row[2:].astype(float).reshape(4, 2), pixels, atol=2e-4)
        checked += 1
    assert checked >= 20


@pytest.mark.parametrize('error', [KeyboardInterrupt, Exception])
def test_a_flight_without_pictures_has_its_name_once_it_is_whole(tmp_path, monkeypatch, error):
    out, begun = tmp_path / 'out', []

    def interrupted(folder, flight):
        begun.append((folder.is_dir(), out.exists()))
        raise error

    monkeypatch.setattr(simulate_corners, 'write_side_files', interrupted)
    with pytest.raises(error):
        simulate_corners.write_corner_flight(out, plan('april', 11.0), CornerNoise(), 'mcap', lambda _: None)
    assert begun == [(True, False)]
    assert not any(tmp_path.iterdir())
