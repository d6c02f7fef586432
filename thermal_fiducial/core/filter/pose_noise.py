"""Noise of the camera poses: their covariance, split into white and systematic errors; the white part is adapted.

The error of a pose is the sum of a white and a systematic error. Errors of lens and corners are systematic: they stay
the same while the view does, and change as the camera turns or sees other markers. Their size is in the covariance
already: the mapper learns it from the corners' residuals. White noise beyond the claim is learned from innovations.

Source: R. Mehra, "Approaches to Adaptive Filtering", IEEE TAC 1972.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property
import math

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
#: Adaptation of the stamps' jitter: weight of the parameter in poses, memory in poses, range of the standard deviation
#: [s], and the limit of the normalised squared innovation along the motion.
_PRIOR_STAMPS, _MEMORY, _STAMP_RANGE, _LARGEST_SQUARE = 10.0, 300.0, (1e-4, 5e-3), 9.0
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


@dataclass(frozen=True, slots=True)
class PoseNoise:
    """Adapted variances: white error of camera poses as a multiple of their own covariance, and jitter of stamps."""

    white: float
    #: the last accepted pose
    last: BodyPose
    #: variance of the jitter of the camera's stamps [s^2], 0 for exact stamps; information about its logarithm
    jitter: float = 0.0
    jitter_information: float = 0.0
    #: (6,) of the last pose that was compared with the estimate, accepted or not
    innovation: FloatArray = field(default_factory=lambda: np.zeros(6))

    @classmethod
    def of(cls, stamp_jitter: float, first: BodyPose) -> 'PoseNoise':
        """Initial values, for the parameter ``stamp_jitter`` [s] and the ``first`` pose."""
        return cls(WHITE, first, stamp_jitter**2)

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
        if not self.jitter:
            return self
        change = self._change(innovation)
        weighted = S_inverse @ twist
        precision = float(twist @ weighted)
        square = min(float(change @ weighted) ** 2, _LARGEST_SQUARE * precision)
        share = self.jitter * precision
        information = (1.0 - 1.0 / _MEMORY) * self.jitter_information + 0.5 * share**2
        step = 0.5 * (self.jitter * square - share) / (0.5 * _PRIOR_STAMPS + information)
        low, high = _STAMP_RANGE
        jitter = min(max(self.jitter * math.exp(step), low**2), high**2)
        return replace(self, jitter=jitter, jitter_information=information)

    def _change(self, innovation: FloatArray) -> FloatArray:
        """(6,) change of the innovation since the last pose, scaled to the variance of one white innovation."""
        return (innovation - self.innovation) / math.sqrt(2.0)
