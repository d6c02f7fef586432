"""Twist of the camera with its covariance, by odometry or by the motion of corners.

The acceleration is that of a line through the odometry, or of the last two frames.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
import math

import numpy as np

from thermal_fiducial.core.error_model import UNKNOWN_ACCELERATION
from thermal_fiducial.core.measurements import Odometry
from thermal_fiducial.core.types import FloatArray, SECOND_NS

# Covariance of the acceleration by odometry, which changes between its states, for each second that they span.
_CHANGES = 4.0 * UNKNOWN_ACCELERATION
# Least covariance of a twist [m^2/s^2, rad^2/s^2].
_LEAST = 1e-6 * np.eye(6)
_EYE = np.eye(6)


@dataclass(frozen=True, slots=True)
class Twist:
    """Twist of the camera in its own frame, with its acceleration.

    Parameters
    ----------
    value : (6,) v [m/s], omega [rad/s] at a frame's stamp
    covariance : (6, 6) of the twist that blurs the frame: the one a time constant of the bolometers before the stamp
    acceleration, acceleration_covariance : (6,), (6, 6)
    """

    value: FloatArray
    covariance: FloatArray
    acceleration: FloatArray = field(default_factory=lambda: np.zeros(6))
    acceleration_covariance: FloatArray = field(default_factory=lambda: UNKNOWN_ACCELERATION)

    def ago(self, seconds: float) -> FloatArray:
        """Twist (6,) the given ``seconds`` before the stamp."""
        return self.value - seconds * self.acceleration


#: Prior of the twist without any information [m^2/s^2, rad^2/s^2]: a brisk flight.
UNKNOWN_TWIST = Twist(np.zeros(6), 1.5**2 * np.eye(6))


def twist_by_odometry(
    stamp_ns: int, odometry: Sequence[Odometry], transfer: FloatArray, lag: float, clock_std_s: float
) -> Twist:
    """Twist and acceleration at a stamp by a line through the twists of K states.

    The velocity error is common to all states; the error of a rate, gyroscope noise, is independent in each.

    Parameters
    ----------
    transfer : (6, 6) of :func:`thermal_fiducial.core.geometry.se3.twist_transfer`
    lag : time constant of the bolometers [s]
    clock_std_s : standard deviation of the stamp in the odometry's clock [s]
    """
    parts = [part for state in odometry for part in (state.velocity_body, state.angular_velocity_body)]
    values = np.concatenate(parts).reshape(-1, 6) @ transfer.T
    t = np.array([(state.stamp_ns - stamp_ns) / SECOND_NS for state in odometry])
    middle = float(t.sum()) / len(t)
    from_middle = t - middle
    typical = np.asarray(sum(state.twist_covariance for state in odometry) / len(t))
    noise = _LEAST.copy()
    noise[3:, 3:] += transfer[3:, 3:] @ typical[3:, 3:] @ transfer[3:, 3:].T
    # The slope of the line. Of few or noisy states it is hardly known: its prior is UNKNOWN_ACCELERATION.
    squares = float(from_middle @ from_middle) + noise.diagonal() / UNKNOWN_ACCELERATION.diagonal()
    acceleration = from_middle @ values / squares
    acceleration_covariance = noise / squares + float(t[-1] - t[0]) * _CHANGES
    # In all coordinates, as the rate's noise is in the velocity of a camera with a lever arm, too.
    of_mean = transfer * ([1.0] * 3 + [1.0 / math.sqrt(len(t))] * 3)
    covariance = of_mean @ typical @ of_mean.T + (middle + lag) ** 2 * acceleration_covariance + _LEAST
    covariance += clock_std_s**2 * UNKNOWN_ACCELERATION
    return Twist(values.sum(axis=0) / len(t) - middle * acceleration, covariance, acceleration, acceleration_covariance)


def updated(twist: Twist, information: FloatArray, weighted: FloatArray, ago: float, apart: float) -> Twist:
    """Twist after a measurement of its value ``ago`` seconds before the stamp, in information form.

    The Kalman update ``P - P inv(I + W (P + Q)) W P`` for an information W that need not be invertible, with the
    uncertainty Q of what the acceleration has changed meanwhile.

    Parameters
    ----------
    information, weighted : (6, 6), (6,) information times value
    apart : time between the measurement and the twist that blurs the frame [s]
    """
    P = twist.covariance
    S = _EYE + information @ (P + apart**2 * twist.acceleration_covariance)
    residual = weighted - information @ twist.ago(ago)
    change = P @ np.linalg.solve(S, np.concatenate([information @ P, residual[:, None]], axis=1))
    P = P - change[:, :6]
    # Symmetric: rounding errors would add up over the frames.
    return replace(twist, value=twist.value + change[:, 6], covariance=0.5 * (P + P.T))
