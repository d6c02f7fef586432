"""Entry point: runs a command, and reports unusable input in one line with exit status 2."""

from collections.abc import Sequence
import errno
from importlib import import_module
from io import TextIOWrapper
import os
import sys

from thermal_fiducial import __version__
from thermal_fiducial.cli.parser import add_command, Parser, PROGRAM
from thermal_fiducial.errors import InputError, RunError
from thermal_fiducial.files.packages import remedy
from thermal_fiducial.files.reading import shown
from thermal_fiducial.ros.process.interrupts import Interrupts

INSTALL_HINT = f'{remedy("tools,ros")}, or apt on the robot'

#: Commands and their descriptions. Module ``cli/<command>.py`` has ``add_arguments(parser)`` and ``run(args) -> int``;
#: it is imported only when its command is called, so that each starts fast and needs only its own packages.
COMMANDS = {
    'demo': 'simulate a flight through fog, replay it through the four nodes, score it, write the report',
    'simulate': 'write a synthetic thermal bag with ground truth',
    'replay': 'play a recorded bag through the four nodes',
    'batch': 'replay many bags on many workers, and make one map of them',
    'import': "convert a recording of CSV files (ours, EuRoC's or Kalibr's) to a bag",
    'evaluate': 'evaluate a run: errors against ground truth, jitter, consistency, latency; tables and plots',
    'map': 'show, check, edit, merge, refine and align marker maps',
    'markers': 'make markers that can be cut: dictionaries, drawings, planning',
    'calibrate': 'calibrate the thermal camera, camera against IMU, and noise of the IMU',
    'watch': 'show live in a terminal whether the pose may be flown on',
    'check-bridge': 'verify what a flight controller would receive',
}

#: Errors of a file system that is full, read-only, not permitted or broken, and of names that it cannot have.
_REFUSED = (
    *(errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EACCES, errno.EPERM, errno.EIO),
    *(errno.ENAMETOOLONG, errno.ELOOP, errno.ENOTDIR, errno.EISDIR),
)

#: Of pathlib's error for a symbolic link that leads to itself.
_LOOP = 'Symlink loop from '

#: Exit status of an interrupted command, as a shell has it for SIGINT.
INTERRUPTED = 130

#: Modules of commands with a name that no module can have.
MODULES = {'import': 'import_recording'}


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command.

    Parameters
    ----------
    argv : arguments without the program's name; default: those of the process

    Returns
    -------
    Exit status: 0 done, 1 something failed on the way, 2 wrong usage or unusable input, 130 interrupted.
    """
    words = sys.argv[1:] if argv is None else list(argv)
    _replace_closed_streams()
    _allow_any_letter()
    with Interrupts(held=False) as interrupts:
        return _finished(words, interrupts)


def _finished(argv: Sequence[str], interrupts: Interrupts) -> int:
    """Run a command to its end or its error; returns the exit status."""
    try:
        status = _run(argv)
        sys.stdout.flush()
        return status
    except BrokenPipeError:
        _discard_output()
        return 0
    except (Exception, KeyboardInterrupt) as error:
        # Libraries in C turn an interrupt into errors of their own.
        found = _reported(KeyboardInterrupt() if interrupts.asked else error)
        if found is None:
            raise
        status, words = found
        print(f'{PROGRAM} {argv[0] if argv else ""}: {_on_one_line(words)}', file=sys.stderr)
        return status


def _run(argv: Sequence[str]) -> int:
    """Parse the arguments and run their command."""
    parser = Parser(
        prog=PROGRAM, description='Thermal-inertial localization from acrylic markers, for drones in smoke and fog.'
    )
    parser.add_argument('--version', action='version', version=f'{PROGRAM} {__version__}')
    subparsers = parser.add_subparsers(dest='command', metavar='COMMAND', required=True)
    choices = {name: add_command(subparsers, name, text) for name, text in COMMANDS.items()}
    command = argv[0] if argv else ''
    if command not in choices:
        # Prints the help, the version or an error, and ends the process.
        parser.parse_args(argv)
        parser.error('the command comes first')
    module = import_module(f'thermal_fiducial.cli.{MODULES.get(command, command.replace("-", "_"))}')
    module.add_arguments(choices[command])
    return int(module.run(parser.parse_args(argv)))


def _reported(error: BaseException) -> tuple[int, str] | None:
    """Exit status and message for an error that a user can act upon; None for others, which need their traceback."""
    if isinstance(error, InputError | RunError):
        return 2 if isinstance(error, InputError) else 1, str(error)
    if isinstance(error, KeyboardInterrupt):
        return INTERRUPTED, 'interrupted'
    if isinstance(error, ModuleNotFoundError) and error.name and error.name.partition('.')[0] != 'thermal_fiducial':
        return 2, f'needs the Python package {error.name}: {INSTALL_HINT}'
    if type(error).__name__ == 'RCLError' and os.environ.get('ROS_SECURITY_ENABLE') == 'true':
        return 2, f'ROS_SECURITY_ENABLE is true: {str(error).splitlines()[0]}'
    if isinstance(error, RuntimeError) and str(error).startswith(_LOOP):
        return 2, f'{str(error).removeprefix(_LOOP)}: {os.strerror(errno.ELOOP)}'
    if isinstance(error, OSError) and error.errno in _REFUSED:
        _discard_output()
        return 2, f'{shown(error.filename or "output")}: {error.strerror}'
    return None


def _on_one_line(words: str) -> str:
    """A message with what was given, whose letters may be any, without the unprintable ones."""
    return ''.join(letter if letter.isprintable() else '?' for letter in words)


def _replace_closed_streams() -> None:
    """Write to nowhere what a caller has closed (``>&-``): Python has none then, and files would get its number."""
    for name in ('stdout', 'stderr'):
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_WRONLY), 'w'))


def _allow_any_letter() -> None:
    """Let names with letters that the terminal does not have be printed with substitutes."""
    if isinstance(sys.stdout, TextIOWrapper) and sys.stdout.errors == 'strict':
        sys.stdout.reconfigure(errors='replace')


def _discard_output() -> None:
    """Discard unwritten output, which would fail again when the process ends."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
