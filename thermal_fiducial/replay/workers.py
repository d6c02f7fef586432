"""Worker processes of Dask distributed, on this machine or others."""

import asyncio
from collections.abc import Iterator
from contextlib import contextmanager, ExitStack, suppress
import logging
from multiprocessing import resource_tracker
import os
import signal
from typing import Any

from thermal_fiducial.errors import InputError
from thermal_fiducial.ros.process.interrupts import Interrupts

#: Settings of a local cluster: how many workers may die with a bag before the bag is to blame; and no timeout of a
#: starved worker, since a dead one shows by its connection.
_PATIENT = {
    'distributed.scheduler.allowed-failures': 10,
    'distributed.scheduler.worker-ttl': None,
    'distributed.comm.timeouts.connect': '600s',
}


@contextmanager
def workers(count: int, scheduler: str = '') -> Iterator[Any]:
    """A client of ``count`` worker processes of this machine, or of the cluster at address ``scheduler``.

    Raises
    ------
    InputError
        No cluster answers there.
    """
    import dask
    from distributed import Client, LocalCluster

    if scheduler:
        try:
            client = Client(scheduler)
        except (OSError, ValueError) as error:
            raise InputError(f'no scheduler at {scheduler}: {error}') from None
        with client:
            yield client
        return
    # Of killed workers, what is left of their cluster still logs when its own silence has ended with it.
    logging.getLogger('distributed').setLevel(logging.CRITICAL)
    with dask.config.set(_PATIENT), ExitStack() as ending:
        # Half a cluster ends with tracebacks of its own.
        with Interrupts(held=True), _blocked_in_children():
            cluster = LocalCluster(
                n_workers=count,
                threads_per_worker=1,
                processes=True,
                dashboard_address=':0',
                silence_logs=logging.CRITICAL,
            )
            ending.enter_context(cluster)
            client = ending.enter_context(Client(cluster))
            ending.enter_context(_killed_on_errors(cluster))
        yield client


@contextmanager
def _killed_on_errors(cluster: Any) -> Iterator[None]:
    """Kill the workers if the context ends with an error.

    Only asked to end, a worker goes on with its bag until the cluster's patience ends, after four seconds, and is
    killed then.
    """
    try:
        yield
    except BaseException:
        cluster.sync(_kill_workers, cluster)
        raise


async def _kill_workers(cluster: Any) -> None:
    nannies = list(cluster.workers.values())
    # Closing ones start no new worker in place of a killed one.
    ending = [asyncio.ensure_future(nanny.close()) for nanny in nannies]
    for nanny in nannies:
        if nanny.pid is not None:
            with suppress(ProcessLookupError):
                os.kill(nanny.pid, signal.SIGKILL)
    await asyncio.gather(*ending)


@contextmanager
def _blocked_in_children() -> Iterator[None]:
    """Let processes that are started meanwhile, and those that threads of theirs start later, never get SIGINT.

    Ctrl-C reaches all processes of a terminal; only the first of them is to act on it.
    """
    # Python's helper of spawned processes, started here if there is none yet, would unblock it.
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
