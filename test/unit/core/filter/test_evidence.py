"""A camera that is turned on the robot by more than is claimed is named."""

from functools import cache

import numpy as np
import pytest
from scipy.stats import chi2
from support.flights import config, Flight, run, timeline

from thermal_fiducial.core.filter.ekf import PoseEkf
from thermal_fiducial.core.filter.evidence import MountEvidence
from thermal_fiducial.core.geometry.se3 import camera_in_body, quaternion_from_rotation, so3_exp

STD = 0.005


@cache
def flown(turn_deg):
    """A filter after a brisk flight whose camera is turned about all axes by ``turn_deg`` in all."""
    flight = Flight(seed=1, seconds=6.0)
    turn = so3_exp(np.radians(turn_deg) * np.array([0.6, -0.64, 0.48]))
    wrong = turn @ camera_in_body(config())[:3, :3]
    ekf = PoseEkf(config(camera_orientation=tuple(quaternion_from_rotation(wrong)), extrinsics_orientation_std=STD))
    run(ekf, timeline(flight.samples(), flight.poses, 0.03))
    return ekf


def test_a_turned_camera_is_named():
    assert flown(0.0).doubts == []
    # Twelve claimed standard deviations.
    doubt = flown(6.0).doubts[0]
    assert doubt.words == 'camera_orientation is off'
    assert '0.5 are claimed; calibrate camera-imu' in doubt.details


def test_the_evidence_is_that_of_least_squares():
    """Three claimed deviations of what noise and claim allow together, over draws as they say, are as rare as that."""
    rng, by_rotation = np.random.default_rng(2), np.random.default_rng(3).normal(size=(5, 6, 3)) * 0.3
    S = np.diag([0.5, 1.0, 2.0, 0.3, 1.0, 1.5])
    contradicted = 0
    for _ in range(4000):
        turn, evidence = rng.normal(size=3), MountEvidence()
        for J in by_rotation:
            evidence = evidence.after(J, S, J @ turn + np.sqrt(S.diagonal()) * rng.normal(size=6))
        contradicted += evidence.contradiction(STD) is not None
    # 0.27 % of 4000 are 11, and three of their deviations 10.
    assert contradicted == pytest.approx(4000 * chi2.sf(14.2, 3), abs=10)
