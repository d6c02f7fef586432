"""Checks whether an autopilot could land on the published target."""

import numpy as np

from thermal_fiducial.core.types import BoolArray, IntArray, SECOND_NS
from thermal_fiducial.report.bridge_check import Finding, Level
from thermal_fiducial.report.bridge_record import BridgeRecord, LandingRecord
from thermal_fiducial.ros.frames.landing_pad import from_mavros

#: ArduPilot needs a target once a second; both autopilots drop a target after some seconds without a message [s].
LONGEST_GAP = 1.0
#: Largest scatter of a static target while the drone moves, and scatter that proves wrong axes [m].
WANDERS, WRONG = 0.1, 0.5
#: Largest stamp difference of target and odometry for a match [s].
_NEAR = 0.05


def check_landing(robot: BridgeRecord) -> list[Finding]:
    """All findings; none where there is no target."""
    record = robot.landing
    if not len(record.stamps_ns):
        return []
    if not np.isfinite(record.positions).all():
        return [Finding('landing target', Level.FAULT, 'values that are not finite', 'The autopilot refuses it.')]
    if len(record.frames) != 1:
        seen = ' and '.join(record.frames)
        return [Finding('landing target', Level.FAULT, seen, 'Two nodes send one; only one may.')]
    return [_rate(record), _place(record, robot)]


def _rate(record: LandingRecord) -> Finding:
    gaps = np.diff(np.sort(record.stamps_ns)) / SECOND_NS
    if not len(gaps) or gaps.max() > LONGEST_GAP:
        seen = f'gap of {gaps.max():.1f} s' if len(gaps) else 'one message'
        text = 'ArduPilot wants one a second: is the pad in view all the way down?'
        return Finding('landing target rate', Level.WARNING, seen, text)
    return Finding('landing target rate', Level.OK, f'{1.0 / float(np.median(gaps)):.0f} Hz', '')


def _place(record: LandingRecord, robot: BridgeRecord) -> Finding:
    """Check that the target is below the robot and static in the map."""
    nearest, near = _nearest(record.stamps_ns, robot.stamps_ns)
    if not near.any():
        return Finding('landing target', Level.UNTESTED, 'no odometry beside it', 'Its place is not compared.')
    robots = robot.positions[nearest[near]]
    given = record.positions[near]
    in_map = record.frames[0] == 'map'
    targets = given
    if not in_map:
        targets = robots + (robot.rotations[nearest[near]] @ from_mavros(given)[:, :, None])[:, :, 0]
    below = float(np.median(robots[:, 2] - targets[:, 2]))
    wanders = float(np.sqrt(np.mean(np.sum((targets - np.median(targets, axis=0)) ** 2, axis=1))))
    moved = float(np.ptp(robots, axis=0).max())
    kind = 'in the map (PX4, LOCAL_NED)' if in_map else 'in the body (ArduPilot, BODY_FRD)'
    seen = f'{kind}, {below:.2f} m below, wanders by {wanders * 1e3:.0f} mm'
    if below < 0.0:
        text = 'The pad is above the drone: mav_frame, camera_orientation or the order of the axes is wrong.'
        return Finding('landing target', Level.FAULT, seen, text)
    if wanders > WRONG:
        text = 'It follows the drone: axes are swapped, or camera_position and camera_orientation are wrong.'
        return Finding('landing target', Level.FAULT, seen, text)
    if wanders > WANDERS:
        return Finding('landing target', Level.WARNING, seen, 'A pad that lies still seems to move: calibrate.')
    if not in_map and moved < WANDERS:
        return Finding('landing target', Level.UNTESTED, seen, 'Move the drone above the pad while it listens.')
    return Finding('landing target', Level.OK, seen, '')


def _nearest(stamps_ns: IntArray, of_ns: IntArray) -> tuple[IntArray, BoolArray]:
    """Index of the nearest of ``of_ns`` to each stamp, and whether it is near enough."""
    if not len(of_ns):
        return np.zeros(len(stamps_ns), np.int64), np.zeros(len(stamps_ns), bool)
    order = np.argsort(of_ns)
    after = np.clip(np.searchsorted(of_ns[order], stamps_ns), 1, max(len(of_ns) - 1, 1)) % len(of_ns)
    before = np.maximum(after - 1, 0)
    earlier = np.abs(of_ns[order[before]] - stamps_ns) < np.abs(of_ns[order[after]] - stamps_ns)
    nearest = order[np.where(earlier, before, after)]
    return nearest, np.abs(of_ns[nearest] - stamps_ns) < _NEAR * SECOND_NS
