"""``demo``: a flight through fog, from the simulated camera to the report."""

import argparse
import os
from pathlib import Path
import shutil
import sys
import time
from typing import Any, TYPE_CHECKING

from thermal_fiducial.cli.arguments import warn, whole_number
from thermal_fiducial.cli.evaluate import make_video, print_tables
from thermal_fiducial.cli.parser import Parser
from thermal_fiducial.cli.progress import counted, progress_bar
from thermal_fiducial.cli.ranges import FLIGHT_S
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.packages import is_installed, remedy, require_plots
from thermal_fiducial.report.page import evaluate_run, Evaluation, require_packages, write_page
from thermal_fiducial.report.tables import tables

if TYPE_CHECKING:
    from thermal_fiducial.sim.thermal_camera import FlightPlan

SCENARIO = 'fog'
BAG = 'flight_through_fog'
#: Marker file in the folder of a demo: no other folder is replaced.
MARK = '.thermal_fiducial_demo'
#: ROS packages that the replay imports.
ROS_PACKAGES = ('rclpy', 'sensor_msgs', 'geometry_msgs', 'diagnostic_msgs')


def add_arguments(parser: Parser) -> None:
    """Options of the command."""
    parser.add_argument('--out', type=Path, default=Path('runs/demo'), metavar='RUN', help='folder')
    parser.add_argument('--seconds', type=FLIGHT_S, default=30.0, help='length of the flight [s], 11 or more')
    parser.add_argument('--seed', type=whole_number(0), default=0, help='seed of path and noise')
    parser.add_argument('--picture', type=Path, metavar='PNG', help='also draw frame, map and error into one picture')
    parser.add_argument('--video', action='store_true', help='write flight.mp4: frames with their markers')


def run(args: argparse.Namespace) -> int:
    """Simulate a flight, replay it, evaluate it, write the report."""
    _check_packages(args)
    from thermal_fiducial.sim.thermal_camera import plan

    started = time.monotonic()
    flight = plan(SCENARIO, args.seconds, args.seed)
    # Refuses what cannot be flown, before an earlier demo is removed for it.
    flight.scenario.trajectory(flight.seconds, flight.seed)
    _make_room(args.out)
    bag = args.out / BAG
    _simulate(bag, flight)
    _replay(bag, args.out)
    evaluation, numbers = evaluate_run(args.out, bag)
    if args.video:
        make_video(evaluation.run, bag)
    page = write_page(evaluation, numbers, bag)
    if args.picture is not None:
        from thermal_fiducial.report.picture import draw_picture

        draw_picture(evaluation, bag, args.picture)
    _say(evaluation, numbers)
    print(f'\n{time.monotonic() - started:.0f} s from start to end. The report, with all pictures: {page}')
    return 0


def _check_packages(args: argparse.Namespace) -> None:
    """Report missing packages before minutes of work."""
    require_packages(tables=True)
    missing = [name for name in ROS_PACKAGES if not is_installed(name)]
    if missing:
        raise InputError(f'the demo runs the ROS 2 nodes and finds no {missing[0]}: {remedy("ros")}')
    if args.picture is not None:
        require_plots('--picture')
        _check_picture(args.picture, args.out)
    if args.video:
        from thermal_fiducial.report.video import require_encoder

        require_encoder()


def _check_picture(picture: Path, out: Path) -> None:
    """Refuse a picture that could not be written; its folder may be that of the demo, which is made later."""
    if not picture.parent.is_dir() and picture.parent.resolve() != out.resolve():
        raise InputError(f'--picture {picture}: no folder {picture.parent}')
    if picture.is_dir() or picture.suffix.lower() != '.png':
        raise InputError(f'--picture {picture}: is not the name of a PNG file')


def _make_room(out: Path) -> None:
    """Create the empty folder ``out``; an earlier demo in its place is removed."""
    if out.exists() and not (out / MARK).is_file() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f'{out} exists and is no earlier demo: choose another folder with --out')
    try:
        out.mkdir(parents=True, exist_ok=True)
        (out / MARK).touch()
        # The mark stays: without it an interrupted demo would leave a folder that the next one refuses.
        for earlier in out.iterdir():
            if earlier.name != MARK:
                _remove(earlier)
    except OSError as error:
        raise InputError(f'{out}: {error.strerror}') from None


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink()


def _simulate(bag: Path, flight: 'FlightPlan') -> None:
    from thermal_fiducial.sim.writer import write_flight

    with _step(f'1/3 simulating {flight.seconds:g} s of flight') as share:
        write_flight(bag, flight, workers=len(os.sched_getaffinity(0)), progress=counted(share, flight.frame_count))


def _replay(bag: Path, out: Path) -> None:
    from thermal_fiducial.replay.session import Options, replay

    options = Options(bag=bag, run=out, params=bag / 'params.yaml', map_file=bag / 'map_one.yaml')
    with _step('2/3 replaying it through the four nodes') as share:
        replay(options, share, warn)
    print('3/3 scoring', file=sys.stderr)


def _step(title: str) -> Any:
    if not sys.stderr.isatty():
        print(title, file=sys.stderr)
    return progress_bar(title)


def _say(evaluation: Evaluation, numbers: dict[str, Any]) -> None:
    made = tables(evaluation, numbers)
    print_tables(made[name] for name in ('pilot', 'pilot_always', 'accuracy', 'interruptions') if name in made)
