"""Inertial increments: exact motion over a step of constant rate and specific force, its error and its noise."""

import math
from typing import NamedTuple

import numpy as np

from thermal_fiducial.core.types import FloatArray

#: Below this angle [rad] the series are exact to double precision.
_SMALL_ANGLE = 1e-2


class Increment(NamedTuple):
    """Motion over a step, and how its error follows from the errors before and from those of the sample.

    ``rotation`` (3, 3), ``velocity`` and ``position`` (3,) in the robot frame at the start, gravity left out;
    ``transition`` (9, 9) of rotation, velocity and position errors; ``sample_jacobian`` (9, 6) with respect to a bias
    of the sample.
    """

    rotation: FloatArray
    velocity: FloatArray
    position: FloatArray
    transition: FloatArray
    sample_jacobian: FloatArray


def rotation_integrals(angle: FloatArray) -> FloatArray:
    """Rotation of a step and its first and second integral.

    ``Gamma_m(phi) = sum_n skew(phi)^n / (n + m)!`` for m = 0, 1, 2 (Bloesch et al., "State Estimation for Legged
    Robots", 2013): Gamma_0 is the rotation, Gamma_1 the left Jacobian.

    Parameters
    ----------
    angle : (3,) rotation vector [rad]

    Returns
    -------
    (3, 3, 3) Gamma_0, Gamma_1, Gamma_2
    """
    x, y, z = angle.tolist()
    xx, yy, zz = x * x, y * y, z * z
    t2 = xx + yy + zz
    xy, xz, yz = x * y, x * z, y * z
    basis = np.array(
        (
            (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0),
            (0.0, -z, y, z, 0.0, -x, -y, x, 0.0),
            (xx - t2, xy, xz, xy, yy - t2, yz, xz, yz, zz - t2),
        )
    )
    return np.asarray(np.array(_integral_coefficients(t2)) @ basis).reshape(3, 3, 3)


def _integral_coefficients(t2: float) -> tuple[tuple[float, float, float], ...]:
    """Coefficients of 1, skew and skew^2 in Gamma_0, Gamma_1, Gamma_2 for the squared angle ``t2``."""
    if t2 < _SMALL_ANGLE**2:
        a = 1.0 - t2 / 6.0 * (1.0 - t2 / 20.0)
        b = 0.5 - t2 / 24.0 * (1.0 - t2 / 30.0)
        c = 1.0 / 6.0 - t2 / 120.0 * (1.0 - t2 / 42.0)
        d = 1.0 / 24.0 - t2 / 720.0 * (1.0 - t2 / 56.0)
    else:
        t = math.sqrt(t2)
        a, b = math.sin(t) / t, 2.0 * math.sin(0.5 * t) ** 2 / t2
        c, d = (1.0 - a) / t2, (0.5 - b) / t2
    return (1.0, a, b), (1.0, b, c), (0.5, c, d)


def increment(imu: FloatArray, seconds: float) -> Increment:
    """Motion over a step with a rate and a specific force (6,) that hold over it [rad/s, m/s^2].

    With Y = (dR, dv, dp), X+ = G M(X) Y, where M adds v dt to p and G is gravity; thus the error maps by Ad(Y^-1) M,
    exactly (Brossard et al., eq. 36 ff.), and a change of rate or force by the Jacobian of Y.
    """
    gamma = rotation_integrals(imu[:3] * seconds)
    integrals = gamma[1:] @ imu[3:]
    velocity, position = integrals[0] * seconds, integrals[1] * (seconds * seconds)
    local = _local_jacobian(gamma, imu[3:].tolist(), velocity.tolist(), position.tolist(), seconds)
    # All rows turn into the robot frame at the end of the step.
    rows = (gamma[0].T @ local.reshape(3, 3, 15)).reshape(9, 15)
    return Increment(gamma[0], velocity, position, rows[:, :9], rows[:, 9:])


def _local_jacobian(gamma: FloatArray, a: list[float], dv: list[float], dp: list[float], dt: float) -> FloatArray:
    """Jacobian (9, 15) of the increment's error in the robot frame at the start of the step."""
    local = np.zeros((9, 15))
    local[:9, :9].flat[::10] = 1.0
    skews = _skews(a, dv, dp)
    first = gamma[1] * -dt
    local[3:9, 0:3] = skews[3:]
    local[6, 3] = local[7, 4] = local[8, 5] = dt
    local[0:3, 9:12] = first
    local[3:6, 12:15] = first
    local[6:9, 12:15] = gamma[2] * (-dt * dt)
    # To first order in the angle of the step: Gamma_1 a ~ a + 1/2 w x a dt, Gamma_2 a ~ a/2 + 1/6 w x a dt.
    local[3:6, 9:12] = skews[:3] * (0.5 * dt * dt)
    local[6:9, 9:12] = skews[:3] * (dt * dt * dt / 6.0)
    return local


def _skews(a: list[float], dv: list[float], dp: list[float]) -> FloatArray:
    """(9, 3): skew(a), -skew(dv), -skew(dp)."""
    (ax, ay, az), (vx, vy, vz), (px, py, pz) = a, dv, dp
    return np.array(
        (
            (0.0, -az, ay),
            (az, 0.0, -ax),
            (-ay, ax, 0.0),
            (0.0, vz, -vy),
            (-vz, 0.0, vx),
            (vy, -vx, 0.0),
            (0.0, pz, -py),
            (-pz, 0.0, px),
            (py, -px, 0.0),
        )
    )
