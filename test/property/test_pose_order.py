"""The filter's state is a function of the data, not of the order in which they come.

While it learns the clock offset it uses the samples that come after a pose, too: then it depends a little on lateness,
which is tested with the filter.
"""

from dataclasses import replace
from functools import cache

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
from support.flights import config, Flight, run, timeline

from thermal_fiducial.core.filter.ekf import PoseEkf
from thermal_fiducial.core.geometry.se3 import transform

POSES = 20
SEVERAL_MARKERS = {'rotation_std': (0.003, 0.003, 0.001), 'translation_std': (0.0003, 0.0003, 0.003)}


@cache
def flight(offset):
    return Flight(seed=9, seconds=1.5, imu_rate=100.0, offset=offset, **SEVERAL_MARKERS)


def known_clock(offset):
    return config(camera_time_offset=offset, estimate_time_offset=False, time_offset_std=0.0, stamp_jitter=0.0)


@cache
def in_order(offset):
    ekf = PoseEkf(known_clock(offset))
    run(ekf, timeline(flight(offset).samples(), flight(offset).poses[:POSES]))
    return ekf.estimate


def assert_same(estimate, expected):
    # 1e-9 of the value: the same operations, so only a missing or misplaced pose differs
    for name in ('R_map_body', 'velocity', 'position', 'bias', 'time_offset'):
        value, other = getattr(estimate.state, name), getattr(expected.state, name)
        np.testing.assert_allclose(value, other, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(estimate.covariance, expected.covariance, rtol=1e-9, atol=1e-12)


@settings(max_examples=5)
@given(st.lists(st.floats(0.0, 0.5), min_size=POSES, max_size=POSES), st.sampled_from((-0.03, 0.0, 0.03)))
def test_any_delays_give_the_same_state(delays, offset):
    ekf = PoseEkf(known_clock(offset))
    run(ekf, timeline(flight(offset).samples(), flight(offset).poses[:POSES], delays))
    assert_same(ekf.estimate, in_order(offset))


@settings(max_examples=5)
@given(st.sets(st.integers(0, POSES - 1)), st.lists(st.floats(0.0, 0.4), min_size=POSES, max_size=POSES))
def test_so_do_wrong_poses_and_the_alternatives_that_they_begin(wrong, delays):
    """Refused poses, and estimates that replace others, are functions of the data as well."""
    aside = transform(np.eye(3), (0.3, 0.0, 0.0))
    poses = [
        replace(pose, T_map_camera=aside @ pose.T_map_camera) if index in wrong else pose
        for index, pose in enumerate(flight(0.0).poses[:POSES])
    ]
    prompt, late = PoseEkf(known_clock(0.0)), PoseEkf(known_clock(0.0))
    run(prompt, timeline(flight(0.0).samples(), poses))
    run(late, timeline(flight(0.0).samples(), poses, delays))
    assert (late.status, late.resets) == (prompt.status, prompt.resets)
    if prompt.estimate:
        assert_same(late.estimate, prompt.estimate)
