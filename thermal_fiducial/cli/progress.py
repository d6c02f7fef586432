"""How far long work has come: a bar on a terminal, a line every few seconds anywhere else."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
import sys
import time
from typing import Protocol, TypeVar

_Item = TypeVar('_Item')

#: Between two lines where there is no terminal [s]: work that is done by then says nothing.
LINE_EVERY_S = 5.0


class ShowProgress(Protocol):
    """Takes the share that is done, None where nobody knows, and what else there is to say."""

    def __call__(self, share: float | None, note: str = '') -> None:
        """Show that so much is done by now."""


@contextmanager
def progress_bar(title: str) -> Iterator[ShowProgress]:
    """Show on stderr how far the work called ``title`` has come; yields what takes the share done (0 to 1)."""
    if not sys.stderr.isatty():
        yield _lines(title)
        return
    try:
        from rich.console import Console
        from rich.progress import Progress
    except ImportError:
        yield _lines(title)
        return
    with Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(title, total=None)

        def update(share: float | None, note: str = '') -> None:
            total = None if share is None else 1.0
            bar.update(task, completed=share, total=total, description=f'{title}: {note}' if note else title)

        yield update


def counted(show: ShowProgress, total: int) -> Callable[[int], None]:
    """What takes how many of ``total`` pieces are done since it was called last."""
    done = 0

    def advance(count: int) -> None:
        nonlocal done
        done += count
        show(min(1.0, done / total))

    return advance


def tracked(items: Iterable[_Item], title: str, total: int) -> Iterator[_Item]:
    """``items``, of which there are ``total``, with the progress of the work on them called ``title``."""
    with progress_bar(title) as show:
        advance = counted(show, max(1, total))
        for item in items:
            yield item
            advance(1)


def _lines(title: str) -> ShowProgress:
    last = time.monotonic()

    def line(share: float | None, note: str = '') -> None:
        nonlocal last
        now = time.monotonic()
        if now - last >= LINE_EVERY_S:
            last = now
            done = '' if share is None else f'{100.0 * share:.0f} %'
            print(f'{title}: {", ".join(filter(None, (note, done)))}', file=sys.stderr, flush=True)

    return line
