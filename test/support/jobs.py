"""Jobs on processes that have a pipe each: one that is killed ends its pipe, at any time, and costs its own job alone.

The workers of Python's pools share one pipe. Where one of them is killed while it sends, whoever reads waits for ever.
"""

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
import multiprocessing
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
import sys
from typing import Any


class Died:
    """The process of a job ended without an answer."""


@dataclass
class _Worker:
    process: BaseProcess
    job: tuple[Any, ...]
    begun: int = 1


def outcomes(
    function: Callable[..., Any], waiting: deque[tuple[Any, ...]], workers: int, most: int = sys.maxsize
) -> Iterator[tuple[tuple[Any, ...], Any]]:
    """Each job with what ``function`` returned for it, or ``Died``, as they are done.

    Parameters
    ----------
    function : of a module, as the processes import it by name
    waiting : arguments of the jobs, taken from the left; further ones may be added meanwhile
    workers : number of processes
    most : jobs of a process, which a new one replaces then

    Raises
    ------
    Exception
        Of a job.
    """
    running: dict[Connection, _Worker] = {}
    try:
        while waiting or running:
            while waiting and len(running) < workers:
                pipe, worker = _started(function, waiting.popleft())
                running[pipe] = worker
            for pipe in wait(list(running)):
                worker = running[pipe]
                job, outcome = worker.job, _received(pipe)
                if waiting and worker.begun < most and not isinstance(outcome, Died):
                    worker.job = waiting.popleft()
                    worker.begun += 1
                    pipe.send(worker.job)
                else:
                    _kill(running.pop(pipe).process, pipe)
                if isinstance(outcome, Exception):
                    raise outcome
                yield job, outcome
    finally:
        for pipe, worker in running.items():
            _kill(worker.process, pipe)


class Elsewhere:
    """One process that calls a function of a module with one job after another, so that its memory is its own.

    Attributes
    ----------
    pid : of the process
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        self._pipe, self._process = _connected(_serve, function)
        self.pid = self._process.pid

    def __enter__(self) -> 'Elsewhere':
        return self

    def __exit__(self, *_: object) -> None:
        _kill(self._process, self._pipe)

    def __call__(self, *job: Any) -> Any:
        """What the function returned, or ``Died``. Raises the exceptions of the function."""
        self._pipe.send(job)
        outcome = _received(self._pipe)
        if isinstance(outcome, Exception):
            raise outcome
        return outcome


def _started(function: Callable[..., Any], job: tuple[Any, ...]) -> tuple[Connection, _Worker]:
    pipe, process = _connected(_serve_from, function, job)
    return pipe, _Worker(process, job)


def _connected(serve: Callable[..., None], *arguments: Any) -> tuple[Connection, BaseProcess]:
    """Our end of a pipe, and the process that calls ``serve`` with ``arguments`` and the other end."""
    context = multiprocessing.get_context('spawn')
    ours, theirs = context.Pipe()
    # The parent keeps no copy of the other end, which would keep the pipe open.
    with theirs:
        process = context.Process(target=serve, args=(*arguments, theirs), daemon=True)
        process.start()
    return ours, process


def _received(pipe: Connection) -> Any:
    try:
        return pipe.recv()
    except (EOFError, OSError):
        return Died()


def _kill(process: BaseProcess, pipe: Connection) -> None:
    process.kill()
    process.join()
    pipe.close()


def _serve_from(function: Callable[..., Any], job: tuple[Any, ...], pipe: Connection) -> None:
    pipe.send(_outcome(function, job))
    _serve(function, pipe)


def _serve(function: Callable[..., Any], pipe: Connection) -> None:
    while True:
        try:
            job = pipe.recv()
        except EOFError:
            return
        pipe.send(_outcome(function, job))


def _outcome(function: Callable[..., Any], job: tuple[Any, ...]) -> Any:
    try:
        return function(*job)
    except Exception as error:  # raised by the parent, whatever it is
        return error
