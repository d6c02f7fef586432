"""Which markers may be some, by the kind of those seen before."""

import numpy as np
import pytest

from thermal_fiducial.core.detection.corners.focus import Focus
from thermal_fiducial.core.detection.corners.gray_scale import UNKNOWN_SCALE
from thermal_fiducial.core.detection.finding.finder import FrameHistory
from thermal_fiducial.core.detection.prediction.known_markers import ExpectedMarkers
from thermal_fiducial.core.detection.prediction.tracking import MotionTrack

BOTH = 1.0, -1.0

FOCUS = Focus.as_declared(0.66)


def seen(*frames):
    """The history after frames with markers of such contrast-to-noise ratios."""
    history = FrameHistory(MotionTrack(np.eye(4), 0.0), FOCUS)
    for index, cnr in enumerate(frames):
        count = len(cnr)
        markers = ExpectedMarkers(np.arange(count), np.zeros((count, 4, 2)), np.ones((count, 4)), np.array(cnr))
        history = history.after(index * 33_333_333, None, markers, FOCUS, UNKNOWN_SCALE, saw_partial=False)
    return history


def test_nothing_is_excluded_before_a_kind_is_sure():
    assert seen([3.0, 4.0]).polarities('alike') == BOTH


@pytest.mark.parametrize('sign', [1.0, -1.0])
def test_markers_are_like_those_before(sign):
    history = seen(*[[sign * 3.0, sign * 0.1]] * 10)
    assert history.polarities('alike') == (sign,)


def test_a_single_other_one_changes_nothing():
    history = seen(*[[3.0, 4.0]] * 10, [-200.0])
    assert history.polarities('alike') == (1.0,)


@pytest.mark.parametrize('count', [1, 8])
def test_a_kind_outlasts_seconds_without_any(count):
    # The first marker after them is often in motion blur, and its plate then looks like one of the other kind.
    history = seen(*[[3.0] * count] * 100, *[[]] * 300)
    assert history.polarities('alike') == (1.0,)


@pytest.mark.parametrize('count', [1, 8])
def test_kinds_are_forgotten_when_none_is_seen(count):
    # Wherever contrast reverses, as a surface cools down, there is a time without any: 40 s here.
    history = seen(*[[3.0] * count] * 100, *[[]] * 1200)
    assert history.polarities('alike') == BOTH


def test_stamps_that_go_back_forget_nothing():
    history = seen(*[[3.0]] * 100)
    history = history.after(0, None, ExpectedMarkers.none(), FOCUS, UNKNOWN_SCALE, saw_partial=False)
    assert history.polarities('alike') == (1.0,)


def test_rules():
    history = seen(*[[-3.0, -4.0]] * 10)
    assert history.polarities('any') == BOTH
    assert history.polarities('dark') == (1.0,)
    assert history.polarities('bright') == (-1.0,)
