"""Runs one long computation at a time in a separate process, so that it never delays a callback."""

from collections.abc import Callable
import multiprocessing
from multiprocessing.connection import Connection
import os
import signal
from threading import Thread
import time
from typing import Generic, TypeVar

from thermal_fiducial.errors import InputError

Task = TypeVar('Task')
Result = TypeVar('Result')

#: Time that work may take [s]: two seconds of a slow core become a minute beside thirty busy programs.
PATIENCE_S = 60.0


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

    def take(self, patience_s: float = 0.0) -> Result | None:
        """The result, once; None as long as there is none."""
        result, self._result = self._result, None
        return result

    def close(self) -> None:
        """Nothing to stop."""


class Background(Generic[Task, Result]):
    """Runs ``function`` on one task at a time in a spawned process of low priority.

    A process that has ended is replaced with the next task, and so is one that hangs. A thread does all that waits for
    it, since a pipe blocks while the process at its other end is stopped.

    Parameters
    ----------
    function : of a module, as the process imports it by name; tasks and results are pickled
    """

    def __init__(self, function: Callable[[Task], Result]) -> None:
        self._function = function
        #: time after which a process that has not answered is killed [s]
        self.patience_s = PATIENCE_S
        self._outcome: Result | Exception | None = None
        self._spawn()
        self._begin(self._await_imports)

    def _spawn(self) -> None:
        # Spawned, since a forked child would wait for locks held by DDS threads.
        context = multiprocessing.get_context('spawn')
        self._connection, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(self._function, theirs), daemon=True)
        self._process.start()
        theirs.close()

    def _begin(self, wait: Callable[[], Result | None]) -> None:
        """Let a thread ``wait`` for the process."""

        def answer() -> None:
            try:
                self._outcome = wait()
            except (EOFError, OSError):
                # Its end of the pipe is closed before it has ended: the next task must not go to it.
                self._process.kill()
                self._process.join()
                self._outcome = InputError(f'its process ended, or gave no answer for {self.patience_s:g} s')
            except Exception as error:  # reported by the node, whatever it is
                self._outcome = error

        self._until = time.monotonic() + self.patience_s
        self._thread: Thread | None = Thread(target=answer, daemon=True)
        self._thread.start()

    def _await_imports(self) -> None:
        self._connection.recv()

    @property
    def busy(self) -> bool:
        """Whether no task can be started: the process is starting or working, or its result has not been taken."""
        return self._thread is not None

    def start(self, task: Task) -> None:
        """Process ``task``; only when not busy."""
        fresh = not self._process.is_alive()
        if fresh:
            self._connection.close()
            self._spawn()

        def work() -> Result:
            if fresh:
                self._await_imports()
            self._connection.send(task)
            return self._connection.recv()  # type: ignore[no-any-return]

        self._begin(work)

    def take(self, patience_s: float = 0.0) -> Result | None:
        """The result, once; None as long as there is none, for which it waits up to ``patience_s`` [s].

        Raises
        ------
        InputError
            The computation failed, or the process has ended or was killed for taking too long.
        """
        if self._thread is None:
            return None
        self._thread.join(patience_s)
        if self._thread.is_alive():
            if time.monotonic() > self._until:
                self._process.kill()
            return None
        self._thread, outcome, self._outcome = None, self._outcome, None
        if isinstance(outcome, Exception):
            raise InputError(f'{self._function.__name__} failed: {outcome}')
        return outcome

    def close(self) -> None:
        """Terminate the process, even during a task."""
        self._process.kill()
        # First its thread: of two that wait for a process, one comes back before it has been taken off the list.
        if self._thread is not None:
            self._thread.join()
        self._process.join()


def _serve(function: Callable[[Task], Result], connection: Connection) -> None:
    """Process tasks until the connection closes; the first answer, None, signals that all imports are done."""
    # A terminal, or who stops a service, signals all processes at once: the node decides what is still to be done.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    # The node that starts it may have real-time priority.
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    os.nice(10)
    connection.send(None)
    while True:
        try:
            task = connection.recv()
        except EOFError:
            return
        # Only now: multiprocessing ends a process by it that is left over, and waits for it.
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        try:
            outcome: Result | Exception = function(task)
        except Exception as error:  # sent to the node, whatever it is
            outcome = error
        try:
            connection.send(outcome)
        except BrokenPipeError:  # The node was killed meanwhile.
            return
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
