"""``evaluate RUN``: errors, jitter, consistency and latency of a run, as tables and as a page; or several compared."""

import argparse
from collections.abc import Iterable, Iterator
from dataclasses import replace
import json
from pathlib import Path
from typing import Any, Literal

from thermal_fiducial.cli.arguments import file_to_write, warn
from thermal_fiducial.cli.parser import Parser
from thermal_fiducial.cli.progress import progress_bar
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.packages import remedy
from thermal_fiducial.report.page import evaluate_run, require_packages, VIDEO, write_page
from thermal_fiducial.report.run_folder import Run
from thermal_fiducial.report.tables import tables
from thermal_fiducial.report.text_table import Table

COMPARISON = Path('comparison.html')
#: First columns up to this width do not wrap.
_WHOLE = 44


def add_arguments(parser: Parser) -> None:
    """Options of the command."""
    parser.add_argument('folders', type=Path, nargs='+', metavar='RUN', help='run folder, as replay leaves it')
    parser.add_argument(
        '--truth',
        type=Path,
        metavar='BAG-or-TUM',
        help='ground truth: a TUM file, or a bag with ground_truth/odometry (default: truth.tum in RUN, or '
        'ground_truth.tum in the bag that was replayed, or beside its single file, if any)',
    )
    parser.add_argument(
        '--truth-map',
        type=Path,
        metavar='FILE',
        help='the map as it really is (default: map_true.yaml beside the ground truth)',
    )
    parser.add_argument('--bag', type=Path, help='the bag with the frames (default: where it was during the replay)')
    parser.add_argument('--video', action='store_true', help='write flight.mp4: frames with their markers')
    parser.add_argument('--json', action='store_true', help='print the measures as JSON instead of tables')
    parser.add_argument('--no-report', action='store_true', help='write no report.html')
    parser.add_argument(
        '--compare', action='store_true', help="several runs side by side, with evo's conventions and numbers"
    )
    parser.add_argument('--out', type=file_to_write, metavar='HTML', help=f'page of --compare (default: {COMPARISON})')
    parser.refuse(['--truth-map', '--bag', '--video'], 'with --compare', lambda args: args.compare)
    parser.refuse(['--out'], 'without --compare', lambda args: not args.compare)
    parser.refuse(['--out'], 'with --no-report', lambda args: args.no_report)
    parser.refuse(['--bag'], 'with --no-report', lambda args: args.no_report and not args.video)


def run(args: argparse.Namespace) -> int:
    """Evaluate a run, print the tables, write ``summary.json`` and ``report.html``."""
    if args.compare:
        return _compare(args)
    if len(args.folders) > 1:
        raise InputError('several runs are shown side by side with --compare')
    if not args.no_report:
        require_packages()
    evaluation, numbers = evaluate_run(args.folders[0], args.truth, args.truth_map)
    if evaluation.doubt_of_truth:
        warn(evaluation.doubt_of_truth)
    if args.video:
        make_video(evaluation.run, args.bag)
    page = None if args.no_report else write_page(evaluation, numbers, args.bag)
    if args.json:
        print(json.dumps(numbers, indent=2))
        return 0
    print_tables(tables(evaluation, numbers).values())
    print(f'ground truth: {evaluation.run.truth_path or "none, so no errors (--truth)"}')
    if args.video:
        print(f'video: {evaluation.run.path / VIDEO}')
    if page is not None:
        print(f'report: {page}')
    return 0


def make_video(run: Run, bag: Path | None = None) -> None:
    """Write the video of a run into its folder."""
    from thermal_fiducial.report.video import write_video

    with progress_bar('video') as progress:
        write_video(run, run.path / VIDEO, bag, progress)


def _compare(args: argparse.Namespace) -> int:
    page = args.out or COMPARISON
    try:
        from thermal_fiducial.report.comparison import compare
    except ModuleNotFoundError as error:
        raise InputError(f'--compare needs {error.name}: {remedy("tools")}') from None
    comparison = compare(args.folders, args.truth)
    if args.json:
        print(json.dumps(comparison.numbers, indent=2))
    else:
        print_tables(comparison.tables)
        if comparison.note:
            print(comparison.note)
    if not args.no_report:
        comparison.write(page)
        if not args.json:
            print(f'comparison: {page}')
    return 0


def print_tables(shown: Iterable[Table]) -> None:
    """Print tables to the terminal; tables that are too wide are split into parts.

    Raises
    ------
    InputError
        Without rich (extra ``tools``).
    """
    try:
        from thermal_fiducial.cli.terminal_tables import show
    except ModuleNotFoundError as error:
        raise InputError(f'the tables need {error.name}: {remedy("tools")}, or use --json') from None
    for entry in shown:
        for part in _parts(entry):
            show(_for_terminal(part))


def _parts(entry: Table) -> Iterator[Table]:
    """Tables with as many columns as fit, each with the columns that name its rows."""
    from thermal_fiducial.cli.terminal_tables import fits

    about = [column for column, head in enumerate(entry.heads[:2]) if column == 0 or head == 'unit']
    left = list(range(len(about), len(entry.heads)))
    continued = replace(entry, title=f'{entry.title} (continued)')
    while left:
        count = len(left)
        while count > 1 and not fits(_for_terminal(entry.of([*about, *left[:count]]))):
            count -= 1
        yield entry.of([*about, *left[:count]])
        entry, left = continued, left[count:]


def _for_terminal(entry: Table) -> Any:
    from rich.text import Text

    from thermal_fiducial.cli.terminal_tables import table_of

    table = table_of(entry.title, ())
    for index, head in enumerate(entry.heads):
        # Names of rows do not wrap; headers of numbers do.
        whole = index == 0 and max((len(row[0]) for row in entry.rows), default=0) <= _WHOLE
        style = 'blue' if head.startswith('fused') else 'red' if head.startswith('markers alone') else ''
        justify: Literal['left', 'right'] = 'left' if entry.is_text(index) else 'right'
        table.add_column(Text(head), justify=justify, header_style=style, overflow='fold', no_wrap=whole)
    for row in entry.rows:
        table.add_row(*map(Text, row))
    return table
