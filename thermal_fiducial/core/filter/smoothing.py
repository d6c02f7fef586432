"""A pose without steps for controllers that hate them. It is late by design, and never the honest output."""

from dataclasses import replace
import math

import numpy as np

from thermal_fiducial.core.geometry.se3 import inverse, so3_exp, so3_log, transform
from thermal_fiducial.core.measurements import Odometry
from thermal_fiducial.core.types import FloatArray

#: A correction beyond this [m] is a new start of the filter: spreading it would only prolong the error.
LARGEST_STEP = 1.0


class SmoothOutput:
    """Follows the filter's odometry: moves with its twist, and takes up its corrections with a time constant."""

    def __init__(self, seconds: float) -> None:
        """``seconds``: time constant [s]."""
        self._seconds = seconds
        self._honest: Odometry | None = None
        self._T = np.eye(4)

    def follow(self, odometry: Odometry) -> Odometry:
        """Odometry with the smooth pose; its covariance and twist are the filter's."""
        if self._honest is None:
            self._T = odometry.T_map_body
        else:
            dt = (odometry.stamp_ns - self._honest.stamp_ns) * 1e-9
            left = inverse(odometry.T_map_body) @ self._T @ _motion(self._honest, odometry, dt)
            share = math.exp(-dt / self._seconds) if np.linalg.norm(left[:3, 3]) < LARGEST_STEP else 0.0
            rotation = so3_exp(share * so3_log(left[:3, :3]))
            self._T = odometry.T_map_body @ transform(rotation, share * left[:3, 3])
        self._honest = odometry
        return replace(odometry, T_map_body=self._T)


def _motion(before: Odometry, now: Odometry, dt: float) -> FloatArray:
    """T_before_now (4, 4) by the mean of both twists."""
    rotation = so3_exp(0.5 * dt * (before.angular_velocity_body + now.angular_velocity_body))
    return transform(rotation, 0.5 * dt * (before.velocity_body + rotation @ now.velocity_body))
