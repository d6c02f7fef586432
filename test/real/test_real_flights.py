"""Real IMUs before real markers, from the corners on: what holds of the fused pose."""

from functools import cache

import pytest
from support import real_flights
from support.corner_runs import fly

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures('real_data')]


@cache
def board_run(camera):
    """The board with published densities and default parameters, poses 30 ms late."""
    return fly(real_flights.april_board(camera))


@pytest.mark.parametrize('camera', ['cam0', 'cam1'])
def test_markers_alone_are_as_good_as_the_reference(camera):
    run = board_run(camera)
    score = run.markers.score(run.flight)
    assert len(run.markers) > 790  # of 801 frames
    # The reference is good to 3 mm and 0.2 deg, and rests on the same corners.
    assert score.rms_mm < 5.0
    assert score.rms_deg < 0.25
    # Five per cent of a chi-square of 6 d.o.f. are above 2.1 of one; these are means over a flight.
    assert 0.5 < score.nees < 2.0


@pytest.mark.parametrize('camera', ['cam0', 'cam1'])
def test_half_of_the_fused_poses_are_within_a_centimetre(camera):
    run = board_run(camera)
    # The median of markers alone is 2.4 mm; resets and refusals make the fused pose worse.
    assert run.published.score(run.flight).median_mm < 10.0
    # Every IMU sample after the start has a pose.
    assert len(run.published) > 0.97 * len(run.flight.samples)
