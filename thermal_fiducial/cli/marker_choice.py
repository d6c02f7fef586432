"""Options that choose markers of a dictionary."""

import argparse

import numpy as np

from thermal_fiducial.cli.arguments import warn
from thermal_fiducial.cli.parser import Parser
from thermal_fiducial.core.detection.patterns import Dictionary, turned_alike
from thermal_fiducial.core.wording import listed
from thermal_fiducial.errors import InputError
from thermal_fiducial.fabrication.dictionary_search import mirror_images, windows
from thermal_fiducial.files.dictionary import load_dictionary

# No dictionary of the package has more.
_MOST_NAMED = 12


def add_choice(parser: Parser) -> None:
    """Add the options."""
    parser.add_argument(
        '--dictionary', default='STENCIL_4X4_100', help='dictionary of OpenCV or of this package, or a file'
    )
    parser.add_argument('--ids', metavar='LIST', help='markers, e.g. 0-7,12 (default: all)')


def chosen(args: argparse.Namespace) -> tuple[Dictionary, list[int]]:
    """The whole dictionary, and the chosen IDs.

    Raises
    ------
    InputError
        No such dictionary, or no such marker in it.
    """
    dictionary = load_dictionary(args.dictionary)
    count = len(dictionary.bits)
    ids = list(range(count)) if args.ids is None else _id_list(args.ids, count, args.dictionary)
    for index in np.flatnonzero(turned_alike(dictionary.bits[ids])):
        warn(f'marker {ids[index]} of {args.dictionary} looks the same upside down, shows no pose and is not detected')
    return dictionary, ids


def name_look_alikes(dictionary: Dictionary, ids: list[int]) -> None:
    """Warn of the markers ``ids`` that in a mirror may be read as themselves or one another, or look like a window."""
    pairs = mirror_images(dictionary.bits[ids], dictionary.correctable)
    if pairs:
        read = (f'{ids[a]} as {"itself" if a == b else ids[b]}' for a, b in pairs)
        warn(f'in a mirror (metal, glass, a wet floor) these markers may be read: {listed(read, _MOST_NAMED)}')
    if plain := [str(ids[k]) for k in windows(dictionary.bits[ids])]:
        warn(f'a light window in a dark panel may be read as {listed(plain, _MOST_NAMED)}')


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
