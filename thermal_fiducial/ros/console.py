"""What a pilot must know, on the console: a line where it changes, at most one a second of each kind."""

from typing import Any


class Console:
    """Lines through ``logger``; :meth:`say` is called once a second."""

    def __init__(self, logger: Any) -> None:
        self._logger = logger
        self._said = ''
        self._events: dict[str, str] = {}

    def event(self, kind: str, line: str) -> None:
        """Keep a line for the next second; a later one of its ``kind`` replaces it."""
        self._events[kind] = line

    def say(self, headline: str, *, calm: bool) -> None:
        """Print the events since the last time, and the ``headline`` where it has changed."""
        for line in self._events.values():
            self._logger.warning(line)
        self._events.clear()
        if headline == self._said:
            return
        self._said = headline
        # Two lines of code, as rclpy takes no two severities from one.
        if headline and calm:
            self._logger.info(headline)
        elif headline:
            self._logger.warning(headline)
