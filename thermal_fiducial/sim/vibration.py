"""Vibration by propellers out of balance: of the whole body, and noise of the IMU alone."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from thermal_fiducial.core.types import FloatArray
from thermal_fiducial.sim.spline_trajectory import Motion, MotionPath


@dataclass(frozen=True)
class Vibration:
    """Oscillations of the body about its path, with a phase for each of three axes.

    Parameters
    ----------
    frequencies : of the propellers and of their harmonics [Hz]
    acceleration : amplitude of each [m/s^2]
    rate : amplitude of each [rad/s]
    """

    frequencies: tuple[float, ...] = (83.0, 91.0, 133.0, 166.0, 179.0)
    acceleration: float = 0.4
    rate: float = 0.015

    @cached_property
    def omega(self) -> FloatArray:
        """Angular frequencies (F, 1) [rad/s]."""
        return 2 * np.pi * np.array(self.frequencies)[:, None]


@dataclass(frozen=True)
class Shaken:
    """A path with vibration: p + d in ``map``, and R Exp(theta)."""

    path: MotionPath
    vibration: Vibration
    seed: int

    def __call__(self, t: npt.ArrayLike) -> Motion:
        """The motion at times ``t`` (N,) [s]."""
        t = np.atleast_1d(np.asarray(t, dtype=np.float64))
        smooth, omega = self.path(t), self.vibration.omega
        phases = np.random.default_rng([self.seed, 7]).uniform(0.0, 2 * np.pi, (2, len(omega), 3))
        moved, turned = omega * t[:, None, None] + phases[:, None]
        acceleration, rate = self.vibration.acceleration, self.vibration.rate
        theta, theta_dot = np.sum(-rate / omega * np.cos(turned), axis=1), np.sum(rate * np.sin(turned), axis=1)
        turn = Rotation.from_rotvec(theta)
        return Motion(
            smooth.position - np.sum(acceleration / omega**2 * np.sin(moved), axis=1),
            smooth.rotation * turn,
            smooth.velocity - np.sum(acceleration / omega * np.cos(moved), axis=1),
            smooth.acceleration + np.sum(acceleration * np.sin(moved), axis=1),
            turn.inv().apply(smooth.angular_velocity_body) + _body_rate(theta, theta_dot),
        )


def _body_rate(theta: FloatArray, theta_dot: FloatArray) -> FloatArray:
    """Rate of Exp(theta): the right Jacobian of SO(3) times theta_dot, to third order of angles below a milliradian."""
    once = np.cross(theta, theta_dot)
    return np.asarray(theta_dot - once / 2 + np.cross(theta, once) / 6)
