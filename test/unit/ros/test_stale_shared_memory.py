"""Shared memory of killed processes is removed, that of living ones is not."""

from contextlib import suppress
import fcntl
import os
from pathlib import Path
import subprocess
import sys
import time

import pytest
from support.empty_stage import environment, finished

from thermal_fiducial.ros.process.stale_shared_memory import remove_stale_memory

DEAD, LIVING, YOUNG = 'fastrtps_0123456789abcdef', 'fastrtps_1123456789abcdef', 'fastrtps_2123456789abcdef'
OTHERS = ('fastrtps_port7411', 'fastrtps_port7411_el', 'sem.fastrtps_3123456789abcdef', 'fastrtps_x_el')


def test_only_segments_that_nobody_holds_are_removed(tmp_path):
    long_ago = time.time() - 60.0
    for name in (DEAD, LIVING, YOUNG, *(f'{name}_el' for name in (DEAD, LIVING, YOUNG)), *OTHERS):
        (tmp_path / name).write_text('')
        os.utime(tmp_path / name, (long_ago, long_ago))
    os.utime(tmp_path / f'{YOUNG}_el')
    (tmp_path / 'fastrtps_4123456789abcdef_el').symlink_to(tmp_path / OTHERS[0])
    os.mkfifo(tmp_path / 'fastrtps_5123456789abcdef_el')
    before = set(tmp_path.iterdir())
    with (tmp_path / f'{LIVING}_el').open() as lock:
        fcntl.flock(lock, fcntl.LOCK_SH)
        remove_stale_memory(tmp_path)
    assert {path.name for path in before - set(tmp_path.iterdir())} == {DEAD, f'{DEAD}_el'}


PROGRAM = """
import sys
from support.empty_stage import EmptyStage
from thermal_fiducial.ros.process.run import run

class Stage(EmptyStage):
    def __init__(self):
        super().__init__()
        print('here', flush=True)
        if sys.argv[1] == 'ends':
            self.create_timer(0.01, self.end)

    def end(self):
        raise SystemExit(0)

sys.exit(run(Stage, []))
"""


def locks_of(process):
    """Lock files of a process's segments of shared memory, among all that it has open at this moment."""
    opened = []
    for file in Path(f'/proc/{process}/fd').iterdir():
        # Closed since the folder was listed: its threads go on opening and closing files.
        with suppress(FileNotFoundError):
            opened.append(str(file.readlink()))
    return [Path(name) for name in opened if name.endswith('_el') and 'port' not in name]


@pytest.mark.ros
def test_a_node_removes_what_a_killed_one_has_left():
    command = [sys.executable, '-c', PROGRAM, 'lives']
    with subprocess.Popen(command, stdout=subprocess.PIPE, env=environment()) as killed:
        try:
            assert killed.stdout.readline() == b'here\n'
            locks = locks_of(killed.pid)
            finished(PROGRAM, 'ends')
            assert locks
            assert all(lock.exists() for lock in locks)
        finally:
            killed.kill()
    for lock in locks:
        os.utime(lock, (0, 0))
    finished(PROGRAM, 'ends')
    assert not any(lock.exists() or lock.with_name(lock.name[:-3]).exists() for lock in locks)
