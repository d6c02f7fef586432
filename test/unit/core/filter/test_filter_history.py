"""What the filter keeps of samples and poses."""

import numpy as np
from support.flights import config, Flight, in_order, Motion, run, timeline

from thermal_fiducial.core.filter.ekf import PoseEkf
from thermal_fiducial.core.filter.history import History
from thermal_fiducial.core.filter.initialization import WINDOW_SECONDS
from thermal_fiducial.core.measurements import ImuSample


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


def test_suspected_steps_of_the_clock_count_once_however_many_samples_come_together():
    """Of 10 and 20 ms, in a queue that is caught up with at once, and sample by sample."""
    flight = Flight(seed=1, seconds=5.0)
    samples = [sample for k, sample in enumerate(flight.samples()[:907]) if k not in (901, 903, 904, 905)]
    queue_ns = flight.samples()[900].stamp_ns
    arrivals = [(sample.stamp_ns, 0, sample) for sample in samples]
    arrivals += [(pose.stamp_ns, 1, pose) for pose in flight.poses if pose.stamp_ns < queue_ns]
    one_by_one, at_once = PoseEkf(config()), PoseEkf(config())
    for arrival in in_order(arrivals):
        if not isinstance(arrival, ImuSample):
            one_by_one.add_pose(arrival)
            at_once.add_pose(arrival)
            continue
        one_by_one.add_imu(arrival)
        if queue_ns < arrival.stamp_ns < samples[-1].stamp_ns:
            at_once.keep_imu(arrival)
        else:
            at_once.add_imu(arrival)
    # One sum in another order.
    np.testing.assert_allclose(at_once.estimate.covariance, one_by_one.estimate.covariance, rtol=1e-9, atol=1e-15)


def test_an_initialisation_is_the_same_when_its_first_pose_comes_last():
    """A brisk start with an offset of two standard deviations: it is linearised about its clock offset twice."""
    sharp = {'rotation_std': (0.003, 0.003, 0.001), 'translation_std': (0.0003, 0.0003, 0.003)}
    brisk = Motion.random(np.random.default_rng(4), speed=2.0, turn=1.0)
    flight = Flight(seed=4, seconds=2.0, offset=0.06, motion=brisk, **sharp)
    delays = np.full(len(flight.poses), 0.15)
    in_turn, late = PoseEkf(config()), PoseEkf(config())
    run(in_turn, timeline(flight.samples(), flight.poses, delays.copy()))
    delays[0] = 0.6
    run(late, timeline(flight.samples(), flight.poses, delays))
    apart = late.state.position - in_turn.state.position
    # The samples after a pose that have arrived by then are other ones: a tenth of what it was, 1.9 mm.
    assert np.abs(apart).max() < 2e-4


def test_late_poses_after_a_pause_of_the_start_are_compared_with_their_own_instants():
    """Two poses, none for 2.5 s, in which old samples are forgotten, and further ones: at once, and 0.3 s late."""
    flight = Flight(seed=4, seconds=4.0)
    poses = flight.poses[:2] + [pose for pose in flight.poses if pose.stamp_ns > flight.poses[0].stamp_ns + 2.55e9]
    at_once, late = PoseEkf(config()), PoseEkf(config())
    run(at_once, timeline(flight.samples(), poses))
    run(late, timeline(flight.samples(), poses, 0.3))
    apart = late.state.position - at_once.state.position
    # Samples after a pose that have arrived by then: 0.4 mm. Compared with the end of the pause, 850 mm.
    assert np.abs(apart).max() < 2e-3
