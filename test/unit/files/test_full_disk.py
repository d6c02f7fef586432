"""Disks that are full or read-only, at the start or in the middle of work: one line, nothing half, no map lost."""

from contextlib import contextmanager
import errno
import gc
import json
import os
import resource
import shutil
import sys
import tempfile
import time

import numpy as np
import pytest
from std_srvs.srv import Trigger
from support import small_bag
from support.messages import info
from support.ros_graph import ros_graph
from support.waiting import PATIENCE_S

from thermal_fiducial.cli.main import main
from thermal_fiducial.core.mapping.map_data import MapperResult
from thermal_fiducial.core.measurements import MARKER_DTYPE
from thermal_fiducial.errors import InputError
from thermal_fiducial.files import atomic
from thermal_fiducial.files.atomic import locked
from thermal_fiducial.files.bag_writer import BagWriter, STORAGES
from thermal_fiducial.files.bags import BagReader, IMU_TOPIC
from thermal_fiducial.files.map_keeper import MapKeeper
from thermal_fiducial.files.marker_map import load_map, save_map
from thermal_fiducial.files.trajectory_file import save_tum
from thermal_fiducial.nodes.marker_mapper import MarkerMapperNode
from thermal_fiducial.replay.session import Options, replay
from thermal_fiducial.ros.base.node import WARN
from thermal_fiducial.ros.messages import clouds, convert


@contextmanager
def full_after(size):
    """No file grows beyond ``size`` bytes: what a full disk answers, without root and without a disk."""
    before, wrote = resource.getrlimit(resource.RLIMIT_FSIZE), sys.dont_write_bytecode
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    # Python takes the bytecode that it has cut off for whole, and no later process can import such a module.
    sys.dont_write_bytecode = True
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        sys.dont_write_bytecode = wrote


@contextmanager
def refused(monkeypatch, folder, number=errno.EROFS):
    """Nothing new can be made in ``folder`` and below it."""
    make, open_ = os.mkdir, os.open

    def guarded(act, flags_at):
        def tried(path, *rest, **named):
            new = flags_at is None or (rest and rest[0] & (os.O_CREAT | os.O_WRONLY | os.O_RDWR))
            if new and os.fspath(path).startswith(str(folder)):
                raise OSError(number, os.strerror(number), path)
            return act(path, *rest, **named)

        return tried

    with monkeypatch.context() as disk:
        disk.setattr(os, 'mkdir', guarded(make, None))
        disk.setattr(os, 'open', guarded(open_, 0))
        yield


def one_line(capsys):
    error = capsys.readouterr().err
    assert error.count('\n') == 1, error
    return error


# Where the library cannot open a bag it leaves the file to the garbage collector.
@pytest.mark.filterwarnings('ignore::pytest.PytestUnraisableExceptionWarning')
@pytest.mark.parametrize('storage', STORAGES)
@pytest.mark.parametrize('size', [0, 100_000], ids=['at once', 'on the way'])
def test_a_bag_that_does_not_fit_is_one_line_and_leaves_nothing(tmp_path, storage, size):
    message = small_bag.imu(small_bag.START_NS, np.zeros(6))

    def write(messages):
        with BagWriter(tmp_path / 'bag', storage) as bag:
            for count in range(messages):
                bag.write(IMU_TOPIC, small_bag.START_NS + count, message)

    with full_after(size), pytest.raises(InputError, match=r'bag: ') as refusal:
        write(5000)
    assert '\n' not in str(refusal.value)
    assert list(tmp_path.iterdir()) == []
    del refusal
    gc.collect()
    write(100)
    with BagReader(tmp_path / 'bag') as bag:
        assert bag.message_count() == 100


def test_a_bag_whose_writing_is_interrupted_is_removed(tmp_path):
    def interrupted():
        with BagWriter(tmp_path / 'bag') as bag:
            bag.write(IMU_TOPIC, small_bag.START_NS, small_bag.imu(small_bag.START_NS, np.zeros(6)))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize('size', [0, 2_000, 50_000])
def test_a_simulation_that_does_not_fit_leaves_nothing(tmp_path, capsys, size):
    with full_after(size):
        assert main(['simulate', str(tmp_path / 'bag'), '--scenario', 'april', '--seconds', '1']) == 2
    assert str(tmp_path / 'bag') in one_line(capsys)
    assert list(tmp_path.iterdir()) == []


def test_a_file_that_does_not_fit_stays_as_it_was(tmp_path):
    path, poses = tmp_path / 'a.tum', np.zeros((100, 3))
    quaternions = np.tile([0.0, 0.0, 0.0, 1.0], (100, 1))
    save_tum(path, range(10), poses[:10], quaternions[:10])
    before = path.read_bytes()
    with full_after(1000), pytest.raises(InputError, match=f'{path}: File too large'):
        save_tum(path, range(100), poses, quaternions)
    assert (path.read_bytes(), list(tmp_path.iterdir())) == (before, [path])


# As with bags, of reportlab.
@pytest.mark.filterwarnings('ignore::pytest.PytestUnraisableExceptionWarning')
@pytest.mark.parametrize(
    ('command', 'name'),
    [
        (['map', 'show', 'hall.yaml', '--plot'], 'map.png'),
        *(
            (['markers', 'make', '--ids', '1', '--formats', kind, '--out'], '.')
            for kind in ('svg', 'dxf', 'pdf', 'png')
        ),
    ],
)
def test_a_drawing_that_does_not_fit_leaves_no_half(tmp_path, capsys, monkeypatch, command, name):
    monkeypatch.chdir(tmp_path)
    save_map(tmp_path / 'hall.yaml', small_bag.map_of((0, 1)))
    with full_after(500):
        assert main([*command, str(tmp_path / name)]) == 2
    assert 'File too large' in one_line(capsys)
    assert list(tmp_path.iterdir()) == [tmp_path / 'hall.yaml']
    gc.collect()
    assert main([*command, str(tmp_path / name)]) == 0
    assert len(list(tmp_path.iterdir())) == 2


@pytest.mark.ros
def test_a_run_that_does_not_fit_leaves_parameters_and_map_and_can_be_flown_again(tmp_path):
    small_bag.recording(seconds=1.2).write(tmp_path / 'bag')
    map_file, params = small_bag.side_files(tmp_path, ids=(0, 1, 2, 3))
    out = tmp_path / 'run'
    options = Options(tmp_path / 'bag', out, params, map_file)
    arguments = ['replay', tmp_path / 'bag', '--out', out, '--params', params, '--map', map_file, '--no-report']
    command = [str(word) for word in arguments]
    (out / 'output').mkdir(parents=True)
    for earlier in ('parameters.yaml', 'summary.json', 'fused.tum'):
        (out / earlier).touch()
    # The disk fills up behind the first second; fused.tum alone has more than this.
    with full_after(resource.RLIM_INFINITY), pytest.raises(InputError, match=f'{out}.*: File too large'):
        replay(options, lambda _: resource.setrlimit(resource.RLIMIT_FSIZE, (3000, resource.RLIM_INFINITY)), print)
    assert {path.name for path in out.iterdir()} <= {'parameters.yaml', 'marker_map.yaml', 'marker_map.yaml.history'}
    assert load_map(out / 'marker_map.yaml').markers.keys() == {0, 1, 2, 3}
    assert main(command) == 0
    assert json.loads((out / 'summary.json').read_text())['messages_out']['pose'] > 0


@pytest.mark.ros
def test_a_run_that_is_killed_leaves_no_table_that_looks_whole(tmp_path):
    small_bag.recording(seconds=1.2).write(tmp_path / 'bag')
    map_file, params = small_bag.side_files(tmp_path, ids=(0, 1, 2, 3))
    out, seen = tmp_path / 'run', set()
    for _ in range(2):
        replay(
            Options(tmp_path / 'bag', out, params, map_file),
            lambda _: seen.update(p.name for p in out.iterdir()),
            print,
        )
    tables = {'fused.tum', 'fiducial.tum', 'detections.csv'}
    # While it lasts, also over an earlier run: what a kill would leave.
    assert not seen & (tables | {'summary.json'})
    assert {f'{name}.part' for name in tables} <= seen
    assert {*tables, 'summary.json'} <= {path.name for path in out.iterdir()}
    assert not list(out.glob('*.part'))


@pytest.mark.parametrize('number', [errno.EROFS, errno.EACCES])
def test_commands_in_a_folder_that_is_read_only_say_so_in_a_line(tmp_path, capsys, monkeypatch, number):
    path = tmp_path / 'hall.yaml'
    save_map(path, small_bag.map_of((0, 1)))
    before = path.read_bytes()
    commands = [
        ['simulate', tmp_path / 'bag', '--scenario', 'april', '--seconds', '1'],
        ['map', 'move', path, '1', '--position', '1', '2', '3'],
        ['markers', 'make', '--ids', '1', '--out', tmp_path / 'markers'],
    ]
    for command in commands:
        with refused(monkeypatch, tmp_path, number):
            assert main(list(map(str, command))) == 2, command
        line = one_line(capsys)
        assert str(tmp_path) in line
        assert os.strerror(number) in line
    assert (path.read_bytes(), list(tmp_path.iterdir())) == (before, [path])


@pytest.fixture
def homes(tmp_path, monkeypatch):
    """Where a node may keep its own things, and where everybody may keep temporary ones."""
    homes = tmp_path / 'ros', tmp_path / 'temporary'
    homes[1].mkdir()
    monkeypatch.setenv('ROS_HOME', str(homes[0]))
    monkeypatch.setattr(tempfile, 'tempdir', str(homes[1]))
    return homes


def learned(folder):
    """A keeper of a map in ``folder`` that has learned one marker more, and what it is to save."""
    folder.mkdir()
    path = folder / 'hall.yaml'
    save_map(path, small_bag.map_of((0,)))
    keeper = MapKeeper(path, small_bag.SIZE, {})
    keeper.read()
    keeper.take()
    keeper.unsaved = True
    return keeper, small_bag.map_of((0, 1))


def test_a_map_whose_folder_takes_nothing_is_saved_where_something_can_be(tmp_path, homes, monkeypatch):
    home, temporary = homes
    keeper, grown = learned(tmp_path / 'maps')
    before = keeper.path.read_bytes()
    with refused(monkeypatch, tmp_path / 'maps'):
        saved = keeper.save(grown)
    assert saved == home / 'thermal_fiducial' / 'hall.new.yaml'
    assert load_map(saved).markers.keys() == {0, 1}
    assert 'Read-only file system' in keeper.obstacle
    assert keeper.path.read_bytes() == before
    shutil.rmtree(home)
    with refused(monkeypatch, tmp_path / 'maps'), refused(monkeypatch, home):
        saved = keeper.save(grown)
    assert saved.parent.parent == temporary
    assert load_map(saved).markers.keys() == {0, 1}
    assert keeper.save(grown) == keeper.path
    assert keeper.obstacle == ''


@pytest.mark.ros
def test_a_disk_that_is_full_in_flight_is_reported_until_it_takes_the_map_again(tmp_path, homes, monkeypatch, capfd):
    keeper, grown = learned(tmp_path / 'maps')
    with ros_graph() as graph:
        node = graph.add(MarkerMapperNode, live=True, map_file=str(keeper.path), mode='mapping', autosave_period=0.05)
        node.mapper.map.markers |= grown.markers
        node.mapper.learn = lambda frame: MapperResult(1, None, '', learned=True)
        graph.send('thermal/camera_info', info())
        frame = clouds.cloud(np.zeros(0, MARKER_DTYPE), convert.header(1, 'camera'))
        failed = f'no autosave: {keeper.path}.autosave: No space left on device'
        with refused(monkeypatch, tmp_path / 'maps', errno.ENOSPC):
            graph.send('markers', frame)
            graph.spin_until(lambda: node.headline() == failed)
            # Also in seconds in which none is tried.
            assert graph.diagnose(node)[:2] == (WARN, failed)
            graph.diagnose(node)
            saved = graph.call(Trigger, 'marker_mapper/save', Trigger.Request())
            assert (saved.success, 'No space left on device' in saved.message) == (True, True)
            assert load_map(homes[0] / 'thermal_fiducial' / 'hall.new.yaml').markers.keys() == {0, 1}
        graph.send('markers', frame)
        graph.spin_until(lambda: node.headline() == '')
        assert load_map(f'{keeper.path}.autosave').markers.keys() == {0, 1}
        assert graph.call(Trigger, 'marker_mapper/save', Trigger.Request()).message.endswith(f'saved to {keeper.path}')
        assert sorted(path.name for path in keeper.path.parent.iterdir()) == ['hall.yaml', 'hall.yaml.history']
        node.close()
    assert capfd.readouterr().err.count('no autosave') == 1


@pytest.mark.ros
def test_frames_do_not_wait_for_a_disk_that_does_not_answer(tmp_path, homes, monkeypatch):
    """Here it is another program that keeps the lock of the folder for longer than anybody waits."""
    monkeypatch.setattr(atomic, 'PATIENCE_S', PATIENCE_S)
    keeper, grown = learned(tmp_path / 'maps')
    before = keeper.path.read_bytes()
    with ros_graph() as graph:
        node = graph.add(MarkerMapperNode, live=True, map_file=str(keeper.path), mode='mapping')
        node.mapper.map.markers |= grown.markers
        with locked(keeper.path):
            began = time.monotonic()
            response = graph.call(Trigger, 'marker_mapper/save', Trigger.Request())
            # A second is the patience of services; that for the lock is more than a busy machine needs for all else.
            assert time.monotonic() - began < 0.5 * PATIENCE_S
            assert (response.success, 'the disk is busy' in response.message) == (False, True)
            assert keeper.path.read_bytes() == before
        graph.spin_until(lambda: keeper.path.read_bytes() != before)
        node.close()
    assert load_map(keeper.path).markers.keys() == {0, 1}


@pytest.mark.ros
def test_a_disk_that_is_full_at_the_end_of_a_mapper_costs_no_map(tmp_path, homes, monkeypatch):
    keeper, grown = learned(tmp_path / 'maps')
    with ros_graph() as graph:
        node = graph.add(MarkerMapperNode, live=True, map_file=str(keeper.path), mode='mapping')
        node.mapper.map.markers |= grown.markers
        # What was loaded is gone: all there is must be saved.
        keeper.path.unlink()
        with refused(monkeypatch, tmp_path / 'maps', errno.ENOSPC):
            node.close()
        assert load_map(homes[0] / 'thermal_fiducial' / 'hall.new.yaml').markers.keys() == {0, 1}
        shutil.rmtree(homes[0])
        with refused(monkeypatch, tmp_path), pytest.raises(InputError, match=r'not saved: .*hall.yaml: '):
            node.close()
