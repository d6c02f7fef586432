"""Regenerates the tables of the documents and the parameter file: ``python test/bench/readme.py`` (``make tables``).

A table stands between ``<!-- NAME -->`` and ``<!-- end -->``. Parameters come from ``config.py``; measured tables
from the Markdown files that the benchmarks leave in ``doc/tables/``.
"""

import json
from pathlib import Path
import re

from thermal_fiducial.config import NODES, OPTIONAL_NODES, parameters
from thermal_fiducial.ros.parameter_file import parameter_file

ROOT = Path(__file__).resolve().parents[2]
PAGES = (ROOT / 'doc' / 'accuracy.md', ROOT / 'doc' / 'nodes.md')


def parameter_table(config: type) -> str:
    """Markdown table of a node's parameters."""
    rows = ['| parameter | default | meaning |', '|---|---|---|']
    for name, item, default in parameters(config):
        limits = item.metadata
        extra = f' One of: {", ".join(limits["choices"])}.' if limits['choices'] else ''
        live = ' Live.' if limits['live'] else ''
        rows.append(f'| `{name}` | `{json.dumps(default)}` | {limits["description"]}{extra}{live} |')
    return '\n'.join(rows)


def tables() -> dict[str, str]:
    """Name to Markdown of every table that can be made now."""
    measured = {path.stem: path.read_text().strip() for path in sorted((ROOT / 'doc' / 'tables').glob('*.md'))}
    nodes = NODES | OPTIONAL_NODES
    return measured | {f'parameters {name}': parameter_table(config) for name, config in nodes.items()}


def spliced(text: str, contents: dict[str, str]) -> str:
    """``text`` with each named block replaced."""
    for name, content in contents.items():
        block = re.compile(rf'(<!-- {re.escape(name)} -->\n).*?(<!-- end -->)', re.DOTALL)
        text = block.sub(lambda match, content=content: f'{match[1]}{content}\n{match[2]}', text)
    return text


if __name__ == '__main__':
    contents = tables()
    for page in PAGES:
        page.write_text(spliced(page.read_text(), contents))
    (ROOT / 'config' / 'thermal_fiducial.yaml').write_text(parameter_file())
