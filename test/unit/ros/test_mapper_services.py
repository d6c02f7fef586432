"""Every service of the mapper, frozen and free, started in either mode; what of it reaches the file and the console."""

from dataclasses import replace
import errno
import multiprocessing
import os
from pathlib import Path
import threading
import time

import pytest
from rclpy.parameter import Parameter
from sensor_msgs.msg import PointCloud2
from std_srvs.srv import SetBool, Trigger
from support.waiting import PATIENCE_S

from thermal_fiducial.core.mapping.map_data import MapMarker, MapperResult, MarkerMap
from thermal_fiducial.files import atomic
from thermal_fiducial.files.atomic import locked
from thermal_fiducial.files.dictionary import load_dictionary, not_in_dictionary, save_dictionary
from thermal_fiducial.files.map_history import autosave_file, entries
from thermal_fiducial.files.map_keeper import MapKeeper
from thermal_fiducial.files.marker_map import load_map, save_map
from thermal_fiducial.nodes.marker_mapper import MarkerMapperNode
from thermal_fiducial.ros.base import qos
from thermal_fiducial.ros.base.node import ERROR, WARN
from thermal_fiducial.ros.mapper_node import map_services, map_status

pytestmark = pytest.mark.ros
MODES = ('mapping', 'localization')
FROZEN = 'the map is frozen'


def ask(graph, name):
    response = graph.call(Trigger, f'marker_mapper/{name}', Trigger.Request())
    return response.success, response.message


def freeze(graph, frozen):
    return graph.call(SetBool, 'marker_mapper/freeze', SetBool.Request(data=frozen)).message


@pytest.mark.parametrize('mode', MODES)
def test_services_depend_on_whether_the_map_is_frozen_and_not_on_the_mode(graph, map_file, mode):
    node = graph.add(MarkerMapperNode, map_file=str(map_file), mode=mode)
    assert node.mapper.frozen == (mode == 'localization')
    for frozen in (True, False, True, False):
        assert freeze(graph, frozen) == ('map frozen' if frozen else 'map free')
        assert node.mapper.frozen == frozen
        before = node.mapper.map.revision
        for name in ('load', 'undo', 'reset', 'refine'):
            success, message = ask(graph, name)
            if frozen:
                assert (success, message) == (False, FROZEN)
        assert (node.mapper.map.revision == before) == frozen
        assert ask(graph, 'save')[0]
        assert load_map(map_file).revision == node.mapper.map.revision


@pytest.mark.parametrize('mode', MODES)
def test_load_undo_and_save_of_a_free_map(graph, map_file, mode):
    """The file is edited by another program, taken over, saved, and both are undone again."""
    node = graph.add(MarkerMapperNode, map_file=str(map_file), mode=mode)
    freeze(graph, False)
    T = load_map(map_file).markers[0].T_map_marker
    edited = load_map(map_file)
    edited.markers[9] = MapMarker(9, 0.3, True, T)
    save_map(map_file, edited)
    # Who saves now would take the edit away, or the edit what was mapped: both are kept.
    success, message = ask(graph, 'save')
    assert success
    assert 'map.new.yaml' in message
    assert load_map(map_file).markers.keys() == {0, 9}
    assert ask(graph, 'load') == (True, f'2 markers loaded from {map_file}')
    assert node.mapper.map.markers.keys() == {0, 9}
    assert ask(graph, 'save')[0]
    assert len(entries(map_file)) == 1
    assert ask(graph, 'undo')[0]
    assert ask(graph, 'undo') == (False, f'{map_file}: no earlier version is kept')
    assert ask(graph, 'reset') == (True, '2 markers left')


def test_a_map_that_begins_empty_names_a_dictionary_file_that_is_beside_it(graph, tmp_path):
    """It had the path of the file, which the rules of maps refuse, and which a folder that is moved leaves behind."""
    own, file = tmp_path / 'rig' / 'own.yaml', tmp_path / 'maps' / 'hall.yaml'
    own.parent.mkdir()
    file.parent.mkdir()
    save_dictionary(own, 'own', load_dictionary('DICT_4X4_50'))
    graph.add(MarkerMapperNode, map_file=str(file), dictionary=str(own))
    assert ask(graph, 'save') == (True, f'0 markers saved to {file}')
    moved = file.parent.rename(tmp_path / 'moved')
    named = load_map(moved / file.name).dictionary
    assert named == own.name
    assert not_in_dictionary([3, 50], named, moved) == [50]
    # A map is saved where its dictionary is on another computer.
    own.unlink()
    file.parent.mkdir()
    saved, message = ask(graph, 'save')
    assert (saved, load_map(file).dictionary) == (True, own.name)
    assert message.startswith(f'0 markers saved to {file}, without its dictionary: {own}: cannot read it: ')


class Flown(MarkerMapperNode):
    """A mapper that can find a marker without a frame."""

    def find(self, marker_id):
        self.mapper.map.markers[marker_id] = replace(self.mapper.map.markers[0], id=marker_id)
        self._map.note_learned()


def test_what_is_found_while_a_disk_is_busy_is_saved_at_the_end(graph, map_file, monkeypatch):
    """The save went on in a thread, and took what was found meanwhile for saved."""
    node, idle = graph.add(Flown, map_file=str(map_file), mode='mapping'), threading.Event()
    node.find(7)
    with monkeypatch.context() as disk:
        disk.setattr(MapKeeper, 'finish', lambda _: idle.wait(PATIENCE_S))
        assert ask(graph, 'save') == (False, f'{map_file}: the disk is busy; this goes on without an answer')
        node.find(9)
        idle.set()
        graph.spin_until(lambda: entries(map_file))
    node.close()
    assert load_map(map_file).markers.keys() == {0, 7, 9}


def test_a_load_holds_no_frame_up_for_another_programs_lock(graph, map_file, monkeypatch):
    """Behind the limited wait it removed the autosave, and waited five seconds for the lock: no pose meanwhile."""
    keepers = []

    class Kept(MapKeeper):
        def __init__(self, *arguments, **options):
            super().__init__(*arguments, **options)
            keepers.append(self)

    monkeypatch.setattr(map_services, 'MapKeeper', Kept)
    monkeypatch.setattr(atomic, 'PATIENCE_S', PATIENCE_S)
    node, (keeper,) = graph.add(MarkerMapperNode, map_file=str(map_file), mode='mapping', autosave_period=0.0), keepers
    # An autosave of a map that counts as saved, as while a save waits for its disk.
    keeper.unsaved = True
    keeper.autosave(node.mapper.map)
    keeper.finish()
    keeper.unsaved = False
    with locked(map_file):
        began = time.monotonic()
        assert ask(graph, 'load') == (False, f'{map_file}: the disk is busy; this goes on without an answer')
        # A second is the patience of services; that for the lock is more than a busy machine needs for all else.
        assert time.monotonic() - began < 0.5 * PATIENCE_S
    assert ask(graph, 'load')[0]
    assert not autosave_file(map_file).exists()


def test_the_autosave_of_a_robot_with_a_namespace_is_its_own(graph, map_file, tmp_path, monkeypatch):
    monkeypatch.setenv('ROS_HOME', str(tmp_path))
    parameters = [Parameter('map_file', value=str(map_file)), Parameter('autosave_period', value=0.05)]
    for space, ending in (('', ''), ('fleet/drone1', '.fleet.drone1')):
        node = Flown(live=True, context=graph.context, namespace=space, parameter_overrides=parameters)
        graph.added(node).find(9)
        graph.spin_until(Path(f'{map_file}.autosave{ending}').exists)
        node.finish()
        node.close()
    assert not list(map_file.parent.glob(f'{map_file.name}.autosave*'))


@pytest.mark.parametrize('name', ['load', 'undo'])
def test_flown_markers_that_a_load_or_undo_replaces_can_be_had_back(graph, map_file, name):
    node = graph.add(Flown, map_file=str(map_file), mode='mapping')
    # What undo undoes.
    assert ask(graph, 'reset')[0]
    assert ask(graph, 'save')[0]
    node.find(9)
    success, message = ask(graph, name)
    aside = map_file.with_name('map.replaced.yaml')
    assert success
    assert message.endswith(f'1 marker loaded from {map_file}; 2 markers before it, unsaved until now, are in {aside}')
    assert node.mapper.map.markers.keys() == {0}
    assert load_map(aside).markers.keys() == {0, 9}


def test_a_map_file_that_was_mended_and_loaded_is_no_fault_any_more(graph, map_file):
    text = map_file.read_text()
    map_file.write_text('markers: [')
    node = graph.add(MarkerMapperNode, map_file=str(map_file), mode='mapping')
    assert not ask(graph, 'load')[0]
    level, reason, _ = graph.diagnose(node)
    assert (level, 'not valid YAML' in reason) == (ERROR, True)
    map_file.write_text(text)
    assert ask(graph, 'load')[0]
    assert graph.diagnose(node)[:2] == (WARN, 'nothing on markers')


def test_a_full_disk_at_undo_costs_neither_the_map_nor_its_history_nor_the_node(graph, map_file, monkeypatch):
    node = graph.add(MarkerMapperNode, map_file=str(map_file), mode='mapping')
    node.mapper.map.markers[9] = replace(node.mapper.map.markers[0], id=9)
    assert ask(graph, 'save')[0]
    saved, files = map_file.read_bytes(), sorted(map_file.parent.rglob('*'))

    def full(descriptor):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as disk:
        disk.setattr(os, 'fsync', full)
        success, message = ask(graph, 'undo')
        assert not success
        assert message.count('\n') == 0
        assert str(map_file) in message
        assert 'No space left on device' in message
        assert map_file.read_bytes() == saved
        assert sorted(map_file.parent.rglob('*')) == files
        assert node.mapper.map.markers.keys() == {0, 9}
    assert ask(graph, 'undo')[0]
    assert load_map(map_file).markers.keys() == node.mapper.map.markers.keys() == {0}


@pytest.mark.parametrize('mode', MODES)
def test_a_free_mapper_refines_in_a_process_of_its_own_in_either_mode(graph, map_file, tmp_path, monkeypatch, mode):
    # The next mapper would begin free as this one is set here.
    monkeypatch.setenv('ROS_HOME', str(tmp_path))
    before = set(multiprocessing.active_children())
    node = graph.add(MarkerMapperNode, live=True, map_file=str(map_file), mode=mode)
    try:
        assert bool(set(multiprocessing.active_children()) - before) == (mode == 'mapping')
        freeze(graph, False)
        assert len(set(multiprocessing.active_children()) - before) == 1
    finally:
        node.close()
    assert set(multiprocessing.active_children()) == before


@pytest.mark.parametrize(
    ('name', 'words'), [('a' * 300 + '.yaml', 'File name too long'), ('/', '/: is a folder, not a file')]
)
def test_a_map_file_with_a_name_that_no_file_can_have_is_a_fault_and_the_node_ends_in_order(graph, name, words):
    node = graph.add(MarkerMapperNode, map_file=name)
    assert words in graph.diagnose(node)[1]
    node.close()


def test_the_map_is_published_again_when_a_service_has_replaced_it(graph, map_file):
    graph.listen(PointCloud2, 'marker_map', qos.LATCHED)
    graph.add(MarkerMapperNode, map_file=str(map_file))
    graph.spin_until(lambda: len(graph.heard['marker_map']) == 1)
    assert ask(graph, 'reset')[0]
    graph.spin_until(lambda: len(graph.heard['marker_map']) == 2)


def test_a_quarantined_marker_is_named_with_its_reason_once():
    before = MapperResult(1, None, '', quarantine_reasons={3: 'old'})
    now = MapperResult(2, None, '', quarantine_reasons={3: 'old', 7: '9.1 px off, 12.3 sigma'})
    assert map_status.news(before, now) == {7: 'marker 7 quarantined: 9.1 px off, 12.3 sigma'}
    assert map_status.news(now, before) == {7: 'marker 7 is trusted again'}
    assert map_status.state(now, '', frozen=False)[1] == 'quarantined: 3, 7'
    assert map_status.figures(MarkerMap(), 0, now, 0.0)['quarantine'] == '3: old; 7: 9.1 px off, 12.3 sigma'
