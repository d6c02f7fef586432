"""YAML files whose fields are not of ours alone, as plain objects: parameters of ROS, for one.

The text passes the checks of :mod:`thermal_fiducial.files.schema` first: neither aliases nor tags, nor a depth or
length that no such file has.
"""

from pathlib import Path
from typing import Any

import yaml

from thermal_fiducial.errors import InputError
from thermal_fiducial.files.reading import one_line, read_text
from thermal_fiducial.files.schema import parse_yaml


def load_plain(path: str | Path) -> Any:
    """The one document of a YAML file, None of an empty one.

    Raises
    ------
    InputError
        As :func:`thermal_fiducial.files.schema.load_yaml`, or a value that is spelt like a date or number and is none.
    """
    text = read_text(path)
    parse_yaml(str(path), text)
    try:
        document = yaml.load(text, Loader=getattr(yaml, 'CSafeLoader', yaml.SafeLoader))
    except (yaml.YAMLError, ValueError, OverflowError, TypeError) as error:
        raise InputError(f'{path}: not valid YAML: {one_line(error)}') from None
    _check_integers(str(path), document)
    return document


def _check_integers(path: str, value: Any) -> None:
    """Raise for a whole number that no field can hold: none of the libraries behind says so in a line."""
    if isinstance(value, dict):
        value = [*value.keys(), *value.values()]
    if isinstance(value, list):
        for item in value:
            _check_integers(path, item)
    elif isinstance(value, int) and not -(2**63) <= value < 2**63:
        raise InputError(f'{path}: a whole number of {value.bit_length()} bits')
