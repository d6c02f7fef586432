"""What camera poses are worth: at best what their covariance says; where they scatter more, that is learned.

A part of the error is white; another is systematic: errors of lens and corners are the same while the view is, and
another once the camera has turned to other parts of the image or sees other markers. How large that is, the mapper has
learned from the residuals of the corners, and has put it into the covariance.

Source: R. Mehra, "Approaches to Adaptive Filtering", IEEE TAC 1972.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property
import math

import numpy as np

from thermal_fiducial.core.error_model import CHI2_OF_POSE
from thermal_fiducial.core.geometry.se3 import rotation_angle
from thermal_fiducial.core.types import FloatArray

#: Variance of the white error of a pose where it claims enough, in units of its covariance: the rest is systematic.
WHITE = 0.5
#: Where it claims too little, what is learned of the last poses, so many; the variance is at most so many times as
#: large, and no pose changes it by more than e^0.2.
_WHITE_MEMORY, _LARGEST, _LARGEST_STEP = 10.0, 30.0, 0.3
#: Stamps: poses that count as much as the parameter, poses over which their jitter may change, its range [s], and the
#: largest square of an innovation along the motion, normalised.
_PRIOR_STAMPS, _MEMORY, _STAMP_RANGE, _LARGEST_SQUARE = 10.0, 300.0, (1e-4, 5e-3), 9.0
#: What the covariance of a pose never is below: rounding of float32 corners [rad, m].
_ROUNDING = np.diag(np.repeat([1e-5, 3e-5], 3) ** 2)


@dataclass(frozen=True)
class BodyPose:
    """A measured pose of the robot."""

    stamp_ns: int
    T_map_body: FloatArray
    #: (6, 6) relative to the map as it is: rotation, then position, in the robot frame [rad, m]
    covariance: FloatArray
    #: (6, 6) by errors of the map: ROS convention, in ``map`` [m, rad]
    map_covariance: FloatArray = field(default_factory=lambda: np.zeros((6, 6)))

    @cached_property
    def shape(self) -> FloatArray:
        """(6, 6) the covariance, never singular."""
        return self.covariance + _ROUNDING

    def map_change(self, last: 'BodyPose') -> FloatArray:
        """Covariance (6, 6), as ``covariance``, of what changed with the map's error since the ``last`` pose.

        The same markers in the same map have the same error; as far as the two covariances differ it is another one.
        """
        if not self.map_covariance.any():
            return np.zeros((6, 6))
        turn = np.zeros((6, 6))
        turn[:3, 3:] = turn[3:, :3] = self.T_map_body[:3, :3].T
        then, now = (turn @ pose.map_covariance @ turn.T for pose in (last, self))
        same = math.exp(2.0 * log_overlap(then + self.shape, now + self.shape))
        return np.asarray((1.0 - same) * now)


def log_overlap(A: FloatArray, B: FloatArray) -> float:
    """Logarithm, at most 0, of Bhattacharyya's coefficient of errors with covariances (m, m)."""
    determinants = np.linalg.slogdet(np.stack((A, B, 0.5 * (A + B))))[1]
    return min(float(0.25 * (determinants[0] + determinants[1]) - 0.5 * determinants[2]), 0.0)


@dataclass(frozen=True, slots=True)
class PoseNoise:
    """Variances of the white error of camera poses, in units of their own covariance, and of the jitter of stamps."""

    white: float
    #: the last pose that was compared with the estimate
    last: BodyPose
    #: variance of the jitter of the camera's stamps [s^2], 0: they are exact; information about its logarithm
    jitter: float = 0.0
    jitter_information: float = 0.0
    #: (6,) of the last pose that was compared
    innovation: FloatArray = field(default_factory=lambda: np.zeros(6))

    @classmethod
    def of(cls, stamp_jitter: float, first: BodyPose) -> 'PoseNoise':
        """To begin with: the jitter of the camera's stamps [s], the ``first`` pose."""
        return cls(WHITE, first, stamp_jitter**2)

    def in_moved_map(self, T_new_old: FloatArray) -> 'PoseNoise':
        """The same in a map whose coordinates are moved by ``T_new_old`` (4, 4)."""
        turn = np.kron(np.eye(2), T_new_old[:3, :3])
        last = replace(
            self.last,
            T_map_body=T_new_old @ self.last.T_map_body,
            map_covariance=turn @ self.last.map_covariance @ turn.T,
        )
        return replace(self, last=last)

    def alike(self, pose: BodyPose, angle: float) -> float:
        """Correlation of the systematic errors of ``pose`` and of the last one, 0 to 1.

        It falls with the change of the view, e-fold for ``angle`` [rad], and as far as the two covariances differ
        (Bhattacharyya's coefficient): other markers have other errors.
        """
        A, B = self.last.shape, pose.shape
        # What is uncertain of position for what is uncertain of rotation: the distance to the markers.
        variances = B.diagonal()
        distance = math.sqrt(float(variances[3:].sum() / variances[:3].sum()))
        T_last, T = self.last.T_map_body, pose.T_map_body
        turned = float(rotation_angle(T_last[:3, :3].T @ T[:3, :3]))
        moved = float(np.linalg.norm(T[:3, 3] - T_last[:3, 3])) / distance
        return math.exp(-(turned + moved) / angle + log_overlap(A, B))

    def weighed(self, pose: BodyPose, innovation: FloatArray, S_inverse: FloatArray) -> 'PoseNoise':
        """What is known after a pose was weighed: a step of Fisher scoring on the likelihood of its white error.

        White is what changes from pose to pose: a clock that has stepped, or a marker that has moved, is there in all
        of them. Refused poses count too; if nothing were learned from these, poses that claim too little would stay
        refused. A change that no white error explains says nothing of it.

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
        """What is known of the stamps' jitter after an accepted pose, from how innovations change along the motion.

        ``twist`` (6,): by which a late stamp moves the pose [1/s].
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
        """(6,) by which an innovation differs from the last, as large as one where both are white."""
        return (innovation - self.innovation) / math.sqrt(2.0)
