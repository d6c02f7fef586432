"""Runs mapper nodes that have something to save, and ends them in every way; each in a process of its own.

``python -m support.shutdowns FOLDER COUNT SEED signals|kill``: prints a line for whatever was lost or not in order. A
process is forked from one that has imported everything but started nothing, so that a trial takes a fraction of a
second.
"""

import os
from pathlib import Path
import signal
import sys
import time

import numpy as np

from thermal_fiducial.core.mapping.map_data import MapMarker, MarkerMap
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.map_history import autosave_file
from thermal_fiducial.files.marker_map import load_map, save_map
from thermal_fiducial.nodes.marker_mapper import MarkerMapperNode
from thermal_fiducial.ros.process.run import run
from thermal_fiducial.ros.process.stopping import STOPS

MARKERS = 60
AUTOSAVE_S = 0.05


def grown(revision):
    """A map whose every marker says which revision it is of."""
    T = np.eye(4)
    T[0, 3] = revision
    return MarkerMap({i: MapMarker(i, 0.3, i == 0, T) for i in range(MARKERS)}, revision=revision)


def whole(path):
    """Revision of a map file that is whole; raises InputError or AssertionError where it is not."""
    found = load_map(path)
    assert len(found.markers) == MARKERS
    assert {marker.T_map_marker[0, 3] for marker in found.markers.values()} == {float(found.revision)}
    return found.revision


def serve(path, ready):
    """The child: a mapper that has learned one revision more than its file has."""

    class Learned(MarkerMapperNode):
        def __init__(self):
            super().__init__()
            self.mapper.map = grown(self.mapper.map.revision + 1)
            self._map.note_learned()
            self.create_timer(AUTOSAVE_S, self._learn)
            os.write(ready, b'.')

        def _learn(self):
            """So that every autosave has something new."""
            self._map.note_learned()

    arguments = ['--ros-args', '-p', f'map_file:={path}', '-p', f'autosave_period:={AUTOSAVE_S}']
    return run(Learned, arguments)


def started(path, log):
    """(process, file that says when it is ready) of a mapper that runs."""
    reading, writing = os.pipe()
    process = os.fork()
    if process == 0:
        os.close(reading)
        os.setsid()
        os.dup2(os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), 2)
        status = 99
        try:
            status = serve(path, writing)
        finally:
            sys.stderr.flush()
            os._exit(status)
    os.close(writing)
    assert os.read(reading, 1) == b'.', Path(log).read_text()
    os.close(reading)
    return process


def signalled(path, log, rng):
    """End a mapper by two or three signals, 1 to 400 ms apart; what went wrong."""
    before = whole(path)
    process = started(path, log)
    time.sleep(rng.uniform(0.0, 0.1))
    for _ in range(rng.integers(2, 4)):
        os.kill(process, rng.choice(STOPS))
        time.sleep(10 ** rng.uniform(-3.0, np.log10(0.4)))
    status = os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
    if status != 0:
        return f'exit status {status}: {Path(log).read_text()}'
    if 'Traceback' in Path(log).read_text():
        return Path(log).read_text()
    if whole(path) != before + 1:
        return f'revision {whole(path)}, not {before + 1}'
    litter = [file.name for file in path.parent.iterdir() if file.name not in (path.name, f'{path.name}.history')]
    return f'left behind: {litter}' if litter else ''


def killed(path, log, rng):
    """Kill a mapper at any instant, also in the middle of an orderly end; what went wrong."""
    before = whole(path)
    process = started(path, log)
    time.sleep(rng.uniform(0.0, 4 * AUTOSAVE_S))
    if rng.random() < 0.5:
        os.kill(process, signal.SIGTERM)
        time.sleep(rng.uniform(0.0, 0.05))
    os.kill(process, signal.SIGKILL)
    os.waitpid(process, 0)
    if whole(path) < before:
        return f'revision {whole(path)} after {before}'
    if autosave_file(path).exists() and whole(autosave_file(path)) < before:
        return f'autosave of revision {whole(autosave_file(path))} after {before}'
    return ''


def main(folder, count, seed, way):
    # Under nohup it is ignored, by the nodes too: a trial of hangups alone would never end.
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    folder = Path(folder)
    path, log, rng = folder / 'maps' / 'hall.yaml', folder / 'log', np.random.default_rng(int(seed))
    path.parent.mkdir()
    save_map(path, grown(1))
    for trial in range(int(count)):
        try:
            wrong = (signalled if way == 'signals' else killed)(path, log, rng)
        except (AssertionError, InputError) as error:
            wrong = f'not whole: {error}'
        if wrong:
            print(f'trial {trial}: {wrong}', flush=True)


if __name__ == '__main__':
    main(*sys.argv[1:])
