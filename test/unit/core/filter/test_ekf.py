"""The filter as its users meet it: what comes out, when, and in what words."""

from copy import deepcopy
from dataclasses import replace
import re

import numpy as np
import pytest
from support.estimates import difference
from support.flights import config, errors, Flight, matched, Motion, run, START_NS, timeline

from thermal_fiducial.core.filter.ekf import PoseEkf
from thermal_fiducial.core.filter.state import TIME_OFFSET
from thermal_fiducial.core.geometry.se3 import transform
from thermal_fiducial.core.measurements import ImuSample


@pytest.fixture(scope='module')
def flight():
    return Flight(seed=1, seconds=6.0)


@pytest.fixture(scope='module')
def short_flight():
    return Flight(seed=1, seconds=3.0)


@pytest.fixture(scope='module')
def filter_after_short_flight(short_flight):
    ekf = PoseEkf(config())
    run(ekf, timeline(short_flight.samples(), short_flight.poses))
    return ekf


@pytest.fixture
def flown(filter_after_short_flight):
    """A filter that has flown ``short_flight``, each test its own."""
    return deepcopy(filter_after_short_flight)


def test_noiseless_data_give_the_truth():
    flight = Flight(seed=1, seconds=4.0, noiseless=True, imu_rate=400.0)
    states, _ = run(PoseEkf(matched()), timeline(flight.samples(), flight.poses))
    position, attitude = errors(flight, states, 2.0)
    # what is left is the trapezoid: jerk-like 10 m/s^3 x (2.5 ms)^2 / 12 over the filter's memory, tens of micrometres
    assert position.max() < 1e-4
    assert attitude.max() < 1e-4


def test_every_sample_has_its_odometry_once_initialised(short_flight):
    ekf, flight = PoseEkf(config()), short_flight
    states, _ = run(ekf, timeline(flight.samples(), flight.poses, 0.03))
    stamps = np.array([state.stamp_ns for state in states])
    expected = [sample.stamp_ns for sample in flight.samples()]
    assert list(stamps) == expected[-len(stamps) :]
    # three poses from 0.2 s on, the last with its delay and the sample after it
    assert (stamps[0] - START_NS) * 1e-9 < 0.2 + 2 / 30 + 0.03 + 0.01
    assert ekf.status == 'tracking'
    assert not ekf.lost


def after(flight, delay, **changes):
    """A filter at the end of a flight whose poses came with a ``delay`` [s]."""
    delays = np.random.default_rng(2).uniform(0.0, 0.2, len(flight.poses)) if delay == 'random' else delay
    ekf = PoseEkf(config(**changes))
    run(ekf, timeline(flight.samples(), flight.poses, delays))
    return ekf


def test_samples_after_a_late_pose_help_to_find_the_clock_offset(flight):
    """They show the motion better; that is all that lateness changes."""
    in_order, late = (after(flight, delay).estimate for delay in (0.0, 0.05))
    assert late.std(TIME_OFFSET) < in_order.std(TIME_OFFSET)
    apart = difference(in_order.state, late.state)
    # less than a standard deviation: they share nearly all that they know
    assert (np.abs(apart[:15]) < np.sqrt(in_order.covariance.diagonal()[:15])).all()


#: With an unknown offset the order of arrival matters, as the test above says.
KNOWN_CLOCK = {'estimate_time_offset': False, 'time_offset_std': 0.0, 'stamp_jitter': 0.0}


@pytest.fixture(scope='module')
def in_order(short_flight):
    return after(short_flight, 0.0, **KNOWN_CLOCK)


@pytest.mark.parametrize('delay', [pytest.param(0.05, marks=pytest.mark.nightly), 0.4, 'random'])
def test_late_and_out_of_order_poses_equal_in_order_processing(short_flight, in_order, delay):
    flight, late = short_flight, after(short_flight, delay, **KNOWN_CLOCK)
    late_now, now = late.estimate, in_order.estimate
    # the last pose is 0.13 s old, so a delay of up to 0.4 s needs the poses that haven't arrived
    if delay == 0.4:
        for pose in flight.poses:
            late.add_pose(pose)
        late_now = late.estimate
    for name in ('R_map_body', 'velocity', 'position', 'bias', 'time_offset'):
        np.testing.assert_allclose(getattr(late_now.state, name), getattr(now.state, name), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(late_now.covariance, now.covariance, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize('motion', [Motion.still(), None], ids=['still', 'flying'])
@pytest.mark.parametrize('factor', [-1.0, 1 / 9.80665], ids=['sign', 'units'])
def test_an_imu_that_measures_no_gravity_is_named(motion, factor):
    """The two commonest errors of who writes a driver: the sign of the specific force, and g instead of m/s^2."""
    flight = Flight(seed=1, seconds=3.0, motion=motion)
    wrong = [replace(s, linear_acceleration=factor * s.linear_acceleration) for s in flight.samples()]
    ekf = PoseEkf(config())
    states, updates = run(ekf, timeline(wrong, flight.poses, 0.03))
    assert not states
    assert {update.reason for update in updates if not update.pending} == {'refused: contradicts gravity'}
    assert 'contradict gravity' in ekf.status
    assert 'units' in ekf.status


def test_a_gyroscope_in_degrees_is_named_where_no_flight_can_begin():
    flight = Flight(seed=1, seconds=4.0)
    ekf, said = PoseEkf(config()), set()
    wrong = [replace(s, angular_velocity=np.degrees(s.angular_velocity)) for s in flight.samples()]
    for item in timeline(wrong, flight.poses, 0.03):
        if isinstance(item, ImuSample):
            assert ekf.add_imu(item) is None
        else:
            ekf.add_pose(item)
        said.add(ekf.status)
    assert re.match(r'poses contradict the gyroscope: \d+ deg apart after 0\.\d\d s; its units', ekf.status)
    # Three poses make a flight, the first is no contradiction yet; then nothing else is said than what contradicts.
    assert {line.split(':')[0] for line in said} == {
        'waiting for markers',
        'initialising',
        'poses contradict the gyroscope',
    }


def test_live_parameters_hold_from_then_on(short_flight):
    ekf, flight = PoseEkf(config()), short_flight
    arrivals = timeline(flight.samples(), flight.poses, 0.03)
    half = len(arrivals) // 2
    _, before = run(ekf, arrivals[:half])
    # A gate of one where six are expected, of poses that claim a tenth of their errors: hardly one passes.
    ekf.configure(config(gate=1.0, pose_noise_scale=0.1))
    _, after = run(ekf, arrivals[half:])
    assert all(update.accepted for update in before[3:])
    passed = [update for update in after if update.accepted and not update.reason]
    assert len(passed) < 0.05 * len(after)


def test_innovations_stand_in_the_diagnostics(short_flight):
    ekf, flight = PoseEkf(matched()), short_flight
    run(ekf, timeline(flight.samples(), flight.poses, 0.03))
    # 30 poses of 6 degrees of freedom: the mean is known to sqrt(12 / 30); four of that
    said = ekf.diagnostics()
    assert said['NIS per d.o.f.'] == pytest.approx(1.0, abs=4.0 * np.sqrt(12.0 / 30.0) / 6.0)
    # Those with which it began were compared with nothing: they are no refused ones.
    assert said['poses refused'] == sum(update.refused for update in ekf.decided.values())
    assert said['poses refused'] < 3


def test_a_pose_ahead_of_the_imu_waits(flight):
    ekf = PoseEkf(config())
    samples = flight.samples()
    for sample in samples[:100]:
        ekf.add_imu(sample)
    pose = next(pose for pose in flight.poses if pose.stamp_ns > samples[99].stamp_ns)
    update = ekf.add_pose(pose)
    assert update.pending
    assert not update.accepted
    assert 'waits' in update.reason
    for sample in samples[100:110]:
        ekf.add_imu(sample)
    assert ekf.decided[pose.stamp_ns].reason == 'initialising'


@pytest.fixture(scope='module')
def filter_in_flight(flight):
    samples = flight.samples()
    ekf = PoseEkf(config())
    run(ekf, timeline(samples[:400], [pose for pose in flight.poses if pose.stamp_ns < samples[390].stamp_ns]))
    return ekf


@pytest.mark.parametrize(
    ('change', 'word'),
    [
        ({'angular_velocity': np.array([0.0, np.nan, 0.0])}, 'finite'),
        ({'linear_acceleration': np.array([0.0, np.inf, 0.0])}, 'finite'),
        ({'angular_velocity': np.array([0.0, 1e30, 0.0])}, 'range'),
        ({'linear_acceleration': np.array([0.0, 0.0, -1e4])}, 'range'),
        ({'stamp_ns': -5_000_000}, 'repeated'),
        ({'stamp_ns': -8_000_000}, 'back'),
        ({'stamp_ns': 3_000_000_000}, 'ahead'),
    ],
)
def test_a_bad_sample_is_refused_and_the_next_one_used(flight, filter_in_flight, change, word):
    ekf, samples = deepcopy(filter_in_flight), flight.samples()
    bad = samples[400]
    change = {key: bad.stamp_ns + value if key == 'stamp_ns' else value for key, value in change.items()}
    assert ekf.add_imu(replace(bad, **change)) is None
    assert word in ekf.status
    assert ekf.diagnostics()['IMU samples refused'] == 1.0
    state = ekf.add_imu(samples[401])
    assert state is not None
    assert ekf.status == 'tracking'
    truth = flight.motion.pose(flight.t[401])
    # single-marker poses after 1.8 s: a few centimetres at the most
    assert np.linalg.norm(state.T_map_body[:3, 3] - truth[:3, 3]) < 0.05


@pytest.mark.parametrize('jump', [-5.0, -0.5, 30.0])
def test_a_clock_that_jumps_resets(short_flight, flown, jump):
    ekf, flight = flown, short_flight
    shift = round((jump - 3.0 if jump < -1.0 else jump) * 1e9)
    samples = [replace(sample, stamp_ns=sample.stamp_ns + 3_000_000_000 + shift) for sample in flight.samples()]
    poses = [replace(pose, stamp_ns=pose.stamp_ns + 3_000_000_000 + shift) for pose in flight.poses]
    statuses = set()
    for item in timeline(samples, poses):
        if isinstance(item, ImuSample):
            ekf.add_imu(item)
            statuses.add(ekf.status)
        else:
            ekf.add_pose(item)
    assert any('reset' in status or 'waiting' in status for status in statuses)
    assert ekf.status == 'tracking'
    # a position that went on from the old clock would be off by the flight's extent, metres
    error = np.linalg.norm(ekf.state.position - flight.motion.pose(flight.t[-1])[:3, 3])
    assert error < 0.05


@pytest.mark.parametrize(('patience', 'resets'), [(60.0, 0.0), (2.0, 1.0)])
def test_after_long_enough_without_markers_it_resets(flight, patience, resets):
    poses = [pose for pose in flight.poses if not 1.0 < (pose.stamp_ns - START_NS) * 1e-9 < 4.0]
    ekf = PoseEkf(config(reinitialise_after=patience))
    states, _ = run(ekf, timeline(flight.samples(), poses, 0.03))
    assert ekf.diagnostics()['resets'] == resets
    # Of poses that are good to some centimetres.
    assert errors(flight, states, 5.0)[0].max() < 0.1


def test_a_pose_after_too_long_without_one_is_refused_for_that(flight):
    poses = [pose for pose in flight.poses if not 1.0 < (pose.stamp_ns - START_NS) * 1e-9 < 4.0]
    ekf = PoseEkf(config(reinitialise_after=2.0))
    run(ekf, timeline(flight.samples(), poses, 0.03))
    reasons = {update.reason for update in ekf.decided.values() if update.refused}
    # Not for its innovation, which is below the gate.
    assert reasons == {'refused: after 3 s without one'}


@pytest.mark.parametrize(
    'bad',
    [
        lambda sample, k: replace(sample, stamp_ns=sample.stamp_ns + k * 5_000_000, angular_velocity=np.full(3, 1e3)),
        lambda sample, k: sample,
    ],
    ids=['beyond all range', 'one stamp'],
)
def test_an_imu_without_a_usable_sample_leaves_no_pose_to_fly_on(short_flight, bad):
    ekf, samples = PoseEkf(config()), short_flight.samples()
    run(ekf, timeline(samples, short_flight.poses))
    lost = []
    for k in range(1, 101):
        assert ekf.add_imu(bad(samples[-1], k)) is None
        lost.append(ekf.lost)
    # Nine in a row may be those behind a jump of the stamps, which are followed from the tenth on.
    assert lost == [k >= 10 for k in range(1, 101)]
    assert ekf.add_imu(replace(samples[-1], stamp_ns=samples[-1].stamp_ns + 20_000_000)) is not None
    assert not ekf.lost


@pytest.mark.parametrize(
    ('bad', 'words'),
    [
        (lambda C: {'map_covariance': np.full((6, 6), np.nan)}, 'map_covariance that is not finite'),
        (lambda C: {'map_covariance': np.full((6, 6), np.inf)}, 'map_covariance that is not finite'),
        (lambda C: {'map_covariance': -C}, 'map_covariance with a variance of -'),
        (lambda C: {'map_covariance': 1.5 * C}, 'covariance without map_covariance with a variance of -'),
        (lambda C: {'T_map_camera': transform(np.eye(3), [1e300, 0.0, 0.0])}, '1e+300 m away'),
        (lambda C: {'T_map_camera': np.diag([1.0, 1.0, 1.0, 5.0])}, 'no finite rotation and translation'),
    ],
)
def test_a_pose_of_impossible_numbers_is_refused(flown, short_flight, bad, words):
    """Who calls the library has no messages, whose numbers are checked; these ended in errors of linear algebra."""
    late = replace(short_flight.poses[-1], stamp_ns=short_flight.poses[0].stamp_ns + 2_650_000_000)
    update = flown.add_pose(replace(late, **bad(late.covariance)))
    assert not update.accepted
    assert update.reason.startswith('refused: ')
    assert words in update.reason
    # All of an error may be of the map: such a pose reaches the gate.
    assert np.isfinite(flown.add_pose(replace(late, map_covariance=late.covariance)).nis)


def test_unusable_poses_are_refused_with_a_reason(short_flight, flown):
    ekf, flight = flown, short_flight
    pose = flight.poses[0]
    assert 'no IMU' in PoseEkf(config()).add_pose(pose).reason
    assert 'too late' in ekf.add_pose(pose).reason
    assert 'repeated' in ekf.add_pose(flight.poses[-1]).reason
    assert 'ahead' in ekf.add_pose(replace(pose, stamp_ns=pose.stamp_ns + 60_000_000_000)).reason
    assert 'finite' in ekf.add_pose(replace(flight.poses[-1], T_map_camera=np.full((4, 4), np.nan))).reason
    for no_rotation in (np.diag([2.0, 2.0, 2.0, 1.0]), np.diag([1.0, 1.0, -1.0, 1.0])):
        assert 'no finite rotation' in ekf.add_pose(replace(flight.poses[-1], T_map_camera=no_rotation)).reason
    shifted = flight.poses[-1].T_map_camera.copy()
    shifted[0, 3] += 1.0
    update = ekf.add_pose(replace(flight.poses[-1], stamp_ns=pose.stamp_ns + 2_650_000_000, T_map_camera=shifted))
    assert not update.accepted
    assert 'sigma' in update.reason
    assert update.nis > 22.5


def test_odometry_is_in_ros_frames():
    """Twist in the body; the covariance's small axis follows the body into the map."""
    flight = Flight(seed=3, seconds=4.0)
    ekf = PoseEkf(config())
    states, _ = run(ekf, timeline(flight.samples(), flight.poses))
    last = states[-1]
    T = flight.motion.pose(flight.t[-1])
    # 0.1 m/s, 0.01 rad/s: far above the filter's error, far below a wrong frame's
    np.testing.assert_allclose(last.velocity_body, T[:3, :3].T @ flight.motion.velocity(flight.t[-1]), atol=0.1)
    np.testing.assert_allclose(last.angular_velocity_body, flight.motion.imu(flight.t[-1])[:3], atol=0.01)
    P, R = ekf.estimate.covariance, ekf.state.R_map_body
    np.testing.assert_allclose(last.pose_covariance[:3, :3], R @ P[6:9, 6:9] @ R.T, atol=1e-15)
    np.testing.assert_allclose(last.pose_covariance[:3, 3:], R @ P[6:9, :3] @ R.T, atol=1e-15)
    np.testing.assert_allclose(last.pose_covariance[3:, 3:], R @ P[:3, :3] @ R.T, atol=1e-15)
    assert np.linalg.eigvalsh(last.twist_covariance).min() > 0.0


@pytest.mark.parametrize('turn', [0.0, 0.05])
def test_a_gyroscope_bias_is_known_after_seconds_at_rest_and_in_a_slow_turn(turn):
    """As quiet as on the ground, and what the gyroscope feels may be either."""
    motion = Motion.still()
    motion.rotation[2, 0] = 10.0 * turn, 0.1, 0.0
    flight = Flight(seed=5, seconds=4.0, motion=motion, bias_std=(0.02, 0.05))
    ekf = PoseEkf(config())
    run(ekf, timeline(flight.samples(), flight.poses))
    std = np.sqrt(np.diag(ekf.estimate.covariance)[9:12])
    assert np.all(np.abs(ekf.state.bias[:3] - flight.bias[-1, :3]) < 3.0 * std)
    # A quarter of what is allowed for at the start: a degree in 4 s without markers.
    assert np.all(std < 0.25 * 0.02)


@pytest.mark.parametrize('wrong', [1, 2])
def test_a_start_with_wrong_poses_is_given_up(wrong):
    flight = Flight(seed=4, seconds=2.0)
    aside = [
        replace(pose, T_map_camera=transform(np.eye(3), (0.0, 1.0, 0.0)) @ pose.T_map_camera) for pose in flight.poses
    ]
    # The second of two comes just after the first, where nothing can say that it is wrong.
    poses = [aside[0], replace(flight.poses[1], stamp_ns=aside[0].stamp_ns + 1)][:wrong] + flight.poses[1:]
    ekf = PoseEkf(config())
    states, _ = run(ekf, timeline(flight.samples(), poses))
    off, _ = errors(flight, states, 1.5)
    # One marker at 2 m, known for a second: 3 cm rms.
    assert off.max() < 0.15


def test_reset_forgets(short_flight, flown):
    ekf = flown
    ekf.reset()
    assert ekf.state is None
    assert ekf.lost
    assert ekf.status == 'waiting for IMU'
    run(ekf, timeline(short_flight.samples(), short_flight.poses))
    assert ekf.status == 'tracking'


def test_samples_that_are_only_kept_lead_to_the_same_state():
    """Nine of ten samples give no output; the tenth goes on over all of them, and over the poses between."""
    flight = Flight(seed=6, seconds=3.0)
    one_by_one, in_tens = PoseEkf(config()), PoseEkf(config())
    samples = {sample.stamp_ns: k for k, sample in enumerate(flight.samples())}
    for item in timeline(flight.samples(), flight.poses, 0.03):
        if not isinstance(item, ImuSample):
            one_by_one.add_pose(item)
            in_tens.add_pose(item)
            continue
        expected = one_by_one.add_imu(item)
        if samples[item.stamp_ns] % 10:
            assert in_tens.keep_imu(item)
        elif (found := in_tens.add_imu(item)) is not None:
            # Rounding: the same steps are joined in another order, and folded elsewhere, as the biases walk meanwhile.
            np.testing.assert_allclose(found.T_map_body, expected.T_map_body, atol=1e-4)
            np.testing.assert_allclose(found.pose_covariance, expected.pose_covariance, rtol=0.02, atol=1e-8)
    assert found is not None
