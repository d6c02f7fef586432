"""Output that never halts a node: a terminal that was stopped, or a program that no longer reads its pipe.

ROS writes each line of the log in the thread that logs, and holds the interpreter meanwhile: a full pipe would end
poses, and the stop signals would not be noticed either.
"""

from contextlib import suppress
import os
import stat
import sys

#: Standard output and standard error.
_STREAMS = (1, 2)


def drop_what_does_not_fit() -> None:
    """Make standard output and error non-blocking for this process: a line that would have to wait is lost."""
    for stream in _STREAMS:
        # It may be a terminal of another user, or a named pipe whose reader has ended.
        with suppress(OSError):
            _unblock(stream)
    if sys.stderr is None:
        # rclpy's executor asks for one.
        sys.stderr = os.fdopen(_STREAMS[-1], 'w', closefd=False)


def _unblock(stream: int) -> None:
    try:
        mode = os.fstat(stream).st_mode
    except OSError:
        # Closed: the next file to be opened, such as a socket, would get its number and our lines.
        _open_as(stream, os.devnull)
        return
    if stat.S_ISSOCK(mode):
        # It cannot be opened again. Of the system's journal, each unit has its own.
        os.set_blocking(stream, False)
    elif stat.S_ISFIFO(mode) or stat.S_ISCHR(mode):
        # Opened again, as the flag of the present one would hold for all programs that share it, such as a shell.
        _open_as(stream, f'/proc/self/fd/{stream}')


def _open_as(stream: int, path: str) -> None:
    opened = os.open(path, os.O_WRONLY | os.O_NONBLOCK | os.O_NOCTTY)
    if opened != stream:
        os.dup2(opened, stream)
        os.close(opened)


def say_last(line: str) -> None:
    """Write a line to standard error just before the end.

    Past Python's buffer: what it cannot flush at the end would change the exit status.
    """
    with suppress(OSError):
        os.write(_STREAMS[-1], f'{line}\n'.encode(errors='replace'))
