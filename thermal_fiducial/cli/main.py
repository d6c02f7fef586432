"""Entry point: chooses the command, turns unusable input into one line and exit status 2."""

import argparse
from collections.abc import Sequence
import errno
from importlib import import_module
from io import TextIOWrapper
import os
import sys
from typing import Any

from thermal_fiducial import __version__
from thermal_fiducial.errors import InputError, RunError

PROGRAM = 'thermal-fiducial'
INSTALL_HINT = "pip install '.[tools,ros]' in the package's folder, or apt on the robot"

#: Command to what it does. Module ``cli/<command>.py`` has ``add_arguments(parser)`` and ``run(args) -> int``; it is
#: imported only when its command is called, so that each starts fast and needs only its own extras.
COMMANDS = {
    'demo': 'simulate a flight through fog, replay it through the four nodes, score it, write the report',
    'simulate': 'write a synthetic thermal bag with ground truth',
    'replay': 'play a recorded bag through the four nodes',
    'batch': 'replay many bags on many workers, and one map of all',
    'import': "a bag from a recording of CSV files: ours, EuRoC's or Kalibr's",
    'evaluate': 'errors against ground truth, jitter, consistency, latency; tables and plots',
    'map': 'show, check, edit, merge, refine and align marker maps',
    'markers': 'make markers that can be cut: dictionaries, drawings, planning',
    'calibrate': 'calibrate the thermal camera, camera against IMU, and noise of the IMU',
    'watch': 'whether the pose may be flown on, live in a terminal',
    'check-bridge': 'verify what a flight controller would receive',
}

#: What a file system refuses: full, read-only, not allowed, broken. Nobody can do anything about it here.
_REFUSED = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EACCES, errno.EPERM, errno.EIO)

#: Commands whose module cannot have their name.
MODULES = {'import': 'import_recording'}


class _Help(argparse.HelpFormatter):
    """Says what every option is when it is left out, unless its text does; a text of several lines keeps them."""

    def _get_help_string(self, action: argparse.Action) -> str | None:
        default = action.default
        needs_none = action.nargs == 0 or action.required or default is argparse.SUPPRESS
        if needs_none or not action.option_strings or 'default' in (action.help or ''):
            return action.help
        values = list(default) if isinstance(default, (list, tuple)) else [default]
        if not values or values[0] in (None, ''):
            values = ['none']
        text = ' '.join(f'{value:g}' if isinstance(value, float) else str(value) for value in values)
        return f'{action.help or ""} (default: {text.replace("%", "%%")})'.lstrip()

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        lines = text.splitlines()
        return text if len(lines) > 1 else super()._fill_text(text, width, indent)


class _Parser(argparse.ArgumentParser):
    """Parser of the program, and of each of its commands, since argparse makes those of the same class."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**{'formatter_class': _Help, **options})


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command.

    Parameters
    ----------
    argv : arguments without the program's name; default: those of the process

    Returns
    -------
    Exit status: 0 done, 1 something failed on the way, 2 wrong usage or unusable input, 130 interrupted.
    """
    argv = sys.argv[1:] if argv is None else list(argv)
    _print_any_name()
    command = argv[0] if argv else ''
    parser = _Parser(
        prog=PROGRAM, description='Thermal-inertial localization from acrylic markers, for drones in smoke and fog.'
    )
    parser.add_argument('--version', action='version', version=f'{PROGRAM} {__version__}')
    subparsers = parser.add_subparsers(dest='command', metavar='COMMAND', required=True)
    choices = {name: subparsers.add_parser(name, help=text, description=text) for name, text in COMMANDS.items()}
    try:
        if command in choices:
            module = import_module(f'thermal_fiducial.cli.{MODULES.get(command, command.replace("-", "_"))}')
            module.add_arguments(choices[command])
        args = parser.parse_args(argv)
        status = int(module.run(args))
        sys.stdout.flush()
        return status
    except InputError as error:
        print(f'{PROGRAM} {command}: {error}', file=sys.stderr)
        return 2
    except RunError as error:
        print(f'{PROGRAM} {command}: {error}', file=sys.stderr)
        return 1
    except ModuleNotFoundError as error:
        if error.name is None or error.name.partition('.')[0] == 'thermal_fiducial':
            raise
        print(f'{PROGRAM} {command}: needs the Python package {error.name}: {INSTALL_HINT}', file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f'{PROGRAM} {command}: interrupted', file=sys.stderr)
        return 130
    except BrokenPipeError:
        _let_go_of_output()
        return 0
    except OSError as error:
        if error.errno not in _REFUSED:
            raise
        _let_go_of_output()
        print(f'{PROGRAM} {command}: {error.filename or "output"}: {error.strerror}', file=sys.stderr)
        return 2


def _print_any_name() -> None:
    """A terminal that has no letter for a name shows another one in its place."""
    if isinstance(sys.stdout, TextIOWrapper) and sys.stdout.errors == 'strict':
        sys.stdout.reconfigure(errors='replace')


def _let_go_of_output() -> None:
    """What is still to be written would fail again when the process ends."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
