"""Replay of a bag with two cameras: the second goes on where the first sees nothing any more."""

import json

import numpy as np
import pytest
from support import small_bag
import yaml

from thermal_fiducial.cli.main import main
from thermal_fiducial.cli.run_parameters import camera_of_run
from thermal_fiducial.core.geometry.se3 import inverse, quaternion_from_rotation, so3_exp, transform
from thermal_fiducial.files.bags import BagReader, CAMERA_INFO_TOPIC, IMAGE_TOPIC, resolve_topics
from thermal_fiducial.files.trajectory_file import load_tum
from thermal_fiducial.report.frames import strip

pytestmark = pytest.mark.ros
#: The second camera sits 0.15 m to the left, and looks 3 degrees up.
T_BODY_SECOND = transform(so3_exp([0.0, -0.05, 0.0]), [0.0, 0.15, 0.0]) @ small_bag.T_BODY_CAMERA
#: Of the flight; the first camera sees the first half. Its frames and the second's are 11 ms apart.
SECONDS, FRAMES, APART_NS = 2.0, 60, 11_000_000


def two_cameras(folder):
    """A bag, with parameters as a launch file would take them, and the map of all markers."""
    recording, rng = small_bag.recording(SECONDS), np.random.default_rng(5)
    half_ns = small_bag.START_NS + round(SECONDS / 2 * 1e9)
    recording.events = [event for event in recording.events if event[1] != IMAGE_TOPIC or event[0] < half_ns]
    T_first_second = T_BODY_SECOND @ inverse(small_bag.T_BODY_CAMERA)
    for k in range(FRAMES):
        stamp = small_bag.START_NS + 2_000_000 + APART_NS + k * 33_333_333
        T_map_body = small_bag.true_pose((stamp - small_bag.START_NS) * 1e-9)
        # As the first camera would see it from a robot elsewhere.
        counts = small_bag.frame(T_map_body @ T_first_second, rng)
        recording.events.append((stamp + 20_000_000, f'down/{CAMERA_INFO_TOPIC}', small_bag.camera_info(stamp)))
        recording.events.append((stamp + 20_000_001, f'down/{IMAGE_TOPIC}', small_bag.image(stamp, counts)))
    small_bag.side_files(folder, ids=(0, 1, 2, 3))
    orientation = quaternion_from_rotation(T_BODY_SECOND[:3, :3]).tolist()
    place = {'position': T_BODY_SECOND[:3, 3].tolist(), 'orientation': orientation}
    of_mapper = {f'second_camera_{name}': value for name, value in place.items()} | {'second_camera': 'down'}
    of_second = {f'camera_{name}': list(value) for name, value in place.items()}
    rig = {
        '/**': {'ros__parameters': small_bag.PARAMETERS | of_mapper},
        '/down/**': {'ros__parameters': of_second},
    }
    (folder / 'params.yaml').write_text(yaml.safe_dump(rig))
    return recording


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp('two')


@pytest.fixture(scope='module')
def recording(folder):
    recording = two_cameras(folder)
    recording.write(folder / 'bag')
    return recording


def replay(folder, bag, run, *extra):
    given = ['--params', folder / 'params.yaml', '--map', folder / 'map.yaml', '--no-report', '--mode', 'localization']
    return main([str(word) for word in ('replay', bag, '--out', folder / run, *given, *extra)])


@pytest.fixture(scope='module')
def run(folder, recording):
    assert replay(folder, folder / 'bag', 'both', '--second-camera', 'down') == 0
    return folder / 'both'


def test_the_second_camera_goes_on_where_the_first_sees_nothing(run, folder):
    summary = json.loads((run / 'summary.json').read_text())
    figures = summary['diagnostics']['marker_mapper']
    # Half of the second's frames have a partner in the first camera, the others are poses by themselves.
    assert int(figures['second camera: joined']) > FRAMES / 2 - 10
    assert int(figures['second camera: alone']) > FRAMES / 2 - 10
    assert int(figures['second camera: contradicted']) == 0
    assert summary['messages_in'][f'down/{IMAGE_TOPIC}'] == FRAMES
    stamps, positions, _ = load_tum(run / 'fiducial.tum')
    assert stamps[-1] > small_bag.START_NS + 1_900_000_000
    truth = [small_bag.true_pose((stamp - small_bag.START_NS) * 1e-9)[:3, 3] for stamp in stamps.tolist()]
    # Three times what comes out, 1.6 mm, also of the first camera alone (1.9 mm).
    assert np.linalg.norm(positions - truth, axis=1).max() < 0.005
    assert replay(folder, folder / 'bag', 'first') == 0
    alone, _, _ = load_tum(folder / 'first' / 'fiducial.tum')
    assert alone[-1] < small_bag.START_NS + 1_100_000_000


def test_it_is_deterministic_to_the_byte(run, folder):
    assert replay(folder, folder / 'bag', 'again', '--second-camera', '/down/') == 0
    for name in ('fused.tum', 'fiducial.tum', 'detections.csv', 'parameters.yaml'):
        assert (folder / 'again' / name).read_bytes() == (run / name).read_bytes()


def test_each_camera_has_its_own_parameters(run):
    document = yaml.safe_load((run / 'parameters.yaml').read_text())
    first, second = (document[f'{at}/aruco_detector']['ros__parameters'] for at in ('', '/down'))
    assert first['camera_position'] == small_bag.PARAMETERS['camera_position']
    assert second['camera_position'] == pytest.approx(T_BODY_SECOND[:3, 3].tolist())
    assert first['marker_size'] == second['marker_size'] == small_bag.SIZE


def test_the_run_can_be_replayed_from_its_markers(run, folder, recording, tmp_path):
    """Both cameras' markers are in the output; calibrations and IMU are those of the bag."""
    markers = small_bag.Recording([event for event in recording.events if not event[1].endswith(IMAGE_TOPIC)])
    with BagReader(run / 'output') as output:
        for message in output.messages(['markers', 'down/markers']):
            raw = small_bag.Raw(message.msgtype, message.cdr)
            markers.events.append((message.stamp_ns, message.topic, raw))
    bag = markers.write(tmp_path / 'markers')
    assert replay(folder, bag, 'of_markers', '--second-camera', 'down') == 0
    assert (folder / 'of_markers' / 'fiducial.tum').read_bytes() == (run / 'fiducial.tum').read_bytes()


@pytest.mark.usefixtures('recording')
def test_a_second_camera_that_the_bag_lacks_is_refused(folder, capsys):
    assert replay(folder, folder / 'bag', 'up', '--second-camera', 'up') == 2
    assert f'no topic up/{IMAGE_TOPIC}' in capsys.readouterr().err


def test_the_replayed_bag_of_a_robot_in_a_namespace_is_read_again(folder, recording, tmp_path, monkeypatch):
    """For the video, pictures of the report, and the calibration of the run: the camera without a name is the first."""
    bag = recording.renamed(lambda topic: f'one/{topic}').write(tmp_path / 'bag')
    monkeypatch.setattr('thermal_fiducial.report.video.require_encoder', lambda: None)
    written = []
    monkeypatch.setattr('thermal_fiducial.cli.replay.make_video', written.append)
    assert replay(folder, bag, 'inside', '--second-camera', 'down', '--video') == 0
    assert len(strip(written[0])) > 5
    assert camera_of_run(folder / 'inside').matches(small_bag.CAMERA)


@pytest.mark.nightly
@pytest.mark.usefixtures('recording')
def test_processes_play_both(folder):
    assert replay(folder, folder / 'bag', 'processes', '--second-camera', 'down', '--transport', 'processes') == 0
    summary = json.loads((folder / 'processes' / 'summary.json').read_text())
    assert int(summary['diagnostics']['marker_mapper']['second camera: alone']) > FRAMES / 2 - 10


def test_both_cameras_of_a_robot_in_a_namespace_are_distinguished():
    recorded = ['/one/thermal/image_raw', '/one/down/thermal/image_raw', '/one/down/markers', '/one/imu/data']
    assert resolve_topics(recorded, second_camera='down') == {
        '/one/thermal/image_raw': 'thermal/image_raw',
        '/one/down/thermal/image_raw': 'down/thermal/image_raw',
        '/one/down/markers': 'down/markers',
        '/one/imu/data': 'imu/data',
    }
