"""A map that leans against gravity by more than is declared is named, once turns have shown that it is the map."""

from dataclasses import replace

import numpy as np
import pytest
from support.flights import config, Flight, GRAVITY, Motion, run, timeline

from thermal_fiducial.core.filter.ekf import PoseEkf
from thermal_fiducial.core.geometry.se3 import so3_exp, transform


def flown(tilt_deg, seed=1, motion=None, **changes):
    """A filter after a flight in a map that leans by ``tilt_deg`` about its x axis."""
    # An IMU of 100 Hz, as of a slow autopilot: a flight takes half as long as with 200 Hz.
    flight = Flight(seed=seed, seconds=10.0, motion=motion, imu_rate=100.0)
    lift = np.array([0.0, 0.0, GRAVITY])
    off = so3_exp([np.radians(tilt_deg), 0.0, 0.0]) @ lift - lift
    forces = flight.imu[:, 3:] + off @ flight.motion.pose(flight.t)[:, :3, :3]
    samples = [replace(s, linear_acceleration=force) for s, force in zip(flight.samples(), forces, strict=True)]
    ekf = PoseEkf(config(**changes))
    run(ekf, timeline(samples, flight.poses, 0.03))
    return ekf


@pytest.mark.parametrize('seed', range(3))
def test_a_map_as_level_as_declared_is_not_named(seed):
    """It leans by two standard deviations of what is declared."""
    assert flown(1.15, seed).doubts == []


def test_a_leaning_map_is_named_with_what_to_write():
    (doubt,) = flown(4.0).doubts
    assert doubt.words == 'the map leans'
    # What is declared keeps the estimate from 4 degrees.
    assert doubt.details == (
        'by 3.7 deg or more against gravity, map_tilt_std says 0.6: level it, or write map_tilt_std: 0.065'
    )
    # With that the map has its tilt: to 0.1 deg, three of the standard deviations that poses and gravity leave.
    written = flown(4.0, map_tilt_std=0.065)
    assert written.doubts == []
    assert np.degrees(written.diagnostics()['map tilt']) == pytest.approx(4.0, abs=0.3)


def test_before_one_heading_it_may_be_the_accelerometer():
    assert flown(4.0, motion=Motion.still()).doubts == []


def test_the_present_map_is_named_not_the_one_before_its_correction():
    """In flight a levelled map is loaded, whose axes are turned by a right angle, too."""
    ekf, level = flown(4.0), so3_exp([-np.radians(4.0), 0.0, 0.0])
    turned = so3_exp([0.0, 0.0, np.pi / 2.0])
    ekf.move_map(transform(turned @ level, np.zeros(3)))
    assert ekf.doubts == []
    ekf.move_map(transform(turned @ level.T @ turned.T, np.zeros(3)))
    assert [doubt.words for doubt in ekf.doubts] == ['the map leans']
