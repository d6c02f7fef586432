"""The layouts for Foxglove and RViz show topics that the nodes publish, and are installed."""

import json
from pathlib import Path
import re
import runpy
import sys

import numpy as np
import pytest
from rosbags.interfaces import Nodetype
from rosbags.typesys import get_typestore, Stores
import yaml

from thermal_fiducial.config import NODES
from thermal_fiducial.ros.base.node import ERROR, OK, WARN
from thermal_fiducial.ros.messages import convert

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
    'annotations': {'foxglove_msgs/ImageAnnotations'},
    'topicToRender': {'diagnostic_msgs/DiagnosticArray'},
}  # fmt: skip


@pytest.fixture(scope='module')
def kind_of():
    """Topic to message type, as the documents list what is published."""
    rows = re.findall(r'\| out \| `([^`]+)` \| (\w+/\w+) \|', (ROOT / 'doc' / 'nodes.md').read_text())
    return {f'/{topic.strip("/")}': kind for topic, kind in rows} | {'/diagnostics': 'diagnostic_msgs/DiagnosticArray'}


@pytest.fixture(scope='module')
def described():
    """Topic to its description in the documents, of those that the nodes publish."""
    nodes = yaml.safe_load((ROOT / 'doc' / 'interfaces.yaml').read_text())
    return {f'/{topic.strip("/")}': text for node in nodes.values() for topic, text in node.get('out', {}).items()}


@pytest.fixture(scope='module')
def published(described):
    """Topics that the documents list as published."""
    return {*described, '/diagnostics'}


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
    assert {'3D', 'Image', 'Plot', 'DiagnosticSummary', 'StateTransitions'} <= set(kinds)


def test_foxglove_shows_path_map_covariances_and_detections(published):
    panels = json.loads(LAYOUT.read_text())['configById']
    space = panels['3D!map']
    assert {'/path', '/marker_map/markers', '/pose', '/camera_pose'} <= space['topics'].keys() <= published
    assert all(space['topics'][topic]['showCovariance'] for topic in ('/pose', '/camera_pose'))
    overlaid, drawn = (panels[name]['imageMode'] for name in ('Image!camera', 'Image!drawn'))
    assert overlaid['annotations'] == {'/thermal/image_annotations': {'visible': True}}
    topics = {overlaid['imageTopic'], drawn['imageTopic'], *overlaid['annotations']}
    paths = [path['value'] for panel in panels.values() for path in panel.get('paths', [])]
    topics |= {re.match(r'/\w+', path)[0] for path in paths} | {panels['DiagnosticSummary!nodes']['topicToRender']}
    assert topics <= published


def test_foxglove_s_panels_can_draw_what_the_topics_are(kind_of):
    panels = json.loads(LAYOUT.read_text())['configById']
    assert {kind_of[topic] for topic in panels['3D!map']['topics']} <= KINDS['3D!map']
    for name in ('Image!camera', 'Image!drawn'):
        mode = panels[name]['imageMode']
        assert kind_of[mode['imageTopic']] in KINDS['imageTopic']
        assert {kind_of[topic] for topic in mode.get('annotations', {})} <= KINDS['annotations']
    assert kind_of[panels['DiagnosticSummary!nodes']['topicToRender']] in KINDS['topicToRender']


def test_the_curves_of_foxglove_are_fields_of_the_messages(kind_of):
    fields = get_typestore(Stores.ROS2_JAZZY).fielddefs
    panels = json.loads(LAYOUT.read_text())['configById']
    curves = [path['value'] for name, panel in panels.items() if name.startswith('Plot') for path in panel['paths']]
    assert curves
    for curve in curves:
        topic, *names = re.sub(r'\[\d+\](\.@sqrt)?$', '', curve).split('.')
        package, name = kind_of[topic].split('/')
        kind = (Nodetype.NAME, f'{package}/msg/{name}')
        for field in names:
            kind = dict(fields[kind[1]][1])[field]
        element = kind[1][0] if kind[0] == Nodetype.ARRAY else kind
        assert element == (Nodetype.BASE, ('float64', 0)), curve


def test_foxglove_draws_standard_deviations():
    """Variances were near 1e-6 m^2, with 17 digits in the legend, and the start of a flight hid all that came after."""
    panel = json.loads(LAYOUT.read_text())['configById']['Plot!deviation']
    assert panel['foxglovePanelTitle'] == 'Standard deviation of the position [m]'
    assert [path['value'] for path in panel['paths']] == [
        f'/odometry.pose.covariance[{place}].@sqrt' for place in np.ravel_multi_index(([0, 1, 2], [0, 1, 2]), (6, 6))
    ]


def test_foxglove_shows_at_a_glance_whether_the_pose_may_be_flown_on():
    """The level of the filter over time, and the row of the filter first; a row without news becomes stale."""
    panels = json.loads(LAYOUT.read_text())['configById']
    name = 'pose_ekf'
    assert name in NODES
    (status,) = convert.diagnostics(name, OK, '', {}, 0).status
    (state,) = panels['StateTransitions!pose']['paths']
    assert state['value'] == f'/diagnostics.status[:]{{name=="{status.name}"}}.level'
    labels = {entry['value']: entry['label'] for entry in state['customStates']['states']}
    title = panels['StateTransitions!pose']['foxglovePanelTitle']
    assert title == 'Pose: ' + ', '.join(f'{level} {label}' for level, label in labels.items())
    assert list(labels) == [str(level[0]) for level in (OK, WARN, ERROR)]
    rows = panels['DiagnosticSummary!nodes']
    assert rows['pinnedIds'] == [f'|{status.hardware_id}|{status.name}|']
    # Diagnostics come once a second; a late one must not make a row stale.
    assert 1 < rows['secondsUntilStale'] <= 3


def test_the_image_that_foxglove_opens_with_needs_no_parameter(described):
    """Outlines that need ``image_annotations: true`` were in the first tab, which showed none with the defaults."""
    panels = json.loads(LAYOUT.read_text())['configById']
    tab = panels['Tab!image']
    shown = panels[tab['tabs'][tab['activeTabIdx']]['layout']]['imageMode']
    description = described[shown['imageTopic']]
    assert 'outlines' in description
    assert ': true`' not in description
    assert 'annotations' not in shown


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
        elif kind == 'StateTransitions':
            (path,) = settings['paths']
            custom = path['customStates']
            assert custom['type'] == 'discrete'
            states = [made(library, 'StateTransitionsDiscreteCustomState', state) for state in custom['states']]
            states = library.StateTransitionsDiscreteCustomStates(states=states)
            paths = [made(library, 'StateTransitionsSeries', path, customStates=states)]
            config = made(library, 'StateTransitionsConfig', settings, paths=paths)
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


def test_images_are_shown_as_they_are_published():
    """With a calibration Studio rectifies the image, not the outlines; it shows none behind an ``equidistant`` lens."""
    panels = json.loads(LAYOUT.read_text())['configById']
    for name in ('Image!camera', 'Image!drawn'):
        assert panels[name]['imageMode']['rectifyImage'] is False
        assert 'calibrationTopic' not in panels[name]['imageMode']


def test_rviz_shows_published_topics(published):
    displays = yaml.safe_load(RVIZ.read_text())['Visualization Manager']['Displays']
    topics = {f'/{entry["Topic"]["Value"].strip("/")}' for entry in displays if entry.get('Topic', {}).get('Value')}
    assert topics
    assert topics <= published


def test_rviz_hears_what_is_latched():
    """A volatile subscriber that comes after the map and its cloud were published gets neither."""
    displays = yaml.safe_load(RVIZ.read_text())['Visualization Manager']['Displays']
    latched = [
        entry['Topic'] for entry in displays if entry.get('Topic', {}).get('Value', '').startswith('marker_map/')
    ]
    assert [topic['Value'] for topic in latched] == ['marker_map/markers', 'marker_map/cloud']
    assert {topic['Durability Policy'] for topic in latched} == {'Transient Local'}


def test_both_are_installed(monkeypatch):
    given = {}
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr(sys, 'argv', ['setup.py', '--version'])
    monkeypatch.setattr('setuptools.setup', lambda **arguments: given.update(arguments))
    runpy.run_path('setup.py')
    installed = {path for _, paths in given['data_files'] for path in paths}
    assert {f'config/{path.name}' for path in (LAYOUT, RVIZ)} <= installed
