"""Runs one long computation at a time in a separate process, so that it never delays a callback."""

from collections.abc import Callable
import multiprocessing
from multiprocessing.connection import Connection
import os
import signal
from typing import Generic, TypeVar

from thermal_fiducial.errors import InputError

Task = TypeVar('Task')
Result = TypeVar('Result')

_ENDED = 'the background process ended'


class Foreground(Generic[Task, Result]):
    """The interface of :class:`Background`, run synchronously, for a lock-step replay."""

    def __init__(self, function: Callable[[Task], Result]) -> None:
        self._function = function
        self._result: Result | None = None
        #: whether it cannot take a task
        self.busy = False

    def start(self, task: Task) -> None:
        """Process ``task``."""
        self._result = self._function(task)

    def take(self) -> Result | None:
        """The result, once; None as long as there is none."""
        result, self._result = self._result, None
        return result

    def close(self) -> None:
        """Nothing to stop."""


class Background(Generic[Task, Result]):
    """Runs ``function`` on one task at a time in a spawned process of low priority.

    Parameters
    ----------
    function : of a module, as the process imports it by name; tasks and results are pickled
    """

    def __init__(self, function: Callable[[Task], Result]) -> None:
        # Spawned, since a forked child would wait for locks held by DDS threads.
        context = multiprocessing.get_context('spawn')
        self._connection, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(function, theirs), daemon=True)
        self._process.start()
        theirs.close()
        #: whether the process is starting or working
        self._waiting = True

    @property
    def busy(self) -> bool:
        """Whether no task can be started: the process is starting, working, or has ended."""
        return self._waiting or not self._process.is_alive()

    def start(self, task: Task) -> None:
        """Send ``task`` to the process; only when not busy.

        Raises
        ------
        InputError
            The process has ended.
        """
        try:
            self._connection.send(task)
        except OSError:
            raise InputError(_ENDED) from None
        self._waiting = True

    def take(self) -> Result | None:
        """The result, once; None as long as there is none.

        Raises
        ------
        InputError
            The computation failed, or the process has ended.
        """
        if not self._waiting or not self._connection.poll():
            return None
        try:
            outcome = self._connection.recv()
        except (EOFError, OSError):
            self._connection.close()
            self._waiting = False
            raise InputError(_ENDED) from None
        self._waiting = False
        if isinstance(outcome, Exception):
            raise InputError(f'background work failed: {outcome}')
        return outcome  # type: ignore[no-any-return]

    def close(self) -> None:
        """Terminate the process, even during a task."""
        self._process.kill()
        self._process.join()


def _serve(function: Callable[[Task], Result], connection: Connection) -> None:
    """Process tasks until the connection closes; the first answer, None, signals that all imports are done."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.nice(10)
    connection.send(None)
    while True:
        try:
            task = connection.recv()
        except EOFError:
            return
        try:
            outcome: Result | Exception = function(task)
        except Exception as error:  # sent to the node, whatever it is
            outcome = error
        connection.send(outcome)
