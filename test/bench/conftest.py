"""What the benchmarks share."""

from functools import partial
from importlib.util import find_spec
from pathlib import Path

import pytest

#: Without pytest-benchmark there is nothing to measure with, and its marker is unknown.
collect_ignore_glob = [] if find_spec('pytest_benchmark') else ['test_*.py']

ROOT = Path(__file__).resolve().parents[2]
TABLES = ROOT / 'doc' / 'tables'


@pytest.fixture
def write_table(request):
    """Write rows of cells, the first one the head, as ``NAME.md`` for the documents; only benchmarks proper do.

    Tables that need recordings, which not everybody has, are on no page: they go to ``build/tables``.
    """
    if not request.config.getoption('benchmark_only'):
        pytest.skip('a measurement of minutes: make bench')

    def write(name, rows, folder=TABLES):
        head, *body = rows
        lines = [head, ['---'] * len(head), *body]
        folder.mkdir(parents=True, exist_ok=True)
        (folder / f'{name}.md').write_text(''.join(f'| {" | ".join(cells)} |\n' for cells in lines))

    return write


@pytest.fixture
def write_recorded(write_table):
    """The same for figures of recordings."""
    return partial(write_table, folder=ROOT / 'build' / 'tables')
