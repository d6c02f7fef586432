"""Sides of markers whose entry in a map has none: options that stand before an action or behind it."""

import argparse

from thermal_fiducial.config import size_overrides
from thermal_fiducial.errors import InputError


def add_sizes(parser: argparse.ArgumentParser, *, behind: bool = False) -> None:
    """Options of a command, or of one of its actions, ``behind`` which they may stand too."""
    size = argparse.SUPPRESS if behind else None
    text = 'side of markers whose entry has none [m]'
    parser.add_argument('--marker-size', type=_side, default=size, metavar='M', help=text)
    # An action's parser starts its lists empty: under one name, it would lose those before the action.
    parser.add_argument(
        '--marker-size-override',
        type=_override,
        action='append',
        dest='sizes_behind' if behind else 'sizes_before',
        default=[],
        metavar='ID:M',
        help='side of one marker [m]; may be given several times',
    )


def join_sizes(args: argparse.Namespace) -> None:
    """Put the overrides of both places into ``args.marker_size_override``; for one marker the last counts."""
    args.marker_size_override = [*args.sizes_before, *args.sizes_behind]


def _side(text: str) -> float:
    try:
        side = float(text)
    except ValueError:
        side = 0.0
    if not 0.0 < side < 100.0:
        raise argparse.ArgumentTypeError(f'{text!r} is no side in metres')
    return side


def _override(text: str) -> str:
    try:
        size_overrides((text,))
    except InputError:
        raise argparse.ArgumentTypeError(f'{text!r} is not ID:SIZE with a size in metres') from None
    return text
