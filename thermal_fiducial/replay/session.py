"""A replay from start to end: validate the inputs, play, write the run folder."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
import json
from pathlib import Path
import shutil
from typing import Any

from thermal_fiducial.config import MarkerMapperConfig, PoseEkfConfig, size_overrides
from thermal_fiducial.core.geometry.se3 import camera_in_body
from thermal_fiducial.core.mapping.map_data import MarkerMap
from thermal_fiducial.core.types import SECOND_NS
from thermal_fiducial.core.wording import number_of
from thermal_fiducial.errors import InputError, INTERNAL_ERROR
from thermal_fiducial.files.bags import BagReader, CAMERA_INFO_TOPIC, COMPRESSED_TOPIC, IMU_TOPIC
from thermal_fiducial.files.dictionary import bring_beside, bring_from_map
from thermal_fiducial.files.marker_map import load_map, save_map
from thermal_fiducial.files.reading import is_text, shown
from thermal_fiducial.files.writing import into, write_text
from thermal_fiducial.replay.job import ReplayJob
from thermal_fiducial.replay.last_stamps import LastStamps
from thermal_fiducial.replay.lockstep import replay_lockstep
from thermal_fiducial.replay.processes import replay_processes
from thermal_fiducial.replay.recorder import refuse_folder_in_use, RunFiles
from thermal_fiducial.replay.settings import read_settings, Settings
from thermal_fiducial.replay.topics import ENTRIES, Entry, entry_of, PLAYED, TopicTypes, type_name
from thermal_fiducial.ros.process.interrupts import Interrupts

MAP_FILE, SUMMARY_FILE = 'marker_map.yaml', 'summary.json'
#: No restart in flight: successive recordings are separate flights. No outputs for others: nobody takes them, their
#: packages need not be there, and publishers of tf2_ros do not count for lock-step.
_NOT_IN_A_REPLAY = (
    'resume:=false',
    'publish_tf:=false',
    "odom_frame:=''",
    'publish_marker_tf:=false',
    "detections:=''",
    'image_annotations:=false',
    'px4:=false',
)


@dataclass(frozen=True)
class Options:
    """Options of a replay."""

    bag: Path
    run: Path
    params: Path | None = None
    map_file: Path | None = None
    mode: str | None = None
    transport: str = 'lockstep'
    rate: float = 1.0
    images: bool = False
    #: a key of ENTRIES: stage at which the bag enters; empty: the earliest possible
    entry: str = ''
    #: namespace of a second camera in the bag, which is played too; empty: the first camera alone
    second_camera: str = ''
    remaps: Mapping[str, str] = field(default_factory=dict)


def replay(
    options: Options,
    progress: Callable[[float], None],
    warn: Callable[[str], None],
    say: Callable[[str], None] = lambda _: None,
) -> dict[str, Any]:
    """Play a bag through the nodes that its topics require, and write the run folder except the report.

    Parameters
    ----------
    options : bag, run folder and settings
    progress : called with the share done, 0 to 1
    warn : called with warnings
    say : called with information for the user

    Returns
    -------
    Content of ``summary.json``.

    Raises
    ------
    InputError
        An unusable bag, parameter or file, or a run folder that cannot be written to. Files written until then are
        removed, except parameters and map.
    """
    settings = _settings(options, warn)
    with _bag_of(options) as bag:
        entry, nodes, played, recorded = _cast(bag, options, settings)
        _doubt_place_of_camera(bag, settings.pose_ekf, warn)
        also = {topic: PLAYED[topic] for topic in entry.also if topic in bag.topics}
        settings = _with_transport(settings, entry)
        arguments = _prepare(options, settings, entry, warn)
        # Files of a run are whole, or none are there.
        with Interrupts(held=True) as interrupts:
            with into(options.run), RunFiles(options.run, camera_in_body(settings.pose_ekf), recorded) as files:
                in_real_time = partial(replay_processes, rate=options.rate, say=say)
                play = in_real_time if options.transport == 'processes' else replay_lockstep
                done = partial(_show_share, progress, max(bag.duration_ns, 1))
                last, check_interrupt = LastStamps(bag), interrupts.check
                job = ReplayJob(last, nodes, also | played, files, recorded, arguments, done, warn, check_interrupt)
                timing = play(job)
                _report_refusals(files, entry, nodes, warn)
            _report_silence(files, nodes, warn)
            marker_map = _final_map(options.run / MAP_FILE, settings.marker_mapper)
            own = {'markers_in_map': len(marker_map.markers), 'last_ns': last.of_topics}
            summary = _summary(options, settings, bag, played, files) | own | timing
            write_text(options.run / SUMMARY_FILE, json.dumps(summary, indent=2) + '\n')
    return summary


def check(options: Options) -> None:
    """Raise InputError for a bag, parameter or file that :func:`replay` would refuse before it plays the bag."""
    settings = _settings(options, lambda _: None)
    with _bag_of(options) as bag:
        _cast(bag, options, settings)


def _bag_of(options: Options) -> BagReader:
    return BagReader(options.bag, options.remaps, second_camera=options.second_camera)


def _cast(
    bag: BagReader, options: Options, settings: Settings
) -> tuple[Entry, tuple[str, ...], TopicTypes, TopicTypes]:
    """The stage at which the bag enters, the nodes to run, the topics to play, and the topics to record.

    Raises
    ------
    InputError
        A topic to play that the bag lacks.
    """
    entry = ENTRIES[options.entry] if options.entry else entry_of(bag.topics)
    nodes, played, recorded = _cast_from(entry, settings, images=options.images)
    bag.require({topic: type_name(kind) for topic, (kind, _) in played.items()})
    return entry, nodes, played, recorded


def _cast_from(entry: Entry, settings: Settings, *, images: bool) -> tuple[tuple[str, ...], TopicTypes, TopicTypes]:
    """The nodes to run, the topics that the bag must have, and the topics to record.

    Raises
    ------
    InputError
        A second camera, or images to record, of a bag that begins behind the cameras.
    """
    if images and entry.skipped:
        raise InputError(f'--images has no effect with input from {entry.topic} (--from): the nodes get no images')
    from_file = bool(settings.tau2_camera.calibration_file)
    played = entry.played(calibration_from_file=from_file)
    recorded = entry.recorded(calibration_from_file=from_file, images=images)
    if settings.second is None:
        return entry.nodes, played, recorded
    if not entry.needs_calibration:
        raise InputError('a second camera (--second-camera): camera poses are already those of all cameras')
    name, from_file = settings.marker_mapper.second_camera, bool(settings.second[0].calibration_file)
    played |= entry.played_of_second(name, calibration_from_file=from_file)
    recorded |= entry.recorded_of_second(name, calibration_from_file=from_file)
    return (*entry.nodes, *entry.nodes_of_second(name)), played, recorded


def _show_share(progress: Callable[[float], None], duration_ns: int, time_ns: int) -> None:
    progress(min(1.0, time_ns / duration_ns))


def _report_silence(files: RunFiles, nodes: Sequence[str], warn: Callable[[str], None]) -> None:
    if not files.counts['pose']:
        reasons = '; '.join(f'{node}: {files.complaints[node]}' for node in nodes if node in files.complaints)
        warn(f'no pose went out. {reasons}')


def _doubt_place_of_camera(bag: BagReader, config: PoseEkfConfig, warn: Callable[[str], None]) -> None:
    """Warn of a bag from a robot whose frames said where the camera is: they are not played."""
    frames = [name for name in bag.topics if name.rpartition('/')[2] in ('tf_static', 'robot_description')]
    untouched = (config.camera_position, config.camera_orientation) == (
        PoseEkfConfig.camera_position,
        PoseEkfConfig.camera_orientation,
    )
    if frames and untouched and config.extrinsics == 'auto':
        named = ' and '.join(sorted(frames))
        warn(f'{bag.path}: a replay does not play {named}: set camera_position and camera_orientation (--params)')


def _with_transport(settings: Settings, entry: Entry) -> Settings:
    """The settings with the image transport of the bag."""
    transport = 'compressed' if entry.topic == COMPRESSED_TOPIC else 'raw'
    second = settings.second
    if second is not None:
        second = (replace(second[0], image_transport=transport), second[1])
    return replace(settings, tau2_camera=replace(settings.tau2_camera, image_transport=transport), second=second)


def _settings(options: Options, warn: Callable[[str], None]) -> Settings:
    """The parameters of the nodes; doubts about them are passed to ``warn``."""
    for path in filter(None, (options.bag.resolve(), options.run, options.map_file)):
        if not is_text(str(path)):
            raise InputError(f'{shown(path)}: the name is not UTF-8, as all is that ROS reads')
    overrides: dict[str, Any] = {}
    if options.map_file is not None:
        overrides['map_file'] = str(options.map_file)
    if options.mode is not None:
        overrides['mode'] = options.mode
    settings = read_settings(options.params, overrides, options.second_camera)
    for line in settings.warnings:
        warn(line)
    return settings


def _prepare(options: Options, settings: Settings, entry: Entry, warn: Callable[[str], None]) -> list[str]:
    """Create the run folder with copies of parameters and map, since the nodes never write to the user's files."""
    refuse_folder_in_use(options.run)
    try:
        options.run.mkdir(parents=True, exist_ok=True)
        settings.write(options.run / 'parameters.yaml')
        for name in (SUMMARY_FILE, 'latency.csv', 'report.html', 'flight.mp4'):
            (options.run / name).unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f'run folder {options.run}: {error.strerror}') from None
    run_map, given = options.run / MAP_FILE, settings.marker_mapper.map_file
    arguments = ['--params-file', str(options.run / 'parameters.yaml')]
    arguments += [word for rule in _NOT_IN_A_REPLAY for word in ('-p', rule)]
    if not given:
        run_map.unlink(missing_ok=True)
        if 'marker_mapper' in entry.nodes:
            warn('no map (--map): without one marker of known pose there is nothing to find the camera from')
        return arguments
    if Path(given).resolve() != run_map.resolve():
        with into(run_map):
            shutil.copyfile(given, run_map)
        bring_from_map(settings.map_dictionary, Path(given).parent, options.run, anew=True)
    return [*arguments, '-p', f'map_file:={json.dumps(str(run_map))}']


def _final_map(path: Path, config: MarkerMapperConfig) -> MarkerMap:
    """The final map; writes its file if no node has saved it, and completes marker sizes that the file leaves out."""
    if not path.exists():
        marker_map = MarkerMap(frame_id=config.map_frame, dictionary=Path(config.dictionary).name)
        bring_beside(config.dictionary, path.parent, anew=True)
    else:
        marker_map = load_map(path, config.marker_size, size_overrides(config.marker_size_overrides))
        if config.mode == 'mapping':
            return marker_map
    save_map(path, marker_map)
    return marker_map


def _report_refusals(files: RunFiles, entry: Entry, nodes: Sequence[str], warn: Callable[[str], None]) -> None:
    """Warn of nodes that refused messages.

    Raises
    ------
    InputError
        All images or, in their place, all markers were refused, all calibrations, or all IMU messages.
    """
    needed = {'aruco_detector': ['thermal/image'], entry.nodes[0]: [entry.topic], 'pose_ekf': [IMU_TOPIC]}
    for node in nodes:
        figures = files.figures.get(node, {})
        refused, reason = int(figures.get('refused messages', 0)), figures.get('last refusal', '')
        if figures.get('calibrations') == '0':
            topic = f'{node.rpartition("/")[0]}/{CAMERA_INFO_TOPIC}'.lstrip('/')
            raise InputError(f'not one message on {topic} holds a usable calibration{_why_not(files, topic)}')
        # An internal error of the node is not a fault of the input.
        for topic in [] if reason.startswith(INTERNAL_ERROR) else needed.get(node, []):
            if refused and refused >= int(figures[f'received /{topic}']):
                raise InputError(f'not one message on {topic} could be used: {reason}')
        if refused:
            warn(f'{node}: {number_of(refused, "message")} refused, the last one: {reason}')


def _why_not(files: RunFiles, topic: str) -> str:
    """The last refusal of a message on ``topic`` by any node, as others follow it in those that have images."""
    name = topic.rpartition('/')[2]
    last = (figures.get('last refusal', '') for figures in files.figures.values())
    return next((f': {reason}' for reason in last if reason.startswith(f'{name}: ')), '')


def _summary(
    options: Options, settings: Settings, bag: BagReader, played: TopicTypes, files: RunFiles
) -> dict[str, Any]:
    """Figures that need no ground truth, independent of the replay's speed."""
    return {
        'format': 'thermal_fiducial/run',
        'version': 1,
        'bag': options.bag.resolve().name,
        'bag_path': str(options.bag.resolve()),
        'remaps': dict(options.remaps),
        'second_camera': options.second_camera,
        'transport': options.transport,
        'mode': settings.marker_mapper.mode,
        'start_ns': bag.start_ns,
        'duration_s': bag.duration_ns / SECOND_NS,
        'messages_in': {topic: bag.message_count([topic]) for topic in PLAYED | played if topic in bag.topics},
        'messages_out': dict(sorted(files.counts.items())),
        'frames_with_markers': files.frames_with_markers,
        'warnings': dict(files.warnings.most_common()),
        'diagnostics': files.figures,
    }
