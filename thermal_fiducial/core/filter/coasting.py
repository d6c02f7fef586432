"""How long the pose stays usable on the IMU alone."""

import numpy as np
from numpy.polynomial import polynomial

from thermal_fiducial.core.filter.state import (
    ACCELEROMETER_BIAS,
    ACCELEROMETER_MATRIX,
    Estimate,
    GRAVITY,
    GYROSCOPE_BIAS,
    POSITION,
    ROTATION,
    SIZE,
    VELOCITY,
)
from thermal_fiducial.core.geometry.se3 import skew
from thermal_fiducial.core.types import FloatArray

#: Longest time looked ahead [s], and the grid of times [s].
HORIZON, STEP = 60.0, 0.05


def usable_seconds(estimate: Estimate, densities: FloatArray, position_std: float) -> float:
    """Seconds [s] of coasting until the position is worse than ``position_std`` [m]; at most ``HORIZON``."""
    times = np.arange(0.0, HORIZON + STEP, STEP)
    beyond = polynomial.polyval(times, coasting_variance(estimate, densities)) > position_std**2
    return float(times[np.argmax(beyond)]) if beyond.any() else HORIZON


def coasting_variance(estimate: Estimate, densities: FloatArray) -> FloatArray:
    """Sum of the position variances [m^2] after t seconds of hover, coefficients of t^0 .. t^6.

    The error is rho + nu t + alpha t^2 / 2 + beta t^3 / 6 + noise, with alpha the acceleration error by tilt and
    accelerometer, and beta its growth by the gyroscope's bias error. ``densities`` (6,): noise of gyroscope and
    accelerometer [rad/s/sqrt(Hz), m/s^2/sqrt(Hz)].
    """
    state = estimate.state
    hovering = -state.gravity @ state.R_map_body
    lift = skew(hovering)
    rho, nu, alpha, beta = (np.zeros((3, SIZE)) for _ in range(4))
    rho[:, POSITION] = nu[:, VELOCITY] = np.eye(3)
    alpha[:, ROTATION], alpha[:, ACCELEROMETER_BIAS], beta[:, GYROSCOPE_BIAS] = -lift, -np.eye(3), lift
    alpha[:, ACCELEROMETER_MATRIX] = -np.kron(np.eye(3), hovering)
    alpha[:, GRAVITY] = state.R_map_body[:2].T
    terms = (rho, nu, alpha / 2.0, beta / 6.0)
    coefficients = np.zeros(7)
    for i, left in enumerate(terms):
        for j, right in enumerate(terms):
            coefficients[i + j] += np.einsum('ik,kl,il', left, estimate.covariance, right)
    coefficients[0] += np.trace(estimate.pose_noise.last.map_covariance[:3, :3])
    # White acceleration noise on three axes, each sigma^2 t^3 / 3, and tilt about two axes by white rate noise.
    rate, force = float(densities[0]), float(densities[3])
    coefficients[3] += force**2
    coefficients[5] += 2.0 * rate**2 * float(state.gravity @ state.gravity) / 20.0
    return coefficients
