"""The documents say what the code does, and stay short."""

from dataclasses import fields
from importlib import import_module
from pathlib import Path
import re
import shlex

import documents
import pytest

from thermal_fiducial.cli.main import COMMANDS, MODULES
from thermal_fiducial.cli.parser import Parser
from thermal_fiducial.config import NODES, OPTIONAL_NODES
from thermal_fiducial.core.filter.state import SIZE
from thermal_fiducial.files.map_format import MapDocument, MarkerEntry

ROOT = Path(__file__).resolve().parents[3]
README = ROOT / 'README.md'
LINK = re.compile(r'\]\(([^)#\s]+)')
#: A link to a heading, of the same page if it names no file.
TO_HEADING = re.compile(r'\]\(((?!\w+:)[^)#\s]*)#([^)\s]+)\)')
PAGES = [README, *sorted((ROOT / 'doc').rglob('*.md'))]


#: Pages that say where things are in the code.
MAPS_OF_THE_CODE = [ROOT / 'doc' / f'{name}.md' for name in ('CONTRIBUTING', 'design', 'mechanisms')]
SOURCES = [path for folder in ('thermal_fiducial', 'test') for path in (ROOT / folder).rglob('*.py')]


def sources_named(name):
    """The files whose path ends with ``name``."""
    return [path for path in SOURCES if f'/{path.relative_to(ROOT)}'.endswith(f'/{name}')]


@pytest.mark.parametrize('page', MAPS_OF_THE_CODE, ids=lambda page: page.stem)
def test_the_design_names_files_that_are_there(page):
    named = set(re.findall(r'`?([\w/]+\.py)\b', page.read_text(encoding='utf-8')))
    assert named
    assert [name for name in sorted(named) if not sources_named(name)] == []


@pytest.mark.parametrize('folder', ['core', 'core/mapping'])
def test_the_design_lists_each_module(folder):
    listed = set(re.findall(r'(?m)^(\w+)\.py ', MAPS_OF_THE_CODE[1].read_text(encoding='utf-8')))
    modules = {path.stem for path in (ROOT / 'thermal_fiducial' / folder).glob('*.py')} - {'__init__'}
    assert sorted(modules - listed) == []


def test_what_to_open_names_functions_of_these_files():
    page = (ROOT / 'doc' / 'CONTRIBUTING.md').read_text(encoding='utf-8')
    pairs = re.findall(r'`([\w/]+\.py)` \(([^)]*)\)', page)
    named = [(file, word) for file, words in pairs for word in re.findall(r'`(\w+)`', words)]
    assert len(named) > 10
    code = {file: '\n'.join(path.read_text(encoding='utf-8') for path in sources_named(file)) for file, _ in named}
    assert [f'{file}: {word}' for file, word in named if not re.search(rf'\b{word}\b', code[file])] == []


def test_the_design_names_functions_that_are_there():
    design, contributing = (page.read_text(encoding='utf-8') for page in (MAPS_OF_THE_CODE[1], MAPS_OF_THE_CODE[0]))
    to_open = contributing.partition('\n## To change')[2].partition('\n## ')[0]
    named = set(re.findall(r'`(\w+)`', design.partition('## Conventions')[0] + to_open))
    assert len(named) > 80
    code = '\n'.join(file.read_text(encoding='utf-8') for file in (ROOT / 'thermal_fiducial').rglob('*.py'))
    words = set(re.findall(r'\w+', code)) | {file.stem for file in (ROOT / 'test').rglob('*.py')}
    assert sorted(named - words) == []


def test_make_help_lists_every_target():
    makefile = (ROOT / 'Makefile').read_text(encoding='utf-8')
    targets = set(re.findall(r'(?m)^([a-z]+):', makefile)) - {'help'}
    assert set(re.findall(r'(?m)^# make (\w+)', makefile)) == targets
    (phony,) = re.findall(r'(?m)^\.PHONY:((?:.*\\\n)*.*)$', makefile)
    assert set(phony.replace('\\', '').split()) == targets | {'help'}


def test_the_drawing_of_the_data_flow_is_one():
    drawings = [
        block
        for page in PAGES
        for block in re.findall(r'^```\w*\n(.*?)^```$', page.read_text(encoding='utf-8'), re.DOTALL | re.MULTILINE)
        if '──►' in block
    ]
    assert len(drawings) == 2, 'one in the README and one in the design'
    assert len(set(drawings)) == 1


@pytest.mark.ros
def test_tables_are_up_to_date():
    # They are made anew by: make tables
    for page, text in documents.pages().items():
        assert page.read_text(encoding='utf-8') == text


def test_each_measured_table_is_on_a_page():
    pages = ''.join(page.read_text(encoding='utf-8') for page in documents.PAGES)
    missing = [path.stem for path in (ROOT / 'doc' / 'tables').glob('*.md') if f'<!-- {path.stem} -->' not in pages]
    assert missing == []


@pytest.mark.parametrize('node', NODES | OPTIONAL_NODES)
def test_each_node_is_on_the_page(node):
    page = (ROOT / 'doc' / 'nodes.md').read_text(encoding='utf-8')
    assert all(f'<!-- {table} {node} -->' in page for table in ('topics', 'parameters'))


def test_the_arguments_of_the_launch_files_are_on_the_page():
    page = (ROOT / 'doc' / 'install.md').read_text(encoding='utf-8')
    assert f'<!-- launch arguments -->\n{documents.launch_table()}\n<!-- end -->' in page


def test_the_fields_of_a_map_file_are_on_the_page():
    page = (ROOT / 'doc' / 'maps.md').read_text(encoding='utf-8')
    (section,) = re.findall(r'^## Fields of a map file$(.*?)^## ', page, re.DOTALL | re.MULTILINE)
    described = re.findall(r'^\| `(\w+)` \|', section, re.MULTILINE)
    assert sorted(described) == sorted(
        ['format', 'version', *(field.name for kind in (MapDocument, MarkerEntry) for field in fields(kind))]
    )


def test_the_error_coordinates_of_the_filter_are_on_the_page():
    page = (ROOT / 'doc' / 'nodes.md').read_text(encoding='utf-8')
    (section,) = re.findall(r'^\| estimated \| coordinates \|.*?^$', page, re.DOTALL | re.MULTILINE)
    counts = [int(count) for count in re.findall(r'^\| [^|]+ \| (\d+) \|', section, re.MULTILINE)]
    assert sum(counts) == SIZE
    assert f'{SIZE} error coordinates' in page


def test_the_page_of_examples_shows_each_script():
    page = (ROOT / 'doc' / 'examples.md').read_text()
    for script in (ROOT / 'doc' / 'examples').glob('*.py'):
        # What the site replaces by the script: a formatter once put it apart.
        assert f"\n--8<-- 'doc/examples/{script.name}'\n" in page


def test_the_readme_is_short():
    assert len(README.read_text().splitlines()) <= 150


@pytest.mark.parametrize('page', PAGES, ids=lambda page: page.name)
def test_links_lead_to_files(page):
    links = [link for link in LINK.findall(page.read_text(encoding='utf-8')) if '://' not in link]
    missing = [link for link in links if not (page.parent / link).exists()]
    assert missing == []


def anchors(page):
    """Names of the headings of a page, as the site and GitHub make them."""
    headings = re.findall(r'^#+ (.+)$', page.read_text(encoding='utf-8'), re.MULTILINE)
    return {re.sub(r'\s+', '-', re.sub(r'[^\w\s-]', '', heading).strip().lower()) for heading in headings}


@pytest.mark.parametrize('page', PAGES, ids=lambda page: page.name)
def test_links_to_headings_lead_to_some(page):
    links = TO_HEADING.findall(page.read_text(encoding='utf-8'))
    missing = [f'{to}#{name}' for to, name in links if name not in anchors(page.parent / to if to else page)]
    assert missing == []


def test_the_list_of_decisions_has_each_once_and_says_what_revises_it():
    records = sorted((ROOT / 'doc' / 'decisions').glob('[0-9]*.md'))
    lines = (ROOT / 'doc' / 'decisions' / 'index.md').read_text(encoding='utf-8').splitlines()
    listed = {line.split('](')[1].split(')')[0]: line for line in lines if line.startswith('- [')}
    assert sorted(listed) == [record.name for record in records]
    assert len(listed) == sum(line.startswith('- [') for line in lines)
    for record in records:
        title, _, opening = record.read_text(encoding='utf-8').split('\n', 3)[:3]
        assert f'[{title.removeprefix("# ")}]' in listed[record.name]
        if re.match('Revises|Supersedes|Replaces', opening):
            first = re.search(r'\]\((\d{4}-[^)]+)\)', opening)
            assert f'({record.name})' in listed[first[1]].split('; revised by')[1]


def test_the_groups_of_decisions_say_what_holds_and_are_in_order():
    text = (ROOT / 'doc' / 'decisions' / 'index.md').read_text(encoding='utf-8')
    for group in text.split('\n## ')[1:]:
        numbers = [int(number) for number in re.findall(r'^- \[(\d+)\. ', group, re.MULTILINE)]
        assert numbers == sorted(numbers)
        holds = set(map(int, re.findall(r'\[(\d+)\]', group.partition('\n- [')[0])))
        assert holds
        assert holds <= {int(path.name[:4]) for path in (ROOT / 'doc' / 'decisions').glob('[0-9]*.md')}


def shown(program):
    """Words after ``program`` of each line of the documents that runs it."""
    found = []
    for page in PAGES:
        for block in re.findall(r'^ *```\w*\n(.*?)^ *```$', page.read_text(encoding='utf-8'), re.DOTALL | re.MULTILINE):
            lines = block.replace('\\\n', ' ').splitlines()
            calls = [line.split(program, 1)[1] for line in lines if line.lstrip().startswith(program)]
            found += [pytest.param(shlex.split(call, comments=True), id=f'{page.stem}: {call}') for call in calls]
    return found


@pytest.mark.parametrize('words', shown('thermal-fiducial '))
def test_commands_in_the_documents_are_understood(words):
    command, *arguments = words
    assert command in COMMANDS
    parser = Parser()
    import_module(f'thermal_fiducial.cli.{MODULES.get(command, command.replace("-", "_"))}').add_arguments(parser)
    assert parser.parse_args(arguments)
