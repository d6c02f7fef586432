"""Options that choose markers of a dictionary."""

import argparse

from thermal_fiducial.core.types import Gray
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.dictionary import load_dictionary


def add_choice(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.add_argument(
        '--dictionary', default='STENCIL_4X4_100', help='dictionary of OpenCV or of this package, or a file'
    )
    parser.add_argument('--ids', metavar='LIST', help='markers, e.g. 0-7,12 (default: all)')


def chosen(args: argparse.Namespace) -> tuple[Gray, list[int]]:
    """Bits (M, n, n) of the whole dictionary, and the chosen IDs.

    Raises
    ------
    InputError
        No such dictionary, or no such marker in it.
    """
    bits = load_dictionary(args.dictionary).bits
    ids = list(range(len(bits))) if args.ids is None else _id_list(args.ids)
    wrong = [marker_id for marker_id in ids if marker_id >= len(bits)]
    if wrong:
        raise InputError(f'{args.dictionary} has no marker {wrong[0]}: its IDs are 0 to {len(bits) - 1}')
    return bits, ids


def _id_list(text: str) -> list[int]:
    ids: list[int] = []
    for part in text.split(','):
        first, dash, last = part.partition('-')
        try:
            ids += range(int(first), int(last if dash else first) + 1)
        except ValueError:
            raise InputError(f'--ids {text!r} is not a list like 0-7,12') from None
    if not ids:
        raise InputError(f'--ids {text!r} names no marker')
    return ids
