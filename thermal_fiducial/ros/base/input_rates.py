"""Rates of a node's inputs, and inputs that have stopped, as diagnostic_updater checks in C++ nodes.

The main input is the first one that the node subscribed to. Its rate is compared with the expected one, a parameter or
the rate of the first seconds. Any other regular and steady input is reported when it stops.
"""

from collections import deque
from collections.abc import Sequence
from statistics import median

from thermal_fiducial.core.types import SECOND_NS
from thermal_fiducial.ros.base.counting import Input

#: Length of the averaging window [samples, one a second]: a shutter event of half a second is 5 % of it.
_WINDOW = 10
#: Consecutive samples with messages after which an input is steady, and samples that determine its first rate.
_STEADY = 5
#: Relative tolerance of a rate: above the loss by a shutter event, below what a second publisher adds.
_TOLERANCE = 0.2
#: Samples without a message after which an input has stopped; a shutter event takes half a second.
_STOPPED = 2


class _Watch:
    """One input."""

    def __init__(self, source: Input) -> None:
        self.topic = source.topic.lstrip('/')
        self.source = source
        self.silent = 0
        self._steady = 0
        self._looks: deque[tuple[int, int]] = deque(maxlen=_WINDOW + 1)
        self._first_rates: list[float] = []

    def look(self, time_ns: int) -> None:
        """Sample the count at a time.

        A simulated clock is 0 until its first message: the jump from there says nothing of a rate, nor does what comes
        while it stands still, nor the time for which an input had stopped.
        """
        count = self.source.count
        before_ns, before = self._looks[-1] if self._looks else (time_ns - SECOND_NS, 0)
        came, returned = count > before, count > before and self.stopped
        self.silent = 0 if came else self.silent + 1
        if not self.is_steady:
            self._steady = self._steady + 1 if came else 0
        if time_ns <= before_ns or before_ns == 0 or returned:
            self._looks.clear()
        elif time_ns > before_ns and came and len(self._first_rates) < _STEADY:
            self._first_rates.append((count - before) / (time_ns - before_ns) * SECOND_NS)
        self._looks.append((time_ns, count))

    @property
    def is_steady(self) -> bool:
        """Whether messages arrived in enough consecutive samples."""
        return self._steady >= _STEADY

    @property
    def stopped(self) -> bool:
        """Whether messages arrived before but no longer do."""
        return self.source.count > 0 and self.silent >= _STOPPED

    @property
    def rate(self) -> float:
        """Mean over the window [Hz]; 0 before the second sample."""
        (first_ns, first), (last_ns, last) = (self._looks[0], self._looks[-1]) if self._looks else ((0, 0), (0, 0))
        return (last - first) / (last_ns - first_ns) * SECOND_NS if last_ns > first_ns else 0.0

    @property
    def first_rate(self) -> float:
        """Median over the first seconds [Hz]; 0 before they are over."""
        return median(self._first_rates) if len(self._first_rates) == _STEADY else 0.0

    @property
    def has_rate(self) -> bool:
        """Whether the window is full."""
        return len(self._looks) > _WINDOW


class InputRates:
    """Monitors the ``inputs`` of a node, a list that may still grow.

    Parameters
    ----------
    expected : rate of the main input [Hz]; 0: its rate in the first seconds
    """

    def __init__(self, inputs: Sequence[Input], expected: float = 0.0) -> None:
        self._inputs = inputs
        self._expected = expected
        self._watches: dict[Input, _Watch] = {}

    def look(self, time_ns: int) -> None:
        """Sample all inputs; call it once a second."""
        for source in self._inputs:
            self._watches.setdefault(source, _Watch(source)).look(time_ns)

    @property
    def _main(self) -> _Watch | None:
        return next(iter(self._watches.values()), None)

    @property
    def main(self) -> str:
        """Topic of the main input."""
        return self._main.topic if self._main else ''

    @property
    def silent(self) -> bool:
        """Whether the main input had no message since the last sample."""
        return self._main is not None and self._main.silent > 0

    @property
    def stopped(self) -> bool:
        """Whether the main input has stopped."""
        return self._main is not None and self._main.stopped

    @property
    def expected(self) -> float:
        """Rate of the main input [Hz]; 0: not known yet."""
        return self._expected or (self._main.first_rate if self._main else 0.0)

    @property
    def stale(self) -> list[str]:
        """Topics of the other inputs that were steady and have stopped."""
        others = [watch for watch in list(self._watches.values())[1:] if watch.source.regular]
        return [watch.topic for watch in others if watch.is_steady and watch.stopped]

    def trouble(self) -> str:
        """Message for the pilot if the main input has not arrived yet or has stopped; else empty."""
        main = self._main
        if main is not None and not main.source.count:
            return f'waiting for {main.topic}'
        return f'{main.topic} has stopped' if main is not None and main.stopped else ''

    def doubt(self) -> str:
        """Faults of the inputs while the main one arrives: its rate, other inputs that have stopped; else empty."""
        words = [f'no {topic} any more' for topic in self.stale]
        main = self._main
        if main is not None and main.has_rate and self.expected and abs(main.rate / self.expected - 1.0) > _TOLERANCE:
            words.append(f'{main.topic} at {main.rate:.3g} Hz, {self.expected:.3g} expected')
        return '; '.join(words)

    def figures(self) -> dict[str, object]:
        """Rates of the inputs, expected rate of the main one, stale inputs."""
        if not self._watches:
            return {}
        rates: dict[str, object] = {
            f'rate /{watch.topic} [Hz]': f'{watch.rate:.4g}' for watch in self._watches.values() if watch.source.count
        }
        low, high = (1.0 - _TOLERANCE) * self.expected, (1.0 + _TOLERANCE) * self.expected
        limits = f'{self.expected:.4g} ({low:.4g} to {high:.4g})' if self.expected else 'not known yet'
        return rates | {'expected rate [Hz]': limits, 'stale inputs': ', '.join(self.stale)}
