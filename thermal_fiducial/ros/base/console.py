"""Console lines for the pilot: printed on change, at most one of each kind a second."""

from typing import Any

from thermal_fiducial.core.wording import without_numbers

#: Calls of :meth:`Console.say` until a headline of which only numbers have changed is printed again: an estimate moves
#: in its last digit at almost each of them. Refusals that stay the same are printed twice a minute, too.
CALLS_BETWEEN = 30


class Console:
    """Lines through ``logger``; :meth:`say` is called once a second."""

    def __init__(self, logger: Any) -> None:
        self._logger = logger
        self._said = ''
        #: calls since that was printed
        self._calls = 0
        self._events: dict[str, str] = {}

    def event(self, kind: str, line: str) -> None:
        """Queue a line for the next :meth:`say`; a later line of the same ``kind`` replaces it."""
        self._events[kind] = line

    def say(self, headline: str, *, calm: bool) -> None:
        """Print the queued events, and the ``headline`` if it has changed, also that there is none any more.

        One of which only numbers have changed is printed :data:`CALLS_BETWEEN` calls after the last line.
        """
        for line in self._events.values():
            self._logger.warning(line)
        self._events.clear()
        self._calls += 1
        same_words = without_numbers(headline) == without_numbers(self._said)
        if headline == self._said or (same_words and self._calls < CALLS_BETWEEN):
            return
        self._calls = 0
        before, self._said = self._said, headline
        # Separate calls: rclpy refuses another severity from the same line of code.
        if headline and calm:
            self._logger.info(headline)
        elif headline:
            self._logger.warning(headline)
        else:
            self._logger.info(f'over: {before}')
