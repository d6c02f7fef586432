"""From an estimate along the IMU samples: the state at each, and the transition of its error, accumulated.

A step costs a product of (9, 9) with (9, 35); the whole covariance is touched once for a pose, not once for a sample.
"""

from dataclasses import dataclass, replace

import numpy as np

from thermal_fiducial.core.filter.increments import increment
from thermal_fiducial.core.filter.state import (
    CORE,
    Estimate,
    GRAVITY,
    GYROSCOPE_BIAS,
    MOVED_BY,
    NavigationState,
    POSITION,
    VELOCITY,
)
from thermal_fiducial.core.types import FloatArray

_SECOND_NS = 1_000_000_000
_AT_REST = np.zeros((9, 35))
_AT_REST[:9, :9] = np.eye(9)
_NO_NOISE = np.zeros((9, 9))


@dataclass(frozen=True, slots=True)
class Prediction:
    """The state at ``stamp_ns`` as inertial steps carry it on from ``origin``.

    ``transition`` (9, 35) of the core's error since then with respect to all that moves it, ``noise`` (9, 9) that has
    come to it.
    """

    origin: Estimate
    stamp_ns: int
    state: NavigationState
    transition: FloatArray
    noise: FloatArray

    @classmethod
    def begin(cls, origin: Estimate) -> 'Prediction':
        """No step yet."""
        return cls(origin, origin.stamp_ns, origin.state, _AT_REST, _NO_NOISE)

    def after(self, imu: FloatArray, stamp_ns: int, densities: FloatArray) -> 'Prediction':
        """The prediction after a step to ``stamp_ns``.

        Parameters
        ----------
        imu : (6,) mean of the samples at its ends
        densities : (6,) of the white noise of the sensors over the step [rad/s/sqrt(Hz), m/s^2/sqrt(Hz)]
        """
        seconds = (stamp_ns - self.stamp_ns) / _SECOND_NS
        if seconds <= 0.0:
            return self
        before = self.state
        step = increment(before.corrected(imu), seconds)
        R, fall = before.R_map_body, before.gravity * seconds
        R_next = R @ step.rotation
        state = NavigationState(
            R_next,
            before.velocity + fall + R @ step.velocity,
            before.position + (before.velocity + 0.5 * fall) * seconds + R @ step.position,
            before.bias,
            before.scale,
            before.gravity,
            before.time_offset,
            before.T_body_camera,
            before.systematic,
        )
        transition = step.transition @ self.transition
        _add_parameters(transition, step.sample_jacobian, imu, R_next, seconds)
        white = (step.sample_jacobian * (densities * densities / seconds)) @ step.sample_jacobian.T
        noise = step.transition @ self.noise @ step.transition.T + white
        return Prediction(self.origin, stamp_ns, state, transition, noise)

    def in_moved_map(self, origin: Estimate, T_new_old: FloatArray) -> 'Prediction':
        """The prediction from the ``origin`` moved along with the map: gravity's coordinates turn."""
        transition = self.transition.copy()
        transition[:, GRAVITY] = self.transition[:, GRAVITY] @ T_new_old[:2, :2].T
        return replace(self, origin=origin, state=self.state.in_moved_map(T_new_old), transition=transition)

    @property
    def seconds(self) -> float:
        """Since the origin [s]."""
        return (self.stamp_ns - self.origin.stamp_ns) / _SECOND_NS

    def core_covariance(self) -> tuple[FloatArray, FloatArray]:
        """Covariance (9, 9) of the core, and (9, 3) of it with the gyroscope's bias."""
        cross = self.transition @ self.origin.covariance[MOVED_BY, MOVED_BY]
        return cross @ self.transition.T + self.noise, cross[:, GYROSCOPE_BIAS]

    def estimate(self, random_walks: FloatArray) -> Estimate:
        """State and whole covariance, for squared densities (48,) of the parameters' random walks."""
        before = self.origin.covariance
        P = before.copy()
        cross = self.transition @ before[MOVED_BY]
        P[CORE, :] = cross
        P[:, CORE] = cross.T
        P[CORE, CORE] = cross[:, MOVED_BY] @ self.transition.T + self.noise
        P.flat[:: len(P) + 1] += random_walks * self.seconds
        return replace(self.origin, stamp_ns=self.stamp_ns, state=self.state, covariance=P)


def _add_parameters(
    transition: FloatArray, jacobian: FloatArray, imu: FloatArray, R_map_body: FloatArray, seconds: float
) -> None:
    """Add what biases, scale errors and the tilt of gravity do over a step to ``transition`` (9, 35)."""
    transition[:, 9:15] += jacobian
    # The error that a share of the reading makes is that of a bias as large.
    transition[:, 15:24] += (jacobian[:, :3, None] * imu[:3]).reshape(9, 9)
    transition[:, 24:33] += (jacobian[:, 3:, None] * imu[3:]).reshape(9, 9)
    horizontal = R_map_body[:2].T * seconds
    transition[VELOCITY, 33:35] += horizontal
    transition[POSITION, 33:35] += horizontal * (0.5 * seconds)
