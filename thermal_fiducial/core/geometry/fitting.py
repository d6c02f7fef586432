"""Levenberg-Marquardt for one pose."""

from collections.abc import Callable

import numpy as np

from thermal_fiducial.core.geometry.reprojection import retract
from thermal_fiducial.core.types import FloatArray

_ITERATIONS = 15
# A step below this [m, rad] changes no digit that anybody reads.
_CONVERGED = 1e-8

#: Whitened residuals (m,) at a pose, measured minus predicted, and the derivative (m, 6) of the prediction.
Evaluation = Callable[[FloatArray], tuple[FloatArray, FloatArray]]


def fit_pose(T: FloatArray, evaluate: Evaluation) -> tuple[FloatArray, float]:
    """Pose (4, 4) with the smallest sum of squares near ``T``, and that sum; inf where ``T`` has none."""
    r, J = evaluate(T)
    cost = float(r @ r)
    if not np.isfinite(cost):
        return T, np.inf
    damping = 1e-4
    for _ in range(_ITERATIONS):
        H = J.T @ J
        step = np.linalg.solve(H + np.diag(damping * np.diag(H) + 1e-12 * np.trace(H)), J.T @ r)
        trial = retract(T, step)
        r_trial, J_trial = evaluate(trial)
        trial_cost = float(r_trial @ r_trial)
        if trial_cost <= cost:
            T, r, J, cost, damping = trial, r_trial, J_trial, trial_cost, 0.1 * damping
        else:
            damping *= 10.0
        if np.max(np.abs(step)) < _CONVERGED:
            break
    return T, cost
