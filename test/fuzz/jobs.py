"""Inputs in processes of their own, so that one that ends its process is found, named, and the rest goes on."""

from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path

from support.jobs import Died, outcomes

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
    # Whole at any instant: a process may be killed while it writes.
    Path(f'{note}.new').write_text(text)
    Path(f'{note}.new').replace(note)


def batches(target: str, first: int, count: int) -> list[tuple[str, range]]:
    """``count`` inputs of a target from number ``first`` on."""
    step = BATCH[target]
    return [(target, range(k, min(k + step, first + count))) for k in range(first, first + count, step)]


def findings(jobs: list[tuple[str, range]], workers: int, folder: Path) -> Iterator[tuple[int, list[Finding]]]:
    """How many inputs are done, and what was found, batch after batch."""
    waiting = deque((target, numbers, str(folder / f'{key}.txt')) for key, (target, numbers) in enumerate(jobs))
    # No process works for long, as what one batch leaves behind must not become the next one's.
    for (target, numbers, note), found in outcomes(batch, waiting, workers, BATCHES):
        if not isinstance(found, Died):
            yield len(numbers), found
            continue
        number = _last(note, numbers)
        rest = range(number + 1, numbers.stop)
        if rest:
            waiting.append((target, rest, note))
        yield number + 1 - numbers.start, [Finding(target, number, 'died', 'the process ended')]


def _last(note: str, numbers: range) -> int:
    """The input that was being tried when a process died: the first of the batch if it had not begun any."""
    try:
        number = int(Path(note).read_text().split()[1])
    except FileNotFoundError:
        return numbers.start
    # A note of an earlier process is about an input before the batch.
    return max(number, numbers.start)
