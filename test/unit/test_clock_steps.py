"""Steps of the camera's clock: the estimate after one is that of a filter that knew when it happened."""

from dataclasses import replace

import numpy as np
import pytest
from support.flights import config, Flight, Motion, START_NS

from thermal_fiducial.core.filter.clock_steps import ClockSteps, FEWEST_POSES, INSTANTS
from thermal_fiducial.core.filter.error_state import ErrorStateFilter
from thermal_fiducial.core.filter.error_state import Motion as FilterMotion
from thermal_fiducial.core.filter.imu import ImuStep
from thermal_fiducial.core.filter.imu_noise import NoiseRange
from thermal_fiducial.core.filter.initialisation import blank_state, start

CONFIG = config(time_offset_random_walk=0.0)
STEP, STEPPED = 0.012, 120
SIZE = ErrorStateFilter(CONFIG).layout.size


def estimates(data, filter_, opened):
    """States after each pose of a clock that steps; with its offset unknown again once it has, if ``opened``."""
    prior = replace(blank_state(CONFIG, filter_.layout), clock_open=False)
    first = filter_.body_pose(data.poses[0], prior.T_body_camera)
    state = start(CONFIG, filter_, first, prior, np.zeros((1, 6)) + data.imu[40])
    noise = NoiseRange((1.7e-4, 2e-3), (1.7e-4, 2e-3))
    states = []
    for count, pose in enumerate(data.poses[1:150]):
        # Poses every 6 samples of the IMU, at its instants; what the clock's step hides is where the robot was.
        begin = 40 + 6 * count
        for imu in 0.5 * (data.imu[begin : begin + 6] + data.imu[begin + 1 : begin + 7]):
            state = filter_.predict(state, ImuStep(imu, 0.005, 1.7e-4, 2e-3))
        body = filter_.body_pose(pose, state.T_body_camera)
        motion = FilterMotion.of(data.imu[begin - 3 : begin + 7], 0.05, pose.stamp_ns, noise)
        corrected, nis = filter_.correct(state, body, motion, -state.time_offset)
        state = corrected if nis <= CONFIG.gate else replace(state, clock_steps=corrected.clock_steps)
        if opened and count == STEPPED:
            state = filter_.with_unknown_clock(state)
        states.append(state)
    return states


@pytest.fixture(scope='module')
def data():
    motion = Motion.random(np.random.default_rng(3), speed=1.0, turn=0.7)
    poses = {'rotation_std': (0.006, 0.006, 0.002), 'translation_std': (0.0006, 0.0006, 0.006)}
    flight = Flight(3, 6.0, motion, pose_rate=200.0 / 6.0, **poses)
    late = []
    for count, pose in enumerate(flight.poses):
        t = (pose.stamp_ns - START_NS) * 1e-9
        moved = motion.pose(t + (STEP if count > STEPPED + 1 else 0.0)) @ np.linalg.inv(motion.pose(t))
        late.append(replace(pose, T_map_camera=moved @ pose.T_map_camera))
    object.__setattr__(flight, 'poses', late)
    return flight


def test_after_a_step_the_estimate_is_as_if_its_instant_had_been_known(data):
    filter_ = ErrorStateFilter(CONFIG)
    known = estimates(data, filter_, opened=True)
    found_in = (
        (state, other, filter_.after_clock_step(state))
        for state, other in zip(estimates(data, filter_, opened=False), known, strict=True)
    )
    state, other, found = next(item for item in found_in if item[2])
    assert found.clock_steps.found == 1
    place = filter_.layout.time_offset
    sigma = np.sqrt(found.covariance[place, place])
    # one knows that the step is some 60 ms, one that it is anything: a tenth of a sigma; and the instant is found
    # from few poses, to one or two of them
    assert found.time_offset == pytest.approx(other.time_offset, abs=sigma)
    assert found.time_offset == pytest.approx(state.time_offset + STEP, abs=4.0 * sigma)
    np.testing.assert_allclose(found.position, other.position, atol=2e-3)
    np.testing.assert_allclose(np.sqrt(np.diag(found.covariance)), np.sqrt(np.diag(other.covariance)), rtol=0.5)
    # without it the estimate stays with the clock of before
    assert abs(state.time_offset - other.time_offset) > 5.0 * sigma


def test_nothing_is_found_before_a_step(data):
    filter_ = ErrorStateFilter(CONFIG)
    assert all(filter_.after_clock_step(state) is None for state in estimates(data, filter_, opened=False)[:STEPPED])


def constant(steps, innovation, poses, gate=22.5):
    """``steps`` after poses that all have the same innovation (6,), in a motion along the first axis."""
    H = np.zeros((6, SIZE))
    H[3, -1] = 1.0
    for _ in range(poses):
        shown = H @ steps.responses
        steps = steps.seen(innovation, shown, 1e4 * np.eye(6), gate)
        steps = steps.corrected(np.zeros((SIZE, 6)), shown, SIZE - 1)
    return steps


@pytest.mark.parametrize(
    ('metres', 'aside', 'poses', 'found'),
    [
        (0.04, 0.0, FEWEST_POSES + 1, True),
        (0.04, 0.0, FEWEST_POSES, False),
        (0.02, 0.0, FEWEST_POSES + 1, False),
        (0.002, 0.0, 2 * INSTANTS, False),
        (0.04, 0.04, FEWEST_POSES + 1, False),
        (0.4, 0.1, 3 * INSTANTS, False),
    ],
)
def test_a_step_is_what_enough_poses_show_and_nothing_else_explains(metres, aside, poses, found):
    """Of 1 cm: 4 cm are four sigma along the motion, and 4 cm aside of it are no matter of the clock."""
    steps = constant(ClockSteps.none(SIZE), np.array([0.0, 0.0, 0.0, metres, aside, 0.0]), poses)
    step = steps.found_step()
    assert (step is not None) == found
    if step:
        assert step.error[-1] == pytest.approx(metres)


def test_hypotheses_turn_with_the_error(data):
    rng = np.random.default_rng(0)
    steps = ClockSteps(rng.normal(size=(SIZE, INSTANTS)), np.zeros((5, INSTANTS)))
    turn = rng.normal(size=(SIZE, SIZE))
    np.testing.assert_allclose(steps.turned(turn).responses, turn @ steps.responses)
