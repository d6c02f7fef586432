"""Freezing and unfreezing a mapper at any moment, started in either mode."""

import numpy as np
import pytest
from support.scenes import motion_prior
from support.walls import CAMERA, flight, see, SIZE, stamp, wall

from thermal_fiducial.config import MarkerMapperConfig
from thermal_fiducial.core.mapping.bundle_adjustment import refine
from thermal_fiducial.core.mapping.map_data import MapMarker, MarkerMap
from thermal_fiducial.core.mapping.mapper import MarkerMapper
from thermal_fiducial.core.measurements import Odometry

MODES = ('mapping', 'localization')
SIGMA_PX = 0.05


def started(poses, mode, known=(0, 1), **parameters):
    config = MarkerMapperConfig(mode=mode, camera_orientation=(0.0, 0.0, 0.0, 1.0), **parameters)
    return MarkerMapper(config, MarkerMap({i: MapMarker(i, SIZE, True, poses[i]) for i in known}))


def odometry(k, T):
    return motion_prior(Odometry(stamp(k), T, np.zeros(3), np.zeros(3), 1e-8 * np.eye(6), 1e-8 * np.eye(6)))


def fly(mapper, poses, frames, rng, only=None):
    """Frames of the slow flight with exact odometry; ``only``: the markers that are not covered up."""
    shown = {i: poses[i] for i in poses if only is None or i in only}
    results = []
    for k in frames:
        T = flight(k / 30)
        results.append(mapper.process(stamp(k), see(T, shown, SIGMA_PX, rng), CAMERA, odometry(k, T)))
    return results


@pytest.mark.parametrize('mode', MODES)
def test_new_markers_alone_right_after_unfreezing(mode):
    """Nothing was kept while the map was frozen that these could be joined to: they wait for a known marker."""
    rng = np.random.default_rng(1)
    poses = wall(rng)
    m = started(poses, mode)
    m.frozen = True
    fly(m, poses, range(10), rng, only=(0, 1))
    m.frozen = False
    results = fly(m, poses, range(10, 30), rng, only=(2, 3))
    assert all(result.pose is None for result in results)
    assert m.map.markers.keys() == {0, 1}
    fly(m, poses, range(40, 60), rng)
    assert m.map.markers.keys() > {0, 1}


def test_new_markers_are_not_joined_to_a_frame_from_before_a_long_freeze():
    rng = np.random.default_rng(2)
    poses = wall(rng)
    m = started(poses, 'mapping', bridge_duration=1.0)
    fly(m, poses, range(10), rng, only=(0, 1))
    m.frozen = True
    fly(m, poses, range(10, 70, 4), rng, only=(0, 1))
    m.frozen = False
    fly(m, poses, range(70, 80), rng, only=(2, 3))
    assert m.map.markers.keys() == {0, 1}


@pytest.mark.parametrize('mode', MODES)
@pytest.mark.parametrize('act', ['none', 'reset', 'load', 'refine', 'apply'])
def test_every_step_works_at_every_moment(mode, act):
    """Freeze, unfreeze, and each step between them, twice over; a frame of known markers always gives a pose."""
    rng = np.random.default_rng(3)
    poses = wall(rng)
    m = started(poses, mode)
    k = 0
    for frozen in (True, False, True, False, False):
        m.frozen = frozen
        before = m.map.copy()
        snapshot = m.snapshot()
        results = fly(m, poses, range(k, k + 6), rng)
        results += fly(m, poses, range(k + 6, k + 9), rng, only=(4, 5, 6))
        k += 9
        assert all(result.pose is not None for result in results[:6])
        assert frozen or m.map != before
        if frozen:
            assert m.map == before
        if act == 'reset':
            m.reset()
        elif act == 'load':
            m.load(MarkerMap({i: MapMarker(i, SIZE, True, poses[i]) for i in (0, 1, 2)}))
        elif act == 'refine':
            m.refine()
        elif act == 'apply' and snapshot is not None:
            refinement = refine(snapshot)
            assert m.apply(refinement) != frozen
    assert fly(m, poses, range(k, k + 3), rng)[-1].pose is not None


def test_a_flight_that_begins_frozen_ends_with_the_same_map_quality():
    """Unfrozen in flight, a mapper started in localization maps like one that was started in mapping."""
    errors = {}
    for mode in MODES:
        rng = np.random.default_rng(4)
        poses = wall(rng)
        m = started(poses, mode)
        m.frozen = False
        fly(m, poses, range(0, 200, 4), rng)
        m.refine()
        assert len(m.map.markers) == len(poses)
        errors[mode] = [np.linalg.norm(x.T_map_marker[:3, 3] - poses[i][:3, 3]) for i, x in m.map.markers.items()]
    assert errors['mapping'] == errors['localization']
    assert max(errors['mapping']) < 0.01  # corners of 0.05 px at 3 m: millimetres
