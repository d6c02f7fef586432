"""The filter's speed, its error beside a batch smoother's and what is possible without markers; its clock offset."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy.stats import chi2
from support.flights import (
    config,
    errors,
    Flight,
    IMU,
    matched,
    Motion,
    perfect,
    rms,
    run,
    START_NS,
    timeline,
)

from thermal_fiducial.config import ImuNoise, PoseEkfConfig
from thermal_fiducial.core.filter.ekf import PoseEkf
from thermal_fiducial.core.filter.propagation import hovered, random_walks
from thermal_fiducial.core.filter.state import POSITION
from thermal_fiducial.core.geometry.se3 import rotation_angle, so3_exp, transform
from thermal_fiducial.core.measurements import ImuSample

SETTLED = 5.0
#: One marker at 2 m with 0.3 px corners, and several markers.
POSES = {
    'one marker': {},
    'several markers': {'rotation_std': (0.003, 0.003, 0.001), 'translation_std': (0.0003, 0.0003, 0.003)},
}


@pytest.fixture
def running():
    """A filter in mid-flight, and the samples and poses that come next."""
    data = Flight(seed=1, seconds=20.0)
    samples = data.samples()
    ekf = PoseEkf(config())
    run(ekf, timeline(samples[:1000], [pose for pose in data.poses if pose.stamp_ns < samples[990].stamp_ns]))
    return ekf, iter(samples[1000:]), data


def test_imu_sample(benchmark, running):
    ekf, samples, _ = running
    benchmark.pedantic(lambda: ekf.add_imu(next(samples)), rounds=1000)


def test_pose_sixty_milliseconds_late(benchmark, running):
    ekf, _, data = running
    arrivals = iter(timeline(data.samples()[1000:], data.poses[150:], 0.06))

    def next_pose():
        for item in arrivals:
            if not isinstance(item, ImuSample):
                return (item,), {}
            ekf.add_imu(item)
        raise AssertionError('the flight is too short')

    benchmark.pedantic(ekf.add_pose, setup=next_pose, rounds=200)


def errors_of(data, stamps, T):
    """Position (N,) [m] and attitude (N,) [rad] errors, the first seconds left out."""
    t = (stamps - START_NS) * 1e-9
    truth = data.motion.pose(t)[t > SETTLED]
    T = T[t > SETTLED]
    turn = np.swapaxes(truth[:, :3, :3], -1, -2) @ T[:, :3, :3]
    return np.linalg.norm(T[:, :3, 3] - truth[:, :3, 3], axis=1), rotation_angle(turn)


def filtered_errors(data, delay):
    states, _ = run(PoseEkf(matched()), timeline(data.samples(), data.poses, delay))
    return errors(data, states, SETTLED)


def pooled(method, flights):
    """Rms position [m] and attitude [rad] errors over the flights: one of them varies by a quarter."""
    return [rms(np.concatenate(parts)) for parts in zip(*map(method, flights), strict=True)]


def test_error_beside_the_bounds(benchmark, write_table):
    """All know the noise. At all IMU samples; "best possible" has the poses that came until then, the smoother all."""
    gtsam = pytest.importorskip('support.batch_smoother', reason='gtsam is not installed: pip install .[smoother]')
    rows = [['poses', 'filter', 'best possible', 'ratio', 'batch smoother', 'ratio']]
    benchmark.pedantic(filtered_errors, args=(Flight(seed=1, seconds=15.0), 0.03), rounds=1)
    to_best, to_batch = [], []
    for name, stds in POSES.items():
        flights = [Flight(seed=seed, seconds=15.0, **stds) for seed in range(1, 9)]
        batch = pooled(lambda f: errors_of(f, *gtsam.smooth(matched(), f.samples(), f.poses, 0.0)), flights)
        for delay, arrival in ((0.03, '30 ms late'), (0.0, 'at once')):
            ours = pooled(partial(filtered_errors, delay=delay), flights)
            best = pooled(
                lambda f, d=delay: errors_of(f, *gtsam.follow(matched(), f.samples(), f.poses, 0.0, d)), flights
            )
            cells = [f'{1e3 * p:.2f} mm, {np.degrees(a):.3f} deg' for p, a in (ours, best, batch)]
            to_best.append(ours[0] / best[0])
            to_batch.append(ours[0] / batch[0])
            ratios = f'{to_best[-1]:.3f}', f'{to_batch[-1]:.2f}'
            rows.append([f'{name}, {arrival}', *cells[:2], ratios[0], cells[2], ratios[1]])
    write_table('filter', rows)
    # the filter is linearised once, the bound until it stands; nothing else is between them
    assert max(to_best) < 1.02
    # in theory 2 for white noise at the poses' instants; what a late pose adds is a prediction of 30 ms
    assert max(to_batch) < 2.25


# --- without markers ------------------------------------------------------------------------------------

GAP_BEGIN, GAPS = 7.0, (1.0, 2.0, 5.0)
GOALS = ('4 cm', '10 cm', '50 cm')
#: That of a cheap IMU, ten times the default; and one without scale errors and nonlinearity.
COASTING_IMU = replace(IMU, accelerometer_noise_density=2e-2)
CALIBRATED_IMU = perfect(COASTING_IMU)


def coasted(seed, imu=COASTING_IMU):
    """Errors (3,) [m] after the gaps and their squares in sigma (3 d.o.f.)."""
    data = Flight(seed=seed, seconds=12.5, imu_noise=COASTING_IMU, **POSES['several markers'])
    poses = [pose for pose in data.poses if (pose.stamp_ns - START_NS) * 1e-9 < GAP_BEGIN]
    states, _ = run(PoseEkf(config(imu=imu)), timeline(data.samples(), poses, 0.03))
    t = np.array([(state.stamp_ns - START_NS) * 1e-9 for state in states])
    at = np.searchsorted(t, GAP_BEGIN + np.array(GAPS))
    error = np.array([states[i].T_map_body[:3, 3] for i in at]) - data.motion.pose(t[at])[:, :3, 3]
    P = np.array([states[i].pose_covariance[:3, :3] for i in at])
    return np.linalg.norm(error, axis=1), np.einsum('ni,nij,nj->n', error, np.linalg.inv(P), error)


def bounds(seed, imu):
    """95 % errors (2, 3) [m] of hover from a gap's beginning: the filter that knows the noise; white noise alone."""
    data = Flight(seed=seed, seconds=GAP_BEGIN, imu_noise=COASTING_IMU, **POSES['several markers'])
    exact = matched(imu=perfect(imu))
    ekf = PoseEkf(exact)
    run(ekf, timeline(data.samples(), data.poses))
    known = replace(ekf.estimate, covariance=np.zeros_like(ekf.estimate.covariance))
    densities = np.repeat((COASTING_IMU.gyroscope_noise_density, COASTING_IMU.accelerometer_noise_density), 3)
    walks = random_walks(exact)
    stds = [[hovered(each, densities, walks, gap).std(POSITION) for gap in GAPS] for each in (ekf.estimate, known)]
    return np.array(stds) * np.sqrt(chi2.ppf(0.95, 3) / 3.0)


def test_coasting_beside_its_bound(benchmark, write_table):
    """No filter can be better than the white noise of the IMU, nor than one that knows all densities."""
    benchmark.pedantic(coasted, args=(100,), rounds=1)
    rows = [['no markers for', 'goal', 'error (95 %)', 'inside 3 sigma', 'best possible', 'white noise alone']]
    shares, covered = [], []
    for words, imu in ('', COASTING_IMU), (', no scale errors', CALIBRATED_IMU):
        flights = [coasted(seed, imu) for seed in range(100, 160)]
        distances, squares = (np.array(values) for values in zip(*flights, strict=True))
        reached = np.percentile(distances, 95, axis=0)
        best, noise = np.mean([bounds(seed, imu) for seed in range(200, 206)], axis=0)
        inside = np.mean(squares < chi2.ppf(0.9973, 3), axis=0)
        for i, gap in enumerate(GAPS):
            centimetres = [f'{100 * value[i]:.1f} cm' for value in (reached, best, noise)]
            share = f'{100 * inside[i]:.0f} %'
            rows.append([f'{gap:.0f} s{words}', GOALS[i], centimetres[0], share, *centimetres[1:]])
        shares.append(reached / best)
        covered.append(inside)
    write_table('coasting', rows)
    assert np.min(covered) >= 0.95
    # the 95th percentile of 60 flights scatters by a tenth
    allowing, calibrated = np.max(shares, axis=1)
    assert calibrated < 1.25
    if allowing >= 1.25:
        pytest.xfail(f'allowing for scale errors that the rig does not have costs {allowing:.2f} of the best possible')


# --- clock offset ---------------------------------------------------------------------------------------

#: Densities of gyroscope and accelerometer: the default, and six, twelve and thirty times as noisy.
GRADES = ((1.7e-4, 2e-3), (1e-3, 1e-2), (2e-3, 2e-2), (5e-3, 5e-2))
#: Seconds of poses after which the offset is looked at; flights of each IMU.
LEARNED, CLOCK_SEEDS = 5.0, range(8)
LATE = 0.03
#: Flights of a minute without a step of any clock. A pose in ten comes up to 80 ms later than the others.
STEADY_MINUTES, LATE_SHARE, LATER = 30, 0.1, 0.08
#: A change of the offset [s] from pose to pose that no learning makes, once it is known: half a step that is removed.
STEP = 0.017


def gentle(seed, imu_noise, seconds, **rest):
    """A flight at 0.25 m/s and 0.12 rad/s, rms, whose clock offset is drawn from the filter's prior."""
    rng = np.random.default_rng(500 + seed)
    motion = Motion.random(rng, speed=0.25, turn=0.12)
    offset = PoseEkfConfig().time_offset_std * rng.normal()
    return Flight(seed=seed, seconds=seconds, motion=motion, imu_noise=imu_noise, offset=offset, **rest)


def with_declared_errors(data):
    """Samples and poses with what the filter allows for: scale errors, systematic ones of twice the white variance."""
    rng = np.random.default_rng(900 + data.seed)
    of_rate, of_force = np.eye(3) + rng.normal(0.0, ImuNoise().gyroscope_scale_std, (2, 3, 3))
    samples = [
        replace(s, angular_velocity=of_rate @ s.angular_velocity, linear_acceleration=of_force @ s.linear_acceleration)
        for s in data.samples()
    ]
    drawn, poses = rng.normal(size=6), []
    for pose in data.poses:
        e, T = np.linalg.cholesky(2.0 * pose.covariance) @ drawn, pose.T_map_camera
        poses.append(replace(pose, T_map_camera=transform(so3_exp(e[3:]) @ T[:3, :3], T[:3, 3] + e[:3])))
    return samples, poses


def clock_error(seed, imu_noise, declared):
    """Error of the clock offset and what is claimed of it [s]."""
    data = gentle(seed, imu_noise, LEARNED + 0.3)
    samples, poses = with_declared_errors(data) if declared else (data.samples(), data.poses)
    ekf = PoseEkf(config(imu=imu_noise))
    run(ekf, timeline(samples, poses, LATE + data.offset))
    learned = ekf.diagnostics()
    return learned['time offset'] - data.offset, learned['time offset std']


def false_steps(seed):
    """How often a minute of flight looks like a step of the camera's clock, which there is not."""
    data = gentle(seed, IMU, 60.0, imu_rate=100.0)
    rng, ekf = np.random.default_rng(seed), PoseEkf(config())
    later = LATER * rng.uniform(size=len(data.poses)) * (rng.uniform(size=len(data.poses)) < LATE_SHARE)
    steps, before = 0, None
    for item in timeline(data.samples(), data.poses, LATE + data.offset + later):
        if isinstance(item, ImuSample):
            ekf.add_imu(item)
            continue
        ekf.add_pose(item)
        known = ekf.camera_time_offset
        steps += None not in (before, known) and abs(known - before) > STEP
        before = known
    return steps


def test_clock_offset(benchmark, write_table):
    """Prior of 30 ms, poses late by 30 ms: the offset's error beside its claim after 5 s, and steps that are none."""
    benchmark.pedantic(clock_error, args=(0, IMU, True), rounds=1)
    rows = [['gyroscope, accelerometer', 'errors of the rig', 'error, rms', 'claimed', 'error over claim, rms']]
    shares = {True: [], False: []}
    for declared, words in ((True, 'as declared'), (False, 'none')):
        for densities in GRADES:
            noise = replace(IMU, gyroscope_noise_density=densities[0], accelerometer_noise_density=densities[1])
            error, claim = np.array([clock_error(seed, noise, declared) for seed in CLOCK_SEEDS]).T
            shares[declared].append(rms(error / claim))
            grade = f'{densities[0]:g} rad/s/√Hz, {densities[1]:g} m/s²/√Hz'
            rows.append([grade, words, f'{1e3 * rms(error):.1f} ms', f'{1e3 * rms(claim):.1f} ms'])
            rows[-1].append(f'{shares[declared][-1]:.2f}')
        rows.append(['all four', words, '', '', f'{rms(np.array(shares[declared])):.2f}'])
    steps = sum(false_steps(seed) for seed in range(STEADY_MINUTES))
    rows.append([f'steps of the clock found in {STEADY_MINUTES} min without any', '', '', '', f'{steps}'])
    write_table('clock', rows)
    # 32 draws of a Gaussian have an rms of 1 +- 0.13
    assert 0.8 < rms(np.array(shares[True])) < 1.3
    assert steps == 0
