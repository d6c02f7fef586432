"""Batched Levenberg-Marquardt for poses, in particular of rigid bodies of known points from their noisy images.

The lens distortion is removed once: measured pixels are undistorted, and the derivative of the distortion there enters
the whitening, so the minimisation uses a pinhole projection. The weight of a residual is exact to the order of residual
over focal length, and a residual of zero stays zero.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from thermal_fiducial.core.geometry import se3
from thermal_fiducial.core.geometry.camera import ImagePoints
from thermal_fiducial.core.geometry.se3 import retract
from thermal_fiducial.core.types import BoolArray, FloatArray, TINY

_MAX_STEPS = 20
#: Costs are chi-squares. The last step of a pose is one that lowers its cost by less than _LITTLE, a tenth of a
#: standard deviation; its own error is of second order. A pose whose cost exceeds that of the best alternative, or
#: REFUTED, which no correct pose reaches, ends earlier: with a gain below _LITTLE of the excess. It is given up if
#: its cost still exceeds REFUTED and TIMES_THE_BEST times the best together after a step.
_LITTLE, REFUTED, TIMES_THE_BEST = 1e-2, 50.0, 10.0
#: Damping of Levenberg-Marquardt: factors after a step that lowers the cost, and after one that does not; largest
#: damping, with which the search ends. The search begins with its inverse.
EASED, MOST_DAMPED = 0.1, 1e6
STIFFENED = 1.0 / EASED
# Replaces an initial pose that is not finite.
_AHEAD = se3.transform(np.diag([1.0, -1.0, -1.0]), [0.0, 0.0, 1.0])
#: Ridge that keeps information matrices regular, as a share of their largest entry.
SINGULAR = 1e-12
_MINUS_SKEW = -se3.SKEW
#: Chi square of a point, or of a view, behind the camera: of a gross outlier.
BEHIND_CHI2 = 1e8

#: The cost about poses (B, 4, 4): its value there (B,), gradient (B, 6), information (B, 6, 6).
Quadratic = tuple[FloatArray, FloatArray, FloatArray]


@dataclass(frozen=True, slots=True)
class Images:
    """Whitened images of B bodies of K points each: ``whitening @ x - target`` for normalised coordinates x.

    Parameters
    ----------
    whitening : (B, K, 2, 2)
    target : (B, K, 2)
    """

    whitening: FloatArray
    target: FloatArray

    @staticmethod
    def of(points: ImagePoints, whitening: FloatArray) -> 'Images':
        """The whitened image of points (B, K); ``whitening`` (B, K, 2, 2) [1/px] of their noise."""
        W = whitening @ points.J
        return Images(W, (W @ points.x[..., None])[..., 0])

    def joined(self) -> 'Images':
        """The points of all bodies as those of a single one."""
        return Images(self.whitening.reshape(1, -1, 2, 2), self.target.reshape(1, -1, 2))


def minimise(
    T: FloatArray, evaluated: Callable[[FloatArray], Quadratic], alternatives: int = 1, linear_angle: float = TINY
) -> Quadratic:
    """Poses with the least costs, from starts ``T`` (B, 4, 4).

    Parameters
    ----------
    evaluated : function of poses: cost, half its gradient and half its Gauss-Newton Hessian, for steps of the origin
        and rotations about it, both in the parent frame
    alternatives : number of consecutive starts of the same body, of which only the best is needed
    linear_angle : rotation [rad] of a step after which as much of the cost is still to be gained as it has gained: the
        step ends where the cost is no longer quadratic. After one by an angle a the rest is taken for
        ``gain * min((a / linear_angle)**2, 1)``; the search ends where that is negligible

    Returns
    -------
    Poses (B, 4, 4), costs (B,), inf from an unusable start, and information matrices (B, 6, 6).
    """
    possible: BoolArray = np.asarray(np.isfinite(T).all(axis=(1, 2)))
    T = np.where(possible[:, None, None], T, _AHEAD)
    cost, gradient, information = evaluated(T)
    possible &= np.isfinite(cost)
    if not possible.all():
        information[~possible], gradient[~possible] = np.eye(6), 0.0
    damping = np.full(len(T), 1.0 / MOST_DAMPED)
    active = possible
    for steps in range(_MAX_STEPS):
        step = _solve(information, damping, gradient)
        best = np.repeat(cost.reshape(-1, alternatives).min(axis=1), alternatives)
        gain = (step * gradient).sum(axis=1)
        left_share = np.minimum((step[:, 3:] * step[:, 3:]).sum(axis=1) / linear_angle**2, 1.0)
        last = gain * left_share < _LITTLE * np.maximum(cost - np.minimum(best, REFUTED), 1.0)
        most = REFUTED + TIMES_THE_BEST * best
        if steps > 0:
            active = active & (damping <= MOST_DAMPED) & (cost <= most)
        last |= cost - gain > most
        trial, done = retract(T, -step), active & last
        T[done] = trial[done]
        active = active & ~last
        if not active.any():
            break
        new = evaluated(trial)
        better = active & (new[0] <= cost)
        for kept, tried in zip((T, cost, gradient, information), (trial, *new), strict=True):
            kept[better] = tried[better]
        damping *= np.where(better, EASED, STIFFENED)
    return T, np.where(possible, cost, np.inf), information


def costs(T: FloatArray, points: FloatArray, images: Images, inlier: float) -> FloatArray:
    """The costs (B,) of :func:`evaluate`, without derivatives."""
    u, v, z = np.moveaxis(se3.apply(T, points), -1, 0)
    ahead = np.maximum(z, TINY)
    x, y = u / ahead, v / ahead
    # Number by number: numpy takes many times as long for products of many small matrices.
    W, target = images.whitening, images.target
    residuals = [W[..., row, 0] * x + W[..., row, 1] * y - target[..., row] for row in (0, 1)]
    squared, _ = robust(residuals[0] ** 2 + residuals[1] ** 2, inlier**2)
    # Where there may be outliers, a point behind the camera is one: its marker may have been moved.
    behind = robust(np.asarray(BEHIND_CHI2), inlier**2)[0] if inlier < np.inf else np.inf
    return np.asarray(np.where(z > TINY, squared, behind).sum(axis=-1))


def evaluate(T: FloatArray, points: FloatArray, images: Images, inlier: float = np.inf) -> Quadratic:
    """Robust squared error at poses (B, 4, 4) of bodies in the camera, inf where a point is behind it, and derivatives.

    ``points`` are (B or 1, K, 3) [m] in their bodies. Of a whitened error d, the cost is d^2 up to ``inlier`` and
    ``inlier^2 (1 + 2 log(d / inlier))`` beyond.
    """
    residual, J, seen = linearised(T, points, images)
    squared, J_transposed = (residual * residual).sum(axis=(-1, -2)), J.swapaxes(-1, -2)
    if inlier < np.inf:
        squared, weights = robust(squared, inlier**2)
        J_transposed = J_transposed * np.repeat(weights, 2, axis=-1)[:, None]
    gradient = (J_transposed @ residual.reshape(*J.shape[:2], 1))[..., 0]
    return np.where(seen, squared.sum(axis=-1), np.inf), gradient, J_transposed @ J


def linearised(T: FloatArray, points: FloatArray, images: Images) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Whitened images of ``points`` (B or 1, K, 3) [m] of bodies at poses (B, 4, 4) in the camera.

    Returns
    -------
    predicted minus measured (B, K, 2, 1), its derivative (B, 2 K, 6) for steps of the bodies' origins and rotations
    about these, both in the axes of the camera, and which (B,) bodies are before it
    """
    rotated = points @ T[:, :3, :3].swapaxes(-1, -2)
    p = rotated + T[:, None, :3, 3]
    z = p[..., 2:]
    seen: BoolArray = np.asarray((z > TINY).all(axis=(1, 2)))
    z = np.maximum(z, TINY)
    W = images.whitening
    seen_at = W @ (p[..., :2] / z)[..., None]
    d_p = np.empty((*p.shape[:2], 2, 3))
    d_p[..., :2], d_p[..., 2:] = W, -seen_at
    d_p /= z[..., None]
    J = np.empty((*p.shape[:2], 2, 6))
    J[..., :3] = d_p
    np.matmul(d_p, (rotated @ _MINUS_SKEW).reshape(*p.shape, 3), out=J[..., 3:])
    return seen_at - images.target[..., None], J.reshape(len(T), 2 * p.shape[1], 6), seen


def robust(squared: FloatArray, limit: float) -> tuple[FloatArray, FloatArray]:
    """Costs of squared errors, which grow but logarithmically beyond ``limit``, and the weights of the errors."""
    excess = np.maximum(squared / limit, 1.0)
    return np.where(excess > 1.0, limit * (1.0 + np.log(excess)), squared), 1.0 / excess


def _solve(information: FloatArray, damping: FloatArray, gradient: FloatArray) -> FloatArray:
    """Levenberg-Marquardt steps (N, 6); ``damping`` (N,) is relative to the diagonals of ``information`` (N, 6, 6)."""
    damped = information.copy()
    diagonal = damped.reshape(-1, 36)[:, ::7]
    floor = SINGULAR * np.maximum(diagonal.max(axis=-1, keepdims=True), SINGULAR)
    diagonal += damping[:, None] * diagonal + floor
    return np.asarray(np.linalg.solve(damped, gradient[..., None])[..., 0])
