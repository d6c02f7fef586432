"""``map error``: how far a map lies from the true one, marker by marker."""

import argparse
from pathlib import Path

from thermal_fiducial.cli.arguments import warn
from thermal_fiducial.cli.evaluate import print_tables
from thermal_fiducial.cli.parser import Parser
from thermal_fiducial.config import size_overrides
from thermal_fiducial.files.marker_map import load_map
from thermal_fiducial.report.map_error import doubt_of_dictionary, map_accuracy, marker_errors
from thermal_fiducial.report.tables import map_error_table
from thermal_fiducial.report.text_table import number, Table


def add_error(parser: Parser) -> None:
    """Arguments of the action."""
    parser.description = (
        'Errors of the markers that both maps have: positions and attitudes in the frame of the map, positions also '
        'after a rigid alignment, and whether the covariances claim as much.'
    )
    parser.add_argument('map', type=Path, metavar='MAP', help='map file (YAML)')
    parser.add_argument('truth', type=Path, metavar='TRUTH', help='the map as it really is')
    parser.set_defaults(do=_error)


def _error(args: argparse.Namespace) -> int:
    sizes = args.marker_size, size_overrides(tuple(args.marker_size_override))
    estimate, truth = load_map(args.map, *sizes), load_map(args.truth, *sizes)
    numbers = map_accuracy(estimate, truth)
    if doubt := doubt_of_dictionary(estimate, truth):
        warn(doubt)
    rows = [
        (
            str(error.id), number(error.position_mm), number(error.attitude_deg), number(error.sigma_mm),
            number(error.sigma_deg), number(error.nees), 'fixed' if error.fixed else '',
        )
        for error in marker_errors(estimate, truth).values()
    ]  # fmt: skip
    heads = (
        'marker', 'error [mm]', 'error [deg]', 'sigma [mm]', 'sigma [deg]', 'NEES [per d.o.f.]', 'status',
    )  # fmt: skip
    print_tables([map_error_table(numbers), Table('Markers, one by one', heads, rows)])
    return 0
