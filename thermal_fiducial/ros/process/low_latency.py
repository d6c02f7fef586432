"""Low latency under load: real-time priority, no pauses of the garbage collector."""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
import gc
import os
from pathlib import Path


def keep_for_good() -> None:
    """Exempt all present objects from garbage collection: traversing them halts the process for 50 ms."""
    gc.collect()
    gc.freeze()


def take_priority(priority: int) -> bool:
    """Set SCHED_RR for all threads of this process, unless the user has already chosen a policy.

    Not SCHED_FIFO: the asynchronous writer of Fast DDS spins until another thread of its process has removed a sample,
    and must not keep the core from it.

    Parameters
    ----------
    priority : SCHED_RR priority, 1 to 99

    Returns
    -------
    Whether the user may (root, CAP_SYS_NICE, or ``rtprio`` in limits.conf).
    """
    if os.sched_getscheduler(0) != os.SCHED_OTHER:
        return True
    try:
        _schedule(os.SCHED_RR, priority)
    except PermissionError:
        return False
    return True


@contextmanager
def prompt(priority: int) -> Iterator[None]:
    """Context with the priority and without pauses of the garbage collector."""
    keep_for_good()
    ordinary = os.sched_getscheduler(0) == os.SCHED_OTHER
    take_priority(priority)
    try:
        yield
    finally:
        gc.unfreeze()
        if ordinary:
            _schedule(os.SCHED_OTHER, 0)


def _schedule(policy: int, priority: int) -> None:
    for thread in Path('/proc/self/task').iterdir():
        with suppress(ProcessLookupError):
            os.sched_setscheduler(int(thread.name), policy, os.sched_param(priority))
