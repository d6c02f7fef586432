from dataclasses import replace

import numpy as np
import pytest
from support.scenes import motion_prior

from thermal_fiducial.core.measurements import Odometry
from thermal_fiducial.core.motion_prior import MotionPrior

STATE = Odometry(0, np.eye(4), np.zeros(3), np.zeros(3), np.eye(6), np.eye(6))
PERIOD_NS = 5_000_000


def states(count, first_ns=0):
    return [replace(STATE, stamp_ns=first_ns + k * PERIOD_NS) for k in range(count)]


def stamps(found):
    return [state.stamp_ns for state in found]


def test_empty():
    log = MotionPrior()
    assert log.nearest(0) is None
    assert log.between(0, 10**9, 10) == []


def test_nearest_and_between_whatever_the_order_of_arrival():
    given = states(20)
    log = motion_prior(*given[:10], *given[15:], *given[10:15])
    assert [log.nearest(t).stamp_ns // PERIOD_NS for t in (-(10**9), 12_000_000, 13_000_000, 10**12)] == [0, 2, 3, 19]
    assert stamps(log.between(4 * PERIOD_NS, 8 * PERIOD_NS, 10)) == [k * PERIOD_NS for k in range(4, 9)]
    assert log.between(10**12, 10**13, 10) == []


@pytest.mark.parametrize('name', ['velocity_body', 'angular_velocity_body'])
@pytest.mark.parametrize('speed', [51.0, np.nan])
def test_what_no_camera_that_sees_markers_can_do_is_left_out(name, speed):
    """As where messages are read: a detector that believed a filter that diverges would never see a marker again."""
    first, second = states(2)
    fast = replace(first, **{name: np.array([0.0, 0.0, -49.0])})
    impossible = replace(second, **{name: np.array([0.0, 0.0, -speed])})
    log = motion_prior(fast, impossible)
    assert stamps(log.between(0, 10**9, 10)) == [0]
    assert log.nearest(PERIOD_NS) is None


def test_a_filter_that_has_been_lost_for_long_says_nothing():
    """As where messages are read."""
    lost = replace(STATE, pose_covariance=np.diag([1.0, 901.0, 1.0, 1.0, 1.0, 1.0]))
    assert motion_prior(lost).nearest(0) is None


def test_many_are_thinned_out_evenly():
    assert stamps(motion_prior(*states(19)).between(0, 10**9, 10)) == [2 * k * PERIOD_NS for k in range(10)]
    uneven = stamps(motion_prior(*states(12)).between(0, 10**9, 10))
    assert len(uneven) == 10
    assert (uneven[0], uneven[-1]) == (0, 11 * PERIOD_NS)
    assert len(motion_prior(*states(12)).between(0, 10**9, 1)) == 1


def test_only_those_asked_for_are_read():
    asked = []
    log = MotionPrior(read=lambda chosen: asked.append(stamps(chosen)) or list(chosen))
    for state in states(10):
        log.add(state.stamp_ns, state)
    log.between(0, PERIOD_NS, 10)
    log.nearest(3 * PERIOD_NS)
    assert asked == [[0, PERIOD_NS], [3 * PERIOD_NS]]


def test_what_proves_to_be_unusable_is_missing():
    log = MotionPrior(read=lambda chosen: [state for state in chosen if state.stamp_ns != PERIOD_NS])
    for state in states(3):
        log.add(state.stamp_ns, state)
    assert stamps(log.between(0, 10**9, 10)) == [0, 2 * PERIOD_NS]
    assert log.nearest(PERIOD_NS) is None


def test_old_states_are_forgotten_and_a_clock_set_back_begins_anew():
    log = motion_prior(*states(3000))
    assert 1000 <= len(log.between(0, 10**12, 10**6)) <= 2000
    log.add(0, STATE)
    assert stamps(log.between(-1, 10**12, 10**6)) == [0]


def test_a_clock_that_is_set_back_by_a_part_of_a_second_leaves_nothing_of_before():
    log = motion_prior(*states(1000))
    newest_ns = log.between(0, 10**12, 10**6)[-1].stamp_ns
    log.add(newest_ns - 200_000_000, STATE)
    assert len(log.between(0, 10**12, 10**6)) == 1


def test_stamps_that_do_not_go_on_fill_no_memory():
    log = MotionPrior()
    for k in range(10_000):
        log.add(0, replace(STATE, stamp_ns=k))
    # Of one stamp the latest.
    assert stamps(log.between(-1, 1, 10**6)) == [9_999]
    for k in range(10_000):
        log.add(k, replace(STATE, stamp_ns=k))
    assert 1000 <= len(log.between(-1, 10**12, 10**6)) <= 2000
    assert log.nearest(10**12).stamp_ns == 9_999
