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
                    _end(pipe, running.pop(pipe))
                if isinstance(outcome, Exception):
                    raise outcome
                yield job, outcome
    finally:
        for pipe, worker in running.items():
            _end(pipe, worker)


def _started(function: Callable[..., Any], job: tuple[Any, ...]) -> tuple[Connection, _Worker]:
    context = multiprocessing.get_context('spawn')
    ours, theirs = context.Pipe()
    # The parent keeps no copy of the other end, which would keep the pipe open.
    with theirs:
        process = context.Process(target=_serve, args=(function, job, theirs), daemon=True)
        process.start()
    return ours, _Worker(process, job)


def _received(pipe: Connection) -> Any:
    try:
        return pipe.recv()
    except (EOFError, OSError):
        return Died()


def _end(pipe: Connection, worker: _Worker) -> None:
    worker.process.kill()
    worker.process.join()
    pipe.close()


def _serve(function: Callable[..., Any], job: tuple[Any, ...], pipe: Connection) -> None:
    while True:
        try:
            outcome = function(*job)
        except Exception as error:  # raised by the parent, whatever it is
            outcome = error
        pipe.send(outcome)
        try:
            job = pipe.recv()
        except EOFError:
            return
