"""Options that choose markers of a dictionary."""

import argparse

import numpy as np

from thermal_fiducial.cli.arguments import warn
from thermal_fiducial.cli.parser import Parser
from thermal_fiducial.core.detection.patterns import turned_alike
from thermal_fiducial.core.types import Gray
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.dictionary import load_dictionary


def add_choice(parser: Parser) -> None:
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
    ids = list(range(len(bits))) if args.ids is None else _id_list(args.ids, len(bits), args.dictionary)
    for index in np.flatnonzero(turned_alike(bits[ids])):
        warn(f'marker {ids[index]} of {args.dictionary} looks the same upside down, shows no pose and is not detected')
    return bits, ids


def _id_list(text: str, count: int, dictionary: str) -> list[int]:
    """IDs of ``text``, each once, all of them among the ``count`` of the dictionary."""
    ids: list[int] = []
    for part in text.split(','):
        start, dash, end = part.partition('-')
        try:
            first, last = int(start), int(end if dash else start)
            if last < first:
                raise ValueError
        except ValueError:
            raise InputError(f'--ids {text!r} is not a list like 0-7,12') from None
        if last >= count:
            # Before the list is made: it would fill the memory.
            raise InputError(f'{dictionary} has no marker {max(first, count)}: its IDs are 0 to {count - 1}')
        ids += range(first, last + 1)
    return list(dict.fromkeys(ids))
