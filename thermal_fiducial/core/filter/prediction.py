"""From an estimate along the IMU samples: the state at each instant, and the covariance of its error.

The whole covariance is touched once for a pose, not once for a sample.
"""

from dataclasses import replace

import numpy as np

from thermal_fiducial.core.filter.imu_buffer import Steps
from thermal_fiducial.core.filter.inertial_motion import AT_REST, NOISE, Preintegrated, preintegrated
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


class Prediction:
    """The state at ``stamp_ns``, to which the motion that the IMU felt since ``origin`` has carried it.

    Attributes
    ----------
    origin : estimate that it starts from
    stamp_ns : its instant
    state : estimate there
    transition : (9, 35) of the core's error since the origin with respect to all that moves it
    noise : (9, 9) covariance of what has come to the core's error since the origin
    """

    def __init__(self, origin: Estimate, stamp_ns: int, motion: Preintegrated) -> None:
        self.origin = origin
        self.stamp_ns = stamp_ns
        self._motion = motion
        self.state = _moved(origin.state, motion)
        self.transition = np.empty((9, 35))
        self.transition[:, :33] = motion.error[:, :33]
        self.transition[:, GRAVITY] = 0.0
        fallen = self.state.R_map_body[:2].T * motion.seconds
        self.transition[VELOCITY, GRAVITY] = fallen
        self.transition[POSITION, GRAVITY] = fallen * (0.5 * motion.seconds)
        self.noise = motion.error[:, NOISE]
        self._core: tuple[FloatArray, FloatArray] | None = None

    @classmethod
    def begin(cls, origin: Estimate) -> 'Prediction':
        """No step yet."""
        return cls(origin, origin.stamp_ns, AT_REST)

    def after(self, steps: Steps, stamp_ns: int) -> 'Prediction':
        """The prediction after ``steps`` that end at ``stamp_ns``."""
        motion = preintegrated(steps, self.origin.state.bias, self.origin.state.scale)
        return Prediction(self.origin, stamp_ns, motion if self._motion is AT_REST else self._motion.then(motion))

    def with_origin(self, origin: Estimate) -> 'Prediction':
        """The same motion from another estimate of the same sensors."""
        return Prediction(origin, self.stamp_ns, self._motion)

    @property
    def core_covariance(self) -> tuple[FloatArray, FloatArray]:
        """Covariance (9, 9) of the core, and (9, 3) of it with the gyroscope's bias."""
        if self._core is None:
            cross = self.transition @ self.origin.covariance[MOVED_BY, MOVED_BY]
            self._core = cross @ self.transition.T + self.noise, cross[:, GYROSCOPE_BIAS]
        return self._core

    def estimate(self, random_walks: FloatArray) -> Estimate:
        """State and whole covariance, for squared densities (48,) of the parameters' random walks."""
        before = self.origin.covariance
        P = before.copy()
        cross = self.transition @ before[MOVED_BY]
        P[CORE, :] = cross
        P[:, CORE] = cross.T
        P[CORE, CORE] = cross[:, MOVED_BY] @ self.transition.T + self.noise
        P.flat[:: len(P) + 1] += random_walks * self._motion.seconds
        return replace(self.origin, stamp_ns=self.stamp_ns, state=self.state, covariance=P)


def _moved(before: NavigationState, motion: Preintegrated) -> NavigationState:
    """The state after a motion."""
    turned, seconds = before.R_map_body @ motion.motion, motion.seconds
    fall = before.gravity * seconds
    return NavigationState(
        turned[:, :3],
        before.velocity + fall + turned[:, 3],
        before.position + (before.velocity + 0.5 * fall) * seconds + turned[:, 4],
        before.bias,
        before.scale,
        before.gravity,
        before.time_offset,
        before.T_body_camera,
        before.systematic,
    )
