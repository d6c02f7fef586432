"""Console lines for the pilot: printed on change, at most one of each kind a second."""

from typing import Any


class Console:
    """Lines through ``logger``; :meth:`say` is called once a second."""

    def __init__(self, logger: Any) -> None:
        self._logger = logger
        self._said = ''
        self._events: dict[str, str] = {}

    def event(self, kind: str, line: str) -> None:
        """Queue a line for the next :meth:`say`; a later line of the same ``kind`` replaces it."""
        self._events[kind] = line

    def say(self, headline: str, *, calm: bool) -> None:
        """Print the queued events, and the ``headline`` if it has changed, also that there is none any more."""
        for line in self._events.values():
            self._logger.warning(line)
        self._events.clear()
        if headline == self._said:
            return
        before, self._said = self._said, headline
        # Separate calls: rclpy refuses another severity from the same line of code.
        if headline and calm:
            self._logger.info(headline)
        elif headline:
            self._logger.warning(headline)
        else:
            self._logger.info(f'over: {before}')
