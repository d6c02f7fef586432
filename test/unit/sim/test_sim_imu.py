from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from thermal_fiducial.sim.imu import Delivery, ImuModel, SimulatedNoise
from thermal_fiducial.sim.scenario import SCENARIOS
from thermal_fiducial.sim.spline_trajectory import GRAVITY
from thermal_fiducial.sim.thermal_camera import plan, simulate_imu

SILENT = ImuModel(SimulatedNoise(0.0, 0.0, 0.0, 0.0), 400.0, 0.0, 0.0)


def test_noiseless_imu_integrates_to_the_flight():
    trajectory = SCENARIOS['fast'].trajectory(20.0, seed=2)
    t = np.arange(0.0, 20.0, 1 / 400)
    record = SILENT.sample(trajectory, t, (t * 1e9).astype(np.int64), 0)
    truth = trajectory(t)
    rotation, position, velocity = truth.rotation[0], truth.position[0].copy(), truth.velocity[0].copy()
    step = t[1] - t[0]
    for n in range(len(t) - 1):
        rate = 0.5 * (record.angular_velocity[n] + record.angular_velocity[n + 1])
        later = rotation * Rotation.from_rotvec(rate * step)
        force = [r.apply(f) for r, f in zip((rotation, later), record.linear_acceleration[n : n + 2], strict=True)]
        acceleration = 0.5 * (force[0] + force[1]) - np.array([0.0, 0.0, GRAVITY])
        position += velocity * step + 0.5 * acceleration * step**2
        velocity += acceleration * step
        rotation = later
    # The trapezoid's error at 400 Hz: rate'' step^2/12 of 1e-5 rad, times gravity, twice integrated over 20 s.
    assert (rotation.inv() * truth.rotation[-1]).magnitude() < 1e-4
    np.testing.assert_allclose(position, truth.position[-1], atol=0.02)


def test_at_rest_it_feels_gravity():
    record = SILENT.sample(SCENARIOS['wall'].trajectory(20.0, 0), np.array([0.2]), np.array([0]), 0)
    np.testing.assert_allclose(record.linear_acceleration, [[0.0, 0.0, GRAVITY]], atol=1e-4)


def test_noise_has_the_densities():
    rate, seconds = 200.0, 500.0
    noise = SimulatedNoise(2e-3, 3e-2, 1e-3, 2e-3)
    t = np.arange(0.0, seconds, 1 / rate)
    trajectory = SCENARIOS['wall'].trajectory(20.0, 0)
    stamps = (t * 1e9).astype(np.int64)
    noisy = ImuModel(noise, rate, 0.0, 0.0).sample(trajectory, t, stamps, 3)
    clean = SILENT.sample(trajectory, t, stamps, 3)
    for bias, walk in ((noisy.gyroscope_bias, 1e-3), (noisy.accelerometer_bias, 2e-3)):
        # 100000 steps and three axes: the deviation's own error is 0.2 %, five of them are allowed.
        assert abs(np.diff(bias, axis=0).std() / (walk / np.sqrt(rate)) - 1) < 0.01
    white = noisy.angular_velocity - clean.angular_velocity - noisy.gyroscope_bias
    assert abs(white.std() / (2e-3 * np.sqrt(rate)) - 1) < 0.01
    white = noisy.linear_acceleration - clean.linear_acceleration - noisy.accelerometer_bias
    assert abs(white.std() / (3e-2 * np.sqrt(rate)) - 1) < 0.01


def test_rattle_and_jitter_come_on_top():
    rate = 200.0
    t = np.arange(0.0, 100.0, 1 / rate)
    stamps = np.round(t * 1e9).astype(np.int64)
    trajectory = SCENARIOS['wall'].trajectory(20.0, 0)
    model = ImuModel(rate=rate, gyroscope_rattle=0.02, accelerometer_rattle=0.3, stamp_jitter=3e-4)
    rattling, quiet = (case.sample(trajectory, t, stamps, 3) for case in (model, ImuModel(rate=rate)))
    np.testing.assert_array_equal(rattling.gyroscope_bias, quiet.gyroscope_bias)
    # 20000 samples, three axes: 0.3 % of statistics.
    assert abs((rattling.angular_velocity - quiet.angular_velocity).std() / 0.02 - 1) < 0.02
    assert abs((rattling.linear_acceleration - quiet.linear_acceleration).std() / 0.3 - 1) < 0.02
    late = rattling.stamps_ns - stamps
    # 20000 of them: 0.5 % of statistics, and the mean's deviation is 2 us.
    assert abs(late.std() / 3e5 - 1) < 0.03
    assert abs(late.mean()) < 1e4
    assert np.all(np.diff(rattling.stamps_ns) > 0)
    np.testing.assert_array_equal(quiet.stamps_ns, stamps)


def test_stamps_and_seeds():
    first, again, other = (simulate_imu('wall', 12.0, seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(np.diff(first.stamps_ns), 5_000_000)
    assert len(first.stamps_ns) == 12 * 200 + 1
    np.testing.assert_array_equal(first.angular_velocity, again.angular_velocity)
    assert np.any(first.angular_velocity != other.angular_velocity)
    assert plan('wall', 12.0, 1).imu_stamps()[1][0] == first.stamps_ns[0]


# --- errors beside the noise --------------------------------------------------------------------------


def recorded(model, seed=3):
    """Readings of a silent but otherwise faulty IMU, and what is true, in a flight that turns."""
    t = np.arange(0.0, 20.0, 1 / model.rate)
    path = SCENARIOS['fast'].trajectory(20.0, 0)
    stamps = np.round(t * 1e9).astype(np.int64)
    return t, model.sample(path, t, stamps, seed), replace(SILENT, rate=model.rate).sample(path, t, stamps, seed)


def test_axes_and_g_sensitivity_multiply_the_true_values():
    faulty = replace(SILENT, gyroscope_axes=0.01, accelerometer_axes=0.02, g_sensitivity=1e-3)
    _, readings, truth = recorded(faulty)
    inputs = np.hstack([truth.angular_velocity, truth.linear_acceleration])
    outputs = np.hstack([readings.angular_velocity, readings.linear_acceleration])
    matrix = np.linalg.lstsq(inputs, outputs, rcond=None)[0].T - np.eye(6)
    # Nothing but three matrices of nine draws each: their rms scatters by a quarter, seldom by half.
    for block, deviation in ((matrix[:3, :3], 0.01), (matrix[3:, 3:], 0.02), (matrix[:3, 3:], 1e-3)):
        assert 0.5 * deviation < np.sqrt(np.mean(block**2)) < 1.5 * deviation
    np.testing.assert_allclose(matrix[3:, :3], 0.0, atol=1e-10)


def test_an_instability_has_its_deviation_and_its_time():
    model = replace(SILENT, gyroscope_instability=1e-3, accelerometer_instability=0.05, instability_time=0.2)
    _, readings, truth = recorded(model)
    wander = readings.linear_acceleration - truth.linear_acceleration
    np.testing.assert_allclose(wander, readings.accelerometer_bias, atol=1e-12)
    # 20 s are 50 independent stretches of each of three axes: its variance is known to a tenth.
    assert 0.8 * 0.05 < np.std(wander) < 1.2 * 0.05
    steps = round(0.2 * model.rate)
    correlation = np.mean(wander[steps:] * wander[:-steps]) / np.mean(wander**2)
    assert 0.2 < correlation < 0.55  # e^-1, by as many stretches


def test_a_driver_that_reads_now_and_then():
    model = replace(SILENT, rate=80.0, delivery=Delivery(gaps=((4.0, 0.8),), steps_back=(6.0,)))
    t, readings, truth = recorded(model)
    steps = np.diff(readings.stamps_ns) * 1e-9
    assert np.sum(steps < 0.0) == 1
    np.testing.assert_allclose(steps[np.argmin(steps)], -1e-3, atol=1e-9)
    assert 0.8 < steps.max() < 0.9
    bursts = steps[(steps > 0.0) & (steps < 0.4)]
    assert set(np.round(bursts, 5)) <= {0.00013, 0.03287, 0.033, 0.03274, 0.034, 0.03387}
    # What was sampled between two readings of the driver comes with the second, none of it changed.
    lost = (t % 10.0 >= 4.0) & (t % 10.0 < 4.8)
    np.testing.assert_array_equal(readings.angular_velocity, truth.angular_velocity[~lost])


def test_the_truth_is_in_the_clock_in_which_the_driver_stamps():
    """It was 17 ms early for the carpet: of its own ground truth the report said that its clock was another one."""
    flight = plan('carpet', seed=2)
    readings = simulate_imu('carpet', seed=2)
    path = flight.scenario.trajectory(flight.seconds, 2)
    seconds = (readings.stamps_ns - flight.imu_stamps()[1][0]) * 1e-9
    offsets = np.arange(0.0, 0.035, 0.001)
    off = [np.std(readings.angular_velocity - path(seconds - offset).angular_velocity_body) for offset in offsets]
    late = (flight.truth_stamps() - flight.imu_stamps()[1]) * 1e-9
    # To a step of the offsets and one more, for the noise of 1600 samples.
    np.testing.assert_allclose(late, offsets[np.argmin(off)], atol=2e-3)
    plain = plan('wall')
    np.testing.assert_array_equal(plain.truth_stamps(), plain.imu_stamps()[1])
