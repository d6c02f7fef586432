"""What killed processes leave beside the folders that they were writing."""

import multiprocessing
import os
import signal

import pytest
from support.tasks import work_for_ever

from thermal_fiducial.files.work_folders import work_folder


@pytest.fixture
def writer(tmp_path):
    """A process that is writing the folder "out"."""
    context = multiprocessing.get_context('spawn')
    ours, theirs = context.Pipe()
    process = context.Process(target=work_for_ever, args=(tmp_path / 'out', theirs), daemon=True)
    process.start()
    ours.recv()
    yield process
    process.kill()
    process.join()


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_what_a_killed_process_has_left_is_removed(tmp_path, writer):
    os.kill(writer.pid, signal.SIGKILL)
    writer.join()
    (left,) = names(tmp_path)
    assert names(tmp_path / left) == ['out']
    with work_folder(tmp_path / 'out') as folder:
        assert names(tmp_path) == [folder.name] != [left]
    assert names(tmp_path) == []


def test_a_process_that_lives_keeps_its_own(tmp_path, writer):
    (theirs,) = names(tmp_path)
    with work_folder(tmp_path / 'out') as folder:
        assert names(tmp_path) == sorted([theirs, folder.name])
    assert names(tmp_path) == [theirs]


@pytest.mark.parametrize(
    ('name', 'holds'),
    [('.out-2-abcdefgh', 'out-2'), ('.out-abcdefgh', 'mine'), ('.out-notes', 'out'), ('out-abcdefgh', 'out')],
)
def test_what_is_not_left_by_the_same_output_stays(tmp_path, name, holds):
    (tmp_path / name / holds).mkdir(parents=True)
    with work_folder(tmp_path / 'out'):
        pass
    assert names(tmp_path / name) == [holds]


def test_links_are_not_followed(tmp_path):
    (tmp_path / 'mine' / 'out').mkdir(parents=True)
    (tmp_path / '.out-abcdefgh').symlink_to(tmp_path / 'mine')
    with work_folder(tmp_path / 'out'):
        pass
    assert names(tmp_path / 'mine') == ['out']
