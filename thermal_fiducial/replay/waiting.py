"""Waits of a replay without a timeout, for slow machines; long waits are reported."""

from collections.abc import Callable
import time

#: Time without progress after which a wait is reported [s].
PATIENCE_S = 30.0


class Wait:
    """One wait.

    Parameters
    ----------
    what : describes what is awaited
    say : called with a message for the user
    now : returns seconds of a monotonic clock
    """

    def __init__(
        self, what: Callable[[], str], say: Callable[[str], None], now: Callable[[], float] = time.monotonic
    ) -> None:
        self._what, self._say, self._now = what, say, now
        self._since = now()
        self._patience = PATIENCE_S
        self._progress: object = None

    def go_on(self, progress: object) -> None:
        """Report a wait without progress; ``progress`` is any value that changes with progress."""
        now = self._now()
        if progress != self._progress:
            self._progress, self._since, self._patience = progress, now, PATIENCE_S
        elif now - self._since >= self._patience:
            self._say(f'nothing for {now - self._since:.0f} s, waiting for {self._what()}')
            # The interval doubles with each report: a night's wait gives ten lines.
            self._patience *= 2.0
