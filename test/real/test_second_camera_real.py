"""Two real cameras before the board: together at least as good as the first."""

from dataclasses import replace

import pytest
from support import real_flights
from support.corner_runs import fly

pytestmark = [pytest.mark.nightly, pytest.mark.usefixtures('real_data')]


def test_two_cameras_are_at_least_as_good_as_the_first():
    """Six seconds of the board, poses 30 ms late; the second's arrive before the first's of the same instant."""
    first, second = (_beginning(real_flights.april_board(camera), 6.0) for camera in ('cam0', 'cam1'))
    alone, both = (fly(first, second=other).published.score(first) for other in (None, second))
    assert both.rms_mm <= alone.rms_mm
    assert both.rms_deg <= alone.rms_deg
    assert both.nees <= alone.nees


def _beginning(flight, seconds):
    end = flight.samples[0].stamp_ns + round(seconds * 1e9)
    return replace(
        flight,
        samples=[sample for sample in flight.samples if sample.stamp_ns < end],
        frames={stamp: rows for stamp, rows in flight.frames.items() if stamp < end},
    )
