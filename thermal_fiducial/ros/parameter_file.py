"""Generates the parameter file, with default and description of every parameter, from the config dataclasses.

``python -m thermal_fiducial.ros.parameter_file > config/thermal_fiducial.yaml``
"""

from collections import Counter
from collections.abc import Iterator
from dataclasses import Field
import textwrap
from typing import Any

import yaml

from thermal_fiducial.config import NODES, OPTIONAL_NODES, parameters

_WIDTH = 118
_END_OF_SCALAR = '...\n'
_HEAD = """\
# Every parameter of the nodes with its default. One file serves them all: a node takes the names it knows.
#   ros2 run thermal_fiducial pose_ekf --ros-args --params-file thermal_fiducial.yaml
/**:
  ros__parameters:
"""


def parameter_file() -> str:
    """Text of the file: parameters of several nodes first, then node by node."""
    nodes = NODES | OPTIONAL_NODES
    uses = Counter(name for kind in nodes.values() for name, _, _ in parameters(kind))
    shared: dict[str, str] = {}
    own: dict[str, list[str]] = {node: [] for node in nodes}
    for node, kind in nodes.items():
        for name, item, default in parameters(kind):
            entry = ''.join(_entry(name, item, default))
            if uses[name] > 1:
                shared.setdefault(name, entry)
            else:
                own[node].append(entry)
    sections = {'shared by several nodes': list(shared.values()), **own}
    return _HEAD + '\n'.join(f'    # --- {title}\n{"".join(entries)}' for title, entries in sections.items())


def _entry(name: str, item: 'Field[Any]', default: Any) -> Iterator[str]:
    limits = item.metadata
    text = ' '.join([limits['description'], *_limits(limits)])
    yield textwrap.indent(textwrap.fill(text, _WIDTH - 6), '    # ') + '\n'
    value = yaml.safe_dump(list(default) if isinstance(default, tuple) else default, default_flow_style=True)
    # ROS accepts dotted names like nested ones; they keep each entry on one line.
    yield f'    {name}: {value.removesuffix(_END_OF_SCALAR).strip()}\n'


def _limits(limits: Any) -> Iterator[str]:
    if limits['choices']:
        yield f'One of: {", ".join(filter(None, limits["choices"]))}.'
    low, high = limits['minimum'], limits['maximum']
    if low is not None and high is not None:
        least = limits['least']
        yield f'0, or from {least:g} to {high:g}.' if least else f'From {low:g} to {high:g}.'
    elif low is not None:
        yield f'At least {low:g}.'
    elif high is not None:
        yield f'At most {high:g}.'
    if limits['dynamic']:
        yield 'Dynamic.'


if __name__ == '__main__':
    print(parameter_file(), end='')
