"""``evaluate RUN``: errors, jitter, consistency and latency of a run, as tables and as a page."""

import argparse
import json
from pathlib import Path

from thermal_fiducial.errors import InputError
from thermal_fiducial.report.page import evaluate_run, write_page
from thermal_fiducial.report.tables import Table, tables


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    parser.add_argument('folder', type=Path, metavar='RUN', help='run folder, as replay leaves it')
    parser.add_argument(
        '--truth', type=Path, metavar='BAG-or-TUM', help='ground truth: a TUM file, or a bag with ground_truth/odometry'
    )
    parser.add_argument('--json', action='store_true', help='print the measures as JSON instead of tables')
    parser.add_argument('--no-report', action='store_true', help='write no report.html')


def run(args: argparse.Namespace) -> int:
    """Measure, print, write ``summary.json`` and ``report.html``."""
    evaluation, numbers = evaluate_run(args.folder, args.truth)
    page = None if args.no_report else write_page(evaluation, numbers)
    if args.json:
        print(json.dumps(numbers, indent=2))
        return 0
    print_tables(tables(evaluation, numbers))
    if page is not None:
        print(f'report: {page}')
    return 0


def print_tables(shown: list[Table]) -> None:
    """Print tables to the terminal.

    Raises
    ------
    InputError
        Without rich (extra ``tools``).
    """
    try:
        from rich import box
        from rich.console import Console
        import rich.table
        from rich.text import Text
    except ImportError as error:
        raise InputError(f'the tables need {error.name}: install the extra "tools", or use --json') from None
    console = Console()
    for entry in shown:
        table = rich.table.Table(title=entry.title, title_justify='left', box=box.SIMPLE_HEAD, title_style='bold')
        for index, head in enumerate(entry.heads):
            style = {'fused': 'blue', 'fiducial': 'red'}.get(head, '')
            table.add_column(Text(head), justify='left' if index == 0 or entry.textual else 'right', header_style=style)
        for row in entry.rows:
            table.add_row(*map(Text, row))
        console.print(table)
