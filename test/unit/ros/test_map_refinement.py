"""The last refinement of a flight: with its last keyframes, before the map is saved, and never waited for in vain."""

import multiprocessing
import os
import signal
import time

import numpy as np
import pytest
from support.messages import info
from support.walls import CAMERA, flight, see, SIZE, stamp, wall

from thermal_fiducial.config import MarkerMapperConfig
from thermal_fiducial.core.mapping.map_data import MapMarker, MarkerMap
from thermal_fiducial.core.mapping.mapper import MarkerMapper
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.marker_map import load_map, save_map
from thermal_fiducial.nodes.marker_mapper import MarkerMapperNode
from thermal_fiducial.ros.mapper_node.map_refinement import MapRefinement
from thermal_fiducial.ros.messages import clouds, convert

#: Corner noise [px]: markers placed in flight, unrefined, are then 31 mm off (rms); 7 mm once they are refined.
NOISE_PX = 0.2
FRAMES = range(0, 120, 3)
#: Error of the refined map over that of the map in flight: twice what it is.
BETTER = 0.5


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
        assert refinement.finish(60.0)
        assert errors_mm(mapper.map, poses) < BETTER * before
        assert not mapper.has_unrefined
        assert not refinement.finish(60.0)
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
        # Far less than the minute for which a flying mapper waits.
        assert time.monotonic() - began < 20.0
    finally:
        refinement.close()


@pytest.mark.ros
def test_the_map_is_saved_as_the_last_refinement_has_it(graph, tmp_path, poses):
    path = tmp_path / 'hall.yaml'
    save_map(path, first_map(poses))
    # None in flight.
    node = graph.add(MarkerMapperNode, map_file=str(path), refinement_period=1000.0)
    (frames,) = (source for source in node.inputs if source.topic == '/markers')
    graph.send('thermal/camera_info', info(CAMERA))
    for sent, (k, rows) in enumerate(zip(FRAMES, rows_of_flight(poses), strict=True), start=1):
        graph.send('markers', clouds.cloud(rows, convert.header(stamp(k), 'camera')))
        # One by one: of several that wait a node takes the newest.
        graph.spin_until(lambda sent=sent: frames.count == sent)
    before = errors_mm(node.mapper.map, poses)
    node.finish()
    node.close()
    saved = load_map(path)
    assert saved.revision == node.mapper.map.revision
    assert saved.markers.keys() == poses.keys()
    assert errors_mm(saved, poses) < BETTER * before
