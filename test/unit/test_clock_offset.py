"""The offset between the clocks of camera and odometry, learned from markers off their predicted places."""

from dataclasses import replace

import numpy as np
import pytest
from support.scenes import camera_of, detector_of, told

from thermal_fiducial.core.detection.clock_offset import ClockOffset, LIMIT_S
from thermal_fiducial.core.measurements import Odometry
from thermal_fiducial.sim.camera import render_frames
from thermal_fiducial.sim.scenario import named

PERIOD_NS = 33_333_333
SECONDS, SEED = 20.0, 21


def flown(truth_s, speed_px_s=300.0, frames=60, wrong_marker_px=0.0, seed=0):
    """What is learned from three markers [s], with errors of a pixel that they have in common, and 0.2 of their own."""
    rng, clock = np.random.default_rng(seed), ClockOffset()
    for k in range(frames):
        angle = rng.uniform(0.0, 2.0 * np.pi)
        velocity = np.broadcast_to(speed_px_s * np.array([np.cos(angle), np.sin(angle)]), (3, 4, 2))
        off = (truth_s - 1e-9 * clock.ns) * velocity + rng.normal(0.0, 1.0, 2) + rng.normal(0.0, 0.2, (3, 4, 2))
        off[0] += wrong_marker_px
        clock.learn(k * PERIOD_NS, off, velocity)
    return 1e-9 * clock.ns


@pytest.mark.parametrize('truth_s', [0.0, 0.030, -0.040])
def test_offset_is_learned(truth_s):
    # A pixel at 300 px/s is 3 ms, of which a filter of a second or so averages most.
    assert abs(flown(truth_s) - truth_s) < 0.003


def test_a_marker_that_was_moved_tells_nothing():
    assert abs(flown(0.0, wrong_marker_px=30.0)) < 0.003


def test_slow_images_tell_nothing():
    assert flown(0.030, speed_px_s=50.0) == 0.0
    clock = ClockOffset()
    clock.learn(0, np.zeros((0, 4, 2)), np.zeros((0, 4, 2)))
    assert clock.ns == 0


def test_offset_stays_within_its_limit():
    assert flown(1.0, frames=300) == pytest.approx(LIMIT_S)


def test_offset_may_change():
    clock, velocity = ClockOffset(), np.full((2, 4, 2), 300.0)
    for k in range(600):
        truth = 0.0 if k < 300 else 0.020
        clock.learn(k * PERIOD_NS, (truth - 1e-9 * clock.ns) * velocity, velocity)
    assert 1e-9 * clock.ns == pytest.approx(0.020, abs=0.001)


@pytest.mark.parametrize('offset_s', [0.0, 0.035])
def test_detector_learns_the_clock_of_its_odometry(offset_s):
    scenario = named('fast')
    scenario = replace(scenario, sensor=replace(scenario.sensor, bad_pixel_share=0.0))
    camera, detector = camera_of(scenario), detector_of(scenario, with_map=True)
    path = scenario.trajectory(SECONDS, SEED)
    for frame in render_frames(scenario, SECONDS, SEED, start=300, stop=314):
        motion = path([frame.seconds])
        velocity = motion.rotation.inv().apply(motion.velocity)[0]
        covariance = np.diag([1e-4] * 3 + [1e-5] * 3)
        stamp_ns = frame.stamp_ns + round(offset_s * 1e9)
        turn = motion.angular_velocity_body[0]
        state = Odometry(stamp_ns, motion.T_map_body[0], velocity, turn, covariance, covariance)
        detector.detect(frame.stamp_ns, frame.counts, camera, told(state))
    # The lag is known and the odometry is true: what is left is a pixel of 300 px/s, if anything.
    assert 1e-9 * detector._clock_offset.ns == pytest.approx(offset_s, abs=0.003)
