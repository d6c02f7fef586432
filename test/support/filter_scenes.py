"""Scenes that show what the parts of the filter are for: flights of camera poses and IMU samples."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial
import os
from pathlib import Path
from typing import Any

import numpy as np
from scipy.signal import butter, sosfilt, sosfilt_zi
from scipy.stats import chi2

from support import real_flights
from support.corner_runs import fly, published, rms
from support.flights import config, errors, Flight, in_order, Motion, run_watched, START_NS, timeline
from support.sim_flights import simulated
from thermal_fiducial.config import ImuNoise, PoseEkfConfig
from thermal_fiducial.core.filter.ekf import PoseEkf
from thermal_fiducial.core.geometry.se3 import lever_arm, so3_exp, transform
from thermal_fiducial.core.measurements import CameraPose, ImuSample

Figures = dict[str, float]
#: Parameters of the filter and of its IMU's noise, by their names.
Changes = dict[str, Any]
Scene = Callable[[Changes], Figures]
#: The first seconds are not counted: the filter learns what it flies with.
SETTLED = 4.0


@dataclass(frozen=True)
class Arrivals:
    """A flight, and what arrives of it."""

    flight: Flight
    items: list[Any]
    config: PoseEkfConfig
    #: (begin, end) [s] without poses; counts at its end
    gaps: tuple[tuple[float, float], ...] = ()


def altered(config: PoseEkfConfig, changes: Changes) -> PoseEkfConfig:
    """``config`` with changes, those of the IMU's noise among them."""
    of_imu = {name: value for name, value in changes.items() if hasattr(config.imu, name)}
    others = {name: value for name, value in changes.items() if name not in of_imu}
    return replace(config, imu=replace(config.imu, **of_imu), **others)


@cache
def recorded_poses(name: str) -> Any:
    """A flight through mapper and filter once: the poses that the filter received are the scene."""
    if name in real_flights.CARPETS:
        return fly(real_flights.carpet(name))
    return fly(real_flights.april_board(name) if name.startswith('cam') else simulated(name))


def of_recording(name: str, changes: Changes) -> Figures:
    """The filter alone on the poses of a mapper, 30 ms late, at all IMU samples."""
    run = recorded_poses(name)
    flight, ekf = run.flight, PoseEkf(altered(run.config, changes))
    arrivals: list[tuple[int, int, Any]] = [(sample.stamp_ns, 0, sample) for sample in flight.samples]
    late_ns = round((flight.time_offset + run.late) * 1e9)
    arrivals += [(pose.stamp_ns + late_ns, 1, pose) for pose in run.poses]
    states, _ = run_watched(ekf, in_order(arrivals))
    score = published(flight, states).score(flight)
    return {
        'mm': score.rms_mm,
        'peak mm': score.peak_mm,
        'deg': score.rms_deg,
        'NEES': score.nees,
        'refused': ekf.diagnostics()['poses refused'],
        'resets': float(ekf.resets),
    }


def of_flights(scene: Callable[[int], Arrivals], changes: Changes, seeds: range = range(3)) -> Figures:
    """Means over flights of several seeds."""
    each = [_flown(scene(seed), changes) for seed in seeds]
    return {what: float(np.mean([figures[what] for figures in each])) for what in each[0]}


def _flown(arrivals: Arrivals, changes: Changes) -> Figures:
    flight, ekf = arrivals.flight, PoseEkf(altered(arrivals.config, changes))
    states, lost = run_watched(ekf, arrivals.items)
    position, attitude = errors(flight, states, SETTLED)
    counted = np.array([state.stamp_ns >= START_NS + round(SETTLED * 1e9) for state in states])
    covariances = np.array([state.pose_covariance[:3, :3] for state in states])[counted]
    truth = flight.motion.pose(_seconds(states)[counted])[:, :3, 3]
    e = truth - np.array([state.T_map_body[:3, 3] for state in states])[counted]
    squares = np.einsum('ni,nij,nj->n', e, np.linalg.inv(covariances), e)
    declared = np.array(lost)[counted]
    estimate = ekf.estimate
    assert estimate is not None
    clock = abs(arrivals.config.camera_time_offset + estimate.state.time_offset - flight.offset)
    figures = {
        'mm': 1e3 * rms(position),
        'peak mm': 1e3 * float(position.max()),
        'deg': float(np.degrees(rms(attitude))),
        'NEES': float(np.mean(squares) / 3.0),
        '% beyond 3 sigma, not lost': 100.0 * float(np.mean((squares > chi2.ppf(0.9973, 3)) & ~declared)),
        'clock ms': 1e3 * clock,
        'clock, error over claim': clock / max(ekf.diagnostics()['time offset std'], 1e-6),
        'resets': float(ekf.resets),
    }
    return figures | _at_ends(arrivals, states, truth, counted)


def _seconds(states: list[Any]) -> np.ndarray:
    return np.array([(state.stamp_ns - START_NS) * 1e-9 for state in states])


def _at_ends(arrivals: Arrivals, states: list[Any], truth: np.ndarray, counted: np.ndarray) -> Figures:
    if not arrivals.gaps:
        return {}
    kept = [state for state, chosen in zip(states, counted, strict=True) if chosen]
    ends = np.searchsorted(_seconds(kept), [end for _, end in arrivals.gaps]) - 1
    off = np.array([np.linalg.norm(kept[k].T_map_body[:3, 3] - truth[k]) for k in ends])
    claimed = np.array([np.sqrt(np.trace(kept[k].pose_covariance[:3, :3])) for k in ends])
    return {'coasting cm': 100.0 * rms(off), 'coasting, claim over error': rms(claimed) / rms(off)}


# --- flights ------------------------------------------------------------------------------------------------

LATE = 0.03
#: Errors of poses by several markers.
WELL_SEEN = {'rotation_std': (3e-3, 3e-3, 1e-3), 'translation_std': (3e-4, 3e-4, 3e-3)}


def _arrivals(flight: Flight, poses: list[CameraPose], samples: list[ImuSample] | None = None, **rest: Any) -> Arrivals:
    gaps = rest.pop('gaps', ())
    parameters = config(**rest)
    begin = [START_NS + round(1e9 * (a - flight.offset)) for a, _ in gaps]
    end = [START_NS + round(1e9 * (b - flight.offset)) for _, b in gaps]
    kept = [pose for pose in poses if not any(a <= pose.stamp_ns < b for a, b in zip(begin, end, strict=True))]
    return Arrivals(flight, timeline(samples or flight.samples(), kept, LATE + flight.offset), parameters, gaps)


def brisk(seed: int) -> Arrivals:
    """A metre a second, clocks 20 ms apart."""
    flight = Flight(seed=seed, seconds=16.0, offset=0.02)
    return _arrivals(flight, flight.poses)


def slow_and_noisy(seed: int) -> Arrivals:
    """Slow, with a gyroscope and an accelerometer ten times as noisy, as known.

    The clocks are apart by the standard deviation that the filter expects: an offset of zero would be its prior's mean.
    """
    noise = ImuNoise(gyroscope_noise_density=2e-3, accelerometer_noise_density=2e-2)
    motion = Motion.random(np.random.default_rng(100 + seed), speed=0.25, turn=0.12)
    offset = PoseEkfConfig().time_offset_std * (-1) ** seed
    flight = Flight(seed=seed, seconds=16.0, motion=motion, imu_noise=noise, offset=offset)
    return _arrivals(flight, flight.poses, imu=noise)


def coasting(seed: int) -> Arrivals:
    """Two seconds without poses, in the middle and at the end."""
    flight = Flight(seed=seed, seconds=16.0)
    return _arrivals(flight, flight.poses, gaps=((8.0, 10.0), (13.0, 15.0)))


def _by_samples(seed: int, change: Callable[[np.ndarray, np.random.Generator], np.ndarray], **rest: Any) -> Arrivals:
    """A flight whose samples (N, 6) are changed."""
    flight = Flight(seed=seed, seconds=16.0)
    imu = change(flight.imu.copy(), np.random.default_rng(seed))
    samples = [
        replace(s, angular_velocity=m[:3], linear_acceleration=m[3:])
        for s, m in zip(flight.samples(), imu, strict=True)
    ]
    return _arrivals(flight, flight.poses, samples, gaps=((8.0, 10.0), (13.0, 15.0)), **rest)


def scale_errors(seed: int) -> Arrivals:
    """Half a per cent of scale and cross-axis errors of both triads."""

    def change(imu: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        return imu + np.concatenate([part @ rng.normal(0.0, 0.005, (3, 3)) for part in (imu[:, :3], imu[:, 3:])], 1)

    return _by_samples(seed, change)


def shaken(seed: int) -> Arrivals:
    """Vibration that fills the spectrum: ten and twenty times the densities of the data sheet."""

    def change(imu: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        return imu + rng.normal(size=imu.shape) * np.repeat((1.7e-3, 4e-2), 3) * np.sqrt(200.0)

    return _by_samples(seed, change)


def nonlinear(seed: int) -> Arrivals:
    """Errors in proportion to the motion: a quadratic one of 0.4 % of the rate, 1 % of the force."""

    def change(imu: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        motion = imu - imu.mean(axis=0)
        return imu + np.repeat((0.004, 0.01), 3) * motion * np.abs(motion) / np.abs(motion).mean(axis=0)

    return _by_samples(seed, change)


def saturated(seed: int) -> Arrivals:
    """A range of 1 rad/s that turns exceed."""
    noise = replace(ImuNoise(), gyroscope_range=1.0)
    return _by_samples(seed, lambda imu, _: np.clip(imu, *np.outer((-1, 1), [1.0] * 3 + [1e3] * 3)), imu=noise)


def frozen(seed: int) -> Arrivals:
    """The same sample for half a second."""

    def change(imu: np.ndarray, _: np.random.Generator) -> np.ndarray:
        imu[1600:1700] = imu[1600]
        return imu

    return _by_samples(seed, change)


def gaps_of_imu(seed: int) -> Arrivals:
    """Nine of ten samples are lost in bursts of 60 to 160 ms."""
    flight, rng = Flight(seed=seed, seconds=16.0), np.random.default_rng(seed)
    edges = np.cumsum(rng.integers(12, 32, 200))
    samples = [sample for k, sample in enumerate(flight.samples()) if k < 300 or np.min(np.abs(edges - k)) < 2]
    return _arrivals(flight, flight.poses, samples)


def starved(seed: int) -> Arrivals:
    """A computer that is too busy: for up to 0.8 s neither samples nor poses come, then half of those poses, late."""
    flight, rng = Flight(seed=seed, seconds=20.0), np.random.default_rng(seed)
    begins_ns = START_NS + round(2e9) + np.cumsum(rng.uniform(0.9e9, 3.0e9, 8)).astype(np.int64)
    ends_ns = begins_ns + rng.uniform(0.02e9, 0.8e9, 8).astype(np.int64)

    def end_of_stall(stamp_ns: int) -> int:
        return max(
            (int(end) for begin, end in zip(begins_ns, ends_ns, strict=True) if begin <= stamp_ns < end), default=0
        )

    arrivals: list[tuple[int, Any]] = [(s.stamp_ns, s) for s in flight.samples() if not end_of_stall(s.stamp_ns)]
    for pose in flight.poses:
        due_ns = pose.stamp_ns + round(LATE * 1e9)
        held_ns = end_of_stall(due_ns)
        if not held_ns:
            arrivals.append((due_ns, pose))
        elif rng.random() < 0.5:
            arrivals.append((held_ns + round(rng.exponential(0.1e9)), pose))
    arrivals.sort(key=lambda arrival: arrival[0])
    return Arrivals(flight, [item for _, item in arrivals], config())


def stamped_on_arrival(seed: int) -> Arrivals:
    """Samples of 200 Hz that come in fives and are stamped then, 10 ms early to late; four rotors shake them."""
    flight, rng = Flight(seed=seed, seconds=16.0), np.random.default_rng(seed)
    rotors = 2.0 * np.pi * rng.uniform(75.0, 95.0, (4, 1, 1)) * flight.t[:, None] + rng.uniform(0.0, 6.3, (4, 1, 6))
    shaken = flight.imu + np.sin(rotors).sum(axis=0) * np.repeat((0.01, 0.4), 3)
    samples = [
        ImuSample(START_NS + round(25e6 * (k // 5) + 10e6 + 2e5 * (k % 5)), imu[:3], imu[3:])
        for k, imu in enumerate(shaken)
    ]
    return _arrivals(flight, flight.poses, samples)


def filtered_apart(seed: int) -> Arrivals:
    """An autopilot that filters the gyroscope at 80 Hz, the accelerometer at 10: 3 and 23 ms late."""
    flight = Flight(seed=seed, seconds=16.0)
    samples = []
    passed = np.hstack((_low_pass(flight.imu[:, :3], 80.0), _low_pass(flight.imu[:, 3:], 10.0)))
    for t, imu in zip(flight.t, passed, strict=True):
        samples.append(ImuSample(START_NS + round(t * 1e9), imu[:3], imu[3:]))
    return _arrivals(flight, flight.poses, samples)


def _low_pass(samples: np.ndarray, cutoff: float) -> np.ndarray:
    """Samples (N, 3) of 200 Hz behind a Butterworth filter of second order at ``cutoff`` [Hz], at rest before."""
    sections = butter(2, cutoff, fs=200.0, output='sos')
    at_rest = sosfilt_zi(sections)[:, :, None] * samples[0]
    return sosfilt(sections, samples, axis=0, zi=at_rest)[0]


def bad_samples(seed: int) -> Arrivals:
    """Five single samples at full scale."""
    flight = Flight(seed=seed, seconds=16.0)
    samples = flight.samples()
    for k in range(1000, 3000, 400):
        samples[k] = replace(samples[k], angular_velocity=np.full(3, -34.9), linear_acceleration=np.full(3, -156.9))
    return _arrivals(flight, flight.poses, samples)


def jittering(seed: int) -> Arrivals:
    """Stamps of the camera that are late by 2 ms in the mean, exponentially, and by 2 ms early."""
    flight, rng = Flight(seed=seed, seconds=16.0), np.random.default_rng(seed)
    return _arrivals(
        flight, [replace(p, stamp_ns=p.stamp_ns + round(2e6 * (rng.exponential() - 1.0))) for p in flight.poses]
    )


def shaking_mount(seed: int) -> Arrivals:
    """A camera on a soft mount that rotates by 0.12 deg against the IMU, about each axis at a frequency of its own.

    Its poses are of many markers.
    """
    well_seen = {'rotation_std': (1e-3, 1e-3, 2e-4), 'translation_std': (1e-4, 1e-4, 5e-4)}
    flight, rng = Flight(seed=seed, seconds=16.0, **well_seen), np.random.default_rng(seed)
    phases, frequencies = rng.uniform(0.0, 2.0 * np.pi, 3), np.array([11.0, 15.1, 8.9])
    poses = []
    for pose in flight.poses:
        angles = 2.0 * np.pi * frequencies * (pose.stamp_ns - START_NS) / 1e9 + phases
        T = pose.T_map_camera.copy()
        T[:3, :3] = T[:3, :3] @ so3_exp(np.radians(0.12) * np.sin(angles))
        poses.append(replace(pose, T_map_camera=T))
    return _arrivals(flight, poses)


def tilted_map(seed: int) -> Arrivals:
    """A map 0.5 deg off the vertical."""
    flight = Flight(seed=seed, seconds=16.0)
    tilt = np.eye(4)
    tilt[:3, :3] = so3_exp(np.radians([0.5, 0.0, 0.0]))
    # The flight is level in the map, gravity isn't: what the IMU feels turns.
    lift = np.array([0.0, 0.0, 9.80665])
    R = np.swapaxes(flight.motion.pose(flight.t)[:, :3, :3], -1, -2)
    imu = flight.imu.copy()
    imu[:, 3:] += (R @ (tilt[:3, :3] @ lift - lift)[:, None])[..., 0]
    samples = [replace(s, linear_acceleration=m[3:]) for s, m in zip(flight.samples(), imu, strict=True)]
    return _arrivals(flight, flight.poses, samples, gaps=((8.0, 10.0), (13.0, 15.0)))


def wrong_poses(seed: int) -> Arrivals:
    """A fifth of all poses are metres off."""
    flight, rng = Flight(seed=seed, seconds=16.0), np.random.default_rng(seed)
    wrong = [_shifted(pose, rng.normal(size=3)) if rng.uniform() < 0.2 else pose for pose in flight.poses]
    return _arrivals(flight, wrong)


def twin_marker(seed: int, by: tuple[float, ...] = (0.9, 0.0, 1.2)) -> Arrivals:
    """For two seconds all poses agree on a place a metre and a half off."""
    flight = Flight(seed=seed, seconds=16.0)
    begin, end = START_NS + 9_000_000_000, START_NS + 11_000_000_000
    return _arrivals(flight, [_shifted(pose, by) if begin < pose.stamp_ns < end else pose for pose in flight.poses])


def moved_markers(seed: int) -> Arrivals:
    """For two seconds all poses agree on a place half a metre off."""
    return twin_marker(seed, (0.3, 0.0, 0.4))


def _shifted(pose: CameraPose, by: Any) -> CameraPose:
    T = pose.T_map_camera.copy()
    T[:3, 3] += by
    return replace(pose, T_map_camera=T)


def unknown_clock_at_start(seed: int) -> Arrivals:
    """At rest before the flight: the offset of 40 ms shows with the first motion."""
    flight = Flight(seed=seed, seconds=8.0, offset=0.04)
    return _arrivals(flight, flight.poses)


def stepping_clock(seed: int, step_ns: int = 300_000_000) -> Arrivals:
    """The clock of the camera steps by 0.3 s."""
    flight = Flight(seed=seed, seconds=16.0)
    items = []
    for pose in flight.poses:
        step = step_ns * (pose.stamp_ns - START_NS > 8e9)
        items.append((pose.stamp_ns + round(1e9 * LATE), 1, replace(pose, stamp_ns=pose.stamp_ns + step)))
    samples = [(sample.stamp_ns, 0, sample) for sample in flight.samples()]
    ordered = [item for _, _, item in sorted(samples + items, key=lambda entry: entry[:2])]
    return Arrivals(flight, ordered, config())


def small_step_of_clock(seed: int) -> Arrivals:
    """It steps by less than delays show."""
    return stepping_clock(seed, 10_000_000)


def lasting_errors(seed: int) -> Arrivals:
    """Errors of poses that last as long as the view: a smooth function of attitude, twice the white ones."""
    flight, rng = Flight(seed=seed, seconds=16.0), np.random.default_rng(seed)
    waves, phases = rng.normal(size=(6, 3)) / 0.3, rng.uniform(0.0, 2.0 * np.pi, 6)
    poses = []
    for pose in flight.poses:
        forward = pose.T_map_camera[:3, 2]
        e = 2.0 * np.linalg.cholesky(pose.covariance) @ (np.sqrt(2.0) * np.sin(waves @ forward + phases))
        T = pose.T_map_camera.copy()
        T[:3, 3] += e[:3]
        T[:3, :3] = so3_exp(e[3:]) @ T[:3, :3]
        poses.append(replace(pose, T_map_camera=T, covariance=5.0 * pose.covariance))
    return _arrivals(flight, poses, pose_noise_scale=1.0)


def noise_of_poses(seed: int) -> Arrivals:
    """Poses whose white errors are three times what they claim."""
    flight = Flight(seed=seed, seconds=16.0)
    return _arrivals(flight, [replace(pose, covariance=pose.covariance / 9.0) for pose in flight.poses])


def map_in_the_making(seed: int) -> Arrivals:
    """All poses are off alike by a map that is known to 30 mm, and after half of the flight, refined, to 10 mm."""
    flight, rng = Flight(seed=seed, seconds=16.0), np.random.default_rng(seed)
    poses = []
    for std, half in ((0.03, flight.poses[: len(flight.poses) // 2]), (0.01, flight.poses[len(flight.poses) // 2 :])):
        off, of_map = std * rng.normal(size=3), np.diag(np.repeat((std, 0.0), 3) ** 2)
        for pose in half:
            T = pose.T_map_camera.copy()
            T[:3, 3] += off
            poses.append(replace(pose, T_map_camera=T, covariance=pose.covariance + of_map, map_covariance=of_map))
    return _arrivals(flight, poses, gaps=((13.0, 15.0),))


def poorly_mapped_markers(seed: int) -> Arrivals:
    """By turns of two seconds exact markers, and others whose map is off by 0.6 m and 0.1 rad, as their poses claim."""
    flight, rng = Flight(seed=seed, seconds=16.0, **WELL_SEEN), np.random.default_rng(seed)
    stds, centre = np.repeat((0.6, 0.1), 3), np.array([3.0, 0.0, 1.0])
    off, poses = stds * rng.normal(size=6), []
    for pose in flight.poses:
        if (pose.stamp_ns - START_NS) // 2_000_000_000 % 2:
            to_camera = lever_arm(pose.T_map_camera[:3, 3] - centre)
            of_map = to_camera @ np.diag(stds**2) @ to_camera.T
            turn = transform(so3_exp(off[3:]), centre + off[:3] - so3_exp(off[3:]) @ centre)
            pose = replace(
                pose,
                T_map_camera=turn @ pose.T_map_camera,
                covariance=pose.covariance + of_map,
                map_covariance=of_map,
            )
        poses.append(pose)
    return _arrivals(flight, poses)


def shaken_start(seed: int) -> Arrivals:
    """Begun while shaken by hand, 0.7 m/s and 2 rad/s an axis, with clocks 70 ms apart.

    Of the start itself resets count alone.
    """
    rng = np.random.default_rng(300 + seed)
    phase, frequency = rng.uniform(0.0, 2.0 * np.pi, (2, 3, 2)), rng.uniform(3.0, 6.0, (2, 3, 2))
    rates = np.array([0.7, 2.0])[:, None, None]
    motion = Motion(*np.stack([rates / frequency, frequency, phase], axis=-1))
    flight = Flight(seed=seed, seconds=6.0, motion=motion, offset=-0.07, **WELL_SEEN)
    return _arrivals(flight, flight.poses)


def returning(seed: int) -> Arrivals:
    """A single marker after 25 s without any."""
    flight = Flight(seed=seed, seconds=34.0)
    return _arrivals(flight, flight.poses, gaps=((6.0, 31.0),))


def _scenes() -> dict[str, Scene]:
    flights = (
        brisk, slow_and_noisy, coasting, scale_errors, shaken, nonlinear, saturated, frozen, gaps_of_imu, starved,
        stamped_on_arrival, filtered_apart, bad_samples, jittering, tilted_map, wrong_poses, twin_marker, moved_markers,
        unknown_clock_at_start, stepping_clock, small_step_of_clock, noise_of_poses, lasting_errors, map_in_the_making,
        shaking_mount, poorly_mapped_markers, shaken_start, returning,
    )  # fmt: skip
    scenes: dict[str, Scene] = {scene.__name__.replace('_', ' '): partial(of_flights, scene) for scene in flights}
    # The clock's error over its claim takes more of them.
    scenes['slow and noisy'] = partial(of_flights, slow_and_noisy, seeds=range(8))
    # One start in five is reset.
    scenes['shaken start'] = partial(of_flights, shaken_start, seeds=range(8))
    data = os.environ.get('THERMAL_FIDUCIAL_DATA')
    if data and (Path(data) / 'real_flights').is_dir():
        for name in ('cam0', *real_flights.CARPETS):
            scenes[name] = partial(of_recording, name)
    return scenes


SCENES = _scenes()
