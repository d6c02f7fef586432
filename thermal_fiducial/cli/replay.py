"""Command ``replay``: play a recorded bag through the nodes."""

import argparse
from collections.abc import Mapping
from pathlib import Path
import sys
import time

from thermal_fiducial.cli.arguments import add_remap, warn
from thermal_fiducial.cli.evaluate import make_video
from thermal_fiducial.cli.parser import Parser
from thermal_fiducial.cli.progress import progress_bar
from thermal_fiducial.cli.ranges import RATE
from thermal_fiducial.core.wording import number_of
from thermal_fiducial.errors import InputError, INTERNAL_ERROR
from thermal_fiducial.files.bags import BagReader, parse_remaps
from thermal_fiducial.replay.earlier_runs import refuse_other_folder
from thermal_fiducial.report.page import evaluate_run, require_packages, write_page
from thermal_fiducial.report.run_folder import read_run
from thermal_fiducial.report.verdict import judge


def add_arguments(parser: Parser) -> None:
    """Options of the command."""
    parser.add_argument('bag', type=Path, metavar='BAG', help='rosbag2 folder, .mcap or .db3 file, or ROS 1 .bag')
    parser.add_argument('--out', type=Path, required=True, metavar='RUN', help='folder for the results')
    parser.add_argument(
        '--params', type=Path, metavar='FILE', help="ROS parameter file (default: the nodes' own values)"
    )
    parser.add_argument(
        '--map', type=Path, metavar='FILE', help='marker map to start from (default: map_file of --params)'
    )
    parser.add_argument(
        '--mode',
        choices=('mapping', 'localization'),
        help='whether new markers enter the map (default: mode of --params)',
    )
    parser.add_argument(
        '--transport',
        choices=('lockstep', 'processes'),
        default='lockstep',
        help='lockstep: all nodes in one process, deterministic, as fast as it goes; processes: one process a node, in '
        'real time',
    )
    parser.add_argument(
        '--rate',
        type=RATE,
        metavar='X',
        help='speed of --transport processes, in multiples of real time (default: 1)',
    )
    parser.add_argument(
        '--second-camera',
        default='',
        metavar='NAME',
        help='play a second camera too, whose topics are in the namespace NAME: NAME/thermal/image_raw (default: none)',
    )
    add_remap(parser)
    parser.add_argument('--images', action='store_true', help='record the cleaned images too (as large as the bag)')
    parser.add_argument(
        '--from',
        dest='entry',
        default='',
        choices=('images', 'compressed', 'markers', 'poses'),
        help='input besides the IMU: images, compressed images, markers with camera_info, or camera poses '
        '(default: the first of these in the bag)',
    )
    parser.add_argument('--no-report', action='store_true', help='write no report.html')
    parser.add_argument('--video', action='store_true', help='write flight.mp4: frames with their markers')
    parser.refuse(['--rate'], 'without --transport processes', lambda args: args.transport != 'processes')


def run(args: argparse.Namespace) -> int:
    """Replay the bag, write the run folder, print a summary."""
    replaces = refuse_other_folder(args.out)
    _check_packages(report=not args.no_report, video=args.video)
    if args.video:
        _require_images(args)
    from thermal_fiducial.replay.session import check, Options, replay

    options = Options(
        bag=args.bag,
        run=args.out,
        params=args.params,
        map_file=args.map,
        mode=args.mode,
        transport=args.transport,
        rate=args.rate or 1.0,
        images=args.images,
        entry=args.entry,
        second_camera=args.second_camera.strip('/'),
        remaps=parse_remaps(args.remap),
    )
    if replaces:
        # What is refused replaces nothing.
        check(options)
        print(f'{args.out}: replacing the earlier run there')
    started = time.monotonic()
    with progress_bar(f'replay {args.bag.name}') as progress:
        summary = replay(options, progress, warn, _say)
    seconds = time.monotonic() - started
    out = summary['messages_out']
    print(
        f'{args.out}: {number_of(out.get("pose", 0), "pose")}, {number_of(out.get("camera_pose", 0), "camera pose")}, '
        f'{number_of(summary["markers_in_map"], "marker")} in the map; '
        f'{summary["duration_s"]:.1f} s of bag in {seconds:.1f} s'
    )
    if args.video:
        make_video(read_run(args.out))
    if not args.no_report:
        _report(args.out)
    errors = _internal_errors(summary['diagnostics'])
    for error in errors:
        print(error, file=sys.stderr)
    # As with the findings of other commands, a script must not take a run without a pose for a good one.
    return 0 if out.get('pose', 0) and not errors else 1


def _check_packages(*, report: bool, video: bool) -> None:
    """Report missing packages before the replay, not after minutes of it."""
    if report:
        try:
            require_packages()
        except InputError as error:
            raise InputError(f'{error}, or replay with --no-report') from None
    if video:
        from thermal_fiducial.report.video import require_encoder

        require_encoder()


def _require_images(args: argparse.Namespace) -> None:
    """Refuse a video of a bag without images before the replay, not after it."""
    with BagReader(args.bag, parse_remaps(args.remap), second_camera=args.second_camera.strip('/')) as reader:
        if reader.image_topic not in reader.topics:
            raise InputError(f'--video has no effect with {args.bag}, which has no images')


def _report(run: Path) -> None:
    """Write the report, and print where it is and its first line."""
    evaluation, numbers = evaluate_run(run)
    path = write_page(evaluation, numbers)
    print(f'{path}: {judge(evaluation, numbers).headline}')


def _internal_errors(diagnostics: Mapping[str, Mapping[str, str]]) -> list[str]:
    """Internal errors of the nodes: a node goes on after one, but its results are incomplete."""
    last = {node: figures.get('last refusal', '') for node, figures in diagnostics.items()}
    return [f'{node}: {reason}' for node, reason in last.items() if reason.startswith(INTERNAL_ERROR)]


def _say(line: str) -> None:
    print(line, file=sys.stderr)
