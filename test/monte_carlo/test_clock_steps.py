"""A camera's clock that steps: large ones are refused until enough poses agree, small ones no single pose shows."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from support.flights import config, errors, Flight, Motion, run, START_NS, timeline

from thermal_fiducial.core.filter.error_state import ErrorStateFilter
from thermal_fiducial.core.filter.pose_ekf import PoseEkf
from thermal_fiducial.core.geometry.se3 import so3_exp, so3_log, transform

pytestmark = pytest.mark.slow
STEPPED = 6.0
#: Poses of several markers: a few millimetres and a fifth of a degree; and of one: twice and three times that.
SEVERAL = {'rotation_std': (0.003, 0.003, 0.001), 'translation_std': (0.0003, 0.0003, 0.003)}
ONE = {'rotation_std': (0.009, 0.009, 0.003), 'translation_std': (0.0006, 0.0006, 0.006)}


@cache
def flight(seed, seconds=10.0, one=False):
    motion = Motion.random(np.random.default_rng(seed), speed=1.5, turn=1.0)
    return Flight(seed, seconds, motion, **(ONE if one else SEVERAL))


def seconds_of(item):
    return (item.stamp_ns - START_NS) * 1e-9


def stepping(poses, step):
    """Poses whose stamps step by ``step`` [s]."""
    return [
        replace(pose, stamp_ns=pose.stamp_ns - round((step if seconds_of(pose) > STEPPED else 0.0) * 1e9))
        for pose in poses
    ]


@pytest.mark.parametrize('seed', [30, 34])
@pytest.mark.parametrize('step', [-0.06, -0.03, -0.01, 0.007, 0.03, 0.06])
def test_a_camera_clock_that_steps_is_followed(seed, step):
    """A quarter of the frames is lost, and the rest comes late and in disorder: good poses must win all the same."""
    rng = np.random.default_rng(seed)
    data = flight(seed)
    poses = stepping([pose for pose in data.poses if rng.random() > 0.25], step)
    ekf = PoseEkf(config())
    states, _ = run(ekf, timeline(data.samples(), poses, rng.uniform(0.03, 0.15, len(poses))))
    numbers = ekf.diagnostics()
    # What looks like no step is refused until a second of poses has agreed; that long the IMU alone errs by 5 to 9 mm.
    assert errors(data, states, 5.0)[0].max() < 0.02
    assert numbers['starts afresh'] + numbers['clock steps'] == 1.0
    assert abs(numbers['time offset'] - step) < 4.0 * numbers['time offset std']
    assert numbers['time offset std'] < 0.002


def squares_after_small_steps():
    """Mean squared errors of the poses in sigma, per degree of freedom, from half a second after steps on."""
    means = []
    for seed, step in ((30, 0.008), (31, -0.008), (32, 0.01), (33, -0.01)):
        data = flight(seed, 9.0, one=True)
        states, _ = run(PoseEkf(config()), timeline(data.samples(), stepping(data.poses, step), 0.03))
        after = [state for state in states if seconds_of(state) > STEPPED + 0.5]
        T_true = data.motion.pose([seconds_of(state) for state in after])
        turn = [so3_log(T[:3, :3] @ s.T_map_body[:3, :3].T) for s, T in zip(after, T_true, strict=True)]
        shift = T_true[:, :3, 3] - np.array([state.T_map_body[:3, 3] for state in after])
        error = np.hstack((shift, turn))
        P = np.array([state.pose_covariance for state in after])
        means.append(np.einsum('ni,nij,nj->n', error, np.linalg.inv(P), error).mean() / 6.0)
    return np.array(means)


def test_after_a_small_step_the_pose_is_as_good_as_claimed():
    # 1 is honest, 49 the worst without it; the last poses before the step is believed are in it
    assert squares_after_small_steps().max() < 2.0


def test_small_steps_that_are_learned_slowly_are_noticed(monkeypatch):
    """Negative control."""
    monkeypatch.setattr(ErrorStateFilter, 'after_clock_step', lambda *_: None)
    assert squares_after_small_steps().max() > 4.0


def wild(pose, rng):
    """One pose in ten is anywhere near."""
    T = pose.T_map_camera
    shift, turn = 0.1 * rng.normal(size=3), 0.05 * rng.normal(size=3)
    return transform(T[:3, :3] @ so3_exp(turn), T[:3, 3] + shift) if rng.uniform() < 0.1 else T


def displaced(pose, _):
    """A marker that has been moved is seen alone for 0.8 s."""
    T = pose.T_map_camera
    return transform(T[:3, :3], T[:3, 3] + [0.02, -0.03, 0.01]) if 5.0 < seconds_of(pose) < 5.8 else T


@pytest.mark.parametrize('change', [lambda pose, _: pose.T_map_camera, wild, displaced])
def test_no_step_is_found_where_there_is_none(change):
    for seed in (30, 31):
        data, rng = flight(seed), np.random.default_rng(seed)
        poses = [replace(pose, T_map_camera=change(pose, rng)) for pose in data.poses]
        ekf = PoseEkf(config())
        run(ekf, timeline(data.samples(), poses, 0.03))
        assert ekf.diagnostics()['clock steps'] == 0.0


def test_a_frozen_camera_is_no_clock_that_steps():
    for seed in (30, 31):
        data = flight(seed)
        held = next(pose for pose in data.poses if seconds_of(pose) >= STEPPED)
        poses = [
            replace(pose, T_map_camera=held.T_map_camera, covariance=held.covariance)
            if STEPPED <= seconds_of(pose) < STEPPED + 0.5
            else pose
            for pose in data.poses
        ]
        ekf = PoseEkf(config())
        run(ekf, timeline(data.samples(), poses, 0.03))
        assert ekf.diagnostics()['clock steps'] == 0.0
