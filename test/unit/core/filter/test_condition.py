"""The filter's condition in words, from what its history holds."""

from dataclasses import replace

import numpy as np
import pytest
from support.flights import config, Flight, Motion, run, timeline

from thermal_fiducial.core.filter.belief import REFUSALS_OF_DOUBT
from thermal_fiducial.core.filter.ekf import PoseEkf
from thermal_fiducial.core.filter.history import History
from thermal_fiducial.core.filter.output import (
    COASTING_S,
    coasting_seconds,
    condition_of,
    TRACKING,
    WAITING,
)
from thermal_fiducial.core.geometry.se3 import camera_in_body, inverse
from thermal_fiducial.core.measurements import CameraPose

CONFIG = config(initial_poses=3)
RATE = 200


def history(until, poses, *, seconds=4.0, force=1.0):
    """History after ``until`` [s] of a hovering robot: samples, forces times ``force``, and some of its poses."""
    flight, kept = Flight(seed=1, seconds=seconds, motion=Motion.still()), History(CONFIG, 0.0)
    for sample in flight.samples()[: round(until * RATE)]:
        imu = np.concatenate((sample.angular_velocity, force * sample.linear_acceleration))
        kept.imu.append(sample.stamp_ns, imu, np.repeat((1.7e-4, 2e-3), 3))
    for pose in flight.poses[poses]:
        kept.insert(pose)
    kept.take_in()
    return kept


def test_at_first_it_waits_for_the_imu_then_for_markers():
    assert condition_of(history(0.0, slice(0)), CONFIG).words == 'waiting for IMU'
    assert condition_of(history(0.1, slice(0)), CONFIG) == WAITING


@pytest.mark.parametrize('count', [1, 2])
def test_the_first_poses_are_counted(count):
    assert str(condition_of(history(1.0, slice(10, 10 + count)), CONFIG)) == f'initialising: {count} of 3 poses'


def test_it_tracks_until_poses_stay_away():
    assert condition_of(history(1.0, slice(5, 20)), CONFIG) == TRACKING
    late = history(1.5, slice(5, 20))
    seconds = coasting_seconds(late, late.main)
    since = (late.imu.newest_ns - Flight(seed=1, seconds=4.0).poses[19].stamp_ns) / 1e9
    # but for the clock offset that is estimated of the robot at rest: nothing moves, and so its prior stays
    assert seconds == pytest.approx(since, abs=0.03)
    assert seconds > COASTING_S
    assert str(condition_of(late, CONFIG)) == f'coasting: {seconds:.1f} s without a pose'


def test_lost_counts_before_coasting():
    kept = history(1.5, slice(5, 20))
    strict = config(lost_position_std=0.5 * kept.main.estimate.position_std)
    condition = condition_of(kept, strict)
    assert condition.words == 'lost'
    assert condition.details == f'position known to {kept.main.estimate.position_std:.2f} m'


def test_poses_that_are_refused_in_a_row_put_it_in_doubt():
    kept = history(1.5, slice(5, 20))
    for count, pose in enumerate(Flight(seed=1, seconds=4.0, motion=Motion.still()).poses[20:25], 1):
        aside = pose.T_map_camera.copy()
        aside[0, 3] += 3.0
        kept.insert(type(pose)(pose.stamp_ns, aside, pose.covariance))
        kept.take_in()
        assert (condition_of(kept, CONFIG).words == 'in doubt') == (count >= REFUSALS_OF_DOUBT)
    assert condition_of(kept, CONFIG).details == '5 poses in a row contradict the estimate'


@pytest.mark.parametrize(('std', 'accepted', 'ends'), [(5.0, 12, False), (0.005, 2, True)])
def test_doubt_ends_with_poses_that_would_have_shown_the_error(std, accepted, ends):
    """With forces in g, poses of one marker that claimed 50 m agreed with an estimate 50 m off, which was sent."""
    kept = history(1.5, slice(5, 20))
    poses = Flight(seed=1, seconds=4.0, motion=Motion.still()).poses[20 : 24 + accepted]
    for count, pose in enumerate(poses):
        T, covariance = pose.T_map_camera.copy(), pose.covariance.copy()
        if count < 4:
            T[0, 3] += 3.0
        else:
            covariance[:3, :3] = std**2 * np.eye(3)
        kept.insert(type(pose)(pose.stamp_ns, T, covariance))
        kept.take_in()
    assert [kept.log.latest[pose.stamp_ns].accepted for pose in poses] == [False] * 4 + [True] * accepted
    assert kept.main.in_doubt is not ends


def test_odometry_in_doubt_allows_for_the_poses_that_contradict_it():
    """With forces in g no alternative holds either: it claimed 5 cm to 1 m where poses were 2 to 100 m away."""
    flight, ekf = Flight(seed=1, seconds=5.0), PoseEkf(CONFIG)
    samples = [
        replace(sample, linear_acceleration=(1.0 if k < 2 * RATE else 0.102) * sample.linear_acceleration)
        for k, sample in enumerate(flight.samples())
    ]
    T_body_camera, pose, sigmas = camera_in_body(CONFIG), flight.poses[0], []
    for message in timeline(samples, flight.poses):
        if isinstance(message, CameraPose):
            pose = message
            ekf.add_pose(pose)
        elif (state := ekf.add_imu(message)) is not None and ekf.status.startswith(('in doubt', 'lost')):
            off = state.T_map_body[:3, 3] - (pose.T_map_camera @ inverse(T_body_camera))[:3, 3]
            sigmas.append(np.linalg.norm(off) / np.sqrt(np.trace(state.pose_covariance[:3, :3])))
    assert len(sigmas) > 2 * RATE
    # 1.5 at most in three flights; the pose that it is compared with may be a frame old.
    assert max(sigmas) < 3.0


def test_a_sensor_that_poses_contradict_is_named_until_the_filter_is_initialised():
    upside_down = history(1.0, slice(10, 11), force=-1.0)
    condition = condition_of(upside_down, CONFIG)
    assert condition.words == 'poses contradict gravity'
    # the mean's noise, of 100 samples at 200 Hz of 2e-3 m/s^2/sqrt(Hz) is below the digit that is said
    assert condition.details.startswith('the IMU says ')
    assert '-9.8 m/s^2' in condition.details


def test_a_gyroscope_of_wrong_sign_is_named_also_after_the_start():
    """It passes at rest. In motion the poses reset the filter again and again, although markers are always in view."""
    flight, ekf = Flight(seed=1, seconds=8.0), PoseEkf(CONFIG)
    samples = flight.samples()
    wrong = [replace(sample, angular_velocity=-sample.angular_velocity) for sample in samples[RATE:]]
    run(ekf, timeline(samples[:RATE] + wrong, flight.poses))
    assert ekf.resets > 1
    assert 'axes, sign, units of the IMU' in ekf.reset_reason


def test_a_camera_at_the_wrong_place_of_the_robot_is_named_by_the_reset():
    """The pose is off by as much as the camera, and passes as long as the robot does not turn."""
    flight = Flight(seed=1, seconds=8.0)
    ekf = PoseEkf(replace(CONFIG, camera_position=tuple(-x for x in CONFIG.camera_position)))
    run(ekf, timeline(flight.samples(), flight.poses))
    assert ekf.resets > 0
    assert 'camera_position' in ekf.reset_reason
