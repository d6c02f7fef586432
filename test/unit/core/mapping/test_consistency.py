"""Quarantine of markers that contradict the others, from made-up errors."""

import numpy as np
import pytest

from thermal_fiducial.core.mapping.consistency import Consistency, inconsistent
from thermal_fiducial.core.mapping.map_data import MapMarker


def markers(count=4, **values):
    return {key: MapMarker(key, 0.3, False, np.eye(4), **values) for key in range(count)}


def frame(state, known, errors_px, left_out=()):
    """A frame in which each of the first markers has its error, of 0.1 px that are explained."""
    count = len(errors_px)
    used = set(range(count)) - set(left_out)
    return state.judge(known, range(count), np.array(errors_px), np.full(count, 0.1), used)


def test_a_marker_off_in_most_frames_of_a_second_is_quarantined_and_one_that_fits_again_released():
    known = markers()
    state = Consistency(known)
    changes = [frame(state, known, [0.1, 0.1, 0.1, 2.0]) for _ in range(40)]
    # 1 - 0.95^n exceeds 0.7 with the 24th frame.
    assert changes.index(True) == 23
    assert sum(changes) == 1
    assert not known[3].trusted
    assert state.quarantined == {3: '2.0 px off, 20.0 sigma, in most of the last 20 frames'}
    changes = [frame(state, known, [0.1, 0.1, 0.1, 0.1]) for _ in range(60)]
    assert sum(changes) == 1
    assert known[3].trusted
    assert state.quarantined == {}


@pytest.mark.parametrize('errors', [[2.0], [0.1, 0.1, 0.3]])
def test_one_marker_alone_and_errors_within_four_sigma_are_no_evidence(errors):
    known = markers()
    state = Consistency(known)
    assert not any(frame(state, known, errors) for _ in range(100))
    assert all(marker.trusted for marker in known.values())


@pytest.mark.parametrize(
    ('a', 'b', 'expected'),
    [
        ({'fixed': True}, {}, [False, True]),
        ({}, {'fixed': True}, [True, False]),
        ({'observations': 100}, {'observations': 20}, [False, True]),
        ({'observations': 50}, {'observations': 20}, [False, False]),
    ],
)
def test_of_two_that_contradict_each_other_the_better_known_one_holds(a, b, expected):
    pair = [MapMarker(key, 0.3, T_map_marker=np.eye(4), **({'fixed': False} | own)) for key, own in enumerate((a, b))]
    assert inconsistent(np.array([True, True]), pair).tolist() == expected


def test_a_marker_that_odometry_contradicts_is_quarantined_though_its_error_alone_is_no_evidence():
    known = markers(count=2)
    state = Consistency(known)
    changes = [frame(state, known, [0.1, 0.3], left_out=[1]) for _ in range(24)]
    assert changes.index(True) == 23
    assert known[0].trusted
    assert not known[1].trusted
