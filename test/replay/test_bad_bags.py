"""What a replay makes of bags, parameters and maps that are broken: one line and exit status 2, never a traceback."""

import json
import shutil

import numpy as np
import pytest
from support import small_bag

from thermal_fiducial.cli.main import main
from thermal_fiducial.core.detection.detector import MarkerDetector
from thermal_fiducial.files.bags import CAMERA_INFO_TOPIC, IMAGE_TOPIC, IMU_TOPIC
from thermal_fiducial.files.camera_info import save_camera

pytestmark = pytest.mark.ros


@pytest.fixture(scope='module')
def recording():
    return small_bag.recording(seconds=0.5)


@pytest.fixture
def replay(tmp_path, capfd):
    """Run the command on a bag: exit status and the lines on standard error."""
    map_file, params = small_bag.side_files(tmp_path)

    def run(bag, *extra, map_file=map_file, params=params):
        capfd.readouterr()
        arguments = ['replay', bag, '--out', tmp_path / 'run', '--params', params, '--map', map_file, '--no-report']
        status = main([str(word) for word in (*arguments, *extra)])
        return status, [line for line in capfd.readouterr().err.splitlines() if not line.startswith('[')]

    return run


def fails(outcome, *words):
    status, lines = outcome
    assert status == 2
    assert len(lines) == 1, lines
    for word in words:
        assert word in lines[0]


def test_no_bag(replay, tmp_path):
    fails(replay(tmp_path / 'nothing'), 'nothing')


@pytest.mark.parametrize('which', ['bag', 'run', 'map'])
def test_names_that_are_not_utf_8(replay, recording, tmp_path, which):
    """ROS ended in a traceback, or could not read its parameters, or the run was there and could not be evaluated."""
    folder = tmp_path / 'l\udcfc'
    folder.mkdir()
    bag = recording.write((folder if which == 'bag' else tmp_path) / 'bag')
    map_file = shutil.copy(tmp_path / 'map.yaml', (folder if which == 'map' else tmp_path) / 'start.yaml')
    extra = ['--out', folder / 'run'] if which == 'run' else []
    fails(replay(bag, *extra, map_file=map_file), 'l\\udcfc', 'the name is not UTF-8, as all is that ROS reads')


def test_names_with_blanks_and_letters_that_are_not_printable(replay, recording, tmp_path):
    """A bag behind a no-break space was replayed, and its run could not be evaluated."""
    folder = tmp_path / 'Prüf\u00a0stand \u200b'
    folder.mkdir()
    assert replay(recording.write(folder / 'bag'), '--out', folder / 'run')[0] == 0
    assert main(['evaluate', str(folder / 'run'), '--no-report', '--json']) == 0


@pytest.mark.parametrize('damage', ['cut', 'noise', 'empty'])
@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_a_corrupt_bag(replay, recording, tmp_path, storage, damage):
    bag = recording.write(tmp_path / 'bag', storage)
    (file,) = [path for path in bag.iterdir() if path.suffix in ('.mcap', '.db3')]
    content = bytearray(file.read_bytes())
    if damage == 'cut':
        content = content[: len(content) // 3]
    elif damage == 'noise':
        rng = np.random.default_rng(0)
        content[: len(content) // 2] = rng.bytes(len(content) // 2)
    else:
        content = b''
    file.write_bytes(content)
    fails(replay(bag), 'bag')


def test_a_folder_that_is_no_bag(replay, tmp_path):
    (tmp_path / 'folder').mkdir()
    fails(replay(tmp_path / 'folder'), 'folder', 'neither metadata.yaml nor a file .mcap, .db3, .bag')
    (tmp_path / 'folder' / 'flight_0.mcap').touch()
    fails(replay(tmp_path / 'folder'), 'folder', 'no metadata.yaml (ros2 bag reindex makes one; or give its file ')


@pytest.mark.parametrize('topic', [IMAGE_TOPIC, IMU_TOPIC, CAMERA_INFO_TOPIC])
def test_a_missing_topic(replay, recording, tmp_path, topic):
    fails(replay(recording.without(topic).write(tmp_path / 'bag')), topic)


def test_no_camera_info_but_a_calibration_file(replay, recording, tmp_path):
    bag = recording.without(CAMERA_INFO_TOPIC).write(tmp_path / 'bag')
    save_camera(tmp_path / 'tau2.yaml', small_bag.CAMERA)
    params = tmp_path / 'with_calibration.yaml'
    params.write_text((tmp_path / 'params.yaml').read_text() + f'    calibration_file: {tmp_path}/tau2.yaml\n')
    assert replay(bag, params=params) == (0, [])
    summary = json.loads((tmp_path / 'run' / 'summary.json').read_text())
    assert summary['messages_out']['camera_pose'] == 15
    assert summary['messages_out'][CAMERA_INFO_TOPIC] == 15


def test_names_with_a_namespace_need_nothing_and_others_a_remap(replay, recording, tmp_path):
    prefixed = recording.renamed(lambda topic: f'/drone/{topic}').write(tmp_path / 'prefixed')
    assert replay(prefixed)[0] == 0
    other = recording.renamed(lambda topic: '/boson/raw' if topic == IMAGE_TOPIC else topic).write(tmp_path / 'other')
    fails(replay(other), IMAGE_TOPIC, 'boson/raw')
    assert replay(other, '--remap', 'boson/raw:=thermal/image_raw')[0] == 0
    fails(replay(other, '--remap', 'boson/raw'), 'boson/raw')


def test_a_message_that_cannot_be_decoded(replay, recording, tmp_path):
    broken = small_bag.Recording(list(recording.events))
    index, (stamp, topic, _) = next((i, e) for i, e in enumerate(broken.events) if e[1] == IMU_TOPIC)
    broken.events[index] = (stamp, topic, small_bag.Raw('sensor_msgs/msg/Imu', b'\x00\x01\x00\x00rubbish'))
    fails(replay(broken.write(tmp_path / 'bag')), IMU_TOPIC, 'decoded')


def damaged(recording, topic, damage, count=1):
    """A recording with ``damage`` done to copies of the first ``count`` messages on a topic, from the third on."""
    result, left = small_bag.Recording(), count
    for number, event in enumerate(recording.events):
        stamp, name, message = event
        if name == topic and number > 2 and left:
            left -= 1
            event = (stamp, name, damage(message))
        result.events.append(event)
    return result


def cut_short(message):
    return small_bag.replaced(message, data=message.data[:1000])


def nan(message):
    return small_bag.replaced(
        message, linear_acceleration=small_bag.replaced(message.linear_acceleration, x=float('nan'))
    )


@pytest.mark.parametrize(
    ('topic', 'damage', 'word'), [(IMAGE_TOPIC, cut_short, '640x512'), (IMU_TOPIC, nan, 'not finite')]
)
def test_single_bad_messages_are_said_and_the_replay_goes_on(replay, recording, tmp_path, topic, damage, word):
    status, lines = replay(damaged(recording, topic, damage, 2).write(tmp_path / 'bag'))
    assert status == 0
    assert len(lines) == 1
    assert '2 messages refused' in lines[0]
    assert word in lines[0]
    assert len((tmp_path / 'run' / 'fused.tum').read_text().splitlines()) > 50


def uncalibrated(message):
    return small_bag.replaced(message, k=np.zeros(9))


@pytest.mark.parametrize(
    ('topic', 'damage', 'word'),
    [
        (IMAGE_TOPIC, cut_short, '640x512'),
        (IMU_TOPIC, nan, 'not finite'),
        (CAMERA_INFO_TOPIC, uncalibrated, 'without a focal length: the camera is not calibrated'),
    ],
)
def test_nothing_but_bad_messages(replay, recording, tmp_path, topic, damage, word):
    fails(replay(recording.changed(topic, damage).write(tmp_path / 'bag')), topic, word)


@pytest.mark.parametrize('topic', [IMAGE_TOPIC, IMU_TOPIC])
def test_stamps_that_go_back(replay, recording, tmp_path, topic):
    def back(message):
        stamp = message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec - 70_000_000
        return small_bag.replaced(message, header=small_bag.header(stamp, message.header.frame_id))

    status, _ = replay(damaged(recording, topic, back, 1).write(tmp_path / 'bag'))
    assert status == 0
    times = [float(line.split()[0]) for line in (tmp_path / 'run' / 'fused.tum').read_text().splitlines()]
    assert np.all(np.diff(times) > 0)
    warnings = json.loads((tmp_path / 'run' / 'summary.json').read_text())
    assert warnings['messages_out']['pose'] == len(times) > 50


def test_a_clock_that_was_set_by_years_during_the_recording(replay, recording, tmp_path):
    """A minute of the gap is played: diagnostics of four nodes once a second, and of the rest of the bag."""
    first_ns, topic, message = recording.events[0]
    early = small_bag.Recording([(first_ns - 1_600_000_000_000_000_000, topic, message), *recording.events])
    status, _ = replay(early.write(tmp_path / 'bag'))
    assert status == 0
    summary = json.loads((tmp_path / 'run' / 'summary.json').read_text())
    assert summary['messages_out']['camera_pose'] == 15
    assert 4 * 60 <= summary['messages_out']['/diagnostics'] <= 4 * 63


def test_an_unknown_dictionary(replay, recording, tmp_path):
    params = tmp_path / 'other.yaml'
    params.write_text('/**: {ros__parameters: {dictionary: DICT_9X9_9}}')
    fails(replay(recording.write(tmp_path / 'bag'), params=params), 'DICT_9X9_9')
    params.write_text('/**: {ros__parameters: {dictionary: dict_4x4_50}}')
    fails(replay(tmp_path / 'bag', params=params), 'did you mean DICT_4X4_50?')


@pytest.mark.parametrize('text', ['format: other', 'markers: [', '\x00', 'format: thermal_fiducial/marker_map'])
def test_a_broken_map(replay, recording, tmp_path, text):
    broken = tmp_path / 'broken.yaml'
    broken.write_text(text)
    fails(replay(recording.write(tmp_path / 'bag'), map_file=broken), 'broken.yaml')
    fails(replay(tmp_path / 'bag', map_file=tmp_path / 'nowhere.yaml'), 'nowhere.yaml')
    assert broken.read_text() == text


@pytest.mark.parametrize(
    ('text', 'word'),
    [
        ('/**: {ros__parameters: {marker_size: -1.0}}', 'marker_size'),
        ('/**: {ros__parameters: {marker_size: big}}', 'marker_size'),
        ('/**: {ros__parameters: {camera_position: [1.0]}}', 'camera_position'),
        ('/**: {ros__parameters: {calibration_file: /nowhere/tau2.yaml}}', '/nowhere/tau2.yaml'),
        ('marker_size: 0.3', 'ros__parameters'),
        ('[', 'YAML'),
    ],
)
def test_unusable_parameters(replay, recording, tmp_path, text, word):
    params = tmp_path / 'other.yaml'
    params.write_text(text)
    fails(replay(recording.write(tmp_path / 'bag'), params=params), word)


def test_a_parameter_that_no_node_has_is_refused(replay, recording, tmp_path):
    params = tmp_path / 'other.yaml'
    params.write_text((tmp_path / 'params.yaml').read_text() + '    marker_sice: 0.5\n')
    fails(replay(recording.write(tmp_path / 'bag'), params=params), 'marker_sice')


def test_the_map_that_was_given_is_never_written_to(replay, recording, tmp_path):
    before = (tmp_path / 'map.yaml').read_bytes()
    assert replay(recording.write(tmp_path / 'bag'))[0] == 0
    assert (tmp_path / 'map.yaml').read_bytes() == before
    assert (tmp_path / 'run' / 'marker_map.yaml').read_bytes() != before


def test_localization_adds_nothing_to_a_map_but_the_sizes_that_it_left_out(replay, recording, tmp_path):
    text = (tmp_path / 'map.yaml').read_text()
    (tmp_path / 'map.yaml').write_text(text.replace('size: 0.3, ', ''))
    assert replay(recording.write(tmp_path / 'bag'), '--mode', 'localization')[0] == 0
    assert (tmp_path / 'run' / 'marker_map.yaml').read_text() == text


def test_a_map_of_another_dictionary(replay, recording, tmp_path):
    foreign = tmp_path / 'foreign.yaml'
    foreign.write_text((tmp_path / 'map.yaml').read_text().replace('{id: 0,', '{id: 333,'))
    fails(replay(recording.write(tmp_path / 'bag'), map_file=foreign), 'foreign.yaml', '333', 'DICT_4X4_50')


def test_an_error_of_a_node_itself_is_said_and_no_success(replay, recording, tmp_path, monkeypatch):
    def fail(*_):
        raise ZeroDivisionError('nobody foresaw this')

    monkeypatch.setattr(MarkerDetector, 'detect', fail)
    status, lines = replay(recording.write(tmp_path / 'bag'))
    assert status == 1
    assert lines[-1] == 'aruco_detector: internal error: ZeroDivisionError: nobody foresaw this'


def other_clock(message):
    stamp = message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec - 3_000_000_000
    return small_bag.replaced(message, header=small_bag.header(stamp, message.header.frame_id))


def in_g(message):
    force = message.linear_acceleration
    scaled = {axis: getattr(force, axis) / 9.80665 for axis in 'xyz'}
    return small_bag.replaced(message, linear_acceleration=small_bag.replaced(force, **scaled))


@pytest.mark.parametrize(
    ('damage', 'words'),
    [(other_clock, 'camera and IMU have two clocks: poses are 2.9'), (in_g, 'poses contradict gravity: the IMU says')],
)
def test_without_a_single_pose_the_reason_is_said(replay, recording, tmp_path, damage, words):
    status, (line,) = replay(recording.changed(IMU_TOPIC, damage).write(tmp_path / 'bag'))
    assert status == 1
    assert line.startswith('warning: no pose went out. ')
    assert f'pose_ekf: {words}' in line


def test_camera_info_of_another_resolution(replay, recording, tmp_path):
    def small(message):
        return small_bag.replaced(message, width=320, height=256, k=np.array([372.0, 0, 160, 0, 372, 128, 0, 0, 1]))

    bag = recording.changed(CAMERA_INFO_TOPIC, small).write(tmp_path / 'bag')
    fails(replay(bag), '640x512', 'camera_info of 320x256')


def test_a_map_in_another_frame_and_parameters_of_others_are_doubted(replay, recording, tmp_path):
    bag = recording.write(tmp_path / 'bag')
    other = tmp_path / 'world.yaml'
    other.write_text((tmp_path / 'map.yaml').read_text().replace('frame_id: map', 'frame_id: world'))
    params = tmp_path / 'theirs.yaml'
    params.write_text('their_node: {ros__parameters: {rate: 1}}')
    status, lines = replay(bag, map_file=other, params=params)
    assert status == 0
    assert any("world.yaml: the map is in frame 'world'" in line for line in lines)
    assert any('theirs.yaml: nothing in it is for our nodes: it is for their_node' in line for line in lines)


def test_a_map_of_other_sides_than_the_parameters_is_doubted(replay, recording, tmp_path):
    params = tmp_path / 'rig.yaml'
    params.write_text('/**: {ros__parameters: {marker_size: 0.2}}')
    _, lines = replay(recording.write(tmp_path / 'bag'), params=params)
    assert any('map.yaml: no marker has the side of the parameters' in line for line in lines)


@pytest.mark.parametrize(
    ('parameters', 'doubted'), [('marker_size: 0.3', True), ('extrinsics: parameters', False), ('', False)]
)
def test_frames_of_a_robot_that_are_not_played_are_doubted_where_no_parameter_stands_in(
    replay, recording, tmp_path, parameters, doubted
):
    """In flight the nodes had taken the place of the camera from them."""
    urdf = small_bag.Raw('std_msgs/msg/String', b'\x00\x01\x00\x00\x01\x00\x00\x00\x00')
    events = [(recording.events[0][0], '/drone/robot_description', urdf), *recording.events]
    given = {}
    if parameters:
        given['params'] = tmp_path / 'rig.yaml'
        given['params'].write_text(f'/**: {{ros__parameters: {{{parameters}}}}}')
    status, lines = replay(small_bag.Recording(events).write(tmp_path / 'bag'), **given)
    assert status == 0
    assert any('does not play drone/robot_description' in line for line in lines) == doubted


def test_a_camera_a_hundred_metres_from_the_imu_is_refused(replay, recording, tmp_path):
    params = tmp_path / 'other.yaml'
    params.write_text('/**: {ros__parameters: {camera_position: [100.0, 0.0, 0.0]}}')
    fails(replay(recording.write(tmp_path / 'bag'), params=params), 'camera_position', '-10.0 .. 10.0')


def test_a_file_that_is_no_bag(replay, tmp_path):
    fails(replay(tmp_path / 'map.yaml'), 'map.yaml: no bag: neither a folder nor a file .mcap')
