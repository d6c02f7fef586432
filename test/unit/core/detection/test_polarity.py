"""Which markers may be some, by the kind of those seen before."""

import numpy as np
import pytest

from thermal_fiducial.core.detection.finding import Polarity

BOTH = 1.0, -1.0


def seen(*frames):
    polarity = Polarity()
    for frame in frames:
        polarity = polarity.after(np.array(frame))
    return polarity


def test_nothing_is_excluded_before_a_kind_is_sure():
    assert seen([3.0, 4.0]).kinds('alike') == BOTH


@pytest.mark.parametrize('sign', [1.0, -1.0])
def test_markers_are_like_those_before(sign):
    polarity = seen(*[[sign * 3.0, sign * 0.1]] * 10)
    assert polarity.kinds('alike') == (sign,)


def test_a_single_other_one_changes_nothing():
    polarity = seen(*[[3.0, 4.0]] * 10, [-200.0])
    assert polarity.kinds('alike') == (1.0,)


def test_kinds_are_forgotten_when_none_is_seen():
    # Wherever contrast reverses, as a surface cools down, there is a time without any.
    polarity = seen(*[[3.0] * 8] * 100, *[[]] * 300)
    assert polarity.kinds('alike') == BOTH


def test_rules():
    polarity = seen(*[[-3.0, -4.0]] * 10)
    assert polarity.kinds('any') == BOTH
    assert polarity.kinds('dark') == (1.0,)
    assert polarity.kinds('bright') == (-1.0,)
