"""The file format of marker maps: schema, reader and writer, without geometry.

``version`` is the version of the schema; others are refused. ``revision`` counts the changes of a map. Until 0.2 there
was no ``revision``, and ``version`` was the counter: such a file is refused too, since it looks like a future schema,
and ``map upgrade`` converts it.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from dataclasses import fields as fields_of
import json
import re
from typing import TypeVar

import numpy as np

from thermal_fiducial.config import LARGEST_SIDE
from thermal_fiducial.core.map_limits import fault_of_covariance, LARGEST_COORDINATE
from thermal_fiducial.core.types import LARGEST_ID
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.schema import load_yaml, parse_yaml, Value

T = TypeVar('T')

FORMAT = 'thermal_fiducial/marker_map'
VERSION = 1

# Written decimals: nanometres and nanoradians, below any measurement; and significant digits of covariances, whose
# rounding must leave them positive definite: markers far from the anchor share nearly all of their errors.
_DIGITS = 9
_MOST = 2**63 - 1
_SIMPLE = re.compile(r'[A-Za-z][A-Za-z0-9_./-]*')
_WORDS = {'true', 'false', 'yes', 'no', 'on', 'off', 'null', 'y', 'n'}


@dataclass(frozen=True)
class MarkerEntry:
    """A marker entry of a file."""

    id: int
    #: side of the black square [m]; None: left out
    size: float | None
    fixed: bool
    #: position of its centre in the map [m]
    position: tuple[float, ...]
    #: orientation in the map, quaternion x y z w
    orientation: tuple[float, ...]
    #: 36 numbers, row-major; empty: left out
    covariance: tuple[float, ...] = ()
    reprojection_error_px: float = 0.0
    observations: int = 0
    first_seen_ns: int = 0
    last_seen_ns: int = 0
    trusted: bool = True


@dataclass(frozen=True)
class MapDocument:
    """Content of a map file."""

    markers: tuple[MarkerEntry, ...]
    frame_id: str = 'map'
    dictionary: str = 'DICT_4X4_50'
    revision: int = 1


def read_document(path: str) -> MapDocument:
    """The map in a file.

    Raises
    ------
    InputError
        Unreadable, not a marker map, another schema, or an invalid entry; the message names file, line and field.
    """
    return _document(load_yaml(path))


def parse_document(path: str, text: str) -> MapDocument:
    """The map in a text; ``path`` names it in errors. Raises as :func:`read_document`."""
    return _document(parse_yaml(path, text))


def upgraded(path: str) -> str:
    """Convert a map file from before 0.2, whose ``version`` counted changes, to the present schema.

    Raises
    ------
    InputError
        Unreadable, or not such a file.
    """
    root = load_yaml(path)
    fields = _head(root)
    if 'revision' in fields or 'version' not in fields:
        raise root.error('this map is of the present format already')
    return dump_document(_filled(root, fields, fields['version'].integer(1, LARGEST_ID)))


def _document(root: Value) -> MapDocument:
    fields = _head(root)
    version = fields.get('version')
    number = VERSION if version is None else version.integer(0, LARGEST_ID)
    if version is not None and number != VERSION:
        hint = ''
        if 'revision' not in fields:
            hint = '; if it was written before 0.2, which counted changes there: thermal-fiducial map upgrade'
        raise version.error(f'schema {number} is unknown, this release reads {VERSION}{hint}')
    revision = fields['revision'].integer(0, LARGEST_ID) if 'revision' in fields else 1
    return _filled(root, fields, revision)


def _head(root: Value) -> dict[str, Value]:
    """The fields of a file with the marker map's ``format``."""
    kind = root.content.get('format') if isinstance(root.content, dict) else None
    if kind is None:
        raise root.error(f'not a marker map: no "format: {FORMAT}"')
    if kind.content != FORMAT:
        raise root.error(f'not a marker map: format {kind.quoted()} is not {FORMAT!r}')
    return root.mapping({'format', 'version', *_names(MapDocument)})


def _filled(root: Value, fields: dict[str, Value], revision: int) -> MapDocument:
    if 'markers' not in fields or not isinstance(fields['markers'].content, list):
        raise root.error('no list of markers: the file is broken or cut short')
    entries: dict[int, MarkerEntry] = {}
    for value in fields['markers'].items():
        entry = _entry(value)
        if entry.id in entries:
            raise value.error(f'marker {entry.id} is there twice')
        entries[entry.id] = entry
    return MapDocument(
        tuple(entries.values()),
        fields['frame_id'].text() if 'frame_id' in fields else MapDocument.frame_id,
        fields['dictionary'].text() if 'dictionary' in fields else MapDocument.dictionary,
        revision,
    )


def _entry(value: Value) -> MarkerEntry:
    if not isinstance(value.content, dict):
        raise value.error(f'{value.quoted()} is not a marker')
    if 'id' not in value.content:
        raise value.error('a marker without id')
    name, value.field = value.field, f'{value.field}: id'
    value.content['id'].field = value.field
    marker_id = value.content['id'].integer(0, LARGEST_ID)
    value.field = f'{name} (marker {marker_id})'
    fields = value.mapping(_names(MarkerEntry))
    for needed in ('position', 'orientation'):
        if needed not in fields:
            raise value.error(f'no {needed}')
    return MarkerEntry(
        id=marker_id,
        size=_optional(fields, 'size', _size, None),
        fixed=_optional(fields, 'fixed', Value.flag, False),
        position=tuple(fields['position'].numbers(3, LARGEST_COORDINATE)),
        orientation=tuple(fields['orientation'].unit_quaternion()),
        covariance=_optional(fields, 'covariance', _covariance, ()),
        reprojection_error_px=_optional(
            fields, 'reprojection_error_px', lambda v: v.number(0.0, LARGEST_COORDINATE), 0.0
        ),
        observations=_optional(fields, 'observations', _count, 0),
        first_seen_ns=_optional(fields, 'first_seen_ns', _count, 0),
        last_seen_ns=_optional(fields, 'last_seen_ns', _count, 0),
        trusted=_optional(fields, 'trusted', Value.flag, True),
    )


def _names(kind: type) -> set[str]:
    """Fields of a record, which have the names of those in the file."""
    return {field.name for field in fields_of(kind)}


def _optional(fields: dict[str, Value], name: str, read: Callable[[Value], T], default: T) -> T:
    return read(fields[name]) if name in fields else default


def _count(value: Value) -> int:
    return value.integer(0, _MOST)


def _size(value: Value) -> float:
    size = value.number()
    if not 0.0 < size <= LARGEST_SIDE:
        raise value.error(f'{value.quoted()} is not a side in metres')
    return size


def _covariance(value: Value) -> tuple[float, ...]:
    numbers = value.numbers(36, LARGEST_COORDINATE**2)
    if fault := fault_of_covariance(np.reshape(numbers, (6, 6))):
        raise value.error(fault)
    return tuple(numbers)


def dump_document(document: MapDocument) -> str:
    """YAML text of a map, one line a marker, ordered by ID.

    Raises
    ------
    InputError
        The map has a value that the reader would refuse.
    """
    lines = [
        f'format: {FORMAT}',
        f'version: {VERSION}',
        f'revision: {document.revision}',
        f'frame_id: {_text(document.frame_id)}',
        f'dictionary: {_text(document.dictionary)}',
        'markers:' if document.markers else 'markers: []',
    ]
    lines += [f'  - {{{_fields(entry)}}}' for entry in sorted(document.markers, key=lambda entry: entry.id)]
    text = '\n'.join(lines) + '\n'
    try:
        parse_document('the map', text)
    except InputError as error:
        raise InputError(f'not written, as it could not be read back: {error}') from None
    return text


def _fields(entry: MarkerEntry) -> str:
    fields = [f'id: {entry.id}']
    if entry.size is not None:
        fields.append(f'size: {_number(entry.size)}')
    fields.append(f'fixed: {_flag(entry.fixed)}')
    fields.append(f'position: {_list(round(float(value), _DIGITS) + 0.0 for value in entry.position)}')
    fields.append(f'orientation: {_list(round(float(value), _DIGITS) + 0.0 for value in entry.orientation)}')
    if any(entry.covariance):
        fields.append(f'covariance: {_list(float(f"{value:.{_DIGITS}g}") for value in entry.covariance)}')
    if entry.observations:
        fields.append(f'reprojection_error_px: {_number(round(entry.reprojection_error_px, 6))}')
        fields += [f'{name}: {getattr(entry, name)}' for name in ('observations', 'first_seen_ns', 'last_seen_ns')]
    if not entry.trusted:
        fields.append('trusted: false')
    return ', '.join(fields)


def _list(values: Iterable[float]) -> str:
    return f'[{", ".join(map(_number, values))}]'


def _number(value: float) -> str:
    """A number as YAML 1.1 parses it: with a decimal point before an exponent."""
    text = repr(float(value))
    return text.replace('e', '.0e', 1) if 'e' in text and '.' not in text else text


def _flag(value: bool) -> str:
    return 'true' if value else 'false'


def _text(value: str) -> str:
    if _SIMPLE.fullmatch(value) and value.lower() not in _WORDS:
        return value
    return json.dumps(value, ensure_ascii=False)
