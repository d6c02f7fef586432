"""The filter's state is a function of the data, not of the order in which they come.

While it learns the clock offset it uses the samples that come after a pose, too: then it depends a little on lateness,
which is tested with the filter.
"""

from functools import cache

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
from support.flights import config, Flight, run, timeline

from thermal_fiducial.core.filter.ekf import PoseEkf

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


@settings(max_examples=5)
@given(st.lists(st.floats(0.0, 0.5), min_size=POSES, max_size=POSES), st.sampled_from((-0.03, 0.0, 0.03)))
def test_any_delays_give_the_same_state(delays, offset):
    ekf, expected = PoseEkf(known_clock(offset)), in_order(offset)
    run(ekf, timeline(flight(offset).samples(), flight(offset).poses[:POSES], delays))
    # 1e-9 of the value: the same operations in the same order, so only a missing or misplaced pose differs
    for name in ('R_map_body', 'velocity', 'position', 'bias', 'time_offset'):
        np.testing.assert_allclose(getattr(ekf.state, name), getattr(expected.state, name), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(ekf.estimate.covariance, expected.covariance, rtol=1e-9, atol=1e-12)
