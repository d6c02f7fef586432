"""What a flight with a fault came to, in numbers."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.stats import chi2

from faults.flight import BEGIN, LAST
from faults.run import Flown, Output

#: A pose is off beyond this [m], and beyond three sigma in its six degrees of freedom.
OFF = 0.1
THREE_SIGMA = float(chi2.ppf(0.9973, 6))
#: Longer than this [s] without a pose, and the pose counts as declared lost: four samples of the IMU.
SILENCE = 0.02
#: What goes out undeclared for longer than this [s] is a defect.
TOO_LONG = 0.3


@dataclass(frozen=True)
class Score:
    """Of a flight, or of several: the worst.

    ``worst`` [m] of the poses that went out; ``declared`` [s] after the fault until the first silence, ``recovered``
    [s] after its end until poses go out that are not off: nan where there is nothing to declare or recover from,
    inf where it did not come about; ``beyond`` share beyond three sigma; ``off_for``, ``beyond_for``: longest that
    poses went out that were off, or beyond three sigma [s]; ``sent``, ``sent_off``, ``sent_worst``: to the autopilot,
    how many after the fault, how many of them off, the worst [m].
    """

    worst: float
    declared: float
    recovered: float
    beyond: float
    off_for: float
    beyond_for: float
    sent: int
    sent_off: int
    sent_worst: float

    @property
    def is_defect(self) -> bool:
        """Whether wrong poses went out for too long."""
        return max(self.off_for, self.beyond_for) > TOO_LONG


def score(flown: Flown, ends: float, begin: float = BEGIN, last: float = LAST) -> Score:
    """Score of a flight until ``last`` whose fault lasted from ``begin`` to ``ends`` [s]."""
    times, distance, squares = _since(begin, flown.pose)
    _, bridge_distance, _ = _since(begin, flown.bridge)
    off = distance > OFF
    silences = _silences(times, begin, last)
    return Score(
        worst=float(distance.max(initial=0.0)),
        declared=silences[0][0] - begin if silences else np.nan,
        recovered=_recovered(times, off, silences, ends),
        beyond=float(np.mean(squares > THREE_SIGMA)) if len(squares) else 0.0,
        off_for=_longest(times, off),
        beyond_for=_longest(times, squares > THREE_SIGMA),
        sent=len(bridge_distance),
        sent_off=int(np.sum(bridge_distance > OFF)),
        sent_worst=float(bridge_distance.max(initial=0.0)),
    )


def _since(begin: float, output: Output) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    times = np.array(output.times)
    later = times >= begin
    errors = np.reshape(output.errors, (-1, 6))[later]
    return times[later], np.linalg.norm(errors[:, :3], axis=1), np.array(output.squares)[later]


def _silences(times: np.ndarray, begin: float, last: float) -> list[tuple[float, float]]:
    """Begin and end of each [s]; one that lasts to the end of the flight ends at infinity."""
    edges = np.concatenate(([begin], times, [last]))
    found = [(a, b) for a, b in pairwise(edges) if b - a > SILENCE]
    return [(a, np.inf if b == last else b) for a, b in found]


def _recovered(times: np.ndarray, off: np.ndarray, silences: list[tuple[float, float]], ends: float) -> float:
    bad = [end for _, end in silences] + times[off].tolist()
    if not bad:
        return np.nan
    last = max(bad)
    return np.inf if off[-1:].any() else max(last - ends, 0.0)


def _longest(times: np.ndarray, bad: np.ndarray) -> float:
    """Longest [s] that bad ones followed each other without a silence."""
    longest, begin = 0.0, None
    for index, (time, is_bad) in enumerate(zip(times, bad, strict=True)):
        if not is_bad or (begin is not None and time - times[index - 1] > SILENCE):
            begin = None
        if is_bad:
            begin = time if begin is None else begin
            longest = max(longest, time - begin)
    return float(longest)


def pooled(scores: Sequence[Score]) -> Score:
    """The worst of each; shares and counts are means."""
    declared = [s.declared for s in scores if not np.isnan(s.declared)]
    recovered = [s.recovered for s in scores if not np.isnan(s.recovered)]
    return Score(
        worst=max(s.worst for s in scores),
        declared=max(declared, default=np.nan),
        recovered=max(recovered, default=np.nan),
        beyond=float(np.mean([s.beyond for s in scores])),
        off_for=max(s.off_for for s in scores),
        beyond_for=max(s.beyond_for for s in scores),
        sent=round(np.mean([s.sent for s in scores])),
        sent_off=round(np.mean([s.sent_off for s in scores])),
        sent_worst=max(s.sent_worst for s in scores),
    )
