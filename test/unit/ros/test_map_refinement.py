"""The last refinement of a flight: with its last keyframes, before the map is saved, and never waited for in vain."""

import itertools
import multiprocessing
import os
import signal
import time

import numpy as np
import pytest
from std_srvs.srv import Trigger
from support.messages import info
from support.waiting import PATIENCE_S
from support.walls import CAMERA, flight, see, SIZE, stamp, wall

from thermal_fiducial.config import MarkerMapperConfig
from thermal_fiducial.core.mapping.map_data import MapMarker, MarkerMap
from thermal_fiducial.core.mapping.mapper import MarkerMapper
from thermal_fiducial.core.measurements import MARKER_DTYPE
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.marker_map import load_map, save_map
from thermal_fiducial.nodes.marker_mapper import MarkerMapperNode
from thermal_fiducial.ros.mapper_node import map_services
from thermal_fiducial.ros.mapper_node.map_refinement import MapRefinement
from thermal_fiducial.ros.messages import clouds, convert

#: Corner noise [px]: markers placed in flight, unrefined, are then 31 mm off (rms); 7 mm once they are refined.
NOISE_PX = 0.2
FRAMES = range(0, 120, 3)
#: Error of the refined map over that of the map in flight: twice what it is.
BETTER = 0.5
#: A frame without a marker.
NOTHING = np.zeros(0, MARKER_DTYPE)


def rows_of_flight(poses):
    rng = np.random.default_rng(3)
    return [see(flight(k / 30), poses, NOISE_PX, rng) for k in FRAMES]


def first_map(poses):
    return MarkerMap({0: MapMarker(0, SIZE, True, poses[0])})


def flown(poses, **parameters):
    mapper = MarkerMapper(MarkerMapperConfig(**parameters), first_map(poses))
    for k, rows in zip(FRAMES, rows_of_flight(poses), strict=True):
        mapper.process(stamp(k), rows, CAMERA)
    return mapper


def errors_mm(marker_map, poses):
    away = [marker.T_map_marker[:3, 3] - poses[key][:3, 3] for key, marker in marker_map.markers.items()]
    return 1e3 * float(np.sqrt(np.mean(np.sum(np.square(away), axis=1))))


@pytest.fixture
def poses():
    return wall(np.random.default_rng(3))


@pytest.mark.parametrize('live', [False, True])
def test_a_mapper_without_frames_has_nothing_to_refine(poses, live):
    """It said that a refinement was under way, for as long as no frame came: its process counts as busy until then."""
    refinement = MapRefinement(MarkerMapper(MarkerMapperConfig(), first_map(poses)), live=live)
    try:
        with pytest.raises(InputError, match='nothing to refine yet'):
            refinement.start()
    finally:
        refinement.close()


@pytest.mark.parametrize('live', [False, True])
def test_all_keyframes_are_used_once_at_the_end(poses, live):
    mapper = flown(poses)
    before = errors_mm(mapper.map, poses)
    refinement = MapRefinement(mapper, live=live)
    try:
        # Longer than it takes even beside eight busy programs.
        assert refinement.finish(PATIENCE_S)
        assert errors_mm(mapper.map, poses) < BETTER * before
        assert not mapper.has_unrefined
        assert not refinement.finish(PATIENCE_S)
    finally:
        refinement.close()


@pytest.mark.parametrize('fixed', [{'mode': 'localization'}, {'refinement_period': 0.0}])
def test_a_map_that_is_not_to_be_refined_stays(poses, fixed):
    refinement = MapRefinement(flown(poses, **fixed), live=False)
    assert not refinement.finish(1.0)


def test_a_process_that_does_not_answer_is_not_waited_for(poses):
    refinement = MapRefinement(flown(poses), live=True)
    (process,) = multiprocessing.active_children()
    os.kill(process.pid, signal.SIGSTOP)
    try:
        began = time.monotonic()
        assert not refinement.finish(0.2)
        # Less than the minute for which a flying mapper waits.
        assert time.monotonic() - began < 60.0
    finally:
        refinement.close()


def flown_node(graph, path, poses, **parameters):
    """A mapper's node after the flight."""
    save_map(path, first_map(poses))
    node = graph.add(MarkerMapperNode, map_file=str(path), **parameters)
    graph.send('thermal/camera_info', info(CAMERA))
    for k, rows in zip(FRAMES, rows_of_flight(poses), strict=True):
        show(graph, node, k, rows)
    return node


def show(graph, node, k, rows):
    """Send a frame, and wait for it: of several that wait a node takes the newest."""
    (frames,) = (source for source in node.inputs if source.topic == '/markers')
    count = frames.count
    graph.send('markers', clouds.cloud(rows, convert.header(stamp(k), 'camera')))
    graph.spin_until(lambda: frames.count > count)


def ask(graph, service):
    return graph.call(Trigger, f'marker_mapper/{service}', Trigger.Request()).success


def is_saved_refined(node, path, poses, before):
    """Whether the file is as the node has the map, and that is better than with ``before`` [mm]."""
    saved = load_map(path)
    assert saved.markers.keys() == poses.keys()
    return saved.revision == node.mapper.map.revision and errors_mm(saved, poses) < BETTER * before


@pytest.mark.ros
@pytest.mark.parametrize('saved', [False, True])
def test_the_map_is_saved_as_the_last_refinement_has_it(graph, tmp_path, poses, saved):
    """Also where a service has saved it, and no marker was in view since: the robot has landed."""
    path = tmp_path / 'hall.yaml'
    # None in flight.
    node = flown_node(graph, path, poses, refinement_period=1000.0)
    before = errors_mm(node.mapper.map, poses)
    if saved:
        assert ask(graph, 'save')
    node.finish()
    node.close()
    assert is_saved_refined(node, path, poses, before)


@pytest.mark.ros
@pytest.mark.parametrize('applied', [False, True])
def test_a_refinement_that_came_after_a_save_is_saved_at_the_end(graph, tmp_path, poses, monkeypatch, applied):
    """It is done or under way when the node is stopped; no marker is in view any more."""
    # Longer than it takes even beside eight busy programs.
    monkeypatch.setattr(map_services, '_LAST_REFINEMENT_S', PATIENCE_S)
    path = tmp_path / 'hall.yaml'
    node = flown_node(graph, path, poses, live=True, refinement_period=1000.0)
    before, revision = errors_mm(node.mapper.map, poses), node.mapper.map.revision
    landed = (FRAMES[-1] + k for k in itertools.count(1))
    # The process takes a while to start.
    while not ask(graph, 'refine'):
        show(graph, node, next(landed), NOTHING)
    assert ask(graph, 'save')
    while applied and node.mapper.map.revision == revision:
        show(graph, node, next(landed), NOTHING)
    node.finish()
    node.close()
    assert is_saved_refined(node, path, poses, before)
