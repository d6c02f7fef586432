"""Jobs of ``make faults`` and ``make fuzz`` whose processes are killed."""

from collections import deque
import multiprocessing
from pathlib import Path
import threading
import time

from fuzz.jobs import findings
import pytest
from support.jobs import Died, Elsewhere, outcomes
from support.tasks import large, work

FIRST = 2_000_000


def test_every_job_is_done_once_by_processes_that_are_replaced():
    done = list(outcomes(work, deque((number,) for number in range(5)), 1, most=2))
    assert [(job, answer) for job, (_, answer) in done] == [((number,), number) for number in range(5)]
    assert len({process for _, (process, _) in done}) == 3


def test_a_job_that_fails_is_raised():
    with pytest.raises(ValueError, match='no answer'):
        list(outcomes(work, deque([('fail',)]), 2))
    assert not multiprocessing.active_children()


def test_a_process_that_dies_costs_its_own_job_alone():
    done = dict(outcomes(work, deque([('die',), (1,), (2,)]), 2))
    assert isinstance(done['die',], Died)
    assert [done[job][1] for job in [(1,), (2,)]] == [1, 2]


def test_a_process_elsewhere_does_one_job_after_another():
    with Elsewhere(work) as elsewhere:
        assert [elsewhere(number) for number in range(3)] == [(elsewhere.pid, number) for number in range(3)]
        with pytest.raises(ValueError, match='no answer'):
            elsewhere('fail')
        assert isinstance(elsewhere('die'), Died)
    assert not multiprocessing.active_children()


@pytest.mark.timeout(600, method='thread')
def test_a_process_that_is_killed_while_it_sends_is_noticed():
    """As by the kernel for lack of memory: half an answer is in its pipe, and the rest of it never comes."""
    waiting = deque([(1,)])
    jobs = outcomes(large, waiting, 1)
    waiting.append((30,))
    assert len(next(jobs)[1]) == 1_000_000
    (process,) = multiprocessing.active_children()
    while not _sleeps(process.pid):
        # Until the pipe is full.
        time.sleep(0.1)
    process.kill()
    job, outcome = next(jobs)
    assert job == (30,)
    assert isinstance(outcome, Died)


def _sleeps(pid):
    return Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()[0] == 'S'


@pytest.mark.filterwarnings('ignore')
def test_an_input_whose_process_is_killed_is_named_and_the_others_go_on(tmp_path):
    jobs = [('files', range(first, first + 30)) for first in (FIRST, FIRST + 30)]

    def kill_the_first():
        while not (tmp_path / '0.txt').exists():
            time.sleep(0.001)
        min(multiprocessing.active_children(), key=lambda process: process.pid).kill()

    thread = threading.Thread(target=kill_the_first)
    thread.start()
    done = list(findings(jobs, 2, tmp_path))
    thread.join()
    assert sum(count for count, _ in done) == 60
    (found,) = [finding for _, batch in done for finding in batch]
    assert found.what == 'died'
    assert found.number in range(FIRST, FIRST + 60)
