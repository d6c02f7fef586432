"""``check-bridge``: verify what a flight controller would receive, live or from a recording."""

import argparse
import json
from pathlib import Path
import sys
import textwrap
from typing import TYPE_CHECKING

from thermal_fiducial.cli.parser import Parser
from thermal_fiducial.cli.ranges import LISTEN_S
from thermal_fiducial.errors import InputError
from thermal_fiducial.report.bridge_check import check_bridge, Finding, Level
from thermal_fiducial.report.bridge_links import check_links
from thermal_fiducial.report.bridge_record import BridgeRecord, BridgeRecorder, read_bridge
from thermal_fiducial.report.landing_check import check_landing

if TYPE_CHECKING:
    from thermal_fiducial.ros.watching.bridge_listener import Links

#: Exit status without a fault, but with live checks that lacked their motion.
NOT_TESTED = 3
_WIDTH = 118


def add_arguments(parser: Parser) -> None:
    """Options of the command."""
    parser.description = (
        'Verify rate, stamps, frames (gravity of a still drone, a yaw turn), velocity and covariance of what a flight '
        'controller would receive, and the landing target where there is one, and say what it would do with it. '
        'Without RECORDING it listens: keep the drone still for some seconds, then turn it by hand to the left and '
        'back, and carry it about. Exit status 1 if there is a fault, '
        '3 if there is none but a live check was not tested.'
    )
    parser.add_argument('recording', nargs='?', type=Path, metavar='RECORDING', help='bag or run folder; none: listen')
    parser.add_argument('--topic', default='', help='odometry to check (default: what pose_ekf sends, as remapped)')
    parser.add_argument('--imu', type=Path, metavar='BAG', help='bag with imu/data (default: RECORDING itself)')
    parser.add_argument('--seconds', type=LISTEN_S, default=15.0, help='how long to listen [s]')
    parser.add_argument(
        '--ros-args', nargs=argparse.REMAINDER, default=[], help='remaps and the like, as for any node; last'
    )
    parser.add_argument('--json', action='store_true', help='print the findings as JSON')
    parser.refuse(['--seconds', '--ros-args'], 'with a RECORDING', lambda args: args.recording is not None)
    parser.refuse(['--imu'], 'without a RECORDING', lambda args: args.recording is None)


def run(args: argparse.Namespace) -> int:
    """Check and print the findings; returns :func:`exit_status`."""
    findings: list[Finding] = []
    if args.recording is not None:
        record = read_bridge(args.recording, args.topic, args.imu)
    else:
        record, links = _listen(args.topic, args.seconds, args.ros_args)
        findings += check_links(links)
    findings += check_bridge(record) + check_landing(record)
    if args.json:
        print(json.dumps([_as_json(finding) for finding in findings], indent=2))
    else:
        print('What a flight controller would receive:')
        for finding in findings:
            print(_line(finding))
    return exit_status(findings, live=args.recording is None)


def exit_status(findings: list[Finding], *, live: bool) -> int:
    """1 if an autopilot would reject the odometry, :data:`NOT_TESTED` if that is not known of a ``live`` one, else 0.

    A script that arms on 0 must not do so for a drone that nobody has turned. A recording cannot be repeated, and its
    stamps have no age.
    """
    levels = {finding.level for finding in findings}
    if Level.FAULT in levels:
        return 1
    return NOT_TESTED if live and Level.UNTESTED in levels else 0


def _line(finding: Finding) -> str:
    text = f'{finding.seen}. {finding.consequence}' if finding.consequence else finding.seen
    return textwrap.fill(
        f'{finding.level.value:>10}  {finding.check}: {text}',
        _WIDTH,
        subsequent_indent=' ' * 12,
        break_long_words=False,
    )


def _listen(topic: str, seconds: float, ros_arguments: list[str]) -> 'tuple[BridgeRecord, Links]':
    try:
        from thermal_fiducial.ros.watching.bridge_listener import listen, Topics
    except ModuleNotFoundError as error:
        raise InputError(f'listening needs ROS 2 ({error.name} is missing); name a recording instead') from None
    recorder = BridgeRecorder(live=True)

    def announce(topics: Topics) -> None:
        print(
            f'Listening to {topics.odometry} and {topics.imu} for {seconds:g} s: '
            'keep still, then turn left and back by hand, then carry it about.',
            file=sys.stderr,
        )

    links = listen(
        seconds,
        recorder.odometry,
        recorder.imu,
        recorder.landing_target,
        topic=topic,
        announce=announce,
        ros_arguments=ros_arguments,
    )
    return recorder.record(), links


def _as_json(finding: Finding) -> dict[str, str]:
    return {
        'check': finding.check,
        'level': finding.level.value,
        'seen': finding.seen,
        'consequence': finding.consequence,
    }
