"""Entry point: chooses the command, turns unusable input into one line and exit status 2."""

import argparse
from collections.abc import Sequence
from importlib import import_module
import os
import sys

from thermal_fiducial import __version__
from thermal_fiducial.errors import InputError

PROGRAM = 'thermal-fiducial'

#: Command to what it does. Module ``cli/<command>.py`` has ``add_arguments(parser)`` and ``run(args) -> int``; it is
#: imported only when its command is called, so that each starts fast and needs only its own extras.
COMMANDS = {
    'demo': 'simulate a flight through fog, replay it through the four nodes, score it, write the report',
    'simulate': 'write a synthetic thermal bag with ground truth',
    'replay': 'play a recorded bag through the four nodes',
    'evaluate': 'errors against ground truth, jitter, consistency, latency; tables and plots',
    'map': 'show, check, edit, merge, refine and align marker maps',
    'markers': 'make markers that can be cut: dictionaries, drawings, planning',
    'calibrate': 'calibrate the thermal camera, and camera against IMU',
    'check-bridge': 'verify what a flight controller would receive',
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command.

    Parameters
    ----------
    argv : arguments without the program's name; default: those of the process

    Returns
    -------
    Exit status: 0 done, 2 wrong usage or unusable input, 130 interrupted.
    """
    argv = sys.argv[1:] if argv is None else list(argv)
    command = argv[0] if argv else None
    parser = argparse.ArgumentParser(
        prog=PROGRAM, description='Thermal-inertial localization from acrylic markers, for drones in smoke and fog.'
    )
    parser.add_argument('--version', action='version', version=f'{PROGRAM} {__version__}')
    subparsers = parser.add_subparsers(dest='command', metavar='COMMAND', required=True)
    for name, description in COMMANDS.items():
        subparser = subparsers.add_parser(name, help=description, description=description[0].upper() + description[1:])
        if name == command:
            module = import_module(f'thermal_fiducial.cli.{name.replace("-", "_")}')
            module.add_arguments(subparser)
            subparser.set_defaults(run=module.run)
    args = parser.parse_args(argv)
    try:
        return int(args.run(args))
    except InputError as error:
        print(f'{PROGRAM} {args.command}: {error}', file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f'{PROGRAM} {args.command}: interrupted', file=sys.stderr)
        return 130
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
