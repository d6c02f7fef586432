"""The layouts for Foxglove and RViz show topics that the nodes publish, and are installed."""

import json
from pathlib import Path
import re
import runpy
import sys

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[2]
LAYOUT = ROOT / 'config' / 'thermal_fiducial_foxglove.json'
RVIZ = ROOT / 'config' / 'thermal_fiducial.rviz'


@pytest.fixture(scope='module')
def published():
    """Topics that the documents list as published."""
    nodes = yaml.safe_load((ROOT / 'doc' / 'interfaces.yaml').read_text())
    return {f'/{topic.strip("/")}' for node in nodes.values() for topic in node.get('out', {})} | {'/diagnostics'}


def panels(place):
    """Names of the panels of a layout, whatever splits it."""
    if isinstance(place, str):
        yield place
    elif place:
        yield from panels(place['first'])
        yield from panels(place['second'])


def test_the_panels_of_foxglove_are_those_that_are_configured():
    layout = json.loads(LAYOUT.read_text())
    shown = list(panels(layout['layout']))
    for name in list(shown):
        shown += [tab['layout'] for tab in layout['configById'][name].get('tabs', [])]
    assert sorted(shown) == sorted(layout['configById'])
    kinds = [name.partition('!')[0] for name in shown]
    assert {'3D', 'Image', 'Plot', 'DiagnosticSummary'} <= set(kinds)


def test_foxglove_shows_path_map_covariances_and_detections(published):
    panels = json.loads(LAYOUT.read_text())['configById']
    space = panels['3D!map']
    assert {'/path', '/marker_map/markers', '/pose', '/camera_pose'} <= space['topics'].keys() <= published
    assert all(space['topics'][topic]['showCovariance'] for topic in ('/pose', '/camera_pose'))
    overlaid, drawn = (panels[name]['imageMode'] for name in ('Image!camera', 'Image!drawn'))
    assert overlaid['annotations'] == {'/thermal/image_annotations': {'visible': True}}
    topics = {overlaid['imageTopic'], overlaid['calibrationTopic'], drawn['imageTopic'], *overlaid['annotations']}
    paths = [path['value'] for name, panel in panels.items() if name.startswith('Plot') for path in panel['paths']]
    topics |= {re.match(r'/\w+', path)[0] for path in paths} | {panels['DiagnosticSummary!nodes']['topicToRender']}
    assert topics <= published


def test_rviz_shows_published_topics(published):
    displays = yaml.safe_load(RVIZ.read_text())['Visualization Manager']['Displays']
    topics = {f'/{entry["Topic"]["Value"].strip("/")}' for entry in displays if entry.get('Topic', {}).get('Value')}
    assert topics
    assert topics <= published


def test_both_are_installed(monkeypatch):
    given = {}
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr(sys, 'argv', ['setup.py', '--version'])
    monkeypatch.setattr('setuptools.setup', lambda **arguments: given.update(arguments))
    runpy.run_path('setup.py')
    installed = {path for _, paths in given['data_files'] for path in paths}
    assert {f'config/{path.name}' for path in (LAYOUT, RVIZ)} <= installed
