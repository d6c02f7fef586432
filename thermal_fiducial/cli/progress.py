"""Progress of long work: a bar on a terminal, elsewhere a line every few seconds."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
import sys
import time
from typing import Protocol, TypeVar

_Item = TypeVar('_Item')

#: Interval of lines without a terminal [s]; shorter work prints none.
LINE_EVERY_S = 5.0


class ShowProgress(Protocol):
    """Display of the share that is done, None if unknown, and of a note."""

    def __call__(self, share: float | None, note: str = '') -> None:
        """Update the display."""


@contextmanager
def progress_bar(title: str) -> Iterator[ShowProgress]:
    """Show the progress of the work ``title`` on stderr; yields the function that updates it (0 to 1)."""
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
    """Function to call with the number of pieces, of ``total``, that were done since its last call."""
    done = 0

    def advance(count: int) -> None:
        nonlocal done
        done += count
        show(min(1.0, done / total))

    return advance


def tracked(items: Iterable[_Item], title: str, total: int) -> Iterator[_Item]:
    """Iterate over ``total`` ``items`` and show the progress of the work ``title`` on them."""
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
