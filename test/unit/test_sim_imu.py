import numpy as np
from scipy.spatial.transform import Rotation

from thermal_fiducial.sim.camera import plan, simulate_imu
from thermal_fiducial.sim.imu import ImuModel, ImuNoise
from thermal_fiducial.sim.scenario import SCENARIOS
from thermal_fiducial.sim.trajectory import GRAVITY

SILENT = ImuModel(ImuNoise(0.0, 0.0, 0.0, 0.0), 400.0, 0.0, 0.0)


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
    noise = ImuNoise(2e-3, 3e-2, 1e-3, 2e-3)
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
