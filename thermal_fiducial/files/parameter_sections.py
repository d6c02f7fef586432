"""Files of ROS parameters: their sections, each for the nodes that its name matches."""

from collections.abc import Collection, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from thermal_fiducial.config import meant_node, NODES, parameters
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.plain_yaml import load_plain
from thermal_fiducial.files.reading import shown

_PARAMETERS = 'ros__parameters'
# What nodes share in name alone.
_OWN = ('realtime_priority', 'image_rate')


def load_sections(path: Path) -> dict[str, dict[str, Any]]:
    """Name of each section (``/**``, ``/drone/pose_ekf``) to its parameters, whose nested names are joined by dots.

    Raises
    ------
    InputError
        Unreadable, not the form of such a file, or a parameter that is there twice.
    """
    document = load_plain(path)
    if not isinstance(document, dict) or not document:
        raise _no_parameters(path)
    return dict(_sections(path, document, ''))


def mistyped_sections(sections: Mapping[str, Mapping[str, Any]]) -> Iterator[tuple[str, str]]:
    """The node that each section with a mistyped name is meant for, and a warning that it gets nothing of it."""
    for section, values in sections.items():
        if node := meant_node(section, values):
            yield node, f'section {shown(section)}: no node of ours is called so; did you mean {node}?'


def sections_outside(sections: Mapping[str, Mapping[str, Any]], node: str) -> Iterator[str]:
    """A warning for each section without a namespace that is meant for ``node``, which has one: ROS ignores it.

    In a file with sections for that namespace, those without one are taken to be for nodes without one.

    Parameters
    ----------
    sections : name to parameters
    node : its full name, as ``/drone/pose_ekf``
    """
    namespace, _, name = node.rpartition('/')
    spaces = {section.strip('/').rpartition('/')[0] for section in sections}
    if not namespace or namespace.strip('/') in spaces:
        return
    for section in sections:
        if section.strip('/') == name:
            yield (
                f'section {shown(section)}: ROS ignores it, as it is for a node without a namespace; '
                f'for {node} write {node} or /**/{name}'
            )


def values_for(sections: Mapping[str, Mapping[str, Any]], node: str, seconds: Collection[str] = ()) -> dict[str, Any]:
    """Values of a node of the first camera by name; sections in the namespaces of ``seconds`` do not apply to it."""
    return joined(sections, node, (name for name in sections if not set(seconds) & set(name.split('/')[:-1])))


def joined(sections: Mapping[str, Mapping[str, Any]], node: str, names: Iterable[str]) -> dict[str, Any]:
    """Values of a node from those of the sections ``names`` that are meant for it or for all; the last counts."""
    values: dict[str, Any] = {}
    for name in names:
        if name.rpartition('/')[2] in ('**', '*', node):
            values |= sections[name]
    return values


def values_of_others(
    sections: Mapping[str, Mapping[str, Any]], node: str, seconds: Collection[str] = ()
) -> Iterator[str]:
    """A warning for each other node whose sections alone have what ``node`` needs too, as the camera's place."""
    if node not in NODES:
        return
    defaults = {name: default for name, _, default in parameters(NODES[node]) if name not in _OWN}
    own = defaults | values_for(sections, node, seconds)
    for other in (name for name in NODES if name != node):
        theirs = values_for(sections, other, seconds)
        shared = {name for name, _, _ in parameters(NODES[other])} & defaults.keys() & theirs.keys()
        apart = sorted(name for name in shared if as_in_file(theirs[name]) != as_in_file(own[name]))
        if apart:
            yield f'{", ".join(apart)}: {other} has other values than {node}; write them into the section /** for both'


def as_in_file(value: Any) -> Any:
    """The value of a parameter as YAML has it."""
    return list(value) if isinstance(value, tuple) else value


def _sections(path: Path, document: Mapping[str, Any], namespace: str) -> Iterator[tuple[str, dict[str, Any]]]:
    """Sections of a namespace, which may be nested as ROS has it: ``drone: {pose_ekf: {ros__parameters: {...}}}``."""
    for name, content in document.items():
        if not isinstance(content, dict) or not content:
            raise _no_parameters(path)
        if _PARAMETERS not in content:
            yield from _sections(path, content, f'{namespace}{name}/')
        elif isinstance(content[_PARAMETERS], dict):
            yield f'{namespace}{name}', _joined_by_dots(path, content[_PARAMETERS])
        else:
            raise _no_parameters(path)


def _joined_by_dots(path: Path, section: Mapping[str, Any]) -> dict[str, Any]:
    values: dict[str, Any] = {}
    for name, value in _flat(section, ''):
        if name in values:
            # As where the result of a calibration was added to a copy of the package's file.
            raise InputError(f'parameter file {path}: {shown(name)} is there twice, once nested')
        values[name] = value
    return values


def _flat(section: Mapping[str, Any], prefix: str) -> Iterator[tuple[str, Any]]:
    for name, value in section.items():
        if isinstance(value, dict):
            yield from _flat(value, f'{prefix}{name}.')
        else:
            yield f'{prefix}{name}', value


def _no_parameters(path: Path) -> InputError:
    return InputError(f'parameter file {path}: not of the form NODE: {{{_PARAMETERS}: {{...}}}}')
