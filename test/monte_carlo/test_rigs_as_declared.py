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


@pytest.mark.parametrize('rigs', [6, pytest.param(24, marks=pytest.mark.nightly)])
def test_claims_hold_over_rigs_as_the_parameters_declare_them(rigs):
    nees = []
    for seed in range(rigs):
        flight = as_calibrated(simulated('cheap_imu', seed, 12.0), np.random.default_rng(seed))
        published = fly(flight).published
        settled = published.stamps_ns > published.stamps_ns[0] + SETTLED_NS
        nees.append(published.select(settled).score(flight).nees)
    # The errors of a rig last as long as its flight: it is one draw of some four that matter, with a standard deviation
    # of 0.7. Two such deviations of the mean. Without the error of the focal length it is 1.6 over six rigs.
    assert abs(np.mean(nees) - 1.0) < 2.0 * 0.7 / np.sqrt(rigs)
