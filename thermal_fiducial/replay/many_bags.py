"""Many bags, one map: a replay of each bag on Dask distributed workers, then one bundle adjustment of all markers.

A replay depends on its bag alone, so it may run on any worker and be repeated: a worker's death costs only the time
of its bag. Run folders appear atomically.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
import json
from pathlib import Path
from typing import Any

import numpy as np
from sensor_msgs.msg import CameraInfo

from thermal_fiducial.config import size_overrides
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.measurements import Markers
from thermal_fiducial.errors import InputError, RunError
from thermal_fiducial.files.bags import BagReader, CAMERA_INFO_TOPIC, MARKERS_TOPIC
from thermal_fiducial.files.camera_info import load_camera
from thermal_fiducial.files.dictionary import bring_from_map
from thermal_fiducial.files.marker_map import load_map, save_map
from thermal_fiducial.files.work_folders import named_as_those_of, remove_left_behind, work_folder
from thermal_fiducial.files.writing import into, write_text
from thermal_fiducial.map_tools.map_building import build_map, Built
from thermal_fiducial.replay.earlier_runs import refuse_other_folder
from thermal_fiducial.replay.session import check, MAP_FILE, Options, replay
from thermal_fiducial.replay.settings import read_settings, Settings
from thermal_fiducial.ros.messages import clouds, convert, message_bytes

#: Written last; it and the map of an earlier batch are deleted before the first replay.
SUMMARY_FILE = 'batch.json'


@dataclass(frozen=True)
class Batch:
    """Bags to replay, and the output folder.

    Parameters
    ----------
    bags : one run each
    out : folder of the runs, of the joint map and of ``batch.json``
    options : of each replay, except bag and run folder
    max_frames : most frames, evenly chosen from all bags, for the bundle adjustment
    """

    bags: tuple[Path, ...]
    out: Path
    options: Options
    max_frames: int = 1000

    def runs(self) -> list[Options]:
        """The replays, in the order of the bags.

        Raises
        ------
        InputError
            Two bags of the same name, whose runs would share a folder.
        """
        names = [bag.resolve().stem for bag in self.bags]
        doubles = sorted({name for name in names if names.count(name) > 1})
        if doubles:
            raise InputError(f'two bags are named {doubles[0]}: their runs would share a folder')
        return [
            replace(self.options, bag=bag.resolve(), run=self.out.resolve() / name)
            for bag, name in zip(self.bags, names, strict=True)
        ]

    def check(self) -> Camera:
        """The camera of all bags, before any workers are started.

        Raises
        ------
        InputError
            Unusable input.
        """
        runs = self.runs()
        missing = [str(bag) for bag in self.bags if not bag.exists()]
        if missing:
            raise InputError(f'{", ".join(missing)}: no such bag')
        for run in runs:
            # A bag in the folder of the runs would be replaced by its own run.
            refuse_other_folder(run.run)
        if (self.out / MAP_FILE).exists() and not (self.out / SUMMARY_FILE).exists():
            raise InputError(f'{self.out / MAP_FILE} is not of an earlier batch: choose another folder with --out')
        self._refuse_replaced_map(runs)
        self._check_bags(runs)
        return _common_camera(runs, read_settings(self.options.params, {}))

    def _refuse_replaced_map(self, runs: Sequence[Options]) -> None:
        """Refuse to start from a map of an earlier batch that this one deletes before it reads it."""
        given = self.options.map_file
        replaced = [self.out.resolve() / MAP_FILE, *(run.run for run in runs)]
        if given is not None and any(given.resolve().is_relative_to(path) for path in replaced):
            raise InputError(f'{given}: this batch would replace it: copy it, or choose another folder with --out')

    @contextmanager
    def cleared_up(self) -> Iterator[None]:
        """Remove at the end what workers that died or were interrupted have left."""
        try:
            yield
        finally:
            runs = [options.run for options in self.runs()] if self.out.is_dir() else []
            for run in runs:
                for unfinished in named_as_those_of(run):
                    _put_back(unfinished, run)
                remove_left_behind(run, {run.name, _moved_aside(run, run.parent).name})
            # Empty if no bag was replayed.
            with suppress(OSError):
                self.out.rmdir()

    def _check_bags(self, runs: Sequence[Options]) -> None:
        """Name all bags that cannot be replayed, rather than the first, and before hours of replays of the others."""
        reasons: dict[str, None] = {}
        for run in runs:
            try:
                check(run)
            except InputError as error:
                reasons[str(error)] = None
        if reasons:
            raise InputError('; '.join(reasons))


def run_batch(
    batch: Batch, camera: Camera, client: Any, progress: Callable[[float], None], warn: Callable[[str], None]
) -> dict[str, Any]:
    """Replay all bags on the workers of ``client``, then adjust one map to all detections.

    Parameters
    ----------
    batch : bags and options; the paths must be valid on the workers
    camera : that of all bags, from :meth:`Batch.check`
    client : of Dask distributed
    progress : called with the share done, 0 to 1
    warn : called with warnings

    Returns
    -------
    Content of ``batch.json``, independent of the number of workers.

    Raises
    ------
    InputError
        An unusable bag, map or parameter; the other bags are replayed nevertheless.
    RunError
        Repeated deaths of workers on the same bag.
    """
    runs = batch.runs()
    if batch.options.map_file is None:
        raise InputError('a joint map needs --map with at least one marker of known pose')
    _prepare_folder(batch.out)
    _replay_all(runs, client, progress, warn)
    built, frames = _joint_map(batch, runs, camera)
    save_map(batch.out / MAP_FILE, built.map)
    summary = _summary_of(built) | {'runs': [run.run.name for run in runs], 'frames': frames}
    write_text(batch.out / SUMMARY_FILE, json.dumps(summary, indent=2) + '\n')
    bring_from_map(built.map.dictionary, batch.options.map_file.parent, batch.out)
    return summary


def _prepare_folder(out: Path) -> None:
    """Create the folder of a batch, without map and summary of an earlier one."""
    with into(out):
        out.mkdir(parents=True, exist_ok=True)
        for earlier in (MAP_FILE, SUMMARY_FILE):
            (out / earlier).unlink(missing_ok=True)


def _summary_of(built: Built) -> dict[str, Any]:
    """Figures of the joint map."""
    return {
        'format': 'thermal_fiducial/batch',
        'version': 1,
        'frames_used': built.frames_used,
        'rms_px': None if built.refinement is None else built.refinement.rms_px,
        'markers': sorted(built.map.markers),
        'unplaced': {str(key): why for key, why in sorted(built.unplaced.items())},
    }


def _replay_all(
    runs: Sequence[Options], client: Any, progress: Callable[[float], None], warn: Callable[[str], None]
) -> None:
    from distributed import as_completed

    futures = {client.submit(replay_whole, run, pure=False): run for run in runs}
    failures: dict[str, BaseException] = {}
    warnings: dict[str, list[str]] = {}
    for done, future in enumerate(as_completed(futures), 1):
        name = futures[future].run.name
        if future.exception() is not None:
            failures[name] = future.exception()
        else:
            warnings[name] = future.result()
        progress(done / len(runs))
    for run in runs:
        for line in warnings.get(run.run.name, []):
            warn(f'{run.run.name}: {line}')
    errors = [_as_error(run, failures[run.run.name]) for run in runs if run.run.name in failures]
    for error in errors[1:]:
        warn(str(error))
    if errors:
        raise errors[0]


def _as_error(run: Options, failure: BaseException) -> Exception:
    """The failure of a bag as an error of one line that names the bag once."""
    if isinstance(failure, InputError):
        words = str(failure)
        return failure if words.startswith(str(run.bag)) else InputError(f'{run.run.name}: {words}')
    reason = str(failure).splitlines()[0] if str(failure) else ''
    return RunError(f'{run.run.name}: {type(failure).__name__}: {reason}')


def replay_whole(options: Options) -> list[str]:
    """Replay into a run folder that replaces an earlier one atomically; returns the warnings."""
    warnings: list[str] = []
    with into(options.run):
        options.run.parent.mkdir(parents=True, exist_ok=True)
        with work_folder(options.run) as folder:
            replay(replace(options, run=folder / options.run.name), lambda share: None, warnings.append)
            _take_the_place(options.run, folder)
    return warnings


def _take_the_place(run: Path, folder: Path) -> None:
    """Replace an earlier run by the new one in ``folder``, which keeps the earlier one until it is removed."""
    try:
        # A worker that is killed while it deletes files of an earlier run must not leave the rest of them.
        if run.exists():
            run.rename(_moved_aside(run, folder))
        (folder / run.name).rename(run)
    finally:
        _put_back(folder, run)


def _moved_aside(run: Path, folder: Path) -> Path:
    """Where a run is from when it is replaced until it is deleted; ``folder``: that of the new one."""
    return folder / f'{run.name}.earlier'


def _put_back(unfinished: Path, run: Path) -> None:
    """Put an earlier run back from the folder of a worker that was ended between the two renames."""
    with suppress(OSError):
        # Fails where a run is in its place.
        _moved_aside(run, unfinished).rename(run)


def _joint_map(batch: Batch, runs: Sequence[Options], camera: Camera) -> tuple[Built, int]:
    config = replace(read_settings(batch.options.params, {}).marker_mapper, mode='mapping')
    sizes = size_overrides(config.marker_size_overrides)
    start = load_map(Path(str(batch.options.map_file)), config.marker_size, sizes)
    share = max(batch.max_frames // len(runs), 1)
    frames = [rows for run in runs for rows in _frames(run, share)]
    if not frames:
        raise InputError('no markers in any of the bags')
    return build_map(frames, camera, start, config), len(frames)


def _common_camera(runs: Sequence[Options], settings: Settings) -> Camera:
    """The camera of all bags.

    Raises
    ------
    InputError
        A bag without calibration, or bags with different ones.
    """
    cameras = [_camera(run, settings) for run in runs]
    others = [run.run.name for run, camera in zip(runs, cameras, strict=True) if not camera.matches(cameras[0])]
    if others:
        have = 'has' if len(others) == 1 else 'have'
        raise InputError(f'{", ".join(others)} {have} another calibration than {runs[0].run.name}: no joint map')
    return cameras[0]


def _camera(run: Options, settings: Settings) -> Camera:
    """The first usable calibration of a bag, unless the parameters name a file: the nodes pass over others, too."""
    if settings.tau2_camera.calibration_file:
        return load_camera(settings.tau2_camera.calibration_file)
    reason = f'no message on {CAMERA_INFO_TOPIC}'
    with BagReader(run.bag, run.remaps) as bag:
        for message in bag.messages([CAMERA_INFO_TOPIC]):
            try:
                return convert.camera(message_bytes.read(message.cdr, CameraInfo, 'camera_info'))
            except InputError as error:
                reason = str(error)
    raise InputError(f'{run.bag}: {reason}')


def _frames(run: Options, most: int) -> list[Markers]:
    """Detections of at most ``most`` frames with markers, evenly chosen; those that the mapper refused are left out."""
    frames = []
    with BagReader(run.run / 'output') as output:
        for item in output.messages([MARKERS_TOPIC]):
            with suppress(InputError):
                frames.append(clouds.stamped_markers(item.cdr)[1])
    frames = [rows for rows in frames if len(rows)]
    chosen = np.linspace(0, len(frames) - 1, min(most, len(frames))).astype(int)
    return [frames[index] for index in chosen]
