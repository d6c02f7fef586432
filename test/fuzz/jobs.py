"""Inputs in processes of their own, so that one that ends its process is found, named, and the rest goes on."""

from collections.abc import Callable, Iterator
from concurrent.futures import as_completed, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from itertools import islice
import multiprocessing
from pathlib import Path

from fuzz import files, messages
from fuzz.findings import Finding

TARGETS: dict[str, Callable[[range, Callable[[str, int], None]], list[Finding]]] = {
    'messages': messages.run,
    'files': files.run,
}
#: Inputs that a process takes in one go.
BATCH = {'messages': 200, 'files': 200}
#: Batches that a process works on.
BATCHES = 5


def batch(target: str, numbers: range, note: str) -> list[Finding]:
    """Findings of a batch; the input that is being tried stands in the file ``note``."""
    return TARGETS[target](numbers, lambda name, number: _noted(note, f'{name} {number}'))


def _noted(note: str, text: str) -> None:
    # Whole at any instant: a process ends when another beside it has died.
    Path(f'{note}.new').write_text(text)
    Path(f'{note}.new').replace(note)


def batches(target: str, first: int, count: int) -> list[tuple[str, range]]:
    """``count`` inputs of a target from number ``first`` on."""
    step = BATCH[target]
    return [(target, range(k, min(k + step, first + count))) for k in range(first, first + count, step)]


def findings(jobs: list[tuple[str, range]], workers: int, folder: Path) -> Iterator[tuple[int, list[Finding]]]:
    """How many inputs are done, and what was found, batch after batch."""
    context = multiprocessing.get_context('spawn')
    waiting = dict(enumerate(jobs))
    while waiting:
        # A process that dies takes its pool along: what was not done is done in a new one. None works for long, as what
        # one batch leaves behind must not become the next one's; max_tasks_per_child of Python 3.11 hangs for that.
        with ProcessPoolExecutor(workers, mp_context=context) as pool:
            running = {
                pool.submit(batch, target, numbers, str(folder / f'{key}.txt')): key
                for key, (target, numbers) in islice(waiting.items(), workers * BATCHES)
            }
            try:
                for future in as_completed(running):
                    found = future.result()
                    _, numbers = waiting.pop(running[future])
                    yield len(numbers), found
                continue
            except BrokenProcessPool:
                dead = [key for key in waiting if (folder / f'{key}.txt').exists()]
        for key in dead:
            yield from _after_a_death(waiting, key, folder / f'{key}.txt')


def _after_a_death(waiting: dict[int, tuple[str, range]], key: int, note: Path) -> Iterator[tuple[int, list[Finding]]]:
    """The input of a batch that was being tried is blamed where the process died with it; the batch goes on behind."""
    target, numbers = waiting.pop(key)
    number = int(note.read_text().split()[1])
    note.unlink()
    rest = range(number + 1, numbers.stop)
    if rest:
        waiting[key] = target, rest
    yield number + 1 - numbers.start, [Finding(target, number, 'died', 'the process ended, or another one beside it')]
