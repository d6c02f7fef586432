"""Inertial increments: exact motion over a step of constant rate and specific force, its error and its noise."""

from dataclasses import dataclass
import math

import numpy as np

from thermal_fiducial.core.types import FloatArray

#: Below this angle [rad] the series are exact to double precision.
SMALL_ANGLE = 1e-2


@dataclass(slots=True)
class ImuStep:
    """Rate and specific force held over a step, with their noise densities.

    ``imu`` (6,): rad/s then m/s^2; ``seconds``: length of the step; densities in rad/s/sqrt(Hz) and m/s^2/sqrt(Hz).
    """

    imu: FloatArray
    seconds: float
    gyroscope_density: float
    accelerometer_density: float


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
    if t2 < SMALL_ANGLE**2:
        a = 1.0 - t2 / 6.0 * (1.0 - t2 / 20.0)
        b = 0.5 - t2 / 24.0 * (1.0 - t2 / 30.0)
        c = 1.0 / 6.0 - t2 / 120.0 * (1.0 - t2 / 42.0)
        d = 1.0 / 24.0 - t2 / 720.0 * (1.0 - t2 / 56.0)
    else:
        t = math.sqrt(t2)
        a, b = math.sin(t) / t, 2.0 * math.sin(0.5 * t) ** 2 / t2
        c, d = (1.0 - a) / t2, (0.5 - b) / t2
    return (1.0, a, b), (1.0, b, c), (0.5, c, d)


class Transition:
    """Motion (R, v, p) of a step and the (n, n) matrices F and Q of the error, in one reused workspace.

    With the increment Y = (dR, dv, dp), X+ = G M(X) Y, where M adds v dt to p and G is gravity; thus the error
    maps by Ad(Y^-1) M, exactly (Brossard et al., eq. 36 ff.), and a change of rate or force by the Jacobian of Y.
    """

    def __init__(self, size: int, random_walks: FloatArray) -> None:
        """``size``: n; ``random_walks`` (n,): densities of the random walk of each coordinate."""
        self.F = np.eye(size)
        self.Q = np.zeros((size, size))
        self._walk = random_walks**2
        self._walk_part = np.einsum('ii->i', self.Q)[9:]
        self._white = np.zeros(6)
        self._local = np.zeros((9, 15))
        self._local[:9, :9] = np.eye(9)

    def compute(self, step: ImuStep, bias: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Set F and Q for ``step`` under ``bias`` (6,); return dR (3, 3), dv and dp (3,) in the robot frame."""
        dt = step.seconds
        imu = step.imu - bias
        gamma = rotation_integrals(imu[:3] * dt)
        integrals = gamma[1:] @ imu[3:]
        dv, dp = integrals[0] * dt, integrals[1] * (dt * dt)
        self._fill_local(gamma, imu[3:].tolist(), dv.tolist(), dp.tolist(), dt)
        # All rows turn into the robot frame at the end of the step.
        rows = (gamma[0].T @ self._local.reshape(3, 3, 15)).reshape(9, 15)
        self.F[:9, :15] = rows
        self._fill_noise(rows[:, 9:], step)
        return gamma[0], dv, dp

    def _fill_local(self, gamma: FloatArray, a: list[float], dv: list[float], dp: list[float], dt: float) -> None:
        """Jacobian of the increment's error in the robot frame at the start of the step."""
        local = self._local
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

    def _fill_noise(self, jacobian: FloatArray, step: ImuStep) -> None:
        """White noise of a sample acts like a bias over the step; its variance is density^2 / dt."""
        dt = step.seconds
        self._white[:3], self._white[3:] = step.gyroscope_density**2 / dt, step.accelerometer_density**2 / dt
        self.Q[:9, :9] = (jacobian * self._white) @ jacobian.T
        self._walk_part[:] = self._walk[9:] * dt


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
