"""What odometry says of a frame, with the offset of its clock and without."""

from dataclasses import replace
import math

import numpy as np
import pytest
from support.scenes import camera_of, detector_of, motion_prior

from thermal_fiducial.core.detection.prediction.tracking import MotionTrack, predict_frame
from thermal_fiducial.core.detection.prediction.twist import Twist
from thermal_fiducial.core.measurements import Odometry
from thermal_fiducial.sim.scenario import named
from thermal_fiducial.sim.thermal_camera import render_frames

STAMP_NS, PERIOD_NS = 10**9, 5_000_000
VELOCITY, ACCELERATION = np.array([0.0, 2.0, 0.0]), np.array([3.0, 0.0, 0.0])
SECONDS, SEED = 20.0, 21


def states(offset_s=0.0):
    """Of a body that accelerates, in a clock that is ahead of the camera's."""
    found = []
    for seconds in np.arange(-8, 3) * 0.005:
        T = np.eye(4)
        T[:3, 3] = seconds * VELOCITY + 0.5 * seconds**2 * ACCELERATION
        stamp_ns = STAMP_NS + round((seconds + offset_s) * 1e9)
        velocity = VELOCITY + seconds * ACCELERATION
        found.append(Odometry(stamp_ns, T, velocity, np.zeros(3), 1e-4 * np.eye(6), 1e-4 * np.eye(6)))
    return found


def predicted(prior, time_offset_std=0.03):
    return predict_frame(STAMP_NS, prior, MotionTrack(np.eye(4), 0.010), time_offset_std)


@pytest.mark.parametrize('offset_s', [0.0, -0.060, 0.035])
def test_odometry_is_read_at_the_frame_s_stamp_in_its_own_clock(offset_s):
    twist, guide = predicted(motion_prior(*states(offset_s), clock_offset=offset_s))
    np.testing.assert_allclose(guide.T_camera_map, np.eye(4), atol=1e-3)
    np.testing.assert_allclose(twist.value[:3], VELOCITY, atol=0.02)


@pytest.mark.parametrize(('age_s', 'holds'), [(0.140, True), (0.160, False)])
def test_odometry_that_is_late_gives_both_twist_and_pose_or_neither(age_s, holds):
    """The newest state is so old."""
    twist, guide = predicted(motion_prior(*states(-0.010 - age_s), clock_offset=0.0))
    assert (twist is not None) == (guide is not None) == holds


def test_slow_odometry_shows_an_acceleration():
    """Samples of 50 Hz with 0.02 rad/s of noise, the last one 25 ms before the frame; the camera turns ever faster."""
    rng, covariance = np.random.default_rng(2), np.diag([1e-4] * 3 + [4e-4] * 3)
    errors, claims, acceleration = [], [], np.array([3.0, -3.0, 3.0])
    for _ in range(100):
        heard = [
            Odometry(
                STAMP_NS - age_ms * 10**6,
                np.eye(4),
                np.zeros(3),
                noise - 1e-3 * age_ms * acceleration,
                covariance,
                covariance,
            )
            for age_ms, noise in zip(range(105, 5, -20), 0.02 * rng.standard_normal((5, 3)), strict=True)
        ]
        twist, _ = predicted(motion_prior(*heard))
        errors.append(twist.ago(0.010)[3:] + 0.010 * acceleration)
        claims.append(np.sqrt(np.diag(twist.covariance)[3:]))
    error, normalised = (np.sqrt(np.mean(np.square(e))) for e in (errors, np.divide(errors, claims)))
    # As written 0.022 rad/s; of the last state alone, which shows no acceleration, 0.049.
    assert error < 0.03
    assert normalised < 1.0


def position_std(guide):
    return np.sqrt(np.trace(guide.covariance[:3, :3]))


def test_an_unknown_clock_offset_widens_the_predicted_motion_and_pose():
    sure, known = predicted(motion_prior(*states(), clock_offset=0.0))
    unsure, unknown = predicted(motion_prior(*states(), clock_offset=None))
    # 30 ms of the offset at 2 m/s, and at 3 m/s^2; the acceleration itself is known to a few m/s^2.
    assert position_std(unknown) == pytest.approx(np.hypot(position_std(known), 0.06), rel=1e-6)
    # A clock that the rig's file says is known to a millisecond.
    _, calibrated = predicted(motion_prior(*states(), clock_offset=None), time_offset_std=0.001)
    assert position_std(calibrated) == pytest.approx(np.hypot(position_std(known), 0.002), rel=1e-6)
    assert np.sqrt(sure.covariance[0, 0]) < 0.02
    assert 0.08 < np.sqrt(unsure.covariance[0, 0]) < 0.3


def test_a_velocity_that_the_filter_does_not_know_blurs_no_frame():
    """Markers of the last frame say more; without them nothing does, which is a brisk flight of 1.5 m/s."""
    moving = Twist(np.array([0.0, 2.0, 0.0, 0.0, 0.0, 0.0]), 1e-4 * np.eye(6))
    before_ns = STAMP_NS - 33_333_333
    track = MotionTrack(np.eye(4), 0.010, before_ns, moving, last_seen_ns=before_ns)

    def by(std, track):
        covariance = np.diag([std**2] * 3 + [1e-4] * 3)
        wrong = (replace(state, velocity_body=np.full(3, -4.0), twist_covariance=covariance) for state in states())
        return predict_frame(STAMP_NS, motion_prior(*wrong), track, 0.03)[0]

    np.testing.assert_allclose(by(0.05, track).value[:3], -4.0)
    np.testing.assert_allclose(by(3.0, track).value, moving.value, atol=1e-9)
    unknown = MotionTrack(np.eye(4), 0.010)
    np.testing.assert_allclose(by(0.5, unknown).value[:3], -4.0)
    assert by(3.0, unknown) is None


def test_impossible_odometry_is_left_alone():
    twist, guide = predicted(
        motion_prior(*(replace(state, angular_velocity_body=np.full(3, 1e3)) for state in states()))
    )
    assert twist is None
    assert guide is None


@pytest.mark.parametrize('offset_s', [pytest.param(0.0, marks=pytest.mark.nightly), 0.035])
def test_markers_are_found_whatever_the_offset_of_a_clock_that_is_not_known_yet(offset_s):
    scenario = named('fast')
    scenario = replace(scenario, sensor=replace(scenario.sensor, bad_pixel_share=0.0))
    camera, detector, blind = camera_of(scenario), *(detector_of(scenario, with_map=known) for known in (True, False))
    path, found, found_blind = scenario.trajectory(SECONDS, SEED), [], []
    for frame in render_frames(scenario, SECONDS, SEED, start=300, stop=318):
        motion = path([frame.seconds])
        velocity = motion.rotation.inv().apply(motion.velocity)[0]
        covariance = np.diag([1e-4] * 3 + [1e-5] * 3)
        stamp_ns = frame.stamp_ns + round(offset_s * 1e9)
        state = Odometry(
            stamp_ns, motion.T_map_body[0], velocity, motion.angular_velocity_body[0], covariance, covariance
        )
        prior = motion_prior(state, clock_offset=None)
        found.append(detector.detect(frame.stamp_ns, frame.counts, camera, prior)['id'].tolist())
        found_blind.append(blind.detect(frame.stamp_ns, frame.counts, camera)['id'].tolist())
        assert set(found[-1]) <= set(frame.corners_px)
    for marker_id in set().union(*found_blind):
        with_odometry, without = ([marker_id in ids for ids in each] for each in (found, found_blind))
        first = with_odometry.index(True)
        # Where the odometry predicts a marker out of view, it comes with the next blind search.
        assert first <= without.index(True) + math.ceil(30.0 * detector.config.blind_period)
        # None that was found is lost again.
        assert np.all(np.array(with_odometry[first:]) >= without[first:])
