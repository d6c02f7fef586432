"""Mutations of texts, bytes and messages, all of them from a random generator that is handed in."""

import array
from collections.abc import Callable, Iterator
from random import Random
import re
from typing import Any

import numpy as np

#: What takes the place of a number or a word in a text.
TOKENS = (
    'nan', 'inf', '-inf', '1e400', '-1', '0', '1e-320', '9' * 400, str(2**63), str(2**70), '0x10', '1e308', '-1e308',
    '2024-02-31', '1:30:00', 'null', '[]', '{}', '""', 'true', '&a [*a]', '*a', '!!int abc', '!!python/name:os.system',
    '[' * 3000, '{a: ' * 300, '\0', '\ufeff', '\u202e', 'x' * 3000, '%YAML 3.0', '---', '...', '- ', ': ', ',,,,',
    '"', "'", '\t', '\r', '٣', '1_000', '.5', '+', '-', 'e5',
)  # fmt: skip
_WORD = re.compile(rb'[-+.\w]+')
_FLOATS = (np.nan, np.inf, -np.inf, 1.7e308, -1.7e308, 1e200, 1e30, 1e9, -1e9, 1e-320, 0.0, -0.0, -1.0, 1.0)
#: Share of changed numbers among what becomes of a list; texts of more characters are mutated as files are.
_CHANGED, _LONG_TEXT = 0.7, 100
_STRINGS = ('', 'x' * 70_000, '\u202e\ufeff', 'mono16\0', '../../etc', '%s%n', 'nan')


def mutated_bytes(data: bytes, rng: Random) -> bytes:
    """``data`` with one to four mutations: bits, chunks, and tokens instead of words."""
    for _ in range(rng.choice((1, 1, 2, 4))):
        data = rng.choice((_bit, _cut, _repeat, _noise, _token, _token, _token, _truncate))(data, rng)
    return data


def _place(data: bytes, rng: Random) -> tuple[int, int]:
    begin = rng.randrange(len(data) + 1)
    return begin, min(begin + rng.choice((1, 2, 8, 64, 1024)), len(data))


def _bit(data: bytes, rng: Random) -> bytes:
    if not data:
        return data
    place = rng.randrange(len(data))
    return data[:place] + bytes([data[place] ^ (1 << rng.randrange(8))]) + data[place + 1 :]


def _cut(data: bytes, rng: Random) -> bytes:
    begin, end = _place(data, rng)
    return data[:begin] + data[end:]


def _repeat(data: bytes, rng: Random) -> bytes:
    begin, end = _place(data, rng)
    return data[:end] + data[begin:end] * rng.choice((1, 1, 100)) + data[end:]


def _noise(data: bytes, rng: Random) -> bytes:
    begin, end = _place(data, rng)
    return data[:begin] + rng.randbytes(end - begin) + data[end:]


def _truncate(data: bytes, rng: Random) -> bytes:
    return data[: rng.randrange(len(data) + 1)]


def _token(data: bytes, rng: Random) -> bytes:
    # Words of the first part of a large file: a header is there, and looking through all of it takes long.
    words = list(_WORD.finditer(data[:50_000]))
    if not words:
        return data
    word = rng.choice(words)
    return data[: word.start()] + rng.choice(TOKENS).encode() + data[word.end() :]


# --- messages -----------------------------------------------------------------------------------------


def mutate_message(message: Any, rng: Random) -> Any:
    """``message`` itself, one to three of its values replaced by what a publisher may send but should not."""
    for _ in range(rng.choice((1, 1, 2, 3))):
        kind, replace = rng.choice(list(_leaves(message, rng)))
        replace(_value(kind, rng))
    return message


def _leaves(message: Any, rng: Random) -> Iterator[tuple[str, Callable[[Any], None]]]:
    """Type of each value in a message with what replaces it; of many numbers a single one, or their whole list."""
    for name, kind in message.get_fields_and_field_types().items():
        held = getattr(message, name)
        if hasattr(held, 'get_fields_and_field_types'):
            yield from _leaves(held, rng)
        elif isinstance(held, (np.ndarray, array.array, list)) and 'sequence' not in kind:
            yield kind.partition('[')[0], lambda value, held=held: held.__setitem__(rng.randrange(len(held)), value)
        elif isinstance(held, list) and held and hasattr(held[0], 'get_fields_and_field_types'):
            yield from _leaves(held[0], rng)
            yield kind, lambda _, held=held: held.pop()
        elif 'sequence' in kind:
            yield kind, lambda _, name=name: setattr(message, name, _sequence(getattr(message, name), rng))
        elif isinstance(held, str) and len(held) > _LONG_TEXT:
            yield kind, lambda _, name=name: setattr(message, name, _text(getattr(message, name), rng))
        else:
            yield kind, lambda value, name=name: setattr(message, name, value)


def _sequence(held: Any, rng: Random) -> Any:
    """A list that is cut, or longer, or has something else somewhere."""
    if isinstance(held, array.array) and held and rng.random() < _CHANGED:
        return _with_another(held, rng)
    share = rng.choice((0.0, 0.5, 0.99, 2.0))
    cut = held[: int(len(held) * share)] if share < 1.0 else held + held[:8]
    return array.array(held.typecode, cut) if isinstance(held, array.array) else cut


def _with_another(held: 'array.array[Any]', rng: Random) -> 'array.array[Any]':
    """With another number somewhere: of bytes, which may be the rows of a cloud, with four others."""
    changed = array.array(held.typecode, held)
    if held.typecode != 'B':
        changed[rng.randrange(len(held))] = rng.choice(_FLOATS)
        return changed
    begin = 4 * rng.randrange(len(held) // 4 or 1)
    changed[begin : begin + 4] = array.array('B', rng.choice((_single(rng).tobytes(), rng.randbytes(4))))
    return changed


def _single(rng: Random) -> np.float32:
    """In single precision, in which what is vast is infinite."""
    with np.errstate(over='ignore'):
        return np.float32(rng.choice(_FLOATS))


def _text(held: str, rng: Random) -> str:
    return mutated_bytes(held.encode(), rng).decode(errors='replace')


def _value(kind: str, rng: Random) -> Any:
    if 'sequence' in kind:
        return None
    if kind in ('double', 'float', 'float64', 'float32'):
        return float(_single(rng)) if kind in ('float', 'float32') else rng.choice(_FLOATS)
    if kind == 'boolean':
        return rng.random() < 0.5
    if kind.startswith('string'):
        return rng.choice(_STRINGS)
    bits = int(re.sub(r'\D', '', kind) or 8)
    signed = kind.startswith('int')
    high = 2 ** (bits - signed) - 1
    return rng.choice((0, 1, high, high - 1, -(high + 1) if signed else high // 2, rng.randrange(high)))
