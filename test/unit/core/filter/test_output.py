"""The smooth output: the filter's pose with its corrections spread over time."""

from dataclasses import replace

import numpy as np
import pytest

from thermal_fiducial.core.filter.output import LARGEST_STEP, SmoothOutput
from thermal_fiducial.core.geometry.se3 import transform
from thermal_fiducial.core.measurements import Odometry

STEP_NS = 5_000_000
SECONDS = 0.1
#: Flies along x.
VELOCITY = np.array([2.0, 0.0, 0.0])


def at(k, aside=0.0):
    """Odometry at sample ``k``, ``aside`` [m] of its line."""
    position = VELOCITY * k * STEP_NS * 1e-9 + [0.0, aside, 0.0]
    return Odometry(k * STEP_NS, transform(np.eye(3), position), VELOCITY, np.zeros(3), np.eye(6), np.eye(6))


def aside(smooth):
    return smooth.T_map_body[1, 3]


def test_a_correction_is_spread_with_the_time_constant():
    output = SmoothOutput(SECONDS)
    for k in range(10):
        np.testing.assert_allclose(output.follow(at(k)).T_map_body, at(k).T_map_body, atol=1e-12)
    left = [0.1 - aside(output.follow(at(k, 0.1))) for k in range(10, 50)]
    # exact but for rounding: the motion in between is uniform
    np.testing.assert_allclose(left, 0.1 * np.exp(-np.arange(1, 41) * STEP_NS * 1e-9 / SECONDS), atol=1e-12)


def test_what_else_is_in_it_is_the_filters():
    output = SmoothOutput(SECONDS)
    output.follow(at(0))
    smooth, exact = output.follow(at(1, 0.1)), at(1, 0.1)
    assert smooth.stamp_ns == exact.stamp_ns
    np.testing.assert_array_equal(smooth.velocity_body, exact.velocity_body)
    np.testing.assert_array_equal(smooth.pose_covariance, exact.pose_covariance)


@pytest.mark.parametrize('k', [-1000, 0, 1])
def test_a_step_too_large_to_spread_and_a_clock_that_goes_back_start_it_anew(k):
    output = SmoothOutput(SECONDS)
    output.follow(at(0))
    # Stamps that went back: any step. Forward: only one that is a new start of the filter.
    new = at(k, 0.5 if k <= 0 else 1.01 * LARGEST_STEP)
    np.testing.assert_allclose(output.follow(new).T_map_body, new.T_map_body, atol=1e-12)
    after = replace(new, stamp_ns=new.stamp_ns + STEP_NS, velocity_body=np.zeros(3))
    assert aside(output.follow(after)) == pytest.approx(aside(new), abs=1e-12)


def test_jumps_are_counted_and_what_is_spread_is_none():
    output, jumps = SmoothOutput(SECONDS), []
    # Its start, a correction that is spread, a step, and a new start; sample 3 continues the step.
    for k, off in ((0, 0.0), (1, 0.1), (2, 0.1 + 1.2 * LARGEST_STEP), (3, 0.1 + 1.2 * LARGEST_STEP)):
        output.follow(at(k, off))
        jumps.append(output.jumps)
    output.begin_again()
    output.begin_again()
    output.follow(at(4))
    assert [*jumps, output.jumps] == [1, 1, 2, 2, 3]


def test_what_begins_again_does_not_continue_a_pose_that_was_wrong():
    output = SmoothOutput(SECONDS)
    output.follow(at(0))
    output.begin_again()
    np.testing.assert_array_equal(output.follow(at(1, 0.5)).T_map_body, at(1, 0.5).T_map_body)
