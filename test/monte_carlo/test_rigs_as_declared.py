"""Rigs whose calibration is wrong by what the parameters declare: the published poses are off by what they claim."""

from dataclasses import replace

import numpy as np
import pytest
from support.corner_runs import fly
from support.sim_flights import simulated

from thermal_fiducial.config import MarkerMapperConfig, PoseEkfConfig
from thermal_fiducial.core.geometry.se3 import so3_exp, transform

pytestmark = pytest.mark.slow
MAPPER, FILTER = MarkerMapperConfig(), PoseEkfConfig()
#: Errors count from here on [ns]: velocity and tilt are known by then.
SETTLED_NS = 2_000_000_000


def as_calibrated(flight, rng):
    """``flight`` with focal length and extrinsics as a calibration says, wrong by a draw of the declared errors."""
    K = flight.camera.K.copy()
    K[:2, :2] *= 1.0 + MAPPER.focal_length_std * rng.normal()
    turn = so3_exp(FILTER.extrinsics_orientation_std * rng.normal(size=3))
    shift = FILTER.extrinsics_position_std * rng.normal(size=3)
    camera = replace(flight.camera, K=K)
    return replace(flight, camera=camera, T_body_camera=flight.T_body_camera @ transform(turn, shift))


def first_seconds(flight, seconds):
    """The beginning of a flight: no simulated one is shorter than take-off and landing."""
    end_ns = flight.samples[0].stamp_ns + round(1e9 * seconds)
    frames = {stamp: rows for stamp, rows in flight.frames.items() if stamp < end_ns}
    return replace(flight, frames=frames, samples=[sample for sample in flight.samples if sample.stamp_ns < end_ns])


@pytest.mark.parametrize(('rigs', 'seconds'), [(6, 6.0), pytest.param(24, 12.0, marks=pytest.mark.nightly)])
def test_claims_hold_over_rigs_as_the_parameters_declare_them(rigs, seconds):
    nees = []
    for seed in range(rigs):
        whole = simulated('cheap_imu', seed, 12.0)
        flight = as_calibrated(first_seconds(whole, seconds), np.random.default_rng(seed))
        published = fly(flight).published
        settled = published.stamps_ns > published.stamps_ns[0] + SETTLED_NS
        nees.append(published.select(settled).score(flight).nees)
    # The errors of a rig last as long as its flight: it is one draw of some four that matter, with a standard deviation
    # of 0.7. Two such deviations of the mean. Without the error of the focal length it is 1.65 over six rigs, 0.9
    # with it, of 6 s as of 12.
    assert abs(np.mean(nees) - 1.0) < 2.0 * 0.7 / np.sqrt(rigs)


def test_a_bracket_measured_by_hand_is_within_the_claims():
    """The camera turned by 0.5 deg, 5 mrad about each axis, and nothing said of it: by default 3 mrad are claimed."""
    flight = first_seconds(simulated('cheap_imu', 0, 12.0), 6.0)
    turned = flight.T_body_camera @ transform(so3_exp(np.radians(0.5) * np.ones(3) / np.sqrt(3.0)), np.zeros(3))
    published = fly(replace(flight, T_body_camera=turned)).published
    settled = published.select(published.stamps_ns > published.stamps_ns[0] + SETTLED_NS).score(flight)
    # 1.7 standard deviations about each axis, in half of the degrees of freedom: 1.4, and 0.1 as of an exact rig. Asked
    # of claims is at most 2. Taken for known to 2 mrad it is 2.6.
    assert settled.nees < 2.0
