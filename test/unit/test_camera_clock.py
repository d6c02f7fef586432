"""Steps of the camera's clock beyond what is estimated as its offset; poses that are late without one."""

from dataclasses import replace

import numpy as np
import pytest
from support.flights import config, errors, Flight, START_NS

from thermal_fiducial.core.filter.ekf import PoseEkf
from thermal_fiducial.core.measurements import ImuSample

AT = 2.5
LATE = 0.03
#: A second of samples after the step is enough to follow it, two are asked for.
FOLLOWED = AT + 1.0


def flown(step=0.0, late=LATE):
    """The filter, its states, and the flight, in which the stamps step ahead, or poses are late, from ``AT`` on."""
    flight = Flight(seed=3, seconds=5.0)
    arrivals = [(sample.stamp_ns, 0, sample) for sample in flight.samples()]
    for pose in flight.poses:
        later = pose.stamp_ns - START_NS >= AT * 1e9
        arrives = pose.stamp_ns + round(1e9 * (late if later else LATE))
        arrivals.append((arrives, 1, replace(pose, stamp_ns=pose.stamp_ns + round(1e9 * step * later))))
    ekf, states, lost = PoseEkf(config()), [], []
    for _, _, item in sorted(arrivals, key=lambda entry: entry[:2]):
        if isinstance(item, ImuSample):
            state = ekf.add_imu(item)
            states += [state] if state else []
            lost += [ekf.lost] if state else []
        else:
            ekf.add_pose(item)
    return ekf, states, np.array(lost), flight


@pytest.mark.parametrize('step', [-0.5, 1.0, *(pytest.param(step, marks=pytest.mark.nightly) for step in (0.2, -1.0))])
def test_a_step_is_followed(step):
    ekf, states, lost, flight = flown(step)
    off, _ = errors(flight, states, FOLLOWED)
    # One marker at 2 m: as good as before the step, which is 1 to 2 cm.
    assert off.max() < 0.05
    assert not lost[-len(off) :].any()
    assert ekf.resets == 0
    assert ekf.camera_time_offset == pytest.approx(-step, abs=0.01)


@pytest.mark.parametrize('late', [0.15, 1.5])
def test_late_poses_are_no_step(late):
    ekf, states, _, flight = flown(late=late)
    off, _ = errors(flight, states, FOLLOWED)
    # Beyond ``max_delay`` they are refused, and the filter coasts for two and a half seconds.
    assert off.max() < (0.05 if late < 1.0 else 0.5)
    assert abs(ekf.camera_time_offset or 0.0) < 0.02
