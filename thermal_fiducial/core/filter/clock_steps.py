"""Steps of the camera's clock that no single pose shows: a generalised likelihood ratio over the latest poses.

After a step of ten milliseconds poses are displaced along the motion by hardly more than the gate bears, and a filter
that knows its time offset to a fifth of a millisecond would rather believe that the robot has moved. So for instants
at which the clock may have stepped it is followed how a step would show since then: the error that the estimate would
have by now, and how well that explains the innovations, a chi square of one degree of freedom. Once a step explains
them, the estimate is what it would be if the offset had been unknown from that instant on.

Source: A. Willsky, H. Jones, "A Generalized Likelihood Ratio Approach to the Detection and Estimation of Jumps in
Linear Systems", IEEE TAC 1976.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from thermal_fiducial.core.types import FloatArray

#: Instants that are followed; the latest of them are, and of the others those that explain most.
INSTANTS, LATEST = 16, 8
#: A step is believed that explains so much of the innovations (7 sigma), leaves of each pose no more than its degrees
#: of freedom, and that so many poses show.
EVIDENCE, LEFT, FEWEST_POSES = 49.0, 6.0, 5
#: Smaller ones [s] are learned before they do harm, and lags that change with the contrast look like them.
LEAST_STEP = 0.003
#: A motion changes by so much of itself in a second [1/s]: what half of it times the square of a step is beyond first
#: order.
_SWINGING = 3.0
_SCORE, _INFORMATION, _NIS, _COUNTED, _AGE = range(5)
_TINY = 1e-12


class ClockStep(NamedTuple):
    """A step of the clock: the error (n,) of the estimate, and what that adds to its covariance (n, n)."""

    error: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, slots=True)
class ClockSteps:
    """What innovations say of a step of the clock at M instants.

    ``responses`` (n, M): error of the estimate for a step of one second. ``evidence`` (5, M): score and information of
    the step, whose best estimate is their ratio; sum of the normalised innovations squared and number of the poses that
    count; and of all since then. ``found``: steps so far.
    """

    responses: FloatArray
    evidence: FloatArray
    found: int = 0

    @classmethod
    def none(cls, size: int, found: int = 0) -> 'ClockSteps':
        """Before the first pose."""
        evidence = np.zeros((5, INSTANTS))
        evidence[_AGE] = LATEST
        return cls(np.zeros((size, INSTANTS)), evidence, found)

    def propagated(self, F: FloatArray) -> 'ClockSteps':
        """After a step of the estimate with transition ``F`` (n, n)."""
        return ClockSteps(F @ self.responses, self.evidence, self.found)

    def seen(self, innovation: FloatArray, shown: FloatArray, precision: FloatArray, gate: float) -> 'ClockSteps':
        """After a pose, accepted or not.

        Parameters
        ----------
        innovation : (6,)
        shown : (6, M) innovation by each step of one second
        precision : (6, 6) inverse of the innovation's covariance
        gate : poses that are farther from what a step makes of them don't count, squared and normalised
        """
        weighted = precision @ shown
        score, information = innovation @ weighted, np.einsum('ij,ij->j', shown, weighted)
        nis = float(innovation @ precision @ innovation)
        counted = nis - score * score / (information + _TINY) <= gate
        evidence = self.evidence.copy()
        evidence[_SCORE] += counted * score
        evidence[_INFORMATION] += counted * information
        evidence[_NIS] += counted * nis
        evidence[_COUNTED] += counted
        evidence[_AGE] += 1.0
        # What once was contradicted is not to be forgotten for many good poses since.
        left = evidence[_NIS] - _explained(evidence)
        evidence[_NIS, (evidence[_COUNTED] >= FEWEST_POSES) & (left > LEFT * evidence[_COUNTED])] = np.inf
        return ClockSteps(self.responses, evidence, self.found)

    def corrected(self, gain: FloatArray, shown: FloatArray, place: int) -> 'ClockSteps':
        """After the correction by an accepted pose with ``gain`` (n, 6); a step after it takes the place of the least.

        ``place``: that of the time offset among the error coordinates.
        """
        worth = np.where(np.isinf(self.evidence[_NIS]), -1.0, _explained(self.evidence))
        worth[self.evidence[_AGE] <= LATEST] = np.inf
        least = worth.argmin()
        responses, evidence = self.responses - gain @ shown, self.evidence.copy()
        responses[:, least], evidence[:, least] = 0.0, 0.0
        responses[place, least] = 1.0
        return ClockSteps(responses, evidence, self.found)

    def found_step(self) -> ClockStep | None:
        """The step that explains most, if it is one."""
        explained = np.where(self.evidence[_COUNTED] < FEWEST_POSES, 0.0, _explained(self.evidence))
        explained[np.isinf(self.evidence[_NIS])] = 0.0
        best = int(explained.argmax())
        if explained[best] < EVIDENCE:
            return None
        score, information = self.evidence[:2, best].tolist()
        step, response = score / information, self.responses[:, best]
        if abs(step) < LEAST_STEP:
            return None
        variance = 1.0 / information + (0.5 * _SWINGING * step**2) ** 2
        return ClockStep(step * response, variance * np.outer(response, response))

    def turned(self, turn: FloatArray) -> 'ClockSteps':
        """In other error coordinates, ``turn`` (n, n) times these."""
        return replace(self, responses=turn @ self.responses)


def _explained(evidence: FloatArray) -> FloatArray:
    """Part (M,) of the normalised innovations squared that a step explains."""
    return np.asarray(evidence[_SCORE] ** 2 / (evidence[_INFORMATION] + _TINY))
