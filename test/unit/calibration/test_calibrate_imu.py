"""``calibrate imu``: the densities that a simulated IMU at rest has."""

import numpy as np
import pytest
from support import small_bag
from support.flights import rms
import yaml

pytest.importorskip('allantools')

from thermal_fiducial.calibration.allan_deviation import fit_noise
from thermal_fiducial.calibration.preintegration import ImuTrack
from thermal_fiducial.cli.main import main
from thermal_fiducial.config import ImuNoise, PoseEkfConfig
from thermal_fiducial.files.bags import IMU_TOPIC
from thermal_fiducial.replay.settings import read_settings

TRUE = ImuNoise(
    gyroscope_noise_density=3e-3,
    accelerometer_noise_density=2e-2,
    gyroscope_random_walk=4e-4,
    accelerometer_random_walk=3e-3,
)
RATE = 100.0
GAP = slice(1000, 2000)


def at_rest(seconds, noise=TRUE, seed=0):
    """(N, 6) readings and (N,) times."""
    rng, count = np.random.default_rng(seed), round(seconds * RATE)
    white = np.repeat([noise.gyroscope_noise_density, noise.accelerometer_noise_density], 3) * np.sqrt(RATE)
    walk = np.repeat([noise.gyroscope_random_walk, noise.accelerometer_random_walk], 3) / np.sqrt(RATE)
    values = white * rng.normal(size=(count, 6)) + np.cumsum(walk * rng.normal(size=(count, 6)), axis=0)
    return np.arange(count) / RATE, values + np.array([0.01, 0.0, -0.01, 0.0, 0.1, 9.8])


def track(times, values):
    return ImuTrack(times, values[:, :3], values[:, 3:])


def test_densities_of_a_long_recording():
    # Quieter in its walks, so that an hour is at rest.
    noise = ImuNoise(3e-3, 2e-2, 5e-5, 5e-4)
    fit = fit_noise(track(*at_rest(3000.0, noise)))
    assert fit.rate_hz == pytest.approx(RATE)
    # White noise is known to a per cent by 300,000 samples.
    assert rms(fit.gyroscope.white) == pytest.approx(3e-3, rel=0.02)
    assert rms(fit.accelerometer.white) == pytest.approx(2e-2, rel=0.02)
    # Random walks by the few averages over tens of seconds: a quarter to a half.
    assert rms(fit.gyroscope.walk) == pytest.approx(5e-5, rel=0.6)
    assert rms(fit.accelerometer.walk) == pytest.approx(5e-4, rel=0.6)


def test_the_command_writes_parameters(tmp_path, capsys):
    noise = ImuNoise(3e-3, 2e-2, 5e-5, 5e-4)
    times, values = at_rest(60.0, noise)
    stamps = small_bag.START_NS + np.round(times * 1e9).astype(np.int64)
    rows = zip(stamps.tolist(), values, strict=True)
    events = [(stamp, IMU_TOPIC, small_bag.imu(stamp, row)) for stamp, row in rows]
    bag = small_bag.Recording(events).write(tmp_path / 'bag')
    out = tmp_path / 'imu.yaml'
    assert main(['calibrate', 'imu', str(bag), '--out', str(out)]) == 0
    written = yaml.safe_load(out.read_text())['/**']['ros__parameters']['imu']
    assert set(written) == {
        'gyroscope_noise_density', 'accelerometer_noise_density', 'gyroscope_random_walk', 'accelerometer_random_walk',
        'gyroscope_instability', 'accelerometer_instability',
    }  # fmt: skip
    settings = read_settings(out, {})
    assert settings.pose_ekf.imu.gyroscope_noise_density == pytest.approx(3e-3, rel=0.05)
    # At rest biases change less than in flight.
    assert settings.pose_ekf.imu.accelerometer_instability == ImuNoise().accelerometer_instability
    assert settings.pose_ekf.gravity == PoseEkfConfig().gravity
    printed = capsys.readouterr().out
    assert '1.28 s: ' in printed
    assert 'take these for bounds' in printed
    assert '# in flight; at rest ' in printed


def test_the_command_takes_a_csv_file(tmp_path, capsys):
    times, values = at_rest(60.0)
    stamps = small_bag.START_NS + np.round(times * 1e9).astype(np.int64)
    file, out = tmp_path / 'imu.csv', tmp_path / 'imu.yaml'
    lines = [','.join(map(str, (stamp, *row))) for stamp, row in zip(stamps.tolist(), values.tolist(), strict=True)]
    file.write_text('\n'.join(['stamp_ns,wx,wy,wz,ax,ay,az', *lines]))
    assert main(['calibrate', 'imu', str(file), '--out', str(out)]) == 0
    written = yaml.safe_load(out.read_text())['/**']['ros__parameters']['imu']
    # A random walk of 4e-4 adds a few per cent at the shortest averaging times.
    assert written['gyroscope_noise_density'] == pytest.approx(3e-3, rel=0.05)
    assert main(['calibrate', 'imu', str(file), '--remap', 'a:=b']) == 2
    assert '--remap has no effect with a CSV file' in capsys.readouterr().err
    # Stamps in seconds.
    file.write_text('\n'.join(['t,wx,wy,wz,ax,ay,az', *(line[10:] for line in lines)]))
    assert main(['calibrate', 'imu', str(file)]) == 2


@pytest.mark.parametrize(
    ('change', 'words'),
    [
        (lambda t, v: (t[:1000], v[:1000]), 'too short'),
        (lambda t, v: (t, v + 0.5 * (t > 30.0)[:, None]), 'not at rest: its gyroscope x changes at'),
        (
            lambda t, v: (np.delete(t, GAP), np.delete(v, GAP, 0)),
            'missing for 17 % of the time',
        ),
        (lambda t, v: (t, 0.0 * v), 'says the same'),
        # A dead axis need not say zero.
        (lambda t, v: (t, np.where(np.arange(6) == 5, 9.81, v)), 'says the same'),
        (lambda t, v: (t, np.where(np.arange(6) == 0, 0.0123, v)), 'says the same'),
    ],
)
def test_what_is_no_rest_is_refused(change, words):
    with pytest.raises(ValueError, match=words):
        fit_noise(track(*change(*at_rest(60.0, ImuNoise(3e-3, 2e-2, 5e-5, 5e-4)))))


def test_the_command_names_the_recording_that_it_refuses(tmp_path, capsys):
    stamps = small_bag.START_NS + np.arange(200) * 5_000_000
    at_rest = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 9.8])
    events = [(stamp, IMU_TOPIC, small_bag.imu(stamp, at_rest)) for stamp in stamps.tolist()]
    bag = small_bag.Recording(events).write(tmp_path / 'bag')
    assert main(['calibrate', 'imu', str(bag), '--out', str(tmp_path / 'imu.yaml')]) == 2
    assert f'{bag}: 1.0 s are too short' in capsys.readouterr().err


@pytest.mark.parametrize('force', [1.0, 0.0, 9806.65])
def test_accelerations_of_a_bag_are_metres_a_second_squared_with_gravity(tmp_path, capsys, force):
    """A CSV file in g was refused; of a bag in g, or in a thousandth of it, the densities were wrong without a word."""
    times, values = at_rest(25.0)
    values[:, 3:] *= force / 9.8
    stamps = small_bag.START_NS + np.round(times * 1e9).astype(np.int64)
    rows = zip(stamps.tolist(), values, strict=True)
    bag = small_bag.Recording([(stamp, IMU_TOPIC, small_bag.imu(stamp, row)) for stamp, row in rows])
    out = tmp_path / 'imu.yaml'
    assert main(['calibrate', 'imu', str(bag.write(tmp_path / 'bag')), '--out', str(out)]) == 2
    assert 'm/s^2 on average, gravity makes them 9.8' in capsys.readouterr().err
    assert not out.exists()
