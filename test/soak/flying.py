"""The laps through the nodes: four processes in real time, or all in this one as fast as they go."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import psutil

from soak.laps import Laps, TOPICS
from soak.minutes import Errors, Meter, Minute, node_processes
from thermal_fiducial.config import NODES
from thermal_fiducial.files.marker_map import load_map
from thermal_fiducial.replay.job import ReplayJob
from thermal_fiducial.replay.lockstep import replay_lockstep
from thermal_fiducial.replay.processes import replay_processes
from thermal_fiducial.replay.topics import ENTRIES, PLAYED


def soak(
    laps: Laps, folder: Path, say: Callable[[str], None], *, lockstep: bool = False
) -> tuple[list[Minute], list[str]]:
    """Fly.

    Returns
    -------
    What was measured, minute by minute (in lock-step one process is all nodes), and what was said or amiss at the end.
    """
    lines: list[str] = []
    map_file = folder / 'map.yaml'
    map_file.write_bytes((laps.folder / 'map_one.yaml').read_bytes())
    arguments = ['--params-file', str(laps.folder / 'params.yaml'), '-p', f'map_file:={map_file}']
    arguments += ['-p', 'mode:=mapping', '-p', 'resume:=false']
    errors = Errors(laps, folder)
    if lockstep:
        meter = Meter(errors, lambda: {'all nodes': psutil.Process()}, say)
        play = replay_lockstep
    else:
        meter = Meter(errors, lambda: node_processes(NODES), say)
        play = partial(replay_processes, rate=1.0, say=say)
    recorded = ENTRIES['images'].recorded(calibration_from_file=False, images=False)
    played = {topic: PLAYED[topic] for topic in TOPICS}
    play(ReplayJob(laps, tuple(NODES), played, errors, recorded, arguments, meter, lines.append, lambda: None))
    saved = sorted(load_map(map_file).markers)
    expected = [marker.id for marker in laps.scenario.markers]
    if saved != expected:
        lines.append(f'the map that was saved has markers {saved} of {expected}')
    return meter.minutes, lines
