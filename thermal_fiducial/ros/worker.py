"""One long calculation at a time, in a process of its own, so that it never delays a callback."""

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
    """The same interface, at once and here: for a replay in lock-step."""

    def __init__(self, function: Callable[[Task], Result]) -> None:
        self._function = function
        self._result: Result | None = None
        #: whether it cannot take a task
        self.busy = False

    def start(self, task: Task) -> None:
        """Work on ``task``."""
        self._result = self._function(task)

    def take(self) -> Result | None:
        """The result, once; None as long as there is none."""
        result, self._result = self._result, None
        return result

    def close(self) -> None:
        """Nothing is left running."""


class Background(Generic[Task, Result]):
    """Runs ``function`` on one task after the other in a spawned process of low priority.

    Parameters
    ----------
    function : of a module, as it is found by name over there; tasks and results are pickled
    """

    def __init__(self, function: Callable[[Task], Result]) -> None:
        # Not forked: threads of DDS hold locks that a forked child would wait for.
        context = multiprocessing.get_context('spawn')
        self._connection, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(function, theirs), daemon=True)
        self._process.start()
        theirs.close()
        #: whether it cannot take a task: it starts, or works
        self._waiting = True

    @property
    def busy(self) -> bool:
        """Whether it cannot take a task: it is starting, working, or has ended."""
        return self._waiting or not self._process.is_alive()

    def start(self, task: Task) -> None:
        """Have it work on ``task``; only when not busy.

        Raises
        ------
        InputError
            Its process ended.
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
            The calculation failed, or its process ended.
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
        """End it, also in the middle of its work."""
        self._process.kill()
        self._process.join()


def _serve(function: Callable[[Task], Result], connection: Connection) -> None:
    """Answer tasks until the other end is gone; the first answer, None, says that all is imported."""
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
        except Exception as error:  # whatever it is, the node must hear of it
            outcome = error
        connection.send(outcome)
