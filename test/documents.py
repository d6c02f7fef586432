"""Writes the tables of the documents and the parameter file: ``python test/documents.py`` (``make tables``).

A table stands between ``<!-- NAME -->`` and ``<!-- end -->``. Topics and services are those of running nodes with all
optional outputs switched on, parameters come from ``config.py``, arguments from the launch files, measured tables from
the Markdown files that the benchmarks leave in ``doc/tables/``. What a topic is for stands in ``doc/interfaces.yaml``.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib import import_module
from itertools import groupby
import json
from pathlib import Path
import re
import runpy
import sys
import tempfile
from typing import Any
from unittest.mock import patch

import pytest
from rclpy.context import Context
from rclpy.parameter import Parameter
from support import launch_api
from support.small_bag import CAMERA
import yaml

from thermal_fiducial.config import NODES, OPTIONAL_NODES, parameters
from thermal_fiducial.core.measurements import MAP_DTYPE, MARKER_DTYPE
from thermal_fiducial.files.camera_info import save_camera
from thermal_fiducial.ros.base.node import StageNode
from thermal_fiducial.ros.parameter_file import parameter_file

ROOT = Path(__file__).resolve().parents[1]
PAGES = (ROOT / 'README.md', *(ROOT / 'doc' / f'{page}.md' for page in ('accuracy', 'faults', 'install', 'nodes')))
INTERFACES = ROOT / 'doc' / 'interfaces.yaml'
CALIBRATION = 'CALIBRATION'
#: Flights of the measured table that the README shows, in its words.
IN_SHORT = {
    'wall': 'slow, eight markers on a wall',
    'fog': 'slow, through fog',
    'fast': 'fast, 1 to 2 m/s',
    'wall, mapping from one marker': 'slow, mapping from one known marker',
}
#: Packages whose topics ``interfaces.yaml`` has with their type: hidden, so that the pages are the same with them.
ON_A_ROBOT = {'tf2_msgs.msg': None}
#: Parameters that switch the optional topics of a node on, a start for each set; CALIBRATION becomes a file.
SWITCHES: dict[str, tuple[dict[str, Any], ...]] = {
    'tau2_camera': ({'calibration_file': CALIBRATION}, {'image_transport': 'compressed'}),
    'pose_ekf': ({'smoothing_time': 0.5, 'bridge_rate': 30.0},),
    'thermal_source': ({'calibration_file': CALIBRATION},),
}
#: What every node has of rclpy, and the diagnostics, of which the page speaks once.
OF_ALL = re.compile(r'/(rosout|parameter_events|diagnostics)|.*/(.*_parameters(_atomically)?|get_.*)')


def node_class(name: str) -> Any:
    """The class of node ``name``, which its module defines."""
    module = import_module(f'thermal_fiducial.nodes.{name}')
    own = [item for item in vars(module).values() if isinstance(item, type) and item.__module__ == module.__name__]
    (kind,) = [item for item in own if issubclass(item, StageNode)]
    return kind


@contextmanager
def running(kind: type, values: Mapping[str, Any]) -> Iterator[Any]:
    """A node, alone in its context."""
    context = Context()
    context.init(args=[])
    with tempfile.TemporaryDirectory() as folder:
        calibration = Path(folder) / 'camera.yaml'
        save_camera(calibration, CAMERA)
        given = {name: str(calibration) if value == CALIBRATION else value for name, value in values.items()}
        overrides = [Parameter(name, value=value) for name, value in given.items()]
        with patch.dict(sys.modules, ON_A_ROBOT):
            node = kind(live=False, context=context, parameter_overrides=overrides)
        try:
            yield node
        finally:
            node.close()
            node.destroy_node()
            context.try_shutdown()


def interfaces(name: str) -> dict[tuple[str, str], str]:
    """(in, out or service; topic) to type of node ``name``."""
    found: dict[tuple[str, str], str] = {}
    for values in SWITCHES.get(name, ({},)):
        with running(node_class(name), values) as node:
            inputs = [('in', item.topic_name, item.msg_type) for item in (*node.subscriptions, *node.lazy)]
            outputs = [('out', item.topic_name, item.msg_type) for item in node.publishers]
            services = [('service', item.srv_name, item.srv_type) for item in node.services]
            for direction, topic, message in inputs + outputs + services:
                if not OF_ALL.fullmatch(node.resolve_topic_name(topic)):
                    relative = re.sub(rf'^(/?{name}|~)/', '~/', topic).removeprefix('/')
                    found[direction, relative] = f'{message.__module__.partition(".")[0]}/{message.__name__}'
    return found


def interface_table(name: str) -> str:
    """Markdown table of a node's topics and services.

    Raises
    ------
    ValueError
        ``doc/interfaces.yaml`` lacks one, or describes one that the node doesn't have.
    """
    described = yaml.safe_load(INTERFACES.read_text(encoding='utf-8'))[name]
    found = interfaces(name)
    # Those of libraries that are on a robot only stand there with their type.
    elsewhere = {
        (direction, topic): entry['type']
        for direction, topics in described.items()
        for topic, entry in topics.items()
        if isinstance(entry, dict)
    }
    there = {(direction, topic) for direction, topics in described.items() for topic in topics}
    if (found | elsewhere).keys() != there:
        raise ValueError(f'{INTERFACES.name}: {name}: differs in {sorted((found | elsewhere).keys() ^ there)}')
    rows = ['| | name | type | meaning |', '|---|---|---|---|']
    for direction, topics in described.items():
        for topic, entry in topics.items():
            text = entry['meaning'] if isinstance(entry, dict) else entry
            rows.append(f'| {direction} | `{topic}` | {(found | elsewhere)[direction, topic]} | {text} |')
    return '\n'.join(rows)


def parameter_table(config: type) -> str:
    """Markdown table of a node's parameters."""
    rows = ['| parameter | default | meaning |', '|---|---|---|']
    for name, item, default in parameters(config):
        limits = item.metadata
        extra = f' One of: {", ".join(filter(None, limits["choices"]))}.' if limits['choices'] else ''
        dynamic = ' Dynamic.' if limits['dynamic'] else ''
        rows.append(f'| `{name}` | `{json.dumps(default)}` | {limits["description"]}{extra}{dynamic} |')
    return '\n'.join(rows)


def launch_arguments(file: Path) -> dict[str, Any]:
    """Name to declaration of the arguments of a launch file, which runs against stand-ins of ``launch``."""
    with pytest.MonkeyPatch.context() as patched, launch_api.installed(patched, ROOT):
        description = runpy.run_path(str(file))['generate_launch_description']()
    declared = [item for item in description.entities if isinstance(item, launch_api.DeclareLaunchArgument)]
    return {item.name: item for item in declared}


def launch_table() -> str:
    """Markdown table of the arguments that all launch files take, with the defaults of each."""
    files = {file.name: launch_arguments(file) for file in sorted((ROOT / 'launch').glob('*.launch.py'))}
    usual = files['localization.launch.py']
    rows = ['| argument | default | meaning |', '|---|---|---|']
    for name, argument in usual.items():
        defaults: dict[str, list[str]] = {argument.default_value: []}
        for file, declared in files.items():
            defaults.setdefault(declared[name].default_value, []).append(f'`{file}`')
        others = [f'`{value}` in {", ".join(of)}' for value, of in list(defaults.items())[1:]]
        default = '; '.join([f'`{argument.default_value}`' if argument.default_value else '', *others])
        rows.append(f'| `{name}` | {default} | {argument.description} |')
    return '\n'.join(rows)


def flights_in_short(measured: str) -> str:
    """Markdown table of the fused poses of some flights, from the measured table of all."""
    rows = [
        '| simulated flight, 7.5 to 13 mm lens, 30 Hz | fused position, rms | largest error | attitude, rms |',
        '|---|---|---|---|',
    ]
    for line in measured.splitlines():
        flight, pose, rms, largest, attitude, *_ = (cell.strip() for cell in line.strip('|').split('|'))
        if pose == 'fused' and flight in IN_SHORT:
            rows.append(f'| {IN_SHORT[flight]} | {rms} | {largest} | {attitude} |')
    return '\n'.join(rows)


def row_layout(dtype: Any) -> str:
    """The fields of a row with their types, one type after another."""
    kinds = {'<f4': 'float32', '<u4': 'uint32', '|u1': 'uint8'}
    fields = [(name, kinds[dtype[name].str]) for name in dtype.names]
    groups = groupby(fields, key=lambda item: item[1])
    return '`' + '; '.join(f'{kind} {" ".join(name for name, _ in group)}' for kind, group in groups) + '`'


def tables() -> dict[str, str]:
    """Name to Markdown of every table that can be made now."""
    measured = {path.stem: path.read_text().strip() for path in sorted((ROOT / 'doc' / 'tables').glob('*.md'))}
    nodes = NODES | OPTIONAL_NODES
    return (
        measured
        | {f'parameters {name}': parameter_table(config) for name, config in nodes.items()}
        | {f'topics {name}': interface_table(name) for name in nodes}
        | {'launch arguments': launch_table(), 'flights in short': flights_in_short(measured['flights'])}
        | {'rows markers': row_layout(MARKER_DTYPE), 'rows marker_map': row_layout(MAP_DTYPE)}
    )


def spliced(text: str, contents: dict[str, str]) -> str:
    """``text`` with each named block replaced."""
    for name, content in contents.items():
        block = re.compile(rf'(<!-- {re.escape(name)} -->\n).*?(<!-- end -->)', re.DOTALL)
        text = block.sub(lambda match, content=content: f'{match[1]}{content}\n{match[2]}', text)
    return text


def pages() -> dict[Path, str]:
    """Text of each page with the tables as they are now."""
    contents = tables()
    return {page: spliced(page.read_text(encoding='utf-8'), contents) for page in PAGES}


if __name__ == '__main__':
    for page, text in pages().items():
        page.write_text(text, encoding='utf-8')
    (ROOT / 'config' / 'thermal_fiducial.yaml').write_text(parameter_file())
