"""Real-time priority where the user may, and back."""

import gc
import os
import threading

import pytest

from thermal_fiducial.ros.process import low_latency


@pytest.fixture
def scheduler(monkeypatch):
    """Policies of the threads as the kernel received them, instead of the kernel."""
    policies = {}
    monkeypatch.setattr(os, 'sched_getscheduler', lambda pid: policies.get(threading.get_native_id(), os.SCHED_OTHER))
    monkeypatch.setattr(os, 'sched_setscheduler', lambda thread, policy, _: policies.__setitem__(thread, policy))
    return policies


def test_all_threads_get_the_priority_and_lose_it_again(scheduler):
    done = threading.Event()
    other = threading.Thread(target=done.wait)
    other.start()
    threads = {threading.get_native_id(), other.native_id}
    with low_latency.prompt(1):
        # Under SCHED_FIFO a thread that spins until another one has run would keep the core from it for good.
        assert {scheduler[thread] for thread in threads} == {os.SCHED_RR}
        assert gc.get_freeze_count() > 0
    done.set()
    other.join()
    assert {scheduler[thread] for thread in threads} == {os.SCHED_OTHER}
    assert gc.get_freeze_count() == 0


def test_what_the_user_chose_stays(scheduler):
    scheduler[threading.get_native_id()] = os.SCHED_FIFO
    assert low_latency.take_priority(5)
    with low_latency.prompt(5):
        pass
    assert scheduler == {threading.get_native_id(): os.SCHED_FIFO}


def test_a_user_who_may_not_stays_ordinary(scheduler, monkeypatch):
    def refuse(*_):
        raise PermissionError

    monkeypatch.setattr(os, 'sched_setscheduler', refuse)
    assert not low_latency.take_priority(1)
