"""``python -m thermal_fiducial COMMAND``, which pip installs as ``thermal-fiducial``."""

from importlib import import_module
import signal
import sys


def main() -> int:
    """Run a command.

    Before it works and after it has cleared up, Ctrl-C ends the process at once: Python's own handler would print a
    traceback of the imports, or of the interpreter's end.

    Returns
    -------
    Exit status, as of :func:`thermal_fiducial.cli.main.main`.
    """
    # A shell's background jobs ignore the signal.
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    return int(import_module('thermal_fiducial.cli.main').main())


if __name__ == '__main__':
    sys.exit(main())
