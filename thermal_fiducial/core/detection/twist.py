"""Twist and acceleration of the camera with their covariance, and the motion model of both.

The image motion is that of a rigid scene for a camera with twist (v, omega) (F. Chaumette, S. Hutchinson, "Visual
servo control I", 2006, eq. 11). The acceleration is a first-order Markov process (R. Singer, "Estimating optimal
tracking filter performance for manned maneuvering targets", 1970).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
import math

import numpy as np

from thermal_fiducial.core.measurements import Odometry
from thermal_fiducial.core.types import FloatArray, SECOND_NS

# Variances of an unknown twist [m^2/s^2, rad^2/s^2]: a brisk flight.
_UNKNOWN = np.full(6, 1.5**2)
#: Stationary covariance of the acceleration; standard deviations in m/s^2, rad/s^2.
RANDOM = np.diag([3.0, 3.0, 3.0, 4.0, 4.0, 4.0]) ** 2
# Correlation time of the acceleration [s].
_CORRELATED_S = 0.4
# Covariance of the acceleration by odometry due to errors of the filter's vertical and biases.
_UNSURE = 0.3**2 * np.diag([1, 1, 1, 0, 0, 0])
# Least covariance of a twist [m^2/s^2, rad^2/s^2].
_LEAST = 1e-6 * np.eye(6)
_EYE = np.eye(6)


@dataclass(frozen=True, slots=True)
class Twist:
    """Twist of the camera in its own frame, with its acceleration.

    Parameters
    ----------
    value : (6,) v [m/s], omega [rad/s] at a frame's stamp
    covariance : (6, 6) of the value, or (12, 12) of value and acceleration
    acceleration : (6,) of the value
    """

    value: FloatArray
    covariance: FloatArray
    acceleration: FloatArray = field(default_factory=lambda: np.zeros(6))

    def ago(self, seconds: float) -> FloatArray:
        """Twist (6,) the given ``seconds`` before the stamp."""
        return self.value - seconds * self.acceleration

    def covariance_ago(self, seconds: float) -> FloatArray:
        """Covariance (6, 6) of :meth:`ago`."""
        P = self.covariance
        return P[:6, :6] - seconds * (P[:6, 6:] + P[6:, :6]) + seconds**2 * P[6:, 6:]


def interaction(x: FloatArray, depth: FloatArray) -> FloatArray:
    """Derivative (..., 2, 6) of the velocity of normalised points (..., 2) at ``depth`` (...) [m] by the twist."""
    a, b, inverse = x[..., 0], x[..., 1], 1.0 / depth
    J = np.zeros((*x.shape, 6))
    J[..., 0, 0] = J[..., 1, 1] = -inverse
    J[..., 2] = x * inverse[..., None]
    J[..., 0, 3], J[..., 1, 3] = a * b, 1.0 + b * b
    J[..., 0, 4], J[..., 1, 4] = -1.0 - a * a, -J[..., 0, 3]
    J[..., 0, 5], J[..., 1, 5] = b, -a
    return J


def transferred(odometry: Odometry, transfer: FloatArray) -> Twist:
    """Twist of the camera from that of the body, by :func:`twist_transfer`."""
    body = np.concatenate([odometry.velocity_body, odometry.angular_velocity_body])
    return Twist(transfer @ body, transfer @ odometry.twist_covariance @ transfer.T)


def unknown_twist() -> Twist:
    """Prior of the twist without any information."""
    return Twist(np.zeros(6), np.diag(np.concatenate([_UNKNOWN, RANDOM.diagonal()])))


def predicted_twist(twist: Twist, seconds: float) -> Twist:
    """Twist predicted by the motion model ``seconds`` later, or earlier if negative."""
    left, sign = math.exp(-abs(seconds) / _CORRELATED_S), math.copysign(1.0, seconds)
    lasting = sign * _CORRELATED_S * (1.0 - left)
    F = np.eye(12)
    F[:6, 6:], F[6:, 6:] = lasting * _EYE, left * _EYE
    own, both, change = process_noise(abs(seconds))
    covariance = F @ twist.covariance @ F.T
    covariance[:6, :6] += own * RANDOM
    covariance[:6, 6:] += sign * both * RANDOM
    covariance[6:, :6] += sign * both * RANDOM
    covariance[6:, 6:] += change * RANDOM
    return Twist(twist.value + lasting * twist.acceleration, covariance, left * twist.acceleration)


def process_noise(seconds: float) -> tuple[float, float, float]:
    """Process noise over a time in units of :data:`RANDOM`: of the twist, cross-covariance, of the acceleration.

    Singer, eq. 7.
    """
    t, left = seconds / _CORRELATED_S, math.exp(-seconds / _CORRELATED_S)
    own, both = _CORRELATED_S**2 * (2.0 * t - 3.0 + 4.0 * left - left**2), _CORRELATED_S * (1.0 - left) ** 2
    return own, both, 1.0 - left**2


def line_through(stamp_ns: int, odometry: Sequence[Odometry], transfer: FloatArray, clock_std_s: float) -> Twist:
    """Twist and acceleration at a stamp by a line through the twists of K states.

    The velocity error is common to all states; the error of a rate, gyroscope noise, is independent in each.
    ``clock_std_s``: standard deviation of the stamp in the odometry's clock [s].
    """
    parts = [part for state in odometry for part in (state.velocity_body, state.angular_velocity_body)]
    values = np.concatenate(parts).reshape(-1, 6) @ transfer.T
    t = np.array([(state.stamp_ns - stamp_ns) / SECOND_NS for state in odometry])
    middle = float(t.sum()) / len(t)
    off = t - middle
    square = float(off @ off)
    acceleration = (off / square) @ values
    typical = transfer @ (sum(state.twist_covariance for state in odometry) / len(t)) @ transfer.T
    noise = np.zeros((6, 6))
    noise[3:, 3:] = typical[3:, 3:]
    slope = noise / square + process_noise(float(t[-1] - t[0]))[2] * RANDOM + _UNSURE
    covariance = np.empty((12, 12))
    unsure = clock_std_s**2 * (np.outer(acceleration, acceleration) + slope)
    covariance[:6, :6] = noise / len(t) + middle**2 * slope + unsure + _LEAST
    covariance[:3, :3] += typical[:3, :3]
    covariance[:6, 6:] = covariance[6:, :6] = -middle * slope
    covariance[6:, 6:] = slope
    return Twist(values.sum(axis=0) / len(t) - middle * acceleration, covariance, acceleration)


def corrected(twist: Twist, information: FloatArray, weighted: FloatArray, later: float) -> Twist:
    """Twist after a measurement of its value ``later`` seconds later, in information form.

    ``information`` (6, 6) and ``weighted`` (6,), information times value. The Kalman update with H = [I, later I],
    ``P - P H^T inv(I + W H P H^T) W H P`` for an information W that need not be invertible.
    """
    P = twist.covariance
    HP = P[:6] + later * P[6:]
    S = _EYE + information @ (HP[:, :6] + later * HP[:, 6:])
    residual = weighted - information @ twist.ago(-later)
    solved = np.linalg.solve(S, np.concatenate([information @ HP, residual[:, None]], axis=1))
    change = HP.T @ solved
    mean, P = change[:, 12], P - change[:, :12]
    # Symmetric: rounding errors would add up over the frames.
    return Twist(twist.value + mean[:6], 0.5 * (P + P.T), twist.acceleration + mean[6:])
