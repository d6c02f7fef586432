"""Schema validation of the package's YAML files: typed values that know their file, line and field.

Why not a library: the nodes read maps and calibrations when they restart in flight, and their dependencies must come
with ROS. Importing pydantic takes 150 ms, msgspec 75 ms, this module 8 ms beside PyYAML's 90 (one busy machine, one
run), and neither library knows the line of a value. Their further features (models, conversion) are not needed for
the package's few records.

The text is parsed as libyaml's events, not as PyYAML's objects: no implicit dates, tags or expanding aliases, no
recursion, and the field, not the spelling, determines whether a value is a number.
"""

from collections.abc import Collection, Iterator
from dataclasses import dataclass
import math
from pathlib import Path
import re
from typing import Any, TypeAlias

import yaml

from thermal_fiducial.errors import InputError
from thermal_fiducial.files.reading import read_text

#: Deepest nesting of lists and mappings; the package's files have at most five levels.
DEEPEST = 16
#: Most values in a file: a map of 2,770 markers with all fields. The largest dictionary in use, tagStandard41h12, has
#: 2,115.
MOST_VALUES = 150_000
#: Longest quotation of a value in an error [characters].
_QUOTED = 60

# Of quaternions that were written with two digits.
_NORM_TOLERANCE = 0.01
_NUMBER = re.compile(r'[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?')
_INTEGER = re.compile(r'[-+]?\d{1,19}')
_TRUE, _FALSE = ('true', 'yes', 'on'), ('false', 'no', 'off')
_EMPTY = ('', '~', 'null', 'Null', 'NULL')
_PLAIN_TAGS = {f'tag:yaml.org,2002:{kind}' for kind in ('str', 'int', 'float', 'bool', 'seq', 'map')}

Content: TypeAlias = 'str | list[Value] | dict[str, Value]'


@dataclass(slots=True)
class Value:
    """A value of a file with its location."""

    #: the file
    path: str
    #: counted from 1
    line: int
    #: name of the field in errors: ``markers[3]: position``
    field: str
    content: Content
    #: whether a scalar was written without quotes
    plain: bool = False

    def error(self, what: str) -> InputError:
        """Error in one line: file, line, field and ``what``."""
        field = f' {self.field}:' if self.field else ''
        return InputError(f'{self.path}: line {self.line}:{field} {what}')

    def _child(self, name: str, value: 'Value') -> 'Value':
        value.field = f'{self.field}: {name}' if self.field else name
        return value

    def mapping(self, known: Collection[str] | None = None) -> dict[str, 'Value']:
        """Fields by name; ``known``: the allowed names.

        Raises
        ------
        InputError
            Not a mapping, or an unknown field.
        """
        if not isinstance(self.content, dict):
            raise self.error(f'{self.quoted()} is not a set of fields')
        for name, value in self.content.items():
            if known is not None and name not in known:
                raise value.error(f'{self.field + ": " if self.field else ""}unknown field {_shortened(name)}')
            self._child(name, value)
        return {name: value for name, value in self.content.items() if not value.empty}

    def items(self) -> list['Value']:
        """The values of a list.

        Raises
        ------
        InputError
            Not a list.
        """
        if not isinstance(self.content, list):
            raise self.error(f'{self.quoted()} is not a list')
        for index, value in enumerate(self.content):
            value.field = f'{self.field}[{index}]'
        return self.content

    @property
    def empty(self) -> bool:
        """Whether the value is missing or null."""
        return self.plain and self.content in _EMPTY

    def number(self, low: float = -math.inf, high: float = math.inf) -> float:
        """A finite number from ``low`` to ``high``.

        Raises
        ------
        InputError
            It is none.
        """
        text = self.content
        value = float(text) if isinstance(text, str) and _NUMBER.fullmatch(text) else math.nan
        if not math.isfinite(value):
            raise self.error(f'{self.quoted()} is not a number')
        if not low <= value <= high:
            raise self.error(f'{self.quoted()} is outside {low:g} .. {high:g}')
        return value

    def integer(self, low: int, high: int) -> int:
        """A whole number from ``low`` to ``high``.

        Raises
        ------
        InputError
            It is none.
        """
        text = self.content
        if not isinstance(text, str) or not _INTEGER.fullmatch(text):
            raise self.error(f'{self.quoted()} is not a whole number')
        value = int(text)
        if not low <= value <= high:
            raise self.error(f'{self.quoted()} is not a whole number from {low} to {high}')
        return value

    def flag(self) -> bool:
        """A boolean.

        Raises
        ------
        InputError
            It is none.
        """
        word = self.content.lower() if isinstance(self.content, str) and self.plain else ''
        if word not in _TRUE and word not in _FALSE:
            raise self.error(f'{self.quoted()} is neither true nor false')
        return word in _TRUE

    def text(self, longest: int = 200) -> str:
        """A non-empty text of printable characters.

        Raises
        ------
        InputError
            It is none.
        """
        if not isinstance(self.content, str) or not self.content or not self.content.isprintable():
            raise self.error(f'{self.quoted()} is not a name')
        if len(self.content) > longest:
            raise self.error(f'{self.quoted()} is longer than {longest} characters')
        return self.content

    def numbers(self, length: int, limit: float = math.inf) -> list[float]:
        """A list of ``length`` finite numbers from -``limit`` to ``limit``.

        Raises
        ------
        InputError
            It is none.
        """
        if not isinstance(self.content, list) or len(self.content) != length:
            raise self.error(f'not a list of {length} numbers')
        return [value.number(-limit, limit) for value in self.items()]

    def unit_quaternion(self) -> list[float]:
        """A list x y z w, whose norm is 1 but for rounding.

        Raises
        ------
        InputError
            It is none.
        """
        numbers = self.numbers(4)
        norm = math.hypot(*numbers)
        if abs(norm - 1.0) > _NORM_TOLERANCE:
            raise self.error(f'no unit quaternion x y z w (norm {norm:.3g})')
        return numbers

    def quoted(self) -> str:
        """The value, shortened for an error message."""
        if isinstance(self.content, list):
            return f'a list of {len(self.content)}'
        if isinstance(self.content, dict):
            return 'a set of fields'
        return _shortened(self.content)


def load_yaml(path: str | Path) -> Value:
    """The single document of a YAML file.

    Raises
    ------
    InputError
        Unreadable, not YAML, more than one document, aliases, unknown tags, or too deeply nested or too long.
    """
    return parse_yaml(str(path), read_text(path))


def parse_yaml(path: str, text: str) -> Value:
    """The single document of a YAML text; ``path`` names it in errors. Raises as :func:`load_yaml`."""
    try:
        root = _Builder(path).build(yaml.parse(text, Loader=getattr(yaml, 'CSafeLoader', yaml.SafeLoader)))
    except yaml.YAMLError as error:
        raise InputError(f'{path}:{_problem(error, text)}') from None
    return Value(path, 1, '', '', plain=True) if root is None else root


def _problem(error: yaml.YAMLError, text: str) -> str:
    """Line of ``text`` that is not valid YAML, if known, and why."""
    reason = getattr(error, 'problem', None) or str(error).partition('\n')[0] or 'broken text'
    if (mark := getattr(error, 'problem_mark', None)) is None:
        return f' not valid YAML: {reason}'
    rest = dict(enumerate(text.split('\n'))).get(mark.line, '')[mark.column :]
    if rest.startswith('\t'):
        reason = 'a tab, where YAML takes spaces only'
    return f' line {mark.line + 1}: not valid YAML: {reason}'


class _Builder:
    """Assembles events to values, without recursion."""

    def __init__(self, path: str) -> None:
        self._path = path
        self._open: list[Value] = []
        self._keys: list[str | None] = []
        self._root: Value | None = None
        self._values = 0

    def build(self, events: Iterator[Any]) -> Value | None:
        for event in events:
            if isinstance(event, yaml.ScalarEvent):
                self._scalar(event)
            elif isinstance(event, (yaml.MappingStartEvent, yaml.SequenceStartEvent)):
                self._begin(event)
            elif isinstance(event, (yaml.MappingEndEvent, yaml.SequenceEndEvent)):
                self._open.pop()
                self._keys.pop()
            elif isinstance(event, yaml.AliasEvent):
                raise self._error(event, f'alias *{_shortened(event.anchor)} is not allowed')
            elif isinstance(event, yaml.DocumentStartEvent) and self._root is not None:
                raise self._error(event, 'a second document')
        return self._root

    def _error(self, event: Any, what: str) -> InputError:
        return InputError(f'{self._path}: line {event.start_mark.line + 1}: {what}')

    def _scalar(self, event: Any) -> None:
        if self._open and isinstance(self._open[-1].content, dict) and self._keys[-1] is None:
            if event.value in self._open[-1].content:
                raise self._error(event, f'{_shortened(event.value)} is there twice')
            self._keys[-1] = event.value
            return
        self._add(event, event.value, plain=event.implicit[0])

    def _begin(self, event: Any) -> None:
        if len(self._open) == DEEPEST:
            raise self._error(event, f'nested more than {DEEPEST} deep')
        content: Content = {} if isinstance(event, yaml.MappingStartEvent) else []
        self._open.append(self._add(event, content))
        self._keys.append(None)

    def _add(self, event: Any, content: Content, *, plain: bool = False) -> Value:
        if event.tag is not None and event.tag != '!' and event.tag not in _PLAIN_TAGS:
            raise self._error(event, f'tag {_shortened(event.tag)} is not allowed')
        self._values += 1
        if self._values > MOST_VALUES:
            raise self._error(event, f'more than {MOST_VALUES} values')
        value = Value(self._path, event.start_mark.line + 1, '', content, plain)
        if not self._open:
            self._root = value
        elif isinstance(holder := self._open[-1].content, list):
            holder.append(value)
        elif isinstance(holder, dict):
            key = self._keys[-1]
            if key is None:
                raise self._error(event, 'the name of a field is not a text')
            holder[key], self._keys[-1] = value, None
        return value


def _shortened(text: str | None) -> str:
    text = text or ''
    shown = repr(text[: _QUOTED + 1])
    return shown if len(text) <= _QUOTED else f'{text[:_QUOTED]!r} ...'
