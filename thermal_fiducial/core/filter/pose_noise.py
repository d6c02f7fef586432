"""Noise of the camera poses: their covariance, split into white and systematic errors; what is white is adapted.

The error of a pose is the sum of a white and a systematic error. Errors of lens and corners are systematic: they stay
the same while the view does, and change as the camera turns or sees other markers. Their size is in the covariance
already: the mapper learns it from the corners' residuals. White noise beyond the claim is learned from innovations:
in proportion to the claim, along the motion (jitter of stamps), and in rotation (vibration of the camera's mount).

Source: R. Mehra, "Approaches to Adaptive Filtering", IEEE TAC 1972.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property
import math
from typing import NamedTuple

import numpy as np

from thermal_fiducial.core.error_model import CHI2_OF_POSE
from thermal_fiducial.core.geometry.reprojection import turned
from thermal_fiducial.core.geometry.se3 import rotation_angle
from thermal_fiducial.core.types import FloatArray

#: Initial and least variance of the white error, as a share of the pose's covariance. The systematic error has all of
#: it besides: with half of it the fused pose before a recorded board claims less than its error.
WHITE = 0.5
#: Adaptation of the white variance where poses claim too little: memory in poses, largest multiple of the initial
#: value, largest step of its logarithm by one pose.
_WHITE_MEMORY, _LARGEST, _LARGEST_STEP = 10.0, 30.0, 0.3
#: Adaptation of the stamps' jitter and the mount's vibration: weight of the parameter in poses, memory in poses, and
#: the limit of the normalised squared innovation in their directions.
_PRIOR, _MEMORY, _LARGEST_SQUARE = 10.0, 300.0, 9.0
#: Range of their standard deviations [s], [rad].
_STAMP_RANGE, _VIBRATION_RANGE = (1e-4, 5e-3), (1e-5, 1e-2)
#: Least covariance of a pose: rounding of float32 corners [rad, m].
_ROUNDING = np.diag(np.repeat([1e-5, 3e-5], 3) ** 2)


@dataclass(frozen=True)
class BodyPose:
    """A measured pose of the robot."""

    stamp_ns: int
    T_map_body: FloatArray
    #: (6, 6) relative to the map, its error left out: rotation, then position, in the robot frame [rad, m]
    covariance: FloatArray
    #: (6, 6) due to errors of the map: ROS convention, in ``map`` [m, rad]
    map_covariance: FloatArray = field(default_factory=lambda: np.zeros((6, 6)))

    @cached_property
    def shape(self) -> FloatArray:
        """(6, 6) the covariance plus the least one: never singular."""
        return self.covariance + _ROUNDING

    def map_change(self, last: 'BodyPose') -> FloatArray:
        """Covariance (6, 6), conventions of ``covariance``, of the change of the map's error since the ``last`` pose.

        The same markers in the same map have the same error. The overlap of the two covariances is the correlation.
        """
        if not self.map_covariance.any():
            return np.zeros((6, 6))
        turn = np.zeros((6, 6))
        turn[:3, 3:] = turn[3:, :3] = self.T_map_body[:3, :3].T
        then, now = (turn @ pose.map_covariance @ turn.T for pose in (last, self))
        same = math.exp(2.0 * log_overlap(then + self.shape, now + self.shape))
        return np.asarray((1.0 - same) * now)


def log_overlap(A: FloatArray, B: FloatArray) -> float:
    """Logarithm, at most 0, of the Bhattacharyya coefficient of two zero-mean Gaussians, covariances (m, m)."""
    determinants = np.linalg.slogdet(np.stack((A, B, 0.5 * (A + B))))[1]
    return min(float(0.25 * (determinants[0] + determinants[1]) - 0.5 * determinants[2]), 0.0)


class LearnedVariance(NamedTuple):
    """Variance of a white error that is learned from innovations, 0 for none; information about its logarithm."""

    value: float
    information: float = 0.0

    def adapted(
        self, directions: FloatArray, change: FloatArray, S_inverse: FloatArray, stds: tuple[float, float]
    ) -> 'LearnedVariance':
        """One step of Fisher scoring on the likelihood of an innovation's ``change`` (6,).

        Parameters
        ----------
        directions : (6, K) derivative of the innovation by K independent errors of this variance
        S_inverse : (6, 6) of the innovation's covariance
        stds : range of the standard deviation
        """
        if not self.value:
            return self
        weighted = S_inverse @ directions
        precision = directions.T @ weighted
        along = change @ weighted
        square = min(float(along @ along), _LARGEST_SQUARE * float(precision.trace()))
        share = self.value * precision
        information = (1.0 - 1.0 / _MEMORY) * self.information + 0.5 * float(np.sum(share * share))
        step = 0.5 * (self.value * square - float(share.trace())) / (0.5 * _PRIOR + information)
        low, high = stds
        return LearnedVariance(min(max(self.value * math.exp(step), low**2), high**2), information)


_NONE = LearnedVariance(0.0)


@dataclass(frozen=True, slots=True)
class PoseNoise:
    """Adapted variances: white errors of camera poses, as a multiple of their own covariance and beside it."""

    white: float
    #: the last accepted pose
    last: BodyPose
    #: jitter of the camera's stamps [s^2]
    jitter: LearnedVariance = _NONE
    #: rotation of the camera against the IMU by vibration, about each axis [rad^2]
    vibration: LearnedVariance = _NONE
    #: (6,) of the last pose that was compared with the estimate, accepted or not
    innovation: FloatArray = field(default_factory=lambda: np.zeros(6))

    @classmethod
    def of(cls, first: BodyPose, stamp_jitter: float = 0.0, mount_vibration: float = 0.0) -> 'PoseNoise':
        """Initial values; ``stamp_jitter`` [s] and ``mount_vibration`` [rad] are standard deviations."""
        return cls(WHITE, first, LearnedVariance(stamp_jitter**2), LearnedVariance(mount_vibration**2))

    def in_moved_map(self, T_new_old: FloatArray) -> 'PoseNoise':
        """The same in a map whose coordinates are moved by ``T_new_old`` (4, 4)."""
        last = replace(
            self.last,
            T_map_body=T_new_old @ self.last.T_map_body,
            map_covariance=turned(self.last.map_covariance, T_new_old[:3, :3]),
        )
        return replace(self, last=last)

    def alike(self, pose: BodyPose, angle: float) -> float:
        """Correlation, 0 to 1, of the systematic errors of ``pose`` and of the last accepted one.

        It falls with the change of the view, e-fold for ``angle`` [rad], and with the overlap of the two covariances
        (Bhattacharyya coefficient), as other markers have other errors.
        """
        A, B = self.last.shape, pose.shape
        # Ratio of position to rotation uncertainty: about the distance to the markers.
        variances = B.diagonal()
        distance = math.sqrt(float(variances[3:].sum() / variances[:3].sum()))
        T_last, T = self.last.T_map_body, pose.T_map_body
        turned = float(rotation_angle(T_last[:3, :3].T @ T[:3, :3]))
        moved = float(np.linalg.norm(T[:3, 3] - T_last[:3, 3])) / distance
        return math.exp(-(turned + moved) / angle + log_overlap(A, B))

    def weighed(self, pose: BodyPose, innovation: FloatArray, S_inverse: FloatArray) -> 'PoseNoise':
        """Adapt the white variance: one step of Fisher scoring on the likelihood of the innovations' change.

        The change from pose to pose is used since it does not contain what stays, as a step of the clock or a moved
        marker. Refused poses count too: otherwise poses that claim too little would stay refused. A change too large
        for any white error is ignored.

        Parameters
        ----------
        innovation, S_inverse : (6,) and the inverse (6, 6) of its covariance
        """
        change = self._change(innovation)
        weighted = S_inverse @ change
        squared = float(change @ weighted)
        if squared > _LARGEST * CHI2_OF_POSE:
            return replace(self, innovation=innovation)
        share = S_inverse @ (self.white * pose.shape)
        bounded = CHI2_OF_POSE / max(squared, CHI2_OF_POSE)
        score = 0.5 * (bounded * self.white * float(weighted @ pose.shape @ weighted) - float(np.trace(share)))
        information = 0.5 * float(np.sum(share * share.T))
        step = score / (_WHITE_MEMORY * (0.5 + information))
        white = self.white * math.exp(min(max(step, -_LARGEST_STEP), _LARGEST_STEP))
        return replace(self, white=min(max(white, WHITE), _LARGEST * WHITE), innovation=innovation)

    def with_stamps(self, twist: FloatArray, innovation: FloatArray, S_inverse: FloatArray) -> 'PoseNoise':
        """Adapt the stamps' jitter after an accepted pose, from the change of innovations along the motion.

        ``twist`` (6,): derivative of the pose with respect to its stamp [rad/s, m/s].
        """
        jitter = self.jitter.adapted(twist[:, None], self._change(innovation), S_inverse, _STAMP_RANGE)
        return replace(self, jitter=jitter)

    def with_vibration(self, turning: FloatArray, innovation: FloatArray, S_inverse: FloatArray) -> 'PoseNoise':
        """Adapt the vibration of the mount; refused poses count too, see :meth:`weighed`.

        ``turning`` (6, 3): derivative of the pose by the camera's rotation against the robot.
        """
        vibration = self.vibration.adapted(turning, self._change(innovation), S_inverse, _VIBRATION_RANGE)
        return replace(self, vibration=vibration)

    def _change(self, innovation: FloatArray) -> FloatArray:
        """(6,) change of the innovation since the last pose, scaled to the variance of one white innovation."""
        return (innovation - self.innovation) / math.sqrt(2.0)
