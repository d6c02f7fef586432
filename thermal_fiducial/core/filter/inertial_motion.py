"""Preintegration: the motion over many IMU samples, its error and its noise, whatever the state was before them.

A step of constant rate and specific force is exact, and steps are joined pairwise, all pairs at a time, so that the
samples between two poses cost little more than one.

Sources: C. Forster, L. Carlone, F. Dellaert, D. Scaramuzza, "On-Manifold Preintegration for Real-Time Visual-Inertial
Odometry", IEEE T-RO 2017; M. Brossard, A. Barrau, P. Chauchat, S. Bonnabel, "Associating Uncertainty to Extended Poses
for on Lie Group IMU Preintegration", IEEE T-RO 2022 (the error's coordinates).
"""

from dataclasses import dataclass

import numpy as np

from thermal_fiducial.core.filter.imu_buffer import Steps
from thermal_fiducial.core.filter.rotation_integrals import rotation_integrals
from thermal_fiducial.core.geometry.se3 import SKEW
from thermal_fiducial.core.types import FloatArray

#: Columns of ``error``: the error before, biases and matrices of the sensors, noise.
BEFORE, NOISE = slice(0, 9), slice(33, 42)
#: (9, 27): three vectors in a row times this are their cross-product matrices side by side, (3, 9) row by row.
_THREE_SKEWS = np.einsum('ij,krc->ikrjc', np.eye(3), SKEW.reshape(3, 3, 3)).reshape(9, 27)


@dataclass(frozen=True, slots=True)
class Preintegrated:
    """Motion over some time. ``...`` are none or one dimension of many of them.

    Parameters
    ----------
    motion : (..., 3, 5) rotation, velocity and position in the robot frame at the start, gravity left out
    seconds : (...) [s]
    error : (..., 9, 42) what the error of rotation, velocity and position in the robot frame at the end is of the error
        before (9), of an error of the sensors' biases (6) and matrices (18), and the covariance (9) of its noise
    """

    motion: FloatArray
    seconds: FloatArray
    error: FloatArray

    def part(self, index: slice | int) -> 'Preintegrated':
        """Some of many, or one of them."""
        return Preintegrated(self.motion[index], self.seconds[index], self.error[index])

    def then(self, later: 'Preintegrated') -> 'Preintegrated':
        """Both motions as one: this, then a ``later`` one."""
        motion = self.motion[..., :3] @ later.motion
        motion[..., 3] += self.motion[..., 3]
        motion[..., 4] += self.motion[..., 4] + self.motion[..., 3] * later.seconds[..., None]
        transition = later.error[..., BEFORE]
        error = transition @ self.error
        error[..., NOISE] = error[..., NOISE] @ transition.swapaxes(-1, -2)
        error[..., 9:] += later.error[..., 9:]
        return Preintegrated(motion, self.seconds + later.seconds, error)


#: No motion yet.
AT_REST = Preintegrated(np.eye(3, 5), np.zeros(()), np.eye(9, 42))


def preintegrated(steps: Steps, bias: FloatArray, scale: FloatArray) -> Preintegrated:
    """Motion over ``steps`` in a row of an IMU with a ``bias`` (6,) and errors of ``scale`` (2, 3, 3)."""
    without_errors = steps.imu - bias - (scale @ steps.imu.reshape(-1, 2, 3, 1)).reshape(-1, 6)
    motions = _to_a_power_of_two(_each(steps, without_errors))
    while len(motions.seconds) > 1:
        motions = motions.part(slice(0, None, 2)).then(motions.part(slice(1, None, 2)))
    return motions.part(0)


def _to_a_power_of_two(motions: Preintegrated) -> Preintegrated:
    """Motions in a row, followed by rest."""
    count = len(motions.seconds)
    missing = (1 << (count - 1).bit_length()) - count
    if not missing:
        return motions

    def lengthened(part: FloatArray, rest: FloatArray) -> FloatArray:
        return np.concatenate((part, np.broadcast_to(rest, (missing, *rest.shape))))

    return Preintegrated(
        lengthened(motions.motion, AT_REST.motion),
        lengthened(motions.seconds, AT_REST.seconds),
        lengthened(motions.error, AT_REST.error),
    )


def _each(steps: Steps, imu: FloatArray) -> Preintegrated:
    """Motions over steps in which the sensors without errors would have read ``imu`` (N, 6).

    With Y = (dR, dv, dp), X+ = G M(X) Y, where M adds v dt to p and G is gravity; thus the error maps by Ad(Y^-1) M,
    exactly (Brossard et al., eq. 36 ff.), and a change of rate or force by the Jacobian of Y.
    """
    dt = steps.seconds[:, None]
    gamma = rotation_integrals(imu[:, :3] * dt)
    integrals = (gamma[:, 1:] @ imu[:, None, 3:, None])[..., 0]
    dv, dp = integrals[:, 0] * dt, integrals[:, 1] * (dt * dt)
    motion = np.empty((len(imu), 3, 5))
    motion[..., :3], motion[..., 3], motion[..., 4] = gamma[:, 0], dv, dp
    return Preintegrated(motion, steps.seconds, _error(steps, gamma, np.concatenate((dv, dp, imu[:, 3:]), axis=1)))


def _error(steps: Steps, gamma: FloatArray, vectors: FloatArray) -> FloatArray:
    """(N, 9, 42) as in :class:`Preintegrated`, for changes of velocity and position and forces, vectors (N, 9).

    All in the robot frame at the end of the steps. By the rate, to first order in the angle of the step: Gamma_1 a ~
    a + 1/2 w x a dt, Gamma_2 a ~ a/2 + 1/6 w x a dt.
    """
    dt = steps.seconds[:, None, None]
    R_end_start = gamma[:, 0].swapaxes(-1, -2)
    turned = np.empty((len(dt), 3, 12))
    turned[..., :9] = (vectors @ _THREE_SKEWS).reshape(-1, 3, 9)
    turned[..., 9:] = gamma[:, 2]
    turned = R_end_start @ turned
    error = np.zeros((len(dt), 9, 42))
    error[:, 0:3, 0:3] = error[:, 3:6, 3:6] = error[:, 6:9, 6:9] = R_end_start
    error[:, 6:9, 3:6] = R_end_start * dt
    error[:, 3:6, 0:3] = -turned[..., :3]
    error[:, 6:9, 0:3] = -turned[..., 3:6]
    by_bias = error[..., 9:15]
    by_bias[:, 0:3, :3] = by_bias[:, 3:6, 3:] = gamma[:, 1].swapaxes(-1, -2) * -dt
    by_bias[:, 3:6, :3] = turned[..., 6:9] * (0.5 * dt * dt)
    by_bias[:, 6:9, :3] = turned[..., 6:9] * (dt * dt * dt / 6.0)
    by_bias[:, 6:9, 3:] = turned[..., 9:] * (-dt * dt)
    # The error that a share of the reading makes is that of a bias as large.
    shares = by_bias.reshape(-1, 9, 2, 3, 1) * steps.imu.reshape(-1, 1, 2, 1, 3)
    error[..., 15:33] = shares.reshape(-1, 9, 18)
    variances = steps.densities * steps.densities / steps.seconds[:, None]
    error[..., NOISE] = (by_bias * variances[:, None]) @ by_bias.swapaxes(-1, -2)
    return error
