"""Batch adjustment of a recording: body states at the camera's frames, and shared unknowns.

Gauss-Newton on a chain of states (consecutive ones are linked by the preintegrated IMU samples between them) and on the
shared unknowns.
"""

from copy import copy
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from thermal_fiducial.calibration.banded_equations import BandedEquations
from thermal_fiducial.calibration.preintegration import AXES, Densities, ImuTrack, preintegrate
from thermal_fiducial.calibration.rig_state import horizontal, imu_errors, OF_ALL, OF_FRAME, State
from thermal_fiducial.calibration.rolling import RowMoments
from thermal_fiducial.config import ImuNoise
from thermal_fiducial.core.geometry import se3
from thermal_fiducial.core.types import FloatArray, IntArray

_MAX_STEPS = 15
# Convergence threshold of the shared unknowns [rad, m, s], below the printed digits.
_CONVERGED = 1e-7
# Number of groups of the jackknife.
_GROUPS = 8
# Mahalanobis distance of a pose (six degrees of freedom, 99 %) beyond which it loses weight.
_INLIER = 4.1
# Prior standard deviations of the biases at the first state [rad/s, m/s^2].
_BIAS_PRIOR = np.array([0.1] * 3 + [1.0] * 3)
# Prior standard deviations of scale errors (diagonal entries) and misalignments [rad], by data sheets of small IMUs.
_AXES_PRIOR = np.where(np.isin(np.arange(AXES), (0, 4, 8, 9, 11, 14)), 0.01, 0.005)
# That of the delay of the accelerometer behind the gyroscope [s]: as in the filter.
_DELAY_PRIOR = ImuNoise.accelerometer_delay_std
# Of a low-pass filter at 5 Hz: beyond it an IMU is not late but wrong.
_LARGEST_DELAY = 0.05
# Standard deviation of the read-out time about zero: while it is estimated, and while it is held there [s].
_READOUT_PRIOR, _READOUT_HELD = 0.05, 1e-12


@dataclass(frozen=True)
class Solution:
    """The least-squares solution.

    Parameters
    ----------
    state : all unknowns
    covariance : (26, 26) of the shared ones, scaled by ``scale`` squared
    residuals : (N, 6) of the camera poses, position and rotation, in the map [m, rad]
    scale : factor on the given covariances that makes them consistent with the residuals
    jitter : standard deviation of the frames' stamps [s], estimated from the residuals
    """

    state: State
    covariance: FloatArray
    residuals: FloatArray
    scale: float
    jitter: float


def root_information(covariance: FloatArray) -> FloatArray:
    """W (6, 6) with W^T W the inverse of ``covariance``."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray((vectors / np.sqrt(np.maximum(values, 1e-14))).T)


class Problem:
    """The measurements.

    Parameters
    ----------
    stamps : (N,) of the frames, by the camera's clock [s]
    measured : (N, 4, 4) T_map_camera
    root : (N, 6, 6) root information of the poses, see :func:`root_information`
    imu, noise : samples and their noise densities
    rows, readout : row moments of the frames, and the read-out time assumed in their poses [s]; without rows it is zero
    jitter : standard deviation of the stamps [s]
    systematic : (N, 6, K) errors of the poses by a standard deviation of each error that all of them share
    """

    def __init__(
        self,
        stamps: FloatArray,
        measured: FloatArray,
        root: FloatArray,
        imu: ImuTrack,
        noise: Densities,
        rows: RowMoments | None = None,
        readout: float = 0.0,
        jitter: float = 0.0,
        systematic: FloatArray | None = None,
    ) -> None:
        self._systematic = np.zeros((len(stamps), 6, 0)) if systematic is None else systematic
        self._stamps, self._measured, self._root, self._imu, self._noise = stamps, measured, root, imu, noise
        # Averaged, since vibration in the twist would be correlated with that in the prediction.
        self._steady = imu.averaged(float(np.median(np.diff(stamps))))
        self._rows, self._about, self._jitter = rows, readout, jitter
        if rows is not None:
            covariance = np.linalg.inv(np.swapaxes(root, 1, 2) @ root)
            # Error of the measured pose per twist and read-out time, and the remaining information of the corners.
            self._drift = -covariance @ rows.cross
            self._beyond = rows.square + rows.cross @ self._drift

    def solved(self, state: State) -> Solution:
        """The least-squares solution, iterated from ``state``."""
        for _ in range(_MAX_STEPS):
            state, change, covariance = self.improved(state)
            if change < _CONVERGED:
                break
        error, _, shared = self.pose_errors(state)
        whitened = (self._whitening(shared[:, :, 6]) @ error[:, :, None])[:, :, 0]
        scale = max(1.0, 1.4826 * float(np.median(np.abs(whitened))))
        jitter = self._scatter(error, shared[:, :, 6])
        return Solution(state, covariance * scale**2, error, scale, jitter)

    def repeated(self, solution: Solution) -> Solution:
        """``solution`` with the covariance from its scatter when an eighth of the frames is left out.

        Errors that are correlated over seconds (a lens error in a part of the image, unmodelled IMU errors) are not in
        a covariance that assumes white noise. Delete-a-group jackknife, B. Efron, "The
        jackknife, the bootstrap and other resampling plans", 1982; never narrower than the covariance of white noise.
        An answer is a step from the whole's solution: further ones change a deviation by less than a hundredth. What
        all frames share shows in no scatter, and is added.
        """
        of_samples = self._of_samples(solution.state)
        edges = np.linspace(0, len(self._stamps), _GROUPS + 1).astype(int).tolist()
        answers = np.array([self._step_without(solution.state, of_samples, *pair) for pair in pairwise(edges)])
        variance = (_GROUPS - 1) * np.var(answers, axis=0)
        # The direction of gravity is a nuisance parameter.
        variance[7:9] = 0.0
        wider = np.sqrt(np.maximum(1.0, variance / np.diag(solution.covariance)))
        shared = self._steps_by_systematic(solution.state, of_samples)
        return replace(solution, covariance=solution.covariance * np.outer(wider, wider) + shared @ shared.T)

    def _steps_by_systematic(self, state: State, of_samples: BandedEquations) -> FloatArray:
        """Steps (26, K) of the shared unknowns by a standard deviation of each error that all poses share."""
        normal = of_samples.copy()
        self._add_poses(state, normal)
        error, own, shared = self.pose_errors(state)
        root, _ = self._weighted_root(error, shared[:, :, 6])
        own, shared, off = root @ own, root @ shared, root @ self._systematic
        return normal.steps_of_shared(np.swapaxes(own, 1, 2) @ off, np.einsum('nes,nek->sk', shared, off))

    def _step_without(self, state: State, of_samples: BandedEquations, first: int, last: int) -> FloatArray:
        """Step (26,) of the shared unknowns without the frames from ``first`` to ``last``."""
        problem = copy(self)
        problem._root = self._root.copy()
        problem._root[first:last] = 0.0
        if self._rows is not None:
            problem._beyond = self._beyond.copy()
            problem._beyond[first:last] = 0.0
            residual = self._rows.residual.copy()
            residual[first:last] = 0.0
            problem._rows = replace(self._rows, residual=residual)
        normal = of_samples.copy()
        problem._add_poses(state, normal)
        return normal.solved()[1]

    def camera_poses(self, state: State, frames: IntArray, delays: FloatArray) -> FloatArray:
        """T_map_camera (K, 4, 4) by ``delays`` (K,) [s] after ``frames`` (K,)."""
        chosen = replace(state, R=state.R[frames], p=state.p[frames], v=state.v[frames], bias=state.bias[frames])
        moved = self._shifted(chosen, delays[:, None], self._stamps[frames])
        T_map_body = se3.transform(moved.R, moved.p)
        return np.asarray(T_map_body @ se3.transform(state.R_body_camera, state.p_body_camera))

    def improved(self, state: State) -> tuple[State, float, FloatArray]:
        """The next state, the largest change of a shared unknown, and the covariance (26, 26) of these."""
        normal = self._of_samples(state)
        self._add_poses(state, normal)
        own, shared, covariance = normal.solved()
        return self.moved(state, own, shared), float(np.abs(shared).max()), covariance

    def _of_samples(self, state: State) -> BandedEquations:
        """Normal equations of IMU samples and priors."""
        normal = BandedEquations.empty(len(self._stamps), OF_FRAME, OF_ALL)
        self._add_imu(state, normal)
        normal.H[0, 0, 9:, 9:] += np.diag(1.0 / _BIAS_PRIOR**2)
        normal.g[0, 9:] += state.bias[0] / _BIAS_PRIOR**2
        prior = _READOUT_HELD if self._rows is None else _READOUT_PRIOR
        normal.C[9, 9] += 1.0 / prior**2
        normal.c[9] += state.readout / prior**2
        normal.C[10, 10] += 1.0 / _DELAY_PRIOR**2
        normal.c[10] += state.force_delay / _DELAY_PRIOR**2
        normal.C[range(11, OF_ALL), range(11, OF_ALL)] += 1.0 / _AXES_PRIOR**2
        normal.c[11:] += state.axes / _AXES_PRIOR**2
        return normal

    def pose_errors(self, state: State) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Predicted minus measured (N, 6), and its derivatives by state (N, 6, 15) and shared unknowns (N, 6, 26)."""
        count = len(state.p)
        rate, _ = self._steady.corrected(state.axes, state.force_delay).at(self._stamps + state.offset)
        rate = rate - state.bias[:, :3]
        arm = state.p_body_camera
        R = state.R @ state.R_body_camera
        error = np.zeros((count, 6))
        error[:, :3] = state.p + state.R @ arm - self._measured[:, :3, 3]
        error[:, 3:] = se3.so3_log(R @ np.swapaxes(self._measured[:, :3, :3], 1, 2))
        own, shared = np.zeros((count, 6, OF_FRAME)), np.zeros((count, 6, OF_ALL))
        own[:, :3, :3] = np.eye(3)
        own[:, :3, 3:6] = -state.R @ se3.skew(arm)
        own[:, 3:, 3:6] = state.R
        shared[:, 3:, :3] = R
        shared[:, :3, 3:6] = state.R
        shared[:, :3, 6] = state.v + (state.R @ np.cross(rate, arm)[:, :, None])[:, :, 0]
        shared[:, 3:, 6] = (state.R @ rate[:, :, None])[:, :, 0]
        if self._rows is not None:
            # Errors of the twist are of second order: centimetres a second, for milliseconds.
            shared[:, :, 9] = -(self._drift @ shared[:, :, 6, None])[:, :, 0]
            error += (state.readout - self._about) * shared[:, :, 9]
        return error, own, shared

    def _whitening(self, twist: FloatArray) -> FloatArray:
        """Root information (N, 6, 6) of poses whose stamps jitter too, while the camera moves with ``twist`` (N, 6).

        (1 - a u u') W, with u = W twist: a makes its square the inverse of W^-1 W^-T + jitter^2 twist twist'.
        """
        u = (self._root @ twist[:, :, None])[:, :, 0]
        square = np.maximum(np.sum(u**2, axis=1), 1e-12)
        a = (1.0 - 1.0 / np.sqrt(1.0 + self._jitter**2 * square)) / square
        return np.asarray(self._root - a[:, None, None] * u[:, :, None] * (u[:, None, :] @ self._root))

    def _scatter(self, error: FloatArray, twist: FloatArray) -> float:
        """Jitter of the stamps [s]: scatter of the delays that explain errors (N, 6) best, less that by pose noise."""
        u = (self._root @ twist[:, :, None])[:, :, 0]
        square = np.maximum(np.sum(u**2, axis=1), 1e-12)
        fast = square >= np.median(square)
        late = np.sum(u * (self._root @ error[:, :, None])[:, :, 0], axis=1)[fast] / square[fast]
        spread = 1.4826 * float(np.median(np.abs(late - np.median(late))))
        return float(np.sqrt(max(0.0, spread**2 - np.median(1.0 / square[fast]))))

    def _weighted_root(self, error: FloatArray, twist: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Root information (N, 6, 6) of poses off by ``error`` (N, 6) with robust weights, and these weights (N, 1)."""
        root = self._whitening(twist)
        distance = np.linalg.norm((root @ error[:, :, None])[:, :, 0], axis=1)
        weight = np.sqrt(np.minimum(1.0, _INLIER / np.maximum(distance, 1e-12)))[:, None]
        return weight[:, :, None] * root, weight

    def _add_poses(self, state: State, normal: BandedEquations) -> None:
        error, own, shared = self.pose_errors(state)
        root, weight = self._weighted_root(error, shared[:, :, 6])
        if self._rows is not None:
            twist = weight * shared[:, :, 6]
            information = np.einsum('ni,nij,nj->', twist, self._beyond, twist)
            normal.C[9, 9] += information
            normal.c[9] += information * (state.readout - self._about) - np.sum(weight * twist * self._rows.residual)
        e, own, shared = (root @ error[:, :, None])[:, :, 0], root @ own, root @ shared
        normal.add_states(slice(None), own, shared, e)
        normal.add_shared(shared, e)

    def _add_imu(self, state: State, normal: BandedEquations) -> None:
        corrected, times = self._imu.corrected(state.axes, state.force_delay), self._stamps + state.offset
        increments = preintegrate(corrected, times, state.bias[:-1], self._noise)
        e, first, second, shared = imu_errors(state, increments, self._noise)
        for index, J in ((slice(None, -1), first), (slice(1, None), second)):
            normal.add_states(index, J, shared, e)
        normal.H[:-1, 1] += np.swapaxes(second, 1, 2) @ first
        normal.add_shared(shared, e)

    def moved(self, state: State, own: FloatArray, shared: FloatArray) -> State:
        """``state`` after a step of each frame's own unknowns (N, 15) and of the shared ones (26,)."""
        moved = replace(
            state,
            R=state.R @ se3.so3_exp(own[:, 3:6]),
            p=state.p + own[:, :3],
            v=state.v + own[:, 6:9],
            bias=state.bias + own[:, 9:],
            R_body_camera=state.R_body_camera @ se3.so3_exp(shared[:3]),
            p_body_camera=state.p_body_camera + shared[3:6],
            gravity=se3.so3_exp(horizontal(state.gravity) @ shared[7:9]) @ state.gravity,
            readout=state.readout + shared[9],
            force_delay=float(np.clip(state.force_delay + shared[10], -_LARGEST_DELAY, _LARGEST_DELAY)),
            axes=state.axes + shared[11:],
        )
        delay = float(np.clip(shared[6], -0.05, 0.05))
        return replace(self._shifted(moved, np.array([[delay]]), self._stamps), offset=state.offset + delay)

    def _shifted(self, state: State, delay: FloatArray, stamps: FloatArray) -> State:
        """States at ``stamps`` moved along their motion by ``delay`` (1,) or (N, 1) [s]."""
        rate, force = self._imu.corrected(state.axes, state.force_delay).at(stamps + state.offset + 0.5 * delay[:, 0])
        acceleration = (state.R @ (force - state.bias[:, 3:])[:, :, None])[:, :, 0] + state.gravity
        return replace(
            state,
            R=state.R @ se3.so3_exp((rate - state.bias[:, :3]) * delay),
            p=state.p + state.v * delay + 0.5 * acceleration * delay**2,
            v=state.v + acceleration * delay,
        )
