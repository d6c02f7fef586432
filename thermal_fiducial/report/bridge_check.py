"""Checks whether a flight controller could fly on the outputs for it, and how it would react to faults.

Limits are from the sources and documentation of mavros, PX4's EKF2 and ArduPilot's EKF3.
"""

from dataclasses import dataclass
from enum import Enum

import numpy as np

from thermal_fiducial.core.geometry.se3 import so3_log
from thermal_fiducial.core.types import BoolArray, FloatArray, SECOND_NS
from thermal_fiducial.core.wording import number_of
from thermal_fiducial.report.bridge_record import BridgeRecord

GRAVITY = 9.81
#: PX4 needs 30 to 50 Hz, starts with intervals below 0.2 s and stops after 0.4 s; ArduPilot needs 4 Hz.
PX4_RATE, PX4_START, PX4_STOP, ARDUPILOT_RATE, TELEMETRY_RATE = 30.0, 0.2, 0.4, 4.0, 100.0
#: Share by which a stream of just a rate may seem slower: either end of two seconds is off by up to a period of the
#: IMU, 10 ms at 100 Hz.
RATE_TOLERANCE = 0.01
#: ArduPilot's largest VISO_DELAY_MS [s].
ARDUPILOT_DELAY = 0.25
#: The autopilots' lower bounds of the position's standard deviation [m].
PX4_FLOOR, ARDUPILOT_FLOOR = 0.1, 0.2
#: Standard deviations below this [m, rad] are placeholders; PX4 has diverged on them.
MADE_UP = 1e-5
#: Least yaw rate for the yaw check [rad/s], least speed for the velocity check [m/s].
TURN, MOVE = 0.15, 0.2
#: Interval of the velocity check [s].
MOVE_SECONDS = 0.5
#: At rest: limits of turn rate [rad/s], speed [m/s] and specific force minus gravity [m/s^2], for at least so long
#: [ns], since a drone that reverses is slow for an instant too, at its largest acceleration.
STILL_RATE, STILL_SPEED, STILL_FORCE, STILL_NS = 0.05, 0.05, 0.5, 500_000_000
#: Largest tilt of the map's vertical against gravity [rad].
LARGEST_TILT = np.radians(5.0)


class Level(Enum):
    """Severity of a finding."""

    OK = 'ok'
    UNTESTED = 'not tested'
    WARNING = 'warning'
    FAULT = 'fault'


@dataclass(frozen=True)
class Finding:
    """Result of one check: the observation, and the autopilot's reaction."""

    check: str
    level: Level
    seen: str
    consequence: str


def check_bridge(record: BridgeRecord) -> list[Finding]:
    """All findings, in the order in which they should be fixed."""
    if len(record.stamps_ns) < 2:
        text = 'mavros, PX4 and ArduPilot get nothing: is the filter initialised, does it see markers, is it lost?'
        return [Finding('messages', Level.FAULT, number_of(len(record.stamps_ns), 'message'), text)]
    values = _values(record)
    if values.level is Level.FAULT:
        return [values]
    checks = _rate, _stamps, _age, _names, _gravity, _yaw, _velocity, _covariance, _jumps
    return [values, *(check(record) for check in checks)]


def _values(record: BridgeRecord) -> Finding:
    arrays = (record.positions, record.quaternions, record.velocities, record.covariances)
    broken = sum(int((~np.isfinite(array.reshape(len(array), -1)).all(axis=1)).sum()) for array in arrays)
    norm = np.abs(np.linalg.norm(record.quaternions, axis=1) - 1.0).max()
    if broken:
        return Finding('values', Level.FAULT, f'{broken} not finite', 'PX4 takes NaN for "not measured".')
    if norm > 1e-3:
        return Finding('values', Level.FAULT, f'quaternion off unit length by {norm:.3g}', 'Attitude is refused.')
    return Finding('values', Level.OK, f'{len(record.stamps_ns)} messages, finite', '')


def _rate(record: BridgeRecord) -> Finding:
    steps = np.diff(np.sort(record.stamps_ns)) / SECOND_NS
    mean = float(steps.mean())
    rate, gap = (1.0 / mean if mean > 0.0 else 0.0), steps.max()
    seen = f'{rate:.1f} Hz, longest gap {gap * 1e3:.0f} ms'
    if rate < ARDUPILOT_RATE:
        text = 'PX4 never starts on it (needs 5 Hz), ArduPilot reports the source as unhealthy (needs 4 Hz).'
        return Finding('rate', Level.FAULT, seen, text)
    if gap > PX4_STOP:
        text = 'PX4 stops using vision after 0.4 s without it and drifts; position modes may fail over to landing.'
        return Finding('rate', Level.FAULT, seen, text)
    if gap > PX4_START:
        text = 'PX4 does not begin to use vision across gaps beyond 0.2 s.'
        return Finding('rate', Level.WARNING, seen, text)
    if rate < (1.0 - RATE_TOLERANCE) * PX4_RATE:
        text = 'PX4 recommends 30 to 50 Hz; ArduPilot is content.'
        return Finding('rate', Level.WARNING, seen, text)
    if rate > TELEMETRY_RATE:
        text = 'More than a telemetry link carries; 30 to 50 Hz serve (bridge_rate).'
        return Finding('rate', Level.WARNING, seen, text)
    return Finding('rate', Level.OK, seen, 'PX4 and ArduPilot use it.')


def _stamps(record: BridgeRecord) -> Finding:
    steps = np.diff(record.stamps_ns)
    repeated, backward = int((steps == 0).sum()), int((steps < 0).sum())
    if backward:
        text = 'EKF2 and EKF3 throw away what is older than what they have fused.'
        return Finding('stamps', Level.FAULT, f'{backward} go back', text)
    if repeated:
        return Finding('stamps', Level.WARNING, f'{repeated} repeated', 'mavros drops a message with an equal stamp.')
    return Finding('stamps', Level.OK, 'strictly increasing', '')


def _age(record: BridgeRecord) -> Finding:
    if not record.live:
        return Finding('age', Level.UNTESTED, 'recorded', 'Only a live check compares stamps with the clock.')
    age = (record.arrivals_ns - record.stamps_ns) / SECOND_NS
    typical, worst = float(np.median(age)), float(np.percentile(age, 99))
    seen = f'{typical * 1e3:.1f} ms, 99 % below {worst * 1e3:.1f} ms'
    if typical < -0.002:
        text = 'Stamps lie in the future: the IMU driver has another clock. Synchronise, the autopilot cannot.'
        return Finding('age', Level.FAULT, seen, text)
    if worst > ARDUPILOT_DELAY:
        text = 'ArduPilot allows for 250 ms at most (VISO_DELAY_MS); PX4 fuses it at the wrong time.'
        return Finding('age', Level.FAULT, seen, text)
    text = f'Set EKF2_EV_DELAY (PX4) or VISO_DELAY_MS (ArduPilot) to {max(typical * 1e3, 0.0):.0f} plus the link.'
    return Finding('age', Level.OK, seen, text)


def _names(record: BridgeRecord) -> Finding:
    seen = ', '.join(f'{child or "?"} in {frame or "?"}' for frame, child in record.frames)
    if len(record.frames) > 1:
        return Finding('frame names', Level.FAULT, seen, 'Frames change within the stream.')
    frame, child = record.frames[0]
    if frame not in ('map', 'odom') or child != 'base_link':
        text = 'mavros looks up <frame>_ned and base_link_frd and, finding none, sends an uninitialised rotation.'
        return Finding('frame names', Level.FAULT, seen, text)
    return Finding('frame names', Level.OK, seen, 'mavros converts it to NED and FRD by its own static transforms.')


def _gravity(record: BridgeRecord) -> Finding:
    """Check that the specific force at rest points up, +z of an ENU map, at any attitude."""
    up = _specific_force_in_map(record)
    if up is None:
        return Finding('gravity', Level.UNTESTED, 'no IMU at rest', 'Let it listen to imu/data of a still drone.')
    tilt = float(np.arccos(np.clip(up[2] / np.linalg.norm(up), -1.0, 1.0)))
    seen = f'specific force at rest {up[0]:+.2f} {up[1]:+.2f} {up[2]:+.2f} m/s^2 in the map'
    if tilt > np.radians(150.0):
        text = 'Upside down: map or body are NED/FRD here, mavros turns them once more and the drone flips.'
        return Finding('gravity', Level.FAULT, seen, text)
    if tilt > LARGEST_TILT:
        text = f'The vertical is off by {np.degrees(tilt):.1f} deg: the IMU is mounted otherwise, or the map tilts.'
        return Finding('gravity', Level.FAULT, seen, text)
    return Finding('gravity', Level.OK, seen, f'Upright to {np.degrees(tilt):.1f} deg.')


def _specific_force_in_map(record: BridgeRecord) -> FloatArray | None:
    """Mean over the samples at rest, the first ``STILL_NS`` of each rest left out."""
    if len(record.imu) == 0:
        return None
    nearest = np.clip(np.searchsorted(record.stamps_ns, record.imu_stamps_ns), 0, len(record.stamps_ns) - 1)
    quiet = np.linalg.norm(record.imu[:, :3], axis=1) < STILL_RATE
    quiet &= np.abs(np.linalg.norm(record.imu[:, 3:], axis=1) - GRAVITY) < STILL_FORCE
    quiet &= np.linalg.norm(record.velocities[nearest], axis=1) < STILL_SPEED
    quiet &= np.abs(record.stamps_ns[nearest] - record.imu_stamps_ns) < 100_000_000
    last_motion = np.maximum.accumulate(np.where(quiet, record.imu_stamps_ns[0], record.imu_stamps_ns))
    still = record.imu_stamps_ns - last_motion > STILL_NS
    if still.sum() < 20:
        return None
    forces = record.rotations[nearest[still]] @ record.imu[still, 3:, None]
    return np.asarray(forces[..., 0].mean(axis=0))


def _turns(record: BridgeRecord) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Turn rates (N-1, 3) in the body from the poses and from the twists, and which intervals are usable."""
    dt = np.diff(record.stamps_ns) / SECOND_NS
    usable = (dt > 1e-4) & (dt < PX4_START)
    R = record.rotations
    turn = so3_log(np.swapaxes(R[:-1], -1, -2) @ R[1:]) / np.where(usable, dt, 1.0)[:, None]
    return turn, 0.5 * (record.rates[:-1] + record.rates[1:]), usable


def _yaw(record: BridgeRecord) -> Finding:
    """Check that yaw rates of pose and gyroscope have the same sign, positive to the left."""
    turn, rates, usable = _turns(record)
    yaw, gyroscope = turn[:, 2], rates[:, 2]
    if len(record.imu):
        middles = record.stamps_ns[:-1] + np.diff(record.stamps_ns) // 2
        gyroscope = np.interp(middles, record.imu_stamps_ns, record.imu[:, 2])
    slow = usable & (np.abs(yaw) < TURN)
    if slow.any():
        # A bias of 0.08 rad/s, as cheap gyroscopes have, is half of the slowest turn.
        gyroscope = gyroscope - np.median(gyroscope[slow] - yaw[slow])
    turning = usable & (np.abs(gyroscope) > TURN)
    if turning.sum() < 10:
        return Finding('yaw', Level.UNTESTED, 'no turn', 'Turn the drone about the vertical by hand while it listens.')
    ratio = float(np.median(yaw[turning] / gyroscope[turning]))
    seen = f'the pose turns by {ratio:.2f} of what the gyroscope says'
    if ratio < 0.0:
        text = 'Opposite sense: one of them is NED/FRD. The autopilot would run away in yaw.'
        return Finding('yaw', Level.FAULT, seen, text)
    if abs(ratio - 1.0) > 0.1:
        return Finding('yaw', Level.FAULT, seen, 'Axes are mixed up: EKF2 and EKF3 refuse the heading.')
    return Finding('yaw', Level.OK, seen, 'Same sense and size.')


def _velocity(record: BridgeRecord) -> Finding:
    """Check that the twist in the robot's axes, integrated over half a second, equals the change of the position.

    Single intervals are too short: corrections by markers, of millimetres, are as large as the motion.
    """
    t = (record.stamps_ns - record.stamps_ns[0]) / SECOND_NS
    end = np.searchsorted(t, t + MOVE_SECONDS)
    begin = np.flatnonzero(end < len(t))
    end = end[begin]
    # Decreasing stamps have their own finding.
    seconds = np.maximum(t[end] - t[begin], MOVE_SECONDS)[:, None]
    velocity = (record.positions[end] - record.positions[begin]) / seconds
    in_map = (record.rotations @ record.velocities[..., None])[..., 0]
    as_robot, as_map = (
        (path[end] - path[begin]) / seconds for path in (_summed(t, v) for v in (in_map, record.velocities))
    )
    usable = (np.linalg.norm(velocity, axis=1) > MOVE) & (seconds[:, 0] < MOVE_SECONDS + PX4_START)
    if usable.sum() < 10:
        return Finding('velocity', Level.UNTESTED, 'no motion', 'Carry the drone about while it listens.')
    speed = float(np.median(np.linalg.norm(velocity[usable], axis=1)))
    wrong, swapped = (float(np.median(np.linalg.norm(velocity - v, axis=1)[usable])) for v in (as_robot, as_map))
    seen = f'differs from the moving position by {wrong:.2f} m/s at {speed:.2f} m/s'
    if wrong < max(0.25 * speed, 0.1):
        return Finding('velocity', Level.OK, seen, 'In the robot frame, as mavros and PX4 want it.')
    where = 'It is in the map frame instead.' if swapped < 0.5 * wrong else 'Its axes are wrong.'
    return Finding('velocity', Level.FAULT, seen, f'{where} mavros and PX4 take it for the robot frame.')


def _summed(t: FloatArray, velocity: FloatArray) -> FloatArray:
    """Path (N, 3) of a velocity (N, 3) at times (N,), by the trapezoid rule."""
    steps = 0.5 * (velocity[:-1] + velocity[1:]) * np.diff(t)[:, None]
    return np.concatenate((np.zeros((1, 3)), np.cumsum(steps, axis=0)))


def _covariance(record: BridgeRecord) -> Finding:
    P = record.covariances
    lowest = np.linalg.eigvalsh(0.5 * (P + np.swapaxes(P, 1, 2)))[:, 0].min()
    diagonal = np.diagonal(P, axis1=1, axis2=2)
    stds = np.sqrt(np.maximum(diagonal, 0.0))
    position, attitude = np.median(stds[:, :3].max(axis=1)), np.median(stds[:, 3:].max(axis=1))
    seen = f'{position * 1e3:.1f} mm, {np.degrees(attitude):.3f} deg'
    if not diagonal.any():
        text = 'All zero: PX4 falls back on its parameters, ArduPilot too; nobody learns when the pose gets worse.'
        return Finding('covariance', Level.FAULT, seen, text)
    if lowest < -1e-9 or diagonal.min() <= 0.0:
        return Finding('covariance', Level.FAULT, seen, 'No covariance matrix: PX4 refuses variances up to zero.')
    if stds.min() < MADE_UP:
        text = 'Too good to be true: unless floored, EKF2 follows each step of it.'
        return Finding('covariance', Level.WARNING, seen, text)
    text = (
        f'PX4 uses the larger of it and EKF2_EVP_NOISE ({PX4_FLOOR} m by default: lower it to profit), '
        f'ArduPilot of it and VISO_POS_M_NSE ({ARDUPILOT_FLOOR} m).'
    )
    return Finding('covariance', Level.OK, seen, text)


def _jumps(record: BridgeRecord) -> Finding:
    """Check for steps of the position beyond the speed."""
    dt = np.diff(record.stamps_ns) / SECOND_NS
    claimed = 0.5 * (record.velocities[:-1] + record.velocities[1:])
    expected = (record.rotations[:-1] @ claimed[..., None])[..., 0] * dt[:, None]
    jumps = np.linalg.norm(np.diff(record.positions, axis=0) - expected, axis=1)
    worst = float(jumps.max())
    seen = f'largest {worst * 1e3:.0f} mm'
    if worst > 5.0 * PX4_FLOOR:
        text = 'Beyond the 5 sigma gate of EKF2: vision is refused for a second, then the position is reset to it.'
        return Finding('jumps', Level.FAULT, seen, text + ' mavros cannot announce it (no reset counter), DDS does.')
    if worst > 0.05:
        text = 'The controller sees a step; smoothing_time spreads it.'
        return Finding('jumps', Level.WARNING, seen, text)
    return Finding('jumps', Level.OK, seen, '')
