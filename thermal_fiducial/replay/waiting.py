"""Waits of a replay: as long as it takes, however slow the machine. What is waited for is said; nothing is ended."""

from collections.abc import Callable
import time

#: Without progress for so long, what is waited for is said.
PATIENCE_S = 30.0


class Wait:
    """One wait.

    Parameters
    ----------
    what : says what is waited for, in words
    say : takes a line for the user
    now : seconds of a monotonic clock
    """

    def __init__(
        self, what: Callable[[], str], say: Callable[[str], None], now: Callable[[], float] = time.monotonic
    ) -> None:
        self._what, self._say, self._now = what, say, now
        self._since = now()
        self._patience = PATIENCE_S
        self._progress: object = None

    def go_on(self, progress: object) -> None:
        """Wait on; ``progress`` is anything that changes when something happens."""
        now = self._now()
        if progress != self._progress:
            self._progress, self._since, self._patience = progress, now, PATIENCE_S
        elif now - self._since >= self._patience:
            self._say(f'nothing for {now - self._since:.0f} s, waiting for {self._what()}')
            # Said again after twice the time, and so on: a night's wait is ten lines.
            self._patience *= 2.0
