"""The layouts for Foxglove and RViz show topics that the nodes publish, and are installed."""

import json
from pathlib import Path
import re
import runpy
import sys

import pytest
from rosbags.interfaces import Nodetype
from rosbags.typesys import get_typestore, Stores
import yaml

ROOT = Path(__file__).resolve().parents[3]
LAYOUT = ROOT / 'config' / 'thermal_fiducial_foxglove.json'
RVIZ = ROOT / 'config' / 'thermal_fiducial.rviz'


#: Settings in a layout's file that panels have, or had in earlier versions, beside those of Foxglove's own library.
BESIDE = ('foxglovePanelTitle', 'cameraState', 'followMode', 'publish')
#: What the panels draw.
KINDS = {
    '3D!map': {
        'nav_msgs/Path', 'geometry_msgs/PoseWithCovarianceStamped', 'sensor_msgs/PointCloud2',
        'visualization_msgs/MarkerArray',
    },
    'imageTopic': {'sensor_msgs/Image'},
    'calibrationTopic': {'sensor_msgs/CameraInfo'},
    'annotations': {'foxglove_msgs/ImageAnnotations'},
    'topicToRender': {'diagnostic_msgs/DiagnosticArray'},
}  # fmt: skip


@pytest.fixture(scope='module')
def kind_of():
    """Topic to message type, as the documents list what is published."""
    rows = re.findall(r'\| out \| `([^`]+)` \| (\w+/\w+) \|', (ROOT / 'doc' / 'nodes.md').read_text())
    return {f'/{topic.strip("/")}': kind for topic, kind in rows} | {'/diagnostics': 'diagnostic_msgs/DiagnosticArray'}


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


def test_foxglove_s_panels_can_draw_what_the_topics_are(kind_of):
    panels = json.loads(LAYOUT.read_text())['configById']
    assert {kind_of[topic] for topic in panels['3D!map']['topics']} <= KINDS['3D!map']
    for name in ('Image!camera', 'Image!drawn'):
        mode = panels[name]['imageMode']
        for key in ('imageTopic', 'calibrationTopic'):
            assert key not in mode or kind_of[mode[key]] in KINDS[key]
        assert {kind_of[topic] for topic in mode.get('annotations', {})} <= KINDS['annotations']
    assert kind_of[panels['DiagnosticSummary!nodes']['topicToRender']] in KINDS['topicToRender']


def test_the_curves_of_foxglove_are_fields_of_the_messages(kind_of):
    fields = get_typestore(Stores.ROS2_JAZZY).fielddefs
    panels = json.loads(LAYOUT.read_text())['configById']
    curves = [path['value'] for name, panel in panels.items() if name.startswith('Plot') for path in panel['paths']]
    assert curves
    for curve in curves:
        topic, *names = re.split(r'\.', re.sub(r'\[\d+\]$', '', curve))
        package, name = kind_of[topic].split('/')
        kind = (Nodetype.NAME, f'{package}/msg/{name}')
        for field in names:
            kind = dict(fields[kind[1]][1])[field]
        element = kind[1][0] if kind[0] == Nodetype.ARRAY else kind
        assert element == (Nodetype.BASE, ('float64', 0)), curve


def made(library, name, settings, **parts):
    """What Foxglove's own library writes for settings; it refuses those that it does not know."""
    given = settings | parts
    return getattr(library, name)(
        **{re.sub('[A-Z]', lambda letter: f'_{letter[0].lower()}', key): value for key, value in given.items()}
    )


DRAWN_AS = {
    'nav_msgs/Path': 'Poses',
    'geometry_msgs/PoseWithCovarianceStamped': 'Pose',
    'sensor_msgs/PointCloud2': 'PointCloud',
    'visualization_msgs/MarkerArray': 'RosMarker',
}


def test_foxglove_s_own_library_knows_every_setting(kind_of):
    library = pytest.importorskip('foxglove.layouts')
    panels = json.loads(LAYOUT.read_text())['configById']
    for name, panel in panels.items():
        kind = name.partition('!')[0]
        settings = {key: value for key, value in panel.items() if kind == '3D' or key not in BESIDE}
        if kind == 'Plot':
            paths = [made(library, 'PlotSeries', path) for path in settings['paths']]
            config = made(library, 'PlotConfig', settings, paths=paths)
        elif kind == 'DiagnosticSummary':
            config = made(library, 'DiagnosticsSummaryConfig', settings)
        elif kind == 'Image':
            notes = settings['imageMode'].get('annotations', {})
            annotations = {topic: made(library, 'ImageAnnotationSettings', note) for topic, note in notes.items()}
            parts = {'annotations': annotations} if annotations else {}
            mode = made(library, 'ImageModeConfig', settings['imageMode'], **parts)
            config = made(library, 'ImageConfig', settings, imageMode=mode)
        elif kind == '3D':
            camera = made(library, 'ThreeDeeCameraState', settings['cameraState'])
            grid = made(library, 'BaseRendererGridLayerSettings', settings['layers']['grid'])
            config = made(library, 'ThreeDeeConfig', settings, cameraState=camera, layers={'grid': grid})
            for topic, given in settings['topics'].items():
                made(library, f'BaseRenderer{DRAWN_AS[kind_of[topic]]}TopicSettings', given)
        else:
            continue
        assert json.loads(config.to_json()) == settings, name


def test_annotations_lie_on_the_image_as_it_is_published():
    """Corners are those of the raw image: where a panel rectifies it, they would lie beside the markers."""
    panels = json.loads(LAYOUT.read_text())['configById']
    assert all(panels[name]['imageMode']['rectifyImage'] is False for name in ('Image!camera', 'Image!drawn'))


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
