"""Noise that no data sheet tells but innovations do: jitter of the camera's stamps, and vibration that aliases."""

from dataclasses import dataclass, field, replace
import math

import numpy as np

from thermal_fiducial.core.types import FloatArray

#: A parameter counts as much as so many poses that show nothing but the jitter of their stamps.
PRIOR_POSES = 10.0
#: Poses over which the jitter may change, and the range of its standard deviation [s].
MEMORY_POSES, LEAST_JITTER, LARGEST_JITTER = 300.0, 1.0e-4, 5.0e-3
#: Innovations beyond these, squared and normalised, are outliers and teach no more than one at the limit: of one
#: dimension, of six.
LARGEST_SQUARE, LARGEST_NIS = 9.0, 12.0
#: Poses back to which innovations are compared, and poses that their correlations are means over.
LAGS, CORRELATED_POSES = 4, 60.0
#: Poses that are further apart [ns] are not compared.
INTERRUPTED_NS = 150_000_000
#: Correlations of innovations that lasting errors of the poses themselves make, if the filter takes these as they come.
LASTING = 0.9
#: By how much a pose moves the share at twice the correlation that is expected, and at most.
SHARE_STEP, LARGEST_STEP = 0.01, 0.02


@dataclass(frozen=True, slots=True)
class StampJitter:
    """What is known of the jitter of the camera's stamps.

    ``variance`` [s^2], and the Fisher ``information`` of the poses about its logarithm.
    """

    variance: float
    information: float = 0.0

    @classmethod
    def of(cls, std: float) -> 'StampJitter':
        """What a parameter says [s]; 0: the stamps are exact, and nothing is learned."""
        return cls(max(std, LEAST_JITTER) ** 2 if std else 0.0)

    def after(self, twist: FloatArray, weighted_twist: FloatArray, innovation: FloatArray) -> 'StampJitter':
        """What is known after an accepted pose: a step of Fisher scoring on the likelihood of its innovation.

        Parameters
        ----------
        twist : (6,) by which a late stamp moves the pose [1/s]
        weighted_twist : (6,) inverse of the innovation's covariance times ``twist``
        innovation : (6,)
        """
        if not self.variance:
            return self
        precision = float(twist @ weighted_twist)
        square = min(float(innovation @ weighted_twist) ** 2, LARGEST_SQUARE * precision)
        share = self.variance * precision
        information = (1.0 - 1.0 / MEMORY_POSES) * self.information + 0.5 * share**2
        step = 0.5 * (self.variance * square - share) / (0.5 * PRIOR_POSES + information)
        variance = self.variance * math.exp(step)
        return StampJitter(min(max(variance, LEAST_JITTER**2), LARGEST_JITTER**2), information)


@dataclass(frozen=True, slots=True)
class Aliasing:
    """How much of an IMU's vibration is noise at the frequencies of the motion.

    Tones beyond half the sampling rate appear at other frequencies, some at those of the motion, which no spectrum
    tells from it. But there they make innovations that follow each other, which those of a filter that knows its noise
    don't (Mehra, "On the Identification of Variances and Adaptive Kalman Filtering", IEEE TAC 1970).
    """

    #: of the vibration's variance that counts as white noise, 0 to 1; all of it until the innovations speak against it
    share: float = 1.0
    #: (4, 6) the latest innovations, and means (4,) of their products with the innovation after so many poses
    recent: FloatArray = field(default_factory=lambda: np.zeros((LAGS, 6)))
    correlations: FloatArray = field(default_factory=lambda: np.zeros(LAGS))
    time_ns: int = 0

    def after(
        self, time_ns: int, innovation: FloatArray, weighted: FloatArray, step: float, scale: float
    ) -> 'Aliasing':
        """What is known after a pose, accepted or not.

        Parameters
        ----------
        time_ns : instant of the pose
        innovation : (6,)
        weighted : (6,) inverse of its covariance times ``innovation``
        step : share of ``SHARE_STEP``, less where there is little vibration to learn from
        scale : by which the standard deviations of poses are enlarged
        """
        limit = math.sqrt(min(1.0, LARGEST_NIS / max(float(innovation @ weighted), LARGEST_NIS)))
        innovation = limit * innovation
        if time_ns - self.time_ns > INTERRUPTED_NS:
            recent = np.vstack((innovation, np.zeros((LAGS - 1, 6))))
            return replace(self, recent=recent, time_ns=time_ns)
        products = self.recent @ weighted * (limit / 6.0)
        correlations = self.correlations + (products - self.correlations) / CORRELATED_POSES
        excess = math.sqrt(float(correlations @ correlations)) * scale**2 / LASTING - 1.0
        share = self.share + step * min(SHARE_STEP * excess, LARGEST_STEP)
        recent = np.vstack((innovation, self.recent[:-1]))
        return Aliasing(min(max(share, 0.0), 1.0), recent, correlations, time_ns)
