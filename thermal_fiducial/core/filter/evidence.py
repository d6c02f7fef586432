"""What the innovations say beside the filter: of the camera's rotation on the robot, and of the clock offset."""

from dataclasses import dataclass, field

import numpy as np

from thermal_fiducial.core.measurements import Condition
from thermal_fiducial.core.types import FloatArray, TINY

#: Three sigma, for a chi square of three degrees of freedom.
_CONTRADICTS = 14.2
#: Poses over which the information about the clock offset is averaged: three seconds at 30 Hz, longer than manoeuvres.
_POSES = 100.0


@dataclass(frozen=True, slots=True)
class MountEvidence:
    """Information about the camera's rotation, about the axes of the robot, in standard deviations claimed of it.

    The gain of the filter takes the rotation for exact. Given the rotation, innovations of such a filter are white, and
    linear in it: least squares over them is its estimate.

    Source: B. Friedland, "Treatment of Bias in Recursive Filtering", IEEE TAC 1969.
    """

    #: (3, 3) and, times the rotation, (3,)
    information: FloatArray = field(default_factory=lambda: np.zeros((3, 3)))
    weighted: FloatArray = field(default_factory=lambda: np.zeros(3))

    def after(self, by_rotation: FloatArray, S_exact: FloatArray, innovation: FloatArray) -> 'MountEvidence':
        """With one more ``innovation`` (6,), of covariance ``S_exact`` (6, 6) if the mount were exact.

        ``by_rotation`` (6, 3): its derivative.
        """
        weights = np.linalg.solve(S_exact, by_rotation)
        return MountEvidence(self.information + by_rotation.T @ weights, self.weighted + innovation @ weights)

    def contradiction(self, std: float) -> Condition | None:
        """That the rotation is beyond three sigma of what its claim ``std`` [rad] and its own noise allow."""
        information, axes = np.linalg.eigh(self.information)
        information = np.maximum(information, TINY)
        along = axes.T @ self.weighted
        if along @ (along / (information + information**2)) <= _CONTRADICTS:
            return None
        # Of an axis that nothing shows, the claim says that there is nothing.
        off = np.degrees(std * np.linalg.norm(along / (information + 1.0)))
        claimed = np.degrees(std * np.sqrt(3.0))
        details = f'poses and IMU differ by {off:.1f} deg or more, {claimed:.1f} are claimed; calibrate camera-imu'
        return Condition('camera_orientation is off', details)


@dataclass(frozen=True, slots=True)
class ClockEvidence:
    """Information about the clock offset in the latest poses [1/s^2], and how much of it is that of noise.

    A single pose does not show which is which.
    """

    information: float = 0.0
    spurious: float = 0.0

    def after(self, information: float, spurious: float) -> 'ClockEvidence':
        """With one more pose."""
        kept = 1.0 - 1.0 / _POSES
        return ClockEvidence(kept * self.information + information, kept * self.spurious + spurious)

    @property
    def share_of_motion(self) -> float:
        """Share of the information that is not that of noise."""
        return 1.0 - min(self.spurious / max(self.information, TINY), 1.0)
