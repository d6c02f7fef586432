"""What the filter keeps of samples and poses."""

import numpy as np
from support.flights import config, Flight

from thermal_fiducial.core.filter.history import History
from thermal_fiducial.core.filter.initialization import WINDOW_SECONDS


def test_a_start_without_further_poses_keeps_no_more_than_a_flight_does():
    """One marker in passing, then none for long: samples must not gather until the next comes."""
    flight, history = Flight(seed=1, seconds=8.0, imu_rate=50.0), History(config(max_delay=0.0), 0.0)
    coming = [flight.poses[10]]
    for sample in flight.samples():
        imu = np.concatenate((sample.angular_velocity, sample.linear_acceleration))
        history.imu.append(sample.stamp_ns, imu, np.full(6, 1e-3))
        if coming and sample.stamp_ns > coming[0].stamp_ns:
            history.insert(coming.pop())
        history.take_in()
    assert history.belief.alternative is not None
    # Blocks of twice what is kept, and a sample.
    assert len(history.imu) <= 2 * WINDOW_SECONDS * 50 + 2
