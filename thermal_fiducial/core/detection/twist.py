"""Velocity of the camera, how it changes, and what is known of both.

The motion is that of a rigid scene seen from a camera with twist (v, omega) (F. Chaumette, S. Hutchinson, "Visual
servo control I", 2006, eq. 11). The twist changes by an acceleration that dies down and is driven at random (R. Singer,
"Estimating optimal tracking filter performance for manned maneuvering targets", 1970).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
import math

import numpy as np

from thermal_fiducial.core.geometry import se3
from thermal_fiducial.core.measurements import Odometry
from thermal_fiducial.core.types import FloatArray, SECOND_NS

# Twist of which nothing is known: m/s and rad/s of a brisk flight.
_UNKNOWN = np.full(6, 1.5**2)
#: Covariance of an acceleration of which nothing is known [m/s^2, rad/s^2].
RANDOM = np.diag([3.0, 3.0, 3.0, 4.0, 4.0, 4.0]) ** 2
# How long an acceleration is correlated [s].
_CORRELATED_S = 0.4
# What the filter's own error of the vertical and of its biases adds to the acceleration by its states.
_UNSURE = np.diag([0.3, 0.3, 0.3, 0.0, 0.0, 0.0]) ** 2
# Covariance of a twist that is said to be without error [m^2/s^2, rad^2/s^2].
_LEAST = 1e-6 * np.eye(6)
_EYE = np.eye(6)


@dataclass(frozen=True, slots=True)
class Twist:
    """Velocity of the camera in its own frame, and how it changes.

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
        """Value (6,) so many seconds before the stamp."""
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
    """Twist of the camera from that of the body, by :func:`transfer_from_body`."""
    body = np.concatenate([odometry.velocity_body, odometry.angular_velocity_body])
    return Twist(transfer @ body, transfer @ odometry.twist_covariance @ transfer.T)


def transfer_from_body(T_body_camera: FloatArray) -> FloatArray:
    """What makes a camera's twist (6,) of the body's."""
    R = T_body_camera[:3, :3].T
    transfer = np.zeros((6, 6))
    transfer[:3, :3] = transfer[3:, 3:] = R
    transfer[:3, 3:] = -R @ se3.skew(T_body_camera[:3, 3])
    return transfer


def unknown_twist() -> Twist:
    """That of a camera of which nothing is known."""
    return Twist(np.zeros(6), np.diag(np.concatenate([_UNKNOWN, RANDOM.diagonal()])))


def carried(twist: Twist, seconds: float) -> Twist:
    """Twist so much later, its acceleration having died down a little and changed at random; or as much earlier."""
    left, sign = math.exp(-abs(seconds) / _CORRELATED_S), math.copysign(1.0, seconds)
    lasting = sign * _CORRELATED_S * (1.0 - left)
    F = np.eye(12)
    F[:6, 6:], F[6:, 6:] = lasting * _EYE, left * _EYE
    own, both, change = growth(abs(seconds))
    covariance = F @ twist.covariance @ F.T
    covariance[:6, :6] += own * RANDOM
    covariance[:6, 6:] += sign * both * RANDOM
    covariance[6:, :6] += sign * both * RANDOM
    covariance[6:, 6:] += change * RANDOM
    return Twist(twist.value + lasting * twist.acceleration, covariance, left * twist.acceleration)


def growth(seconds: float) -> tuple[float, float, float]:
    """Times :data:`RANDOM`: what a time adds to the covariance of the twist, to that with its acceleration, and of it.

    Singer, eq. 7.
    """
    t, left = seconds / _CORRELATED_S, math.exp(-seconds / _CORRELATED_S)
    own, both = _CORRELATED_S**2 * (2.0 * t - 3.0 + 4.0 * left - left**2), _CORRELATED_S * (1.0 - left) ** 2
    return own, both, 1.0 - left**2


def line_through(stamp_ns: int, odometry: Sequence[Odometry], transfer: FloatArray, clock_std_s: float) -> Twist:
    """Twist that changes evenly through those of K states, at a stamp with a standard deviation ``clock_std_s``.

    The error of the velocity is the same in all, that of a turn rate, a gyroscope's noise, is new in each.
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
    slope = noise / square + growth(float(t[-1] - t[0]))[2] * RANDOM + _UNSURE
    covariance = np.empty((12, 12))
    unsure = clock_std_s**2 * (np.outer(acceleration, acceleration) + slope)
    covariance[:6, :6] = noise / len(t) + middle**2 * slope + unsure + _LEAST
    covariance[:3, :3] += typical[:3, :3]
    covariance[:6, 6:] = covariance[6:, :6] = -middle * slope
    covariance[6:, 6:] = slope
    return Twist(values.sum(axis=0) / len(t) - middle * acceleration, covariance, acceleration)


def corrected(twist: Twist, information: FloatArray, weighted: FloatArray, later: float) -> Twist:
    """Twist when its value so much later is known by ``information`` (6, 6), times the value ``weighted`` (6,).

    The update of a Kalman filter with H = [I, later I], ``P - P H^T inv(I + W H P H^T) W H P`` of an information W that
    need not be invertible.
    """
    P = twist.covariance
    HP = P[:6] + later * P[6:]
    S = _EYE + information @ (HP[:, :6] + later * HP[:, 6:])
    residual = weighted - information @ twist.ago(-later)
    solved = np.linalg.solve(S, np.concatenate([information @ HP, residual[:, None]], axis=1))
    change = HP.T @ solved
    mean, P = change[:, 12], P - change[:, :12]
    # What rounding makes of a covariance would add up over the frames.
    return Twist(twist.value + mean[:6], 0.5 * (P + P.T), twist.acceleration + mean[6:])
