"""Initialisation in brisk motion while the clock offset is still unknown, and from poses that claim little."""

from dataclasses import replace

import numpy as np
import pytest
from support.flights import config, Flight, Motion, run, timeline

from thermal_fiducial.core.filter.ekf import PoseEkf

#: Poses of several markers, and a clock offset of 2.3 of its prior's standard deviations.
POSES = {'rotation_std': (1e-3,) * 3, 'translation_std': (1e-3, 1e-3, 2e-3)}
OFFSET, LATE = -0.07, 0.03


def shaken_by_hand(seed):
    """0.7 m/s and 2 rad/s an axis at 3 to 6 rad/s: rates change by a third within the offset."""
    rng = np.random.default_rng(300 + seed)
    phase, frequency = rng.uniform(0.0, 2.0 * np.pi, (2, 3, 2)), rng.uniform(3.0, 6.0, (2, 3, 2))
    rates = np.array([0.7, 2.0])[:, None, None]
    return Motion(*np.stack([rates / frequency, frequency, phase], axis=-1))


@pytest.mark.parametrize(('seed', 'pose_rate'), [(0, 9.0), (6, 9.0), (0, 30.0), (4, 30.0)])
def test_a_start_in_brisk_motion_is_right_at_once(seed, pose_rate):
    """Linearised about an offset of 0, the estimate refused up to 5 good poses, and an alternative replaced it."""
    flight = Flight(seed, 3.0, shaken_by_hand(seed), pose_rate=pose_rate, offset=OFFSET, **POSES)
    ekf = PoseEkf(config())
    states, updates = run(ekf, timeline(flight.samples(), flight.poses, LATE + OFFSET))
    assert ekf.resets == 0
    assert not any(update.refused for update in updates)
    # three standard deviations of its own
    error = ekf.camera_time_offset - OFFSET
    assert abs(error) < 3.0 * ekf.diagnostics()['time offset std']
    assert len(states) > 400


@pytest.mark.parametrize('seed', range(3))
def test_first_poses_that_claim_little_cost_nothing_later(seed):
    """Motion blur of the first two images is not known yet, their poses claim seven times as much along one axis."""
    flight = Flight(seed, 2.0, Motion.still(), rotation_std=(1e-3,) * 3, translation_std=(1e-3, 1e-3, 5e-3))
    blurred, clear = flight.poses[:2], flight.poses[2:]
    for k, pose in enumerate(blurred):
        along_z = pose.covariance[:, 2]
        wider = pose.covariance + 48.0 * np.outer(along_z, along_z) / along_z[2]
        blurred[k] = replace(pose, covariance=wider)
    claims = []
    for poses in (blurred + clear, clear):
        ekf = PoseEkf(config())
        run(ekf, timeline(flight.samples(), poses, LATE))
        claims.append(ekf.estimate.position_std)
    # Measured 0.99 to 1.003; 1.06 to 1.11 where the error of the first poses was taken for one of all poses.
    assert claims[0] < 1.02 * claims[1]
