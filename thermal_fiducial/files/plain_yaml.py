"""YAML files with arbitrary fields, such as ROS parameters, as plain objects.

The text passes the checks of :mod:`thermal_fiducial.files.schema` first: no aliases, no tags, limited depth and size.
"""

import os
from pathlib import Path
import re
from typing import Any

import yaml

from thermal_fiducial.errors import InputError
from thermal_fiducial.files.reading import one_line, read_text
from thermal_fiducial.files.schema import parse_yaml
from thermal_fiducial.files.writing import write_text

_Loader: Any = type('_Loader', (getattr(yaml, 'CSafeLoader', yaml.SafeLoader),), {})
# PyYAML takes 1e-4 and 1.0e4 for texts, ROS for numbers.
_Loader.add_implicit_resolver(
    'tag:yaml.org,2002:float', re.compile(r'[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)[eE][-+]?[0-9]+$'), list('-+.0123456789')
)


def load_plain(path: str | Path) -> Any:
    """The single document of a YAML file; None if it is empty.

    Raises
    ------
    InputError
        As :func:`thermal_fiducial.files.schema.load_yaml`, or a malformed date or number.
    """
    text = read_text(path)
    parse_yaml(str(path), text)
    try:
        document = yaml.load(text, Loader=_Loader)
    except (yaml.YAMLError, ValueError, OverflowError, TypeError) as error:
        raise InputError(f'{path}: not valid YAML: {one_line(error)}') from None
    _check_integers(str(path), document)
    return document


def save_plain(path: str | os.PathLike[str], document: Any) -> None:
    """Write plain objects in the order given, lists of numbers on one line."""
    write_text(path, yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=120))


def _check_integers(path: str, value: Any) -> None:
    """Raise InputError for an integer that overflows every field; the libraries' errors would be unreadable."""
    if isinstance(value, dict):
        value = [*value.keys(), *value.values()]
    if isinstance(value, list):
        for item in value:
            _check_integers(path, item)
    elif isinstance(value, int) and not -(2**63) <= value < 2**63:
        raise InputError(f'{path}: a whole number of {value.bit_length()} bits')
