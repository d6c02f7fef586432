"""Long work beside the callbacks: done elsewhere, reported once, survived when it fails."""

import multiprocessing
import os
import signal
import subprocess
import sys
import time

import pytest
from support.empty_stage import environment
from support.tasks import work
from support.waiting import PATIENCE_S, until

from thermal_fiducial.errors import InputError
from thermal_fiducial.ros.process.stopping import STOPS
from thermal_fiducial.ros.process.worker import Background, Foreground


@pytest.fixture
def worker():
    worker = Background(work)
    until(lambda: worker.take() is None and not worker.busy)
    yield worker
    worker.close()


def result_of(worker):
    outcome = []
    until(lambda: (outcome.append(worker.take()) or outcome[-1]) is not None)
    return outcome[-1]


def test_work_is_done_in_another_process_without_waiting_for_it(worker, tmp_path):
    end = tmp_path / 'end'
    worker.start(end)
    assert worker.busy
    # Whoever waited for the work here would wait until it fails: only after this does it end.
    assert worker.take() is None
    end.touch()
    process, task = result_of(worker)
    assert task == end
    assert process != os.getpid()
    assert not worker.busy
    assert worker.take() is None


def test_one_task_after_the_other(worker):
    for task in (0.0, 0.01):
        worker.start(task)
        assert result_of(worker)[1] == task


def failure(worker):
    """What is raised while a task is awaited."""
    with pytest.raises(InputError) as caught:
        result_of(worker)
    return str(caught.value)


def test_work_that_fails_is_reported_and_the_next_is_done(worker):
    worker.start('fail')
    assert 'no answer' in failure(worker)
    worker.start(0.0)
    assert result_of(worker)[1] == 0.0


def test_a_process_that_dies_is_reported_once_and_replaced(worker):
    worker.start('die')
    assert 'ended' in failure(worker)
    assert worker.take() is None
    worker.start(0.0)
    assert result_of(worker)[1] == 0.0


def test_a_process_that_has_hung_up_but_not_ended_is_replaced(worker):
    worker.start('hang up')
    assert 'ended' in failure(worker)
    worker.start(0.0)
    assert result_of(worker)[1] == 0.0


def signalled(number):
    """The process of the worker, after a signal."""
    (process,) = multiprocessing.active_children()
    os.kill(process.pid, number)
    return process


@pytest.mark.parametrize('number', STOPS)
def test_work_is_finished_for_a_node_that_is_stopped_with_all_its_processes(worker, tmp_path, number):
    """By Ctrl-C, by a terminal that is closed, or as a service."""
    end = tmp_path / 'end'
    worker.start(end)
    until((tmp_path / 'end.begun').exists)
    signalled(number)
    end.touch()
    assert result_of(worker)[1] == end


def test_a_process_that_is_killed_while_it_waits_is_replaced(worker):
    process = signalled(signal.SIGKILL)
    until(lambda: not process.is_alive())
    worker.start(0.0)
    assert result_of(worker)[1] == 0.0


def test_neither_a_task_nor_an_answer_that_a_stopped_process_leaves_in_the_pipe_is_waited_for(worker):
    """A pipe takes 200 kB; a task of a large map has two megabytes."""
    process = signalled(signal.SIGSTOP)
    began = time.monotonic()
    worker.start(b'x' * 10_000_000)
    assert worker.take() is None
    # Milliseconds, to pickle it; whoever waited for the process would do so for as long as its patience.
    assert time.monotonic() - began < 0.5 * PATIENCE_S
    os.kill(process.pid, signal.SIGCONT)
    assert len(result_of(worker)[1]) == 10_000_000


def test_a_process_that_hangs_is_killed_reported_and_replaced(worker):
    process = signalled(signal.SIGSTOP)
    patience_s, worker.patience_s = worker.patience_s, 0.1
    worker.start(0.0)
    assert 'no answer' in failure(worker)
    assert not process.is_alive()
    worker.patience_s = patience_s
    worker.start(0.0)
    assert result_of(worker)[1] == 0.0


def test_the_process_has_no_real_time_priority():
    """Of a node that has; it may be started in flight, when the map is set free or after a crash."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
    except PermissionError:
        pytest.skip('this user may not')
    try:
        worker = Background(work)
    finally:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    until(lambda: worker.take() is None and not worker.busy)
    (process,) = multiprocessing.active_children()
    assert os.sched_getscheduler(process.pid) == os.SCHED_OTHER
    worker.close()


def test_work_for_a_node_that_was_killed_ends_without_a_word():
    """A mapper killed in flight left a traceback of twenty lines on the console."""
    program = (
        'import os, time; from support.tasks import work; from thermal_fiducial.ros.process.worker import Background\n'
        'if __name__ == "__main__":\n'
        '    worker = Background(work)\n'
        '    while worker.take() is None and worker.busy: time.sleep(0.01)\n'
        '    worker.start(0.3)\n'
        '    time.sleep(0.1)\n'
        '    os._exit(0)\n'
    )
    # It returns when the last process has closed its standard error.
    command = [sys.executable, '-c', program]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S, check=True, env=environment())
    assert ended.stderr == ''


def test_closing_does_not_wait_for_the_work(worker):
    worker.start(600.0)
    began = time.monotonic()
    worker.close()
    assert time.monotonic() - began < PATIENCE_S


def test_in_the_foreground_the_result_is_there_at_once():
    worker = Foreground(work)
    assert worker.take() is None
    worker.start(0.0)
    assert worker.take() == (os.getpid(), 0.0)
    assert worker.take() is None
    assert not worker.busy
