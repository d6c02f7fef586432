import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from thermal_fiducial.errors import InputError
from thermal_fiducial.files.trajectory_file import save_tum
from thermal_fiducial.sim.recorded import RecordedFlight
from thermal_fiducial.sim.scenario import SCENARIOS
from thermal_fiducial.sim.spline_trajectory import Flight, SplineTrajectory
from thermal_fiducial.sim.thermal_camera import plan, true_corners

STEP = 1e-4


def check_derivatives(path, step, rate_atol):
    """The derivatives that a path gives against central differences over ``step`` [s] to either side."""
    t = np.linspace(1.0, 23.0, 57)
    before, here, after = path(t - step), path(t), path(t + step)
    turn = (before.rotation.inv() * after.rotation).as_rotvec() / (2 * step)
    np.testing.assert_allclose(here.velocity, (after.position - before.position) / (2 * step), atol=1e-6)
    np.testing.assert_allclose(here.acceleration, (after.velocity - before.velocity) / (2 * step), atol=1e-5)
    np.testing.assert_allclose(here.angular_velocity_body, turn, atol=rate_atol)


@pytest.mark.parametrize('name', SCENARIOS)
def test_derivatives_are_those_of_the_motion(name):
    # Central differences over 0.1 ms: the error is step^2/6 times a third derivative of at most 100.
    check_derivatives(SCENARIOS[name].flight.trajectory(24.0, seed=4), STEP, 1e-5)


@pytest.mark.parametrize('name', [name for name, item in SCENARIOS.items() if isinstance(item.flight, Flight)])
def test_takes_off_and_lands_at_the_same_point(name):
    trajectory = SCENARIOS[name].flight.trajectory(30.0, seed=1)
    start, high, end = trajectory([0.0]), trajectory([6.0]), trajectory([30.0])
    # The splines' ripple from where the motion begins; it has decayed below a micrometre.
    np.testing.assert_allclose(start.position, end.position, atol=1e-6)
    np.testing.assert_allclose(start.velocity, 0.0, atol=1e-5)
    assert high.position[0, 2] > start.position[0, 2] + 0.5
    assert (start.rotation.inv() * end.rotation).magnitude()[0] < 1e-5


def test_derivatives_of_a_vibration_are_those_of_its_motion():
    scenario, step = SCENARIOS['rough'], 1e-6
    shaken, smooth = scenario.trajectory(24.0, seed=4), scenario.flight.trajectory(24.0, seed=4)
    t = np.linspace(1.0, 23.0, 57)
    # Central differences: step^2/6 times a third derivative of 1e5, five lines of 0.4 m/s^2 at up to 179 Hz.
    check_derivatives(shaken, step, 1e-6)
    here, quiet = shaken(t), smooth(t)
    assert 0.3 < np.std(here.acceleration - quiet.acceleration) / (0.4 * np.sqrt(5 / 2)) < 2.0
    assert np.abs(here.position - quiet.position).max() < 1e-5
    assert 1e-5 < (quiet.rotation.inv() * here.rotation).magnitude().max() < 2e-4


def test_seeds_fly_differently():
    positions = [SCENARIOS['wall'].trajectory(20.0, seed)([9.0]).position for seed in (0, 1)]
    assert np.linalg.norm(positions[0] - positions[1]) > 0.02


def test_fast_flight_is_fast():
    flight = plan('fast')
    motion = flight.scenario.trajectory(flight.seconds, flight.seed)(np.linspace(0, flight.seconds, 600))
    rate = np.degrees(np.linalg.norm(motion.angular_velocity_body, axis=1).max())
    assert 120 < rate < 150
    assert 1.5 < np.linalg.norm(motion.velocity, axis=1).max() < 3.0


def test_dropout_hides_all_markers_twice_for_two_seconds():
    flight = plan('dropout', seed=5)
    scenario = flight.scenario
    plates = scenario.plates
    t = np.arange(0.0, flight.seconds, 0.1)
    poses = scenario.trajectory(flight.seconds, flight.seed)(t).T_map_body @ scenario.T_body_camera
    visible = [true_corners(scenario.lens, scenario.markers, plates, pose) for pose in poses]
    seen = ''.join('x' if corners else ' ' for corners in visible)
    assert [len(gap) >= 20 for gap in seen.split('x') if gap] == [True, True]


def test_too_short_a_flight_is_refused():
    with pytest.raises(InputError, match='too short'):
        SCENARIOS['wall'].trajectory(5.0, 0)


def test_a_flight_that_rotors_cannot_fly_is_refused():
    # A step of seventh degree brakes with 7.5 h / t^2: 13 m/s^2 is more than gravity does, 7.5 m/s^2 less.
    with pytest.raises(InputError, match='falls faster than gravity'):
        Flight(height=0.7, climb_time=0.63).trajectory(12.0, 0)
    Flight(height=0.7, climb_time=0.84).trajectory(12.0, 0)


def test_follows_recorded_poses(tmp_path):
    t = np.arange(0.0, 6.0, 0.02)
    positions = np.stack([np.sin(t), 0.5 * np.cos(t), 1.0 + 0.1 * t], axis=1)
    rotations = Rotation.from_euler('ZYX', np.stack([t, 0.2 * np.sin(t), 0.1 * np.cos(t)], axis=1))
    # The sign of a quaternion in a file is arbitrary.
    signs = np.where(np.arange(len(t)) % 7 < 3, -1.0, 1.0)[:, None]
    save_tum(tmp_path / 'a.tum', (1e9 * (t + 50)).round().astype(int), positions, rotations.as_quat() * signs)
    flight = RecordedFlight.load(tmp_path / 'a.tum')
    motion = flight.trajectory(flight.seconds, 0)(t)
    # Ten knots a second of a curve with unit derivatives: interpolation between the poses adds (0.01)^2/8.
    np.testing.assert_allclose(motion.position, positions, atol=1e-4)
    assert np.max((motion.rotation.inv() * rotations).magnitude()) < 1e-4
    assert flight.seconds == pytest.approx(5.98)


def test_refuses_too_few_poses(tmp_path):
    save_tum(tmp_path / 'a.tum', [0, 10**9], np.zeros((2, 3)), np.tile([0, 0, 0, 1.0], (2, 1)))
    with pytest.raises(InputError, match='too short for a flight'):
        RecordedFlight.load(tmp_path / 'a.tum')
    with pytest.raises(InputError, match='more than'):
        SplineTrajectory(np.arange(3.0), np.zeros((3, 3)), Rotation.identity(3))
    with pytest.raises(InputError, match='increasing'):
        SplineTrajectory(np.zeros(8), np.zeros((8, 3)), Rotation.identity(8))
