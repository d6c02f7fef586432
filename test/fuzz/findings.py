"""What an input may bring about that nothing should."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
import time

#: An input that takes longer hangs whoever has it [s of processor time].
LONGEST = 1.0


@dataclass(frozen=True)
class Finding:
    """What input ``number`` of ``target`` did: died, hung, internal error, not finite, poisoned, lost."""

    target: str
    number: int
    what: str
    detail: str

    def __str__(self) -> str:
        return f'{self.target} {self.number}: {self.what}: {self.detail}'


@contextmanager
def timed(target: str, number: int, findings: list[Finding]) -> Iterator[None]:
    """Find a hang."""
    before = time.process_time()
    yield
    seconds = time.process_time() - before
    if seconds > LONGEST:
        findings.append(Finding(target, number, 'hung', f'{seconds:.1f} s'))
