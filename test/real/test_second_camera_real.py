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


@pytest.mark.parametrize('cameras', [('cam0', 'cam1'), ('cam1', 'cam0')])
def test_a_second_camera_that_takes_turns_with_the_first_claims_no_less_than_its_error(cameras):
    """Twelve seconds of the board, every other 1.5 s without frames of the first: their mounts differ."""
    first, second = (_beginning(real_flights.april_board(camera), 12.0) for camera in cameras)
    half = {stamp: rows for stamp, rows in first.frames.items() if stamp // 1_500_000_000 % 2}
    # 0.82 and 0.89; without the mounts' errors 1.29 and 1.63.
    assert fly(replace(first, frames=half), second=second).published.score(first).nees < 1.0


def _beginning(flight, seconds):
    end = flight.samples[0].stamp_ns + round(seconds * 1e9)
    return replace(
        flight,
        samples=[sample for sample in flight.samples if sample.stamp_ns < end],
        frames={stamp: rows for stamp, rows in flight.frames.items() if stamp < end},
    )
