"""Many bags on workers of Dask: the same bytes from any number of them, also when one is killed."""

from dataclasses import replace
import errno
import os
from pathlib import Path
import signal
import threading
import time

import numpy as np
import pytest
from support import small_bag
from support.interrupts import interrupted
from support.tasks import write_twice

from thermal_fiducial.cli.main import main
from thermal_fiducial.errors import InputError
from thermal_fiducial.files import work_folders
from thermal_fiducial.files.bag_writer import BagWriter
from thermal_fiducial.files.bags import BagReader, CAMERA_INFO_TOPIC, IMAGE_TOPIC, IMU_TOPIC, MARKERS_TOPIC
from thermal_fiducial.files.dictionary import load_dictionary, save_dictionary
from thermal_fiducial.files.marker_map import load_map, save_map
from thermal_fiducial.replay import many_bags
from thermal_fiducial.replay.workers import workers

pytest.importorskip('distributed', reason='the extra "batch" is not installed')
pytestmark = [
    pytest.mark.ros,
    pytest.mark.slow,
    # The cluster's own event loops and sockets, closed while the interpreter collects them.
    pytest.mark.filterwarnings('ignore::ResourceWarning', 'ignore::DeprecationWarning'),
    pytest.mark.filterwarnings('ignore::pytest.PytestUnraisableExceptionWarning'),
]


#: Factors of the nine numbers of a camera matrix: the image enlarged.
ZOOM = np.repeat((1.5, 1.5, 1.0), 3)


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    """Two short bags, with parameters and a map of one marker."""
    folder = tmp_path_factory.mktemp('batch')
    for seed in range(2):
        small_bag.recording(seconds=0.5, seed=seed).write(folder / f'flight{seed}')
    small_bag.side_files(folder)
    return folder


def batch(folder, out, *extra, bags=('flight0', 'flight1')):
    """Exit status of the command."""
    given = ['--out', folder / out, '--map', folder / 'map.yaml', '--params', folder / 'params.yaml', *extra]
    return main([str(word) for word in ('batch', *(folder / bag for bag in bags), *given)])


def contents(out):
    """Path to bytes of every file."""
    return {path.relative_to(out): path.read_bytes() for path in sorted(out.rglob('*')) if path.is_file()}


@pytest.fixture(scope='module')
def alone(folder):
    assert batch(folder, 'alone', '--workers', '1') == 0
    return folder / 'alone'


def test_runs_and_a_joint_map(alone):
    assert sorted(load_map(alone / 'marker_map.yaml').markers) == [0, 1, 2, 3]
    assert {path.name for path in alone.iterdir()} == {'flight0', 'flight1', 'marker_map.yaml', 'batch.json'}
    assert (alone / 'flight1' / 'fused.tum').read_text()


def test_the_joint_map_starts_with_the_sides_of_the_parameters(tmp_path):
    """A map file need not say how large its markers are."""
    small_bag.recording(seconds=0.5).write(tmp_path / 'flight0')
    marker_map, parameters = small_bag.side_files(tmp_path)
    marker_map.write_text(marker_map.read_text().replace(f'size: {small_bag.SIZE}, ', ''))
    side = f'marker_size: 0.1, marker_size_overrides: ["0:{small_bag.SIZE}"]'
    parameters.write_text(f'/**: {{ros__parameters: {{{side}}}}}')
    assert batch(tmp_path, 'out', bags=['flight0']) == 0
    assert load_map(tmp_path / 'out' / 'marker_map.yaml').markers[0].size == small_bag.SIZE


def test_the_joint_map_has_the_dictionary_file_beside_it(tmp_path):
    small_bag.recording(seconds=0.5).write(tmp_path / 'flight0')
    marker_map, _ = small_bag.side_files(tmp_path)
    save_dictionary(tmp_path / 'own.yaml', 'own', load_dictionary('DICT_4X4_50'))
    save_map(marker_map, replace(load_map(marker_map), dictionary='own.yaml'))
    assert batch(tmp_path, 'out', bags=['flight0']) == 0
    assert load_map(tmp_path / 'out' / 'marker_map.yaml').dictionary == 'own.yaml'
    assert (tmp_path / 'out' / 'own.yaml').read_bytes() == (tmp_path / 'own.yaml').read_bytes()


def test_markers_of_a_bag_that_the_mapper_refused_are_not_in_the_joint_map_either(folder, alone):
    """A bag that begins with markers, of which a message is damaged."""
    with BagWriter(folder / 'late') as bag, BagReader(alone / 'flight0' / 'output') as output:
        first = True
        for message in output.messages([MARKERS_TOPIC]):
            data = small_bag.without_a_corner(message.cdr) if first else message.cdr
            bag.write(MARKERS_TOPIC, message.stamp_ns, data, message.msgtype)
            first = False
        with BagReader(folder / 'flight0') as flight:
            for message in flight.messages([IMU_TOPIC, CAMERA_INFO_TOPIC]):
                bag.write(message.topic, message.stamp_ns, message.cdr, message.msgtype)
    assert batch(folder, 'late_runs', '--workers', '1', bags=['late']) == 0
    assert sorted(load_map(folder / 'late_runs' / 'marker_map.yaml').markers) == [0, 1, 2, 3]


def test_the_calibration_of_a_bag_is_read_once(folder, monkeypatch):
    read = []

    class Noted(BagReader):
        """Notes from where messages of which topics are read."""

        def messages(self, topics=None):
            read.append((self.path.name, topics))
            return super().messages(topics)

    monkeypatch.setattr(many_bags, 'BagReader', Noted)
    assert batch(folder, 'once') == 0
    assert [name for name, topics in read if topics == [CAMERA_INFO_TOPIC]] == ['flight0', 'flight1']


def test_two_workers_of_which_one_is_killed_write_the_same_bytes(folder, alone):
    killed = []

    def kill_the_first():
        """As soon as a bag is being replayed: its run folder has a beginning then."""
        while not killed:
            time.sleep(0.05)
            if any((folder / 'killed').glob('.flight*/*/fused.tum*')):
                worker = _workers_of(os.getpid())[0]
                os.kill(worker, signal.SIGKILL)
                killed.append(worker)

    thread = threading.Thread(target=kill_the_first, daemon=True)
    thread.start()
    assert batch(folder, 'killed', '--workers', '2') == 0
    assert killed
    assert contents(folder / 'killed') == contents(alone)


def _workers_of(pid):
    """Process IDs of Dask's workers below a process: spawned ones, the resource tracker aside."""
    children = Path(f'/proc/{pid}/task').glob('*/children')
    below = [int(word) for path in children for word in path.read_text().split()]
    return [child for child in below if b'spawn_main' in Path(f'/proc/{child}/cmdline').read_bytes()]


def test_two_bags_of_one_name(folder, capfd):
    assert batch(folder, 'never', bags=('flight0', 'flight0')) == 2
    assert 'flight0' in capfd.readouterr().err


def test_missing_bags_are_named_before_anything_is_begun(folder, capfd):
    assert batch(folder, 'never', bags=('flight0', 'nope', 'nor_this')) == 2
    names = ', '.join(str(folder / name) for name in ('nope', 'nor_this'))
    assert capfd.readouterr().err == f'thermal-fiducial batch: {names}: no such bag\n'
    assert not (folder / 'never').exists()


def test_a_bag_in_the_folder_of_the_runs_is_not_replaced(folder, capfd):
    before = contents(folder / 'flight0')
    assert batch(folder, '.', bags=('flight0',)) == 2
    assert 'flight0 exists and is no earlier run' in capfd.readouterr().err
    assert contents(folder / 'flight0') == before


def test_a_map_of_something_else_is_not_overwritten(folder, capfd):
    (folder / 'mine').mkdir()
    (folder / 'mine' / 'marker_map.yaml').write_text('mine')
    assert batch(folder, 'mine', bags=('flight0',)) == 2
    assert 'marker_map.yaml is not of an earlier batch' in capfd.readouterr().err
    assert contents(folder / 'mine') == {Path('marker_map.yaml'): b'mine'}


@pytest.mark.parametrize('name', ['marker_map.yaml', 'flight1/marker_map.yaml'])
def test_a_batch_does_not_delete_the_map_that_it_starts_from(folder, alone, capfd, name):
    """Begun from its own result it deleted that and its summary first, and then could not read it."""
    before = contents(alone)
    assert batch(folder, 'alone', '--map', alone / name) == 2
    assert f'{name}: this batch would replace it' in capfd.readouterr().err
    assert contents(alone) == before


def test_all_arguments_that_are_no_bags_are_named_before_any_is_replayed(folder, capfd):
    """A folder without a bag, another file, and a bag without an IMU: as by a pattern that matches too much."""
    (folder / 'empty').mkdir()
    small_bag.recording(seconds=0.1).without(IMU_TOPIC).write(folder / 'no_imu')
    assert batch(folder, 'nothing', bags=('flight0', 'empty', 'map.yaml', 'no_imu')) == 2
    error = capfd.readouterr().err
    assert error.count('\n') == 1
    for words in ('empty: no bag', 'map.yaml: no bag', 'no_imu: no topic imu/data'):
        assert words in error
    assert not (folder / 'nothing').exists()


def test_bags_of_different_calibrations_are_named_before_any_is_replayed(folder, capfd):
    def zoomed(message):
        return small_bag.replaced(message, k=ZOOM * message.k)

    small_bag.recording(seconds=0.1).changed(CAMERA_INFO_TOPIC, zoomed).write(folder / 'zoomed')
    assert batch(folder, 'mixed', bags=('flight0', 'zoomed', 'flight1')) == 2
    (line,) = capfd.readouterr().err.splitlines()
    assert line == 'thermal-fiducial batch: zoomed has another calibration than flight0: no joint map'
    assert not (folder / 'mixed').exists()


def test_a_bag_whose_calibration_is_none_is_named(folder, capfd):
    none = small_bag.Raw('sensor_msgs/msg/CameraInfo', b'\0' * 8)
    small_bag.recording(seconds=0.1).changed(CAMERA_INFO_TOPIC, lambda _: none).write(folder / 'no_lens')
    assert batch(folder, 'lensless', bags=('no_lens',)) == 2
    assert 'no_lens: ' in capfd.readouterr().err
    assert not (folder / 'lensless').exists()


def test_no_folder_is_left_where_no_bag_could_be_replayed(folder, capfd):
    damaged(folder / 'damaged')
    assert batch(folder, 'none', bags=('damaged',)) == 2
    assert 'damaged' in capfd.readouterr().err
    assert not (folder / 'none').exists()


def damaged(path):
    """A bag that only shows while it is played that a message of it is none."""
    recording = small_bag.recording(seconds=0.2)
    index = next(i for i, event in enumerate(recording.events) if event[1] == IMAGE_TOPIC)
    recording.events[index] = (*recording.events[index][:2], small_bag.Raw('sensor_msgs/msg/Image', b'\0' * 8))
    recording.write(path)


def test_a_scheduler_that_is_not_there(folder, capfd):
    assert batch(folder, 'nowhere', '--scheduler', 'nonsense://1', bags=('flight0',)) == 2
    assert 'no scheduler at nonsense://1' in capfd.readouterr().err


def test_a_bad_bag_is_named_and_the_others_are_replayed_by_a_cluster_that_is_there(folder, alone, capfd):
    from distributed import LocalCluster

    damaged(folder / 'broken')
    bags = ('flight0', 'broken')
    local = {'processes': False, 'protocol': 'tcp://', 'dashboard_address': ':0', 'silence_logs': 50}
    with LocalCluster(n_workers=1, threads_per_worker=1, **local) as cluster:
        assert batch(folder, 'cluster', '--scheduler', cluster.scheduler_address, bags=bags) == 2
    lines = [line for line in capfd.readouterr().err.splitlines() if line.startswith('thermal-fiducial')]
    assert len(lines) == 1
    assert lines[0].count('broken') == 1
    assert contents(folder / 'cluster' / 'flight0') == contents(alone / 'flight0')


@pytest.fixture(scope='module')
def longer(folder):
    """Two bags whose replay takes several seconds."""
    bags = folder / 'long0', folder / 'long1'
    for seed, bag in enumerate(bags):
        small_bag.recording(seconds=10.0, seed=seed).write(bag)
    return bags


def interrupted_in_a_bag(begun, ended):
    """A batch that is interrupted as soon as its worker has begun."""
    with workers(1) as client:
        client.submit(write_twice, begun, ended)
        while not begun.exists():
            time.sleep(0.01)
        raise KeyboardInterrupt


def test_workers_end_in_the_middle_of_a_bag_when_the_batch_is_interrupted(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        interrupted_in_a_bag(tmp_path / 'begun', tmp_path / 'ended')
    assert not (tmp_path / 'ended').exists()


class Killed(BaseException):
    """In place of the signal of which no process knows."""


def killed_at(step, monkeypatch):
    """Let a process be killed at one of its renames and removals, of which it does no further ones."""
    steps = []

    def happens():
        steps.append(None)
        if len(steps) >= step:
            raise Killed

    def rename(path, target, rename=Path.rename):
        happens()
        return rename(path, target)

    def half_removed(path, ignore_errors=False):
        if len(steps) < step:
            next(file for file in path.rglob('*') if file.is_file()).unlink()
        happens()

    monkeypatch.setattr(Path, 'rename', rename)
    monkeypatch.setattr(work_folders.shutil, 'rmtree', half_removed)


def written(options, progress, warn):
    """A replay without nodes."""
    options.run.mkdir()
    (options.run / 'new').touch()


def test_an_earlier_run_stays_where_the_new_one_cannot_take_its_place(tmp_path, monkeypatch):
    run = tmp_path / 'flight'
    run.mkdir()
    (run / 'old').touch()
    rename, refused = Path.rename, []

    def full(path, target):
        if path.name == run.name and path.parent != run.parent and not refused:
            refused.append(path)
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return rename(path, target)

    monkeypatch.setattr(many_bags, 'replay', written)
    monkeypatch.setattr(Path, 'rename', full)
    with pytest.raises(InputError, match='No space left'):
        many_bags.replay_whole(many_bags.Options(bag=Path('flight'), run=run))
    assert refused
    assert list(contents(tmp_path)) == [Path('flight/old')]


@pytest.mark.parametrize(('step', 'left'), [(1, 'old'), (2, 'old'), (3, 'new')])
def test_a_worker_that_is_killed_while_it_replaces_a_run_leaves_one_whole(tmp_path, monkeypatch, step, left):
    run = tmp_path / 'out' / 'flight'
    run.mkdir(parents=True)
    (run / 'old').touch()
    options = many_bags.Options(bag=Path('flight'), run=run)
    with monkeypatch.context() as patched:
        patched.setattr(many_bags, 'replay', written)
        killed_at(step, patched)
        with pytest.raises(Killed):
            many_bags.replay_whole(options)
    with many_bags.Batch((options.bag,), run.parent, options).cleared_up():
        pass
    assert list(contents(tmp_path)) == [Path('out/flight') / left]


def test_clearing_up_after_a_run_takes_nothing_of_another(tmp_path):
    """A second run whose name begins like the first one's, killed between two renames, and what is somebody else's."""
    out = tmp_path / 'out'
    for kept in ('.flight-2-abcdefgh/flight-2.earlier', '.flight-notes/mine', '.flight-abcdefgh/mine'):
        (out / kept).mkdir(parents=True)
        (out / kept / 'old').touch()
    (out / '.flight-ijklmnop' / 'flight').mkdir(parents=True)
    bags = tuple(map(Path, ('flight', 'flight-2')))
    with many_bags.Batch(bags, out, many_bags.Options(bag=bags[0], run=out)).cleared_up():
        pass
    kept = ('flight-2/old', '.flight-notes/mine/old', '.flight-abcdefgh/mine/old')
    assert sorted(contents(out)) == sorted(map(Path, kept))
    assert not (out / '.flight-ijklmnop').exists()


@pytest.mark.nightly
@pytest.mark.parametrize(('replaying', 'after_s'), [(False, 0.0), (False, 0.5), (True, 0.2)])
def test_two_interrupts_of_the_terminal_are_one_line_and_leave_nothing_unfinished(folder, longer, replaying, after_s):
    """While workers import what they need, while the cluster connects, and while bags are replayed."""

    def begun(pid):
        return any((folder / 'interrupted').glob('.long*/*/fused.tum*')) if replaying else _workers_of(pid)

    words = ['batch', *longer, '--out', folder / 'interrupted', '--workers', '2']
    words += ['--map', folder / 'map.yaml', '--params', folder / 'params.yaml']
    status, error = interrupted(words, begun, after_s, times=2, apart_s=0.3)
    # For a shell both are 130.
    assert status in (130, -signal.SIGINT)
    assert error[-1] == 'thermal-fiducial batch: interrupted'
    assert not any('Traceback' in line for line in error)
    # A run that was nearly done may be whole before its worker ends.
    left = list((folder / 'interrupted').glob('*'))
    assert all((run / 'summary.json').exists() for run in left)
    assert replaying or not left
