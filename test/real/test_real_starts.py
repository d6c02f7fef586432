"""Starts before the recorded board: claims of the first poses, judged by the other camera."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2
from support import real_flights
from support.corner_runs import fly

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures('real_data')]


def started(begin, seconds):
    """Run of so many ``seconds`` from ``begin`` [s] on, and the flight with the poses of the other camera."""
    stamps_ns, T_map_body = real_flights.board_reference('cam1')
    flight = real_flights.part(real_flights.april_board('cam0'), begin, seconds)
    return fly(flight), replace(flight, reference_ns=stamps_ns, reference=T_map_body)


def test_a_start_allows_for_the_bias_of_the_gyroscope():
    """This one has 4.4 deg/s about one axis, and few tags are in view."""
    run, judged = started(28.0, 1.5)
    error, covariance = run.published.errors(judged), run.published.covariance
    squares = np.einsum('ni,nij,nj->n', error[:, 3:], np.linalg.inv(covariance[:, 3:, 3:]), error[:, 3:])
    assert squares.max() < chi2.ppf(0.9973, 3)
