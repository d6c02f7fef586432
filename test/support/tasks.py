"""Work for a process of its own: it must be found by name over there."""

import os
from pathlib import Path
import time

from support.waiting import until
from thermal_fiducial.files.work_folders import work_folder


def work(task):
    """Process that works, and the answer."""
    if task == 'fail':
        raise ValueError('no answer')
    if task == 'die':
        os._exit(3)
    if task == 'hang up':
        os.closerange(3, 256)
        time.sleep(600.0)
    if isinstance(task, Path):
        _wait_for(task)
    elif isinstance(task, float):
        time.sleep(task)
    return os.getpid(), task


def _wait_for(path):
    """Until a file is there: what ends work when a test says so, however busy the machine is."""
    path.with_suffix('.begun').touch()
    until(path.exists)


def write_twice(begun, ended):
    """Write a file, and another one a second later, which a process that is ended in between does not."""
    begun.touch()
    time.sleep(1.0)
    ended.touch()


def large(megabytes):
    """Bytes that fill any pipe."""
    return bytes(megabytes * 1_000_000)


def work_for_ever(out, connection):
    """Write the folder ``out``, and never finish it."""
    with work_folder(out) as folder:
        (folder / out.name).mkdir()
        connection.send(None)
        time.sleep(600.0)
