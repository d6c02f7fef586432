"""Options for the sides of markers whose entries in a map have none, given before or after an action."""

import argparse

from thermal_fiducial.cli.parser import Parser
from thermal_fiducial.cli.ranges import PLATE_M, SIDE_M
from thermal_fiducial.config import size_overrides
from thermal_fiducial.errors import InputError


def add_sizes(parser: Parser, *, behind: bool = False, without: str = 'none') -> None:
    """Add the options to a command, or to one of its actions (``behind``); ``without``: the side if none is given."""
    size = argparse.SUPPRESS if behind else None
    parser.set_defaults(sizes_behind=[])
    text = f'side of markers whose entry has none [m] (default: {without})'
    parser.add_argument('--marker-size', type=SIDE_M, default=size, metavar='M', help=text)
    # The parser of an action begins with empty lists, and would overwrite those of the command under the same name.
    parser.add_argument(
        '--marker-size-override',
        type=_override,
        action='append',
        dest='sizes_behind' if behind else 'sizes_before',
        default=[],
        metavar='ID:M',
        help='side of one marker [m]; may be given several times',
    )


def add_thickness(parser: Parser) -> None:
    """Add the option for the thickness of the plates, as the nodes have it."""
    parser.add_argument(
        '--plate-thickness',
        type=PLATE_M,
        default=0.0,
        metavar='M',
        help='thickness of the plates, if they are cut from acrylic [m]',
    )


def join_sizes(args: argparse.Namespace) -> None:
    """Join the overrides of both places in ``args.marker_size_override``; for a marker the last one holds."""
    args.marker_size_override = [*args.sizes_before, *args.sizes_behind]


def _override(text: str) -> str:
    try:
        size_overrides((text,))
    except InputError:
        raise argparse.ArgumentTypeError(f'{text!r} is not ID:SIZE with a size in metres') from None
    return text
