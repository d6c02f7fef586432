"""``batch BAG...``: replay many bags on many workers and make one map of them."""

import argparse
from pathlib import Path

from thermal_fiducial.cli.arguments import add_remap, warn, whole_number
from thermal_fiducial.cli.parser import Parser
from thermal_fiducial.cli.progress import progress_bar
from thermal_fiducial.cli.ranges import PROCESSES
from thermal_fiducial.core.wording import number_of
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.bags import parse_remaps
from thermal_fiducial.files.packages import remedy


def add_arguments(parser: Parser) -> None:
    """Options of the command."""
    parser.add_argument('bags', type=Path, nargs='+', metavar='BAG', help='as for replay')
    parser.add_argument(
        '--out', type=Path, required=True, metavar='FOLDER', help='gets a run folder for each bag, and the map'
    )
    parser.add_argument('--map', type=Path, required=True, metavar='FILE', help='marker map to start from')
    parser.add_argument(
        '--params', type=Path, metavar='FILE', help="ROS parameter file (default: the nodes' own values)"
    )
    parser.add_argument(
        '--mode', choices=('mapping', 'localization'), help='mode of each replay (default: mode of --params)'
    )
    where = parser.add_mutually_exclusive_group()
    where.add_argument('--workers', type=PROCESSES, default=1, metavar='N', help='number of processes on this machine')
    where.add_argument(
        '--scheduler',
        default='',
        metavar='ADDRESS',
        help='Dask cluster with access to the same files, tcp://HOST:8786 (default: this machine)',
    )
    parser.add_argument(
        '--max-frames',
        type=whole_number(1),
        default=1000,
        metavar='N',
        help='largest number of frames for the joint map',
    )
    add_remap(parser)


def run(args: argparse.Namespace) -> int:
    """Replay the bags, adjust the joint map, print a summary."""
    try:
        import distributed  # noqa: F401
    except ImportError:
        raise InputError(f'needs the extra "batch": {remedy("batch")}') from None
    from thermal_fiducial.replay.many_bags import Batch, run_batch
    from thermal_fiducial.replay.session import Options
    from thermal_fiducial.replay.workers import workers

    options = Options(
        bag=args.bags[0],
        run=args.out,
        params=None if args.params is None else args.params.resolve(),
        map_file=args.map.resolve(),
        mode=args.mode,
        remaps=parse_remaps(args.remap),
    )
    batch = Batch(tuple(args.bags), args.out, options, args.max_frames)
    camera = batch.check()
    count = min(args.workers, len(args.bags))
    with batch.cleared_up(), workers(count, args.scheduler) as client, progress_bar('batch') as progress:
        summary = run_batch(batch, camera, client, progress, warn)
    runs = number_of(len(summary['runs']), 'run')
    print(
        f'{args.out}: {runs}; {number_of(len(summary["markers"]), "marker")} in the joint map, '
        f'{summary["frames_used"]} of {summary["frames"]} frames used'
    )
    return 0
