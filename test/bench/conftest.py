"""What the benchmarks share."""

from importlib.util import find_spec
from pathlib import Path

import pytest

#: Without pytest-benchmark there is nothing to measure with, and its marker is unknown.
collect_ignore_glob = [] if find_spec('pytest_benchmark') else ['test_*.py']

TABLES = Path(__file__).resolve().parents[2] / 'doc' / 'tables'


@pytest.fixture
def write_table(request):
    """Write rows of cells, the first one the head, as ``doc/tables/NAME.md``; only benchmarks proper do."""
    if not request.config.getoption('benchmark_only'):
        pytest.skip('a measurement of minutes: make bench')

    def write(name, rows):
        head, *body = rows
        lines = [head, ['---'] * len(head), *body]
        TABLES.mkdir(parents=True, exist_ok=True)
        (TABLES / f'{name}.md').write_text(''.join(f'| {" | ".join(cells)} |\n' for cells in lines))

    return write
