"""Numbers and lists of things in messages."""

from collections.abc import Iterable
import re
import sys

_NUMBER = re.compile(r'\d+(\.\d+)?')


def number_of(count: int, noun: str) -> str:
    """A count and its noun, "1 marker" or "3 markers"; ``noun`` is the singular of one that takes an s."""
    return f'{count} {noun}' if count == 1 else f'{count} {noun}s'


def listed(names: Iterable[object], most: int = sys.maxsize) -> str:
    """Names with commas between them; beyond ``most`` only the number of the others: "1, 2 and 3 more"."""
    words = [str(name) for name in names]
    more = f' and {len(words) - most} more' if len(words) > most else ''
    return ', '.join(words[:most]) + more


def marker_names(ids: Iterable[int], most: int = sys.maxsize) -> str:
    """Markers by their IDs, as :func:`listed`: "marker 1", "markers 1, 2 and 3 more"."""
    known = list(ids)
    return f'{"marker" if len(known) == 1 else "markers"} {listed(known, most)}'


def without_numbers(message: str) -> str:
    """A message with N for each number: "0.6 s without a pose" and "0.8 s without a pose" say the same."""
    return _NUMBER.sub('N', message)
