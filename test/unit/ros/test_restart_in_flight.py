"""Nodes that crashed in flight go on: a filter with the clock offset that it knew last, a mapper frozen or free."""

import json
import multiprocessing
import os
import threading
import time

import pytest
from std_srvs.srv import SetBool
from support.messages import imu, pose
from support.ros_graph import ros_graph
from support.waiting import PATIENCE_S

from thermal_fiducial.errors import InputError
from thermal_fiducial.files.clock_offset import recent_clock_offset, save_clock_offset
from thermal_fiducial.files.restart_file import save_for_restart
from thermal_fiducial.nodes.marker_mapper import MarkerMapperNode
from thermal_fiducial.nodes.pose_ekf import PoseEkfNode
from thermal_fiducial.ros.base.restart_memory import RestartMemory
from thermal_fiducial.ros.filter_node import filter_memory
from thermal_fiducial.ros.mapper_node import freeze_memory


def test_the_file_holds_it_for_ten_seconds(tmp_path):
    path = tmp_path / 'folder' / 'pose_ekf.json'
    save_clock_offset(path, 0.004)
    assert recent_clock_offset(path) == 0.004
    os.utime(path, (0, time.time() - 11.0))
    assert recent_clock_offset(path) is None


@pytest.mark.parametrize(
    'text',
    [
        '', '{', '[]', '1', '{"version": 1}', '[' * 9000, '{"a": ' * 1500, '\xff', ' ' * 1_000_000,
        '{"camera_time_offset": 0.004}',
    ],
)  # fmt: skip
def test_an_unusable_file_of_the_offset_is_ignored(tmp_path, text):
    (tmp_path / 'offset.json').write_text(text, encoding='latin-1')
    assert recent_clock_offset(tmp_path / 'offset.json') is None


@pytest.mark.parametrize(
    ('field', 'value'),
    [
        ('camera_time_offset', 'NaN'), ('camera_time_offset', '7'), ('camera_time_offset', 'null'),
        ('camera_time_offset', '"x"'), ('camera_time_offset', '[0.1]'), ('camera_time_offset', '1' + '0' * 400),
        ('format', '"x"'), ('version', '[]'),
    ],
)  # fmt: skip
def test_values_that_no_filter_leaves_are_ignored(tmp_path, field, value):
    path = tmp_path / 'offset.json'
    save_clock_offset(path, 0.004)
    document = json.loads(path.read_text())
    path.write_text(json.dumps({**document, field: 'HERE'}).replace('"HERE"', value))
    assert recent_clock_offset(path) is None


def test_what_stands_where_the_file_is_made_is_neither_followed_nor_waited_for(tmp_path):
    path, victim = tmp_path / 'offset.json', tmp_path / 'victim'
    victim.write_text('precious')
    (tmp_path / 'offset.json.new').symlink_to(victim)
    with pytest.raises(InputError, match='offset'):
        save_clock_offset(path, 0.004)
    assert victim.read_text() == 'precious'
    (tmp_path / 'offset.json.new').unlink()
    os.mkfifo(tmp_path / 'offset.json.new')
    with pytest.raises(InputError, match='offset'):
        save_clock_offset(path, 0.004)
    os.mkfifo(path)
    assert recent_clock_offset(path) is None


def test_a_place_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / 'file').touch()
    with pytest.raises(InputError, match='file'):
        save_clock_offset(tmp_path / 'file' / 'offset.json', 0.004)


@pytest.mark.ros
def test_a_user_without_a_home_keeps_no_node_from_starting(monkeypatch):
    """As in a container: filter and mapper crashed in their constructors, and were started again for ever."""
    with ros_graph() as graph:
        for name in ('HOME', 'ROS_HOME'):
            monkeypatch.delenv(name, raising=False)
        monkeypatch.setattr('pwd.getpwuid', {}.__getitem__)
        for kind in (MarkerMapperNode, PoseEkfNode):
            graph.add(kind, live=True).close()


def fly(graph, first, last):
    for k in range(first, last):
        graph.send('imu/data', imu(k))
        if k % 6 == 5:
            graph.send('camera_pose', pose(k - 4))


@pytest.mark.ros
@pytest.mark.parametrize('closed', [False, True])
def test_a_restarted_filter_begins_with_the_offset_of_the_one_before(tmp_path, monkeypatch, capfd, closed):
    monkeypatch.setenv('ROS_HOME', str(tmp_path))
    with ros_graph() as graph:
        # Known well enough from the parameters, as nothing moves.
        node = graph.add(PoseEkfNode, live=True, camera_time_offset=0.007, time_offset_std=0.001)
        fly(graph, 0, 60)
        assert not node.filter.lost
        node.diagnose(0)
        graph.spin_until(lambda: list(tmp_path.rglob('*.json')))
        # It is killed, or it has crashed or is deaf and closes what it has: in any case the flight goes on.
        if closed:
            node.close()
    with ros_graph() as graph:
        again = graph.add(PoseEkfNode, live=True, time_offset_std=0.001)
        # Nothing moves: the one of the filter before, to a tenth of its standard deviation.
        assert again.config.camera_time_offset == pytest.approx(0.007, abs=1e-4)
        fly(graph, 100, 130)
        assert again.filter.camera_time_offset == pytest.approx(0.007, abs=1e-4)
        again.finish()
        again.close()
    assert 'started again in flight: the clock offset of 7.0 ms is kept' in capfd.readouterr().err
    with ros_graph() as graph:
        graph.add(PoseEkfNode, live=True)
    assert 'started again' not in capfd.readouterr().err


@pytest.mark.ros
def test_robots_whose_names_are_alike_each_have_their_own_file(tmp_path, monkeypatch):
    """The robots /a/b and /a_b shared one, and began with the clock offset of each other."""
    monkeypatch.setenv('ROS_HOME', str(tmp_path))
    # As long as the services of a node allow, 225 characters with its name; they differ in the last one.
    long = ['n' * 210 + end for end in 'xy']
    with ros_graph() as graph:
        names = ['', 'a/b', 'a_b', 'a/b_pose_ekf', 'A/b', *long]
        nodes = [PoseEkfNode(live=True, context=graph.context, namespace=name) for name in names]
        paths = [RestartMemory(graph.added(node), active=False).path for node in nodes]
    assert len(set(paths)) == len(names)
    for path in paths:
        save_clock_offset(path, 0.004)
        # The shortest limit of a file system in use, that of eCryptfs.
        assert len(f'{path.name}.new') <= 143


@pytest.fixture(autouse=True)
def no_process_left():
    """A mapper that is killed here has not ended its process of the refinements."""
    yield
    for process in multiprocessing.active_children():
        process.kill()
        process.join()


def freeze(graph, frozen):
    return graph.call(SetBool, 'marker_mapper/freeze', SetBool.Request(data=frozen)).message


@pytest.mark.ros
@pytest.mark.parametrize(('mode', 'frozen'), [('mapping', True), ('localization', False)])
def test_a_restarted_mapper_is_frozen_or_free_as_the_one_before(tmp_path, map_file, monkeypatch, capfd, mode, frozen):
    """A map that the pilot had frozen changed again after a crash, and nothing said so."""
    monkeypatch.setenv('ROS_HOME', str(tmp_path))
    start = {'live': True, 'map_file': str(map_file), 'mode': mode}
    with ros_graph() as graph:
        graph.add(MarkerMapperNode, **start)
        freeze(graph, frozen)
    # It was killed.
    said = f'started again in flight: the map is {"frozen" if frozen else "free"} as before'
    assert said not in capfd.readouterr().err
    with ros_graph() as graph:
        again = graph.add(MarkerMapperNode, **start)
        assert again.mapper.frozen == frozen
        assert said in capfd.readouterr().err
        # For the next restart the file stays new.
        (file,) = tmp_path.rglob('marker_mapper*.json')
        os.utime(file, (0, 0))
        again.diagnose(0)
        graph.spin_until(lambda: file.stat().st_mtime > 0)
        again.finish()
        again.close()
    with ros_graph() as graph:
        assert graph.add(MarkerMapperNode, **start).mapper.frozen == (mode == 'localization')
    assert said not in capfd.readouterr().err


def frozen_in_file(folder):
    (file,) = folder.rglob('marker_mapper*.json')
    return json.loads(file.read_text())['frozen']


@pytest.mark.ros
def test_what_freeze_is_asked_is_kept_at_once(tmp_path, monkeypatch):
    """It was written once a second: a map that was frozen just before a crash changed again after it."""
    monkeypatch.setenv('ROS_HOME', str(tmp_path))
    with ros_graph() as graph:
        graph.add(MarkerMapperNode, live=True)
        for frozen in (True, False, True):
            freeze(graph, frozen)
            assert frozen_in_file(tmp_path) == frozen


@pytest.mark.ros
def test_a_slow_disk_holds_no_answer_of_freeze_and_keeps_the_last(tmp_path, monkeypatch):
    monkeypatch.setenv('ROS_HOME', str(tmp_path))
    idle = threading.Event()

    def save(*arguments):
        assert idle.wait(PATIENCE_S)
        save_for_restart(*arguments)

    monkeypatch.setattr(freeze_memory, 'save_for_restart', save)
    with ros_graph() as graph:
        node = graph.add(MarkerMapperNode, live=True)
        for frozen in (True, False):
            assert freeze(graph, frozen) == ('map frozen' if frozen else 'map free')
        assert not list(tmp_path.rglob('*.json'))
        idle.set()
        graph.spin_until(lambda: list(tmp_path.rglob('*.json')) and frozen_in_file(tmp_path) is False)
        node.finish()


@pytest.mark.ros
def test_where_no_file_can_be_written_the_map_is_frozen_all_the_same(tmp_path, monkeypatch):
    monkeypatch.setenv('ROS_HOME', str(tmp_path))
    (tmp_path / 'thermal_fiducial').touch()
    with ros_graph() as graph:
        node = graph.add(MarkerMapperNode, live=True)
        for frozen in (True, False, True):
            assert freeze(graph, frozen) == ('map frozen' if frozen else 'map free')
            assert node.mapper.frozen == frozen
        assert (node.refused, 'thermal_fiducial' in node.last_refusal) == (1, True)


@pytest.mark.ros
def test_a_mapper_that_nobody_has_frozen_leaves_no_file(tmp_path, monkeypatch):
    monkeypatch.setenv('ROS_HOME', str(tmp_path))
    with ros_graph() as graph:
        node = graph.add(MarkerMapperNode, live=True)
        node.diagnose(0)
        node.finish()
        node.close()
    assert not list(tmp_path.rglob('*.json'))


@pytest.mark.parametrize(
    'text', ['', '{}', '[]', '{"frozen": true}', '{"format": "thermal_fiducial/freeze", "version": 1, "frozen": 1}']
)
@pytest.mark.ros
def test_what_is_no_file_of_a_mapper_freezes_nothing(tmp_path, monkeypatch, text):
    monkeypatch.setenv('ROS_HOME', str(tmp_path))
    with ros_graph() as graph:
        graph.add(MarkerMapperNode, live=True)
        freeze(graph, True)
        (file,) = tmp_path.rglob('marker_mapper*.json')
    file.write_text(text)
    with ros_graph() as graph:
        assert graph.add(MarkerMapperNode, live=True).mapper.frozen is False


@pytest.mark.ros
def test_a_slow_disk_holds_no_pose(monkeypatch):
    """Where bags are recorded on the same disk, each of these files took up to 51 ms, once a second."""
    idle, written = threading.Event(), []

    def save(path, offset):
        assert idle.wait(PATIENCE_S)
        written.append(offset)

    monkeypatch.setattr(filter_memory, 'save_clock_offset', save)
    with ros_graph() as graph:
        node = graph.add(PoseEkfNode, live=True, camera_time_offset=0.007, time_offset_std=0.001)
        fly(graph, 0, 60)
        poses = graph.published(node, 'pose')
        # The second one does not wait for the first.
        for k in (60, 61):
            node.diagnose(0)
            graph.send('imu/data', imu(k))
        assert graph.published(node, 'pose') == poses + 2
        assert not written
        idle.set()
        node.finish()
        assert written == [pytest.approx(0.007, abs=1e-4)]


@pytest.mark.ros
def test_a_place_that_cannot_be_written_is_reported_once(monkeypatch, tmp_path):
    monkeypatch.setenv('ROS_HOME', str(tmp_path))
    (tmp_path / 'thermal_fiducial').touch()
    with ros_graph() as graph:
        node = graph.add(PoseEkfNode, live=True, time_offset_std=0.001)
        fly(graph, 0, 60)
        graph.spin_until(lambda: node.last_refusal or node.guard(lambda _: node.diagnose(0), None))
        assert (node.refused, 'thermal_fiducial' in node.last_refusal) == (1, True)
        for _ in range(3):
            node.diagnose(0)
        assert node.refused == 1
