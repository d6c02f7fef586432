"""ROS parameters from the config dataclasses: declaration with descriptor, validation, dynamic changes."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import Field
from itertools import pairwise
from pathlib import Path
from typing import Any, get_args

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.exceptions import ParameterException
from rclpy.node import Node
from rclpy.parameter import Parameter

from thermal_fiducial.config import check_names, Config, for_whole_numbers, from_mapping, parameters, QOS_OVERRIDES
from thermal_fiducial.errors import InputError, INTERNAL_ERROR
from thermal_fiducial.files.parameter_sections import (
    load_sections,
    mistyped_sections,
    sections_outside,
    values_of_others,
)

_ARRAYS = {
    float: Parameter.Type.DOUBLE_ARRAY,
    int: Parameter.Type.INTEGER_ARRAY,
    str: Parameter.Type.STRING_ARRAY,
}
_UNBOUNDED = 1e300


def declare(node: Node, kind: type[Config]) -> Config:
    """Declare all parameters of config dataclass ``kind`` on ``node``; returns their values as a config.

    Parameters
    ----------
    node : declares the parameters; those of other nodes in the same file are ignored
    kind : config dataclass

    Raises
    ------
    InputError
        A name that no node has, or a value of the wrong type, out of range, or not among the choices.
    """
    # rclpy has no public access to the overrides, and automatically_declare_parameters_from_overrides fails on an
    # empty list, which has no type.
    given = getattr(node, '_parameter_overrides', {})
    check_names(set(given) - {name for name, _, _ in parameters(kind)})
    if any(name.startswith(QOS_OVERRIDES) for name in given):
        node.get_logger().warning(f'parameters {QOS_OVERRIDES}*: ignored, the quality of service is fixed')
    for name, item, default in parameters(kind):
        try:
            _declare(node, name, item, default)
        except ParameterException as error:
            remedy = for_whole_numbers(given[name].value, default) if name in given else ''
            raise InputError(f'parameter {name}: {remedy or str(error).removesuffix(f": {name}")}') from None
    return from_mapping(kind, current_values(node, kind))


def doubts_of_files(node: str, args: Sequence[str]) -> Iterator[str]:
    """A warning for each of the parameter files in ``args`` that a replay refuses, as it has a parameter twice.

    And for each section in them that is meant for ``node``, but ignored by ROS, and for values that another node alone
    has there. A node that was given another name has none: only who gave it knows how it is spelt. Nor has one of a
    second camera for sections without a namespace, which are for the first.

    Parameters
    ----------
    node : its full name, as ``/drone/pose_ekf``
    args : arguments of the process
    """
    namespace, _, name = node.rpartition('/')
    files: dict[str, dict[str, dict[str, Any]]] = {}
    for file in (value for flag, value in pairwise(args) if flag == '--params-file'):
        try:
            files[file] = load_sections(Path(file))
        except InputError as error:
            # ROS has read the file: a node that starts again in flight must not end for it.
            yield f'{error}: ROS reads the file all the same, and of two takes the last'
    seconds = {str(values.get('second_camera')) for sections in files.values() for values in sections.values()}
    is_second = namespace.rpartition('/')[2] in seconds
    for file, sections in files.items():
        mistyped = (line for meant, line in mistyped_sections(sections) if meant == name)
        outside = () if is_second else sections_outside(sections, node)
        apart = () if is_second else values_of_others(_in_reach(sections, namespace), name, seconds)
        yield from (f'{file}: {line}' for line in (*mistyped, *outside, *apart))


def _in_reach(sections: dict[str, dict[str, Any]], namespace: str) -> dict[str, dict[str, Any]]:
    """Sections that nodes of a namespace read: its own, and those for any; a file may be of several robots."""
    spaces = {section: section.strip('/').rpartition('/')[0] for section in sections}
    own = {section for section, space in spaces.items() if space == namespace.strip('/')}
    for_any = {section for section, space in spaces.items() if space in ('**', '*') or section in ('/**', '**')}
    return {section: values for section, values in sections.items() if section in own | for_any}


def follow(node: Node, kind: type[Config], apply: Callable[[Config], None]) -> None:
    """Call ``apply`` with the new config whenever a dynamic parameter is set, and log it; refuse invalid values."""

    def on_set(changes: Iterable[Parameter]) -> SetParametersResult:
        before, new = current_values(node, kind), {change.name: change.value for change in changes}
        try:
            apply(from_mapping(kind, before | new))
        except InputError as error:
            return SetParametersResult(successful=False, reason=str(error))
        except Exception as error:  # a failed change must not end the node
            return SetParametersResult(successful=False, reason=f'{INTERNAL_ERROR}: {type(error).__name__}: {error}')
        for name in before.keys() & new.keys():
            if new[name] != before[name]:
                node.get_logger().info(f'parameter {name}: {new[name]}, before {before[name]}')
        return SetParametersResult(successful=True)

    node.add_on_set_parameters_callback(on_set)


def current_values(node: Node, kind: type) -> dict[str, Any]:
    """Name to present value on ``node`` of the parameters of ``kind``."""
    values = {name: node.get_parameter_or(name).value for name, _, _ in parameters(kind)}
    return {name: value for name, value in values.items() if value is not None}


def _declare(node: Node, name: str, item: 'Field[Any]', default: Any) -> None:
    if default != ():
        node.declare_parameter(name, list(default) if isinstance(default, tuple) else default, _descriptor(item))
        return
    # An empty list has no type, and a parameter that is declared by type alone stays unset until it is assigned;
    # while one is unset, a request for all parameters fails. It is assigned while still writable, then made read-only.
    kind = _ARRAYS[get_args(item.type)[0]]
    writable, final = _descriptor(item), _descriptor(item)
    writable.read_only, final.type = False, kind.value
    if node.declare_parameter(name, kind, writable).value is None:
        node.set_parameters([Parameter(name, kind, [])])
    node.set_descriptor(name, final)


def _descriptor(item: 'Field[Any]') -> ParameterDescriptor:
    limits = item.metadata
    descriptor = ParameterDescriptor(description=limits['description'], read_only=not limits['dynamic'])
    if limits['choices']:
        descriptor.additional_constraints = 'one of: ' + ', '.join(limits['choices'])
    low, high = limits['minimum'], limits['maximum']
    if low is None and high is None:
        return descriptor
    kind = item.default[0] if isinstance(item.default, tuple) and item.default else item.default
    if isinstance(kind, int):
        descriptor.integer_range = [
            IntegerRange(
                from_value=int(-(2**62) if low is None else low), to_value=int(2**62 if high is None else high)
            )
        ]
    else:
        descriptor.floating_point_range = [
            FloatingPointRange(
                from_value=-_UNBOUNDED if low is None else float(low),
                to_value=_UNBOUNDED if high is None else float(high),
            )
        ]
    return descriptor
