"""A handful of random rigs: a nightly form of ``make rigs``, and a short one. The oracle has tests of its own."""

import numpy as np
import pytest

from rigs.flight import fly
from rigs.rig import SECONDS
from rigs.score import MOST_BEYOND, MOST_NEES, Score, Worth
from rigs.table import line, table

#: Seed, seconds, errors of the position that were measured with the known map and in mapping [mm]; small images, which
#: are quick to render. The short form: raw, transit, 9 Hz.
SHORT = (8, 3.5, (2.6, 4.6))
NIGHTLY = (
    # Linear, looking away.
    (92, SECONDS, (9.5, 13.3)),
    # Plateau, looking away behind smoke, with a shutter event. 16.7 and 24.8 where maps are taken for level to 0.3 deg,
    # as this one is.
    (111, SECONDS, (20.2, 31.5)),
    # Raw, landing behind smoke, with a shutter event.
    (106, SECONDS, (5.4, 5.7)),
    # Linear, turning behind smoke, with a shutter event.
    (108, SECONDS, (12.7, 16.5)),
    # Raw, brisk, with a shutter event.
    (12, SECONDS, (44.8, 34.0)),
    # Plateau, take-off behind smoke.
    (83, SECONDS, (6.2, 10.3)),
    # Raw, 9 Hz, hovering before small markers behind smoke, which leaves their poses noisy: 175 mm and a reset where
    # those of the noisiest poses are the views that place new markers.
    (3, SECONDS, (8.9, 31.4)),
)
FLIGHTS = [SHORT, *(pytest.param(*flight, marks=pytest.mark.nightly) for flight in NIGHTLY)]


@pytest.mark.parametrize(('seed', 'seconds', 'measured_mm'), FLIGHTS)
def test_poses_and_maps_are_within_their_claims(seed, seconds, measured_mm):
    _, scores = fly(seed, seconds)
    for score, rms_mm in zip(scores, measured_mm, strict=True):
        assert score.false_mapped == 0
        # NEES at worst 1.0 of poses and 0.3 of maps, and nothing beyond 3 sigma. A filter and a mapper that take focal
        # length and extrinsics for exact are beyond these bounds in four of the first six: NEES 5, 15, 2.7, 2.1, and up
        # to 48 % beyond 3 sigma.
        assert score.poses.nees < MOST_NEES
        assert score.poses.beyond < MOST_BEYOND
        assert score.markers.count == 0 or score.markers.nees < MOST_NEES
        # Half as much again. A clock offset that is not estimated is in the claims, but doubles the error of those that
        # turn (108: 61 and 69 mm) and fly briskly (12: 113 and 108 mm).
        assert 1e3 * score.poses.rms < 1.5 * rms_mm
        # Lost is no excuse: 10 % of the brisk flight.
        assert score.lost < 0.2


@pytest.mark.nightly
def test_turns_behind_a_display_are_as_good_as_the_borders_of_markers_show():
    """A plateau equalisation, turns on the spot, 9 Hz; with the known map."""
    _, (known, _) = fly(444)
    # 37.5 and 40.3 mm with the linear algebra of two processors, by which the pictures differ in some counts; 31 mm
    # when this was written, and 50 where a display displaced all sides of a marker alike, in motion too.
    assert 1e3 * known.poses.rms < 45.0
    assert known.poses.nees < MOST_NEES
    assert known.poses.beyond < MOST_BEYOND


def test_errors_as_large_as_claimed_have_a_nees_of_one():
    rng = np.random.default_rng(0)
    sigma = np.repeat([0.1, 0.01], 3)
    covariance = np.diag(sigma**2)
    poses = []
    for d in rng.normal(0.0, sigma, (4000, 6)):
        truth = np.eye(4)
        truth[:3, 3] = d[:3]
        # Of small angles; half of their square is 1e-4.
        truth[:3, :3] += np.array([[0.0, -d[5], d[4]], [d[5], 0.0, -d[3]], [-d[4], d[3], 0.0]])
        poses.append((truth, np.eye(4), covariance))
    worth = Worth.of(poses)
    # Three sigma: of the mean NEES (each has a deviation of 0.58), of the rms, of a share of 1 - 0.9973^2.
    assert worth.nees == pytest.approx(1.0, abs=0.03)
    assert worth.rms == pytest.approx(0.1 * np.sqrt(3.0), rel=0.03)
    assert worth.beyond == pytest.approx(0.0054, abs=0.0035)


def test_the_table_names_flights_beyond_their_claims():
    good = Score('localization', Worth(1, 0.01, 1.0, 0.0), Worth(), 0.0, 0, 0.9, 0, 0)
    bad = Score('mapping', Worth(1, 0.02, 3.0, 0.0), Worth(), 0.0, 0, 1.0, 0, 0)
    text = table({7: [good, bad], 8: [good, good]})
    assert '7 (mapping)' in text
    assert '8' not in text.splitlines()[-1]
    assert 'NEES 3.00' in line(bad)
