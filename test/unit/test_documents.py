"""The documents say what the code does, and stay short."""

from pathlib import Path
import re

import documents
import pytest

from thermal_fiducial.config import NODES, OPTIONAL_NODES

ROOT = Path(__file__).resolve().parents[2]
README = ROOT / 'README.md'
LINK = re.compile(r'\]\(([^)#\s]+)')


@pytest.mark.ros
def test_tables_are_up_to_date():
    # They are made anew by: make tables
    for page, text in documents.pages().items():
        assert page.read_text(encoding='utf-8') == text


@pytest.mark.parametrize('node', NODES | OPTIONAL_NODES)
def test_each_node_is_on_the_page(node):
    page = (ROOT / 'doc' / 'nodes.md').read_text(encoding='utf-8')
    assert all(f'<!-- {table} {node} -->' in page for table in ('topics', 'parameters'))


def test_the_readme_is_short():
    assert len(README.read_text().splitlines()) <= 150


@pytest.mark.parametrize('page', [README, *sorted((ROOT / 'doc').rglob('*.md'))], ids=lambda page: page.name)
def test_links_lead_to_files(page):
    links = [link for link in LINK.findall(page.read_text(encoding='utf-8')) if '://' not in link]
    missing = [link for link in links if not (page.parent / link).exists()]
    assert missing == []
