"""YAML files whose fields are not of ours alone, as plain objects: parameters of ROS, rigs of others.

The text passes the checks of :mod:`thermal_fiducial.files.schema` first: neither aliases nor tags, nor a depth or
length that no such file has.
"""

from pathlib import Path
from typing import Any

import yaml

from thermal_fiducial.errors import InputError
from thermal_fiducial.files.reading import read_text
from thermal_fiducial.files.schema import parse_yaml


def load_plain(path: str | Path, head: str = '') -> Any:
    """The one document of a YAML file, None of an empty one; ``head`` is left out at its beginning.

    Raises
    ------
    InputError
        As :func:`thermal_fiducial.files.schema.load_yaml`, or a value that is spelt like a date or number and is none.
    """
    text = read_text(path).removeprefix(head)
    parse_yaml(str(path), text)
    try:
        return yaml.load(text, Loader=getattr(yaml, 'CSafeLoader', yaml.SafeLoader))
    except (yaml.YAMLError, ValueError, OverflowError) as error:
        raise InputError(f'{path}: not valid YAML: {" ".join(str(error).split())[:200]}') from None
