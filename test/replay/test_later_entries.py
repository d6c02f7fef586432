"""Bags that begin later in the chain: markers, or camera poses, in the place of images."""

import json

import pytest
from support import small_bag

from thermal_fiducial.cli.main import main
from thermal_fiducial.files.bag_writer import BagWriter
from thermal_fiducial.files.bags import BagReader, CAMERA_INFO_TOPIC, IMU_TOPIC, MAP_ERROR_TOPIC
from thermal_fiducial.files.dictionary import load_dictionary, save_dictionary
from thermal_fiducial.files.marker_map import load_map

pytestmark = pytest.mark.ros

#: What a bag that begins there has, beside IMU and calibration.
TOPICS = {'markers': ['markers'], 'camera_pose': ['camera_pose', MAP_ERROR_TOPIC]}


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    """A bag of images, its run, and bags of what its nodes published beside the IMU and the calibration."""
    folder = tmp_path_factory.mktemp('entries')
    small_bag.recording(seconds=1.2).write(folder / 'images')
    small_bag.side_files(folder, ids=(0, 1, 2, 3))
    assert replay(folder, 'images') == 0
    for topic, topics in TOPICS.items():
        with BagWriter(folder / topic) as bag, BagReader(folder / 'images') as images:
            played = [*images.messages([IMU_TOPIC, CAMERA_INFO_TOPIC])]
            with BagReader(folder / 'images_run' / 'output') as output:
                played += output.messages(topics)
            for message in sorted(played, key=lambda item: item.stamp_ns):
                bag.write(f'/drone/{message.topic}', message.stamp_ns, message.cdr, message.msgtype)
    return folder


def replay(folder, bag, *extra):
    """Exit status of the command; the map is known, so that frames do not change it."""
    run = ['--out', folder / f'{bag}_run', '--params', folder / 'params.yaml', '--map', folder / 'map.yaml']
    return main([str(word) for word in ('replay', folder / bag, *run, '--mode', 'localization', '--no-report', *extra)])


@pytest.mark.parametrize(
    ('entry', 'transport'),
    [
        ('markers', 'lockstep'),
        ('camera_pose', 'lockstep'),
        ('markers', 'processes'),
        pytest.param('camera_pose', 'processes', marks=pytest.mark.nightly),
    ],
)
def test_the_same_poses_as_from_images(folder, entry, transport):
    run, images = folder / f'{entry}_run', folder / 'images_run'
    enough = 0.9 * len((images / 'fused.tum').read_text().splitlines())
    slower = ['--rate', '0.5'] if transport == 'processes' else []
    for _ in range(3):
        assert replay(folder, entry, '--transport', transport, *slower) == 0
        summary = json.loads((run / 'summary.json').read_text())
        # In real time, what is lost on a machine that others take for a while says nothing of the nodes.
        if summary['messages_out']['pose'] > enough:
            break
    assert 'tau2_camera' not in summary['diagnostics']
    assert set(summary['messages_in']) == {IMU_TOPIC, CAMERA_INFO_TOPIC, *TOPICS[entry]}
    if transport == 'lockstep':
        for name in ('fused.tum', 'fiducial.tum'):
            assert (run / name).read_bytes() == (images / name).read_bytes()
        assert main(['evaluate', str(run)]) == 0
    else:
        # Single messages may be lost on a machine that tests starve.
        assert summary['messages_out']['pose'] > enough


@pytest.mark.parametrize(
    ('bad', 'status', 'words'), [(1, 0, '1 message refused'), (99, 2, 'not one message on markers')]
)
def test_markers_that_the_mapper_refuses_end_a_replay_only_if_all_are(folder, tmp_path, capfd, bad, status, words):
    left = bad
    with BagWriter(tmp_path / 'bag') as damaged, BagReader(folder / 'markers') as whole:
        for message in whole.messages():
            spoil = message.topic == 'markers' and left > 0
            left -= spoil
            data = small_bag.without_a_corner(message.cdr) if spoil else message.cdr
            damaged.write(message.topic, message.stamp_ns, data, message.msgtype)
    given = ['--map', folder / 'map.yaml', '--params', folder / 'params.yaml', '--no-report']
    assert main([str(word) for word in ('replay', tmp_path / 'bag', '--out', tmp_path / 'run', *given)]) == status
    assert words in capfd.readouterr().err


@pytest.mark.parametrize('words', [('images', '--from', 'markers'), ('markers',)])
def test_images_cannot_be_recorded_where_no_node_has_them(folder, words, capfd):
    assert replay(folder, *words, '--images') == 2
    assert '--images has no effect with input from' in capfd.readouterr().err


def test_a_video_of_a_bag_without_images_is_refused_before_the_replay(folder, tmp_path, monkeypatch, capfd):
    # An encoder, if there is none on this machine.
    monkeypatch.setattr('thermal_fiducial.report.video.require_encoder', lambda: None)
    run = tmp_path / 'run'
    words = ['replay', folder / 'markers', '--out', run, '--map', folder / 'map.yaml', '--no-report', '--video']
    assert main([str(word) for word in words]) == 2
    assert '--video has no effect with' in capfd.readouterr().err
    assert not run.exists()


def test_what_is_missing_is_named(folder, tmp_path, capfd):
    recorded = small_bag.recording(seconds=0.2).without('thermal/image_raw')
    recorded.write(tmp_path / 'bag')
    arguments = ['replay', tmp_path / 'bag', '--out', tmp_path / 'run', '--no-report']
    assert main([*map(str, arguments), '--from', 'markers']) == 2
    (line,) = capfd.readouterr().err.splitlines()
    assert 'no topic markers' in line


def test_a_bag_of_images_is_replayed_from_any_entry_that_it_has(folder):
    assert replay(folder, 'markers', '--from', 'images') == 2


def test_a_map_with_a_dictionary_of_its_own_is_read_in_the_run_folder(folder, capfd):
    """The run had a copy of the map without its dictionary file: the nodes and ``map check`` doubted it."""
    save_dictionary(folder / 'own.yaml', 'own', load_dictionary('DICT_4X4_50'))
    own = folder / 'own_map.yaml'
    own.write_text((folder / 'map.yaml').read_text().replace('DICT_4X4_50', 'own.yaml'))
    assert replay(folder, 'markers', '--map', own) == 0
    run = folder / 'markers_run'
    assert (run / 'own.yaml').read_text() == (folder / 'own.yaml').read_text()
    assert 'dictionary' not in capfd.readouterr().err
    assert main(['map', 'check', str(run / 'marker_map.yaml')]) == 0
    assert 'own.yaml' not in capfd.readouterr().err


def test_the_map_of_a_run_without_one_names_a_dictionary_file_that_is_beside_it(folder, tmp_path, capfd):
    """It had the path of the file, which the rules of maps refuse, and which a folder that is moved leaves behind."""
    own, run, moved = tmp_path / 'own.yaml', tmp_path / 'run', tmp_path / 'moved'
    save_dictionary(own, 'own', load_dictionary('DICT_4X4_50'))
    params = tmp_path / 'params.yaml'
    params.write_text(f'/**: {{ros__parameters: {{dictionary: {own}}}}}')
    words = ['replay', folder / 'markers', '--out', run, '--params', params, '--no-report']
    # No pose goes out.
    assert main([*map(str, words)]) == 1
    run.rename(moved)
    assert load_map(moved / 'marker_map.yaml').dictionary == own.name
    capfd.readouterr()
    main(['map', 'check', str(moved / 'marker_map.yaml')])
    assert 'dictionary' not in capfd.readouterr().out
