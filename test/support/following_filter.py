"""Odometry of a filter that follows a mapper's poses: it has the map's error, and drifts where no marker is known."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from support.scenes import motion_prior
from thermal_fiducial.core.geometry.se3 import difference, retract
from thermal_fiducial.core.measurements import Odometry

#: Share of the difference from a pose that the filter takes over, at 8 to 15 frames a second: time constant 0.2 s.
_GAIN = 0.3
#: Drift from one frame to the next: position [m], rotation [rad].
_DRIFT = np.repeat([0.002, 0.0005], 3)
#: Share of an error of roll and pitch that stays from one frame to the next, as gravity shows them.
_TILT_STAYS = 0.95
#: Standard deviations that it claims beside the map's error: pose [m, rad] and twist [m/s, rad/s].
_POSE, _TWIST = np.repeat([0.01, 0.0025], 3), np.repeat([0.03, 0.01], 3)


@dataclass
class FollowingFilter:
    """Such a filter; ``truth``: T_map_camera (4, 4) by stamp."""

    truth: Mapping[int, np.ndarray]
    rng: np.random.Generator
    _off: np.ndarray = field(default_factory=lambda: np.zeros(6))
    _of_map: np.ndarray = field(default_factory=lambda: np.zeros((6, 6)))

    def prior(self, stamp):
        """What it says of the camera at a frame, in the frame of the camera."""
        self._off = self._off + self.rng.normal(size=6) * _DRIFT
        T = retract(self.truth[stamp], self._off)
        state = Odometry(stamp, T, np.zeros(3), np.zeros(3), np.diag(_POSE**2) + self._of_map, np.diag(_TWIST**2))
        return motion_prior(state)

    def follow(self, stamp, pose):
        """Take over the pose of a frame; None: the mapper had none."""
        if pose is not None:
            self._off = self._off + _GAIN * (difference(pose.T_map_camera, self.truth[stamp]) - self._off)
            self._of_map = pose.map_covariance
        self._off[3:5] *= _TILT_STAYS
