"""The filter's state is a function of the data, not of the order in which they come."""

from functools import cache

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
from support.flights import config, Flight, run, timeline

from thermal_fiducial.core.ekf import PoseEkf

POSES = 20


@cache
def flight():
    return Flight(seed=9, seconds=1.5, imu_rate=100.0)


@cache
def in_order():
    ekf = PoseEkf(config())
    run(ekf, timeline(flight().samples(), flight().poses[:POSES]))
    return ekf.state


@settings(max_examples=12)
@given(st.lists(st.floats(0.0, 0.5), min_size=POSES, max_size=POSES))
def test_any_delays_give_the_same_state(delays):
    ekf = PoseEkf(config())
    run(ekf, timeline(flight().samples(), flight().poses[:POSES], delays))
    for name in ('R_map_body', 'velocity', 'position', 'bias', 'covariance'):
        # 1e-9 of the value: the same operations in the same order, so only a missing or misplaced pose differs
        np.testing.assert_allclose(getattr(ekf.state, name), getattr(in_order(), name), rtol=1e-9, atol=1e-12)
