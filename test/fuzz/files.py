"""Mutated files for everything that reads one, and for commands."""

from collections.abc import Callable, Iterable, Mapping
from contextlib import redirect_stderr, redirect_stdout
import io
from pathlib import Path
from random import Random
import shutil
import tempfile
import time
from typing import Any

import cv2
import numpy as np
from support import small_bag
from support.run_folders import make_run

from fuzz.findings import Finding, LONGEST
from fuzz.mutations import mutated_bytes
from thermal_fiducial.cli.main import main
from thermal_fiducial.errors import InputError
from thermal_fiducial.fabrication.planning import load_measurements, PACKAGED
from thermal_fiducial.files.bad_pixel_list import load_bad_pixels
from thermal_fiducial.files.bags import BagReader, CAMERA_INFO_TOPIC, IMAGE_TOPIC, IMU_TOPIC
from thermal_fiducial.files.camera_info import load_camera, save_camera
from thermal_fiducial.files.dictionary import load_dictionary
from thermal_fiducial.files.images import read_picture
from thermal_fiducial.files.marker_map import load_map, save_map
from thermal_fiducial.files.point_cloud import load_alignment, load_cloud, save_alignment
from thermal_fiducial.files.recordings import read_recording
from thermal_fiducial.files.sensor_bag import read_bag
from thermal_fiducial.files.trajectory_file import load_tum
from thermal_fiducial.replay.settings import read_settings
from thermal_fiducial.report.run_folder import read_run

RIG = (
    'cameras:\n  cam0: {width: 640, height: 512, model: plumb_bob, K: [500, 0, 320, 0, 500, 256, 0, 0, 1],\n'
    '    D: [0, 0, 0, 0, 0], camera_position: [0.1, 0, 0], camera_orientation: [-0.5, 0.5, -0.5, 0.5]}\n'
    'imu: {gyroscope_noise_density: 1.0e-3, accelerometer_noise_density: 1.0e-2}\nmarker_size: 0.3\n'
)
DICTIONARY = (
    'format: thermal_fiducial/dictionary\nversion: 1\nname: OURS\nmarker_size: 4\nmax_correction_bits: 1\n'
    "markers:\n  - ['0110', '1011', '0010', '1101']\n  - ['1011', '0101', '0011', '0010']\n"
)
PLY = 'ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\nend_header\n'
PCD = 'VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 3\nHEIGHT 1\nPOINTS 3\nDATA ascii\n'
POINTS = '0 0 1\n1 0 2\n0 1 3\n'
_START = small_bag.START_NS
#: Commands that write a map, and the markers that they are asked to take out.
_LEFT: dict[str, set[int]] = {'map delete': {2}, 'map move': set(), 'map show': set()}


class Targets:
    """Good files in a folder, and what reads them: name to (files one of which is mutated, reader)."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.readers: dict[str, tuple[list[Path], Callable[[], Any]]] = {}
        self._texts()
        self._folders()
        self._commands()

    def _add(self, name: str, read: Callable[[Path], Any], content: bytes | str | None = None) -> Path:
        path = self.folder / name
        if content is not None:
            path.write_bytes(content.encode() if isinstance(content, str) else content)
        self.readers[name] = [path], lambda: read(path)
        return path

    def _texts(self) -> None:
        save_map(self._add('map.yaml', load_map), small_bag.map_of((0, 1, 2, 3)))
        save_camera(self._add('camera.yaml', load_camera), small_bag.CAMERA)
        save_alignment(self._add('alignment.yaml', load_alignment), np.eye(4), 'cloud.ply', 'map')
        self._add('dictionary.yaml', load_dictionary, DICTIONARY)
        self._add('bad_pixels.txt', load_bad_pixels, '3 4\n600 500\n')
        self._add('truth.tum', load_tum, ''.join(f'{k}.25 {k} 0 1 0 0 0 1\n' for k in range(20)))
        self._add('cloud.ply', load_cloud, PLY + POINTS)
        self._add('cloud.pcd', load_cloud, PCD + POINTS)
        self._add('measured.yaml', load_measurements, Path(PACKAGED).read_bytes())
        parameters = {'/**': {'ros__parameters': small_bag.PARAMETERS | {'map_file': str(self.folder / 'map.yaml')}}}
        self._add('params.yaml', lambda path: read_settings(path, {}), _yaml(parameters))
        picture = cv2.imencode('.png', np.arange(64 * 48, dtype=np.uint16).reshape(48, 64))[1].tobytes()
        self._add('picture.png', lambda path: read_picture(path, cv2.IMREAD_UNCHANGED), picture)

    def _folders(self) -> None:
        run = make_run(self.folder / 'run', seconds=1.0, gap=(0.5, 0.6), with_output=False)
        self.readers['run'] = [path for path in run.iterdir() if path.is_file()], lambda: read_run(run)
        recording = self.folder / 'recording'
        recording.mkdir()
        (recording / 'rig.yaml').write_text(RIG)
        (recording / 'imu.csv').write_text(
            'stamp_ns,wx,wy,wz,ax,ay,az\n' + ''.join(f'{_START + 5_000_000 * k},0,0,0,0,0,9.8\n' for k in range(5))
        )
        (recording / 'detections.csv').write_text(
            'stamp_ns,id,u0,v0,u1,v1,u2,v2,u3,v3,sigma_px\n' + f'{_START},2,1,1,9,1,9,9,1,9,0.1\n' * 3
        )
        self.readers['recording'] = list(recording.iterdir()), lambda: read_recording(recording)
        for storage in ('mcap', 'sqlite3'):
            bag = small_bag.recording(0.1).write(self.folder / storage, storage)
            self.readers[f'bag {storage}'] = list(bag.iterdir()), lambda bag=bag: _read_bag(bag)

    def _commands(self) -> None:
        file = {name: str(self.folder / name) for name in ('map.yaml', 'camera.yaml', 'params.yaml', 'mcap')}
        detections = str(self.folder / 'recording' / 'detections.csv')
        commands = {
            'map show': (['map', 'show', file['map.yaml']], 'map.yaml'),
            'map delete': (['map', 'delete', file['map.yaml'], '2'], 'map.yaml'),
            'map move': (['map', 'move', file['map.yaml'], '2', '--position', '1', '2', '3'], 'map.yaml'),
            'map undo': (['map', 'undo', file['map.yaml']], 'map.yaml'),
            'map refine': (
                ['map', 'refine', file['map.yaml'], detections, '--calibration', file['camera.yaml']],
                'recording/detections.csv',
            ),
        }
        for name, (words, mutated) in commands.items():
            self.readers[name] = [self.folder / mutated], lambda words=words: command(words)


def _yaml(document: Mapping[str, Any]) -> str:
    import yaml

    return yaml.safe_dump(dict(document))


def _read_bag(path: Path) -> None:
    for _ in read_bag(path):
        pass
    with BagReader(path) as bag:
        for _ in bag.messages([IMAGE_TOPIC, IMU_TOPIC, CAMERA_INFO_TOPIC]):
            pass


def command(words: list[str]) -> None:
    """Run a command in this process.

    Raises
    ------
    InputError
        It refuses its input, in one line.
    """
    error = io.StringIO()
    with redirect_stderr(error), redirect_stdout(io.StringIO()):
        status = main(words)
    lines = error.getvalue().splitlines()
    if status == 2 and len(lines) == 1:
        raise InputError(lines[0])
    if status not in (0, 1) or any('Traceback' in line for line in lines):
        raise RuntimeError(f'exit status {status}, {lines[-3:]}')


def run(numbers: Iterable[int], begin: Callable[[str, int], None]) -> list[Finding]:
    """Findings of inputs ``numbers``; ``begin`` is called before each."""
    findings: list[Finding] = []
    with tempfile.TemporaryDirectory() as name:
        pristine = Path(name) / 'good'
        pristine.mkdir()
        targets = Targets(pristine)
        names = list(targets.readers)
        backup = Path(name) / 'backup'
        shutil.copytree(pristine, backup)
        for number in numbers:
            begin('files', number)
            rng = Random(number)
            target = names[number % len(names)]
            paths, read = targets.readers[target]
            path = rng.choice(sorted(paths))
            good = path.read_bytes()
            path.write_bytes(mutated_bytes(good, rng))
            markers = _markers(path) if target in _LEFT else None
            found = _judged(target, number, path, read)
            if not found and markers is not None and (loss := _loss(target, path, markers)):
                found = [Finding(f'files {target}', number, 'lost', loss)]
            findings += found
            path.write_bytes(good)
            if target.startswith('map '):
                # Commands leave their traces.
                shutil.rmtree(pristine)
                shutil.copytree(backup, pristine)
    return findings


def _markers(path: Path) -> set[int] | None:
    try:
        return set(load_map(path).markers)
    except InputError:
        return None


def _loss(target: str, path: Path, markers: set[int]) -> str:
    """What a map command has lost of a map that could be read, whether it did its work or refused to."""
    left = _markers(path)
    if left is None:
        return 'the map can no longer be read'
    missing = markers - left - _LEFT[target]
    return f'markers {sorted(missing)} are no longer in the map' if missing else ''


def _judged(target: str, number: int, path: Path, read: Callable[[], Any]) -> list[Finding]:
    """What reading a file did that it should not; what is good may take its time."""
    name, before = f'files {target}', time.process_time()
    try:
        read()
    except InputError as error:
        seconds = time.process_time() - before
        if seconds > LONGEST:
            return [Finding(name, number, 'hung', f'{path.name}: {seconds:.1f} s')]
        if not str(error).isprintable() or len(str(error)) > 1000:
            return [Finding(name, number, 'not one line', repr(str(error))[:300])]
    except (Exception, SystemExit) as error:
        return [Finding(name, number, 'internal error', f'{path.name}: {type(error).__name__}: {error}'[:300])]
    return []
