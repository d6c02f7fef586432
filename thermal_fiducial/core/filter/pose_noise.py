"""Noise of the camera poses: their covariance, split into white and systematic errors; what is white is adapted.

The error of a pose is the sum of a white and a systematic error, and its covariance is that of both together. Errors of
lens and corners are systematic: they stay the same while the view does, and change as the camera turns or sees other
markers. White noise is learned from innovations, by their changes from pose to pose: in proportion to the claim, along
the motion (jitter of stamps), and in rotation (vibration of the camera's mount). What of a claim is known to be white
is not systematic; white noise may exceed the claim.

Source: R. Mehra, "Approaches to Adaptive Filtering", IEEE TAC 1972.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property
import math

import numpy as np

from thermal_fiducial.core.error_model import covariance_root
from thermal_fiducial.core.geometry.plausibility import LEAST_INDEPENDENT
from thermal_fiducial.core.geometry.se3 import screwed, skew, so3_log, turn_between
from thermal_fiducial.core.measurements import NOTHING_KNOWN
from thermal_fiducial.core.types import FloatArray

#: Least white variance of a pose as a multiple of its own covariance. Before a recorded board 0.03 of it is white; with
#: 0.1 the fused poses there are 0.2 mm farther off.
WHITE = 0.2
#: Variance of the white error before anything is learned: it may be all that a pose claims, and so may what lasts.
_WHITE_AT_FIRST = 1.0
#: Least and largest values of the three variances of :class:`PoseNoise`, and the memory [poses] with which they are
#: learned: poses that claim too little must not be refused for long. Stamps of arrival may jitter by 20 ms.
LIMITS = np.array(((WHITE, 1e-8, 1e-10), (15.0, 4e-4, 1e-4)))
_MEMORY = np.array((10.0, 300.0, 300.0))
#: Weight of the initial values, as information about their logarithms; limit of the normalised squared innovation.
_PRIOR, _LARGEST_SQUARE = 5.0, 9.0
#: A pose that claims less of a turn [rad] says nothing of it: a third of what the mapper claims then.
_UNKNOWN_TURN = NOTHING_KNOWN / 3.0
#: Least covariance of a pose: rounding of float32 corners [rad, m].
_ROUNDING = np.diag(np.repeat([1e-5, 3e-5], 3) ** 2)
_ORIGIN = np.zeros(3)


def displacement_of_body(T_map_body: FloatArray, about: FloatArray = _ORIGIN) -> FloatArray:
    """Map (6, 6) from a displacement in the map, position first, to that of the robot in its frame, rotation first.

    ``about`` (3,): the displaced point in the map [m]; a motion of the map is one about its origin.
    """
    R_body_map = T_map_body[:3, :3].T
    J = np.zeros((6, 6))
    J[:3, 3:] = J[3:, :3] = R_body_map
    J[3:, 3:] = -R_body_map @ skew(T_map_body[:3, 3] - about)
    return J


@dataclass(frozen=True)
class BodyPose:
    """A measured pose of the robot."""

    T_map_body: FloatArray
    #: (6, 6) relative to the map, its error left out: rotation, then position, in the robot frame [rad, m]
    covariance: FloatArray
    #: (6, 6) of the motion of the map, about its origin, that its errors are: position, then rotation [m, rad]
    map_covariance: FloatArray = field(default_factory=lambda: np.zeros((6, 6)))

    @cached_property
    def shape(self) -> FloatArray:
        """(6, 6) the covariance plus the least one: never singular."""
        return self.covariance + _ROUNDING

    @cached_property
    def by_map(self) -> FloatArray:
        """(6, 6) its derivative by a motion of the map about its origin, in the conventions of ``covariance``."""
        return displacement_of_body(self.T_map_body)

    @cached_property
    def unknown_turns(self) -> FloatArray:
        """(6, n) twists of turns that the pose does not show, by a radian each: the position follows such a turn."""
        turns = self.covariance[:3, :3]
        if turns.trace() < _UNKNOWN_TURN**2:
            return np.zeros((6, 0))
        variances, axes = np.linalg.eigh(turns)
        unknown = variances > _UNKNOWN_TURN**2
        return np.asarray(self.covariance[:, :3] @ axes[:, unknown] / variances[unknown])

    def turned_to(self, T_map_body: FloatArray) -> 'BodyPose':
        """The pose, by turns that it does not show, where the estimate ``T_map_body`` has it.

        It is as likely there. Left where it is, 15 degrees away, an error of the distance to the marker would look like
        one of the direction, which vanishes if the estimate turns to the pose.
        """
        twists = self.unknown_turns
        if twists.shape[1] == 0:
            return self
        rotation = so3_log(self.T_map_body[:3, :3].T @ T_map_body[:3, :3])
        turn = twists @ (twists[:3].T @ rotation)
        return replace(self, T_map_body=self.T_map_body @ screwed(np.eye(4), turn[[3, 4, 5, 0, 1, 2]]))

    def as_last(self, last: 'BodyPose', T_map_body: FloatArray) -> 'BodyPose':
        """The pose as the one that the next is compared with, seen from ``T_map_body`` of the estimate.

        Of turns that it does not show it has no error of the map either: that of the ``last`` pose stays there.
        """
        seen, twists = replace(self, T_map_body=T_map_body), self.unknown_turns
        if twists.shape[1] == 0:
            return seen
        stays = np.zeros((6, 6))
        stays[:, :3] = twists @ twists[:3].T
        of_last = np.linalg.solve(seen.by_map, stays @ seen.by_map)
        of_own = np.eye(6) - of_last
        of_map = of_own @ self.map_covariance @ of_own.T + of_last @ last.map_covariance @ of_last.T
        return replace(seen, map_covariance=of_map)

    def correlation(self, last: 'BodyPose', angle: float) -> float:
        """Correlation, 0 to 1, of the systematic errors of this pose and of the ``last`` one.

        It falls with the change of the view, e-fold for ``angle`` [rad], and with the overlap of the two covariances
        (Bhattacharyya coefficient), as other markers have other errors.
        """
        # Ratio of position to rotation uncertainty: about the distance to the markers.
        variances = self.shape.diagonal()
        distance = math.sqrt(float(variances[3:].sum() / variances[:3].sum()))
        T_last, T = last.T_map_body, self.T_map_body
        turned = float(turn_between(T_last, T))
        moved = float(np.linalg.norm(T[:3, 3] - T_last[:3, 3])) / distance
        return math.exp(-(turned + moved) / angle + log_overlap(last.shape, self.shape))

    def map_changes(self, others: FloatArray) -> FloatArray:
        """Covariances (n, 6, 6) of motions of the map from errors of covariances ``others`` (n, 6, 6) to this pose's.

        The least motion that makes one of the other (optimal transport of Gaussians; I. Olkin, F. Pukelsheim, "The
        distance between two random vectors with given dispersion matrices", 1982): the same markers have the same
        error, and those that were placed by them about the same. In units of what the pose claims beside it; by the
        white part of that, covariances that the mapper evaluates at a noisy pose differ without a change.
        """
        # Motions of the map that move the pose by a standard deviation of what it claims beside the map.
        units = np.linalg.solve(self.by_map, np.linalg.cholesky(self.shape))
        to_units = np.linalg.inv(units)
        of_maps = np.concatenate((self.map_covariance[None], others))
        roots = covariance_root(to_units @ of_maps @ to_units.T + WHITE * np.eye(6))
        now, then = roots[0], roots[1:]
        U, _, Vt = np.linalg.svd(then.swapaxes(1, 2) @ now)
        changes = units @ (now @ Vt.swapaxes(1, 2) - then @ U)
        return np.asarray(changes @ changes.swapaxes(1, 2))

    def moved_by(self, of_map: FloatArray) -> float:
        """Sum of the variances of the robot's position by a motion of the map of covariance ``of_map`` (6, 6)."""
        return float((self.by_map[3:] @ of_map @ self.by_map[3:].T).trace())


def log_overlap(A: FloatArray, B: FloatArray) -> float:
    """Logarithm, at most 0, of the Bhattacharyya coefficient of two zero-mean Gaussians, covariances (m, m)."""
    determinants = np.linalg.slogdet(np.stack((A, B, 0.5 * (A + B))))[1]
    return min(float(0.25 * (determinants[0] + determinants[1]) - 0.5 * determinants[2]), 0.0)


def share_that_stays(earlier: FloatArray, claimed: FloatArray) -> FloatArray:
    """Gain (6, 6) from an earlier systematic error to that of a pose, which is at most what the pose claims.

    A pose that claims less than the systematic error so far uses more information: other markers, a motion that is
    known by now. The better of two such estimates cannot be improved by the other, so their covariance is that of the
    better one, B. The earlier error, of covariance A, is carried over with the gain B / A, at most 1 along each axis.

    Parameters
    ----------
    earlier : (6, 6) covariance of the systematic error so far
    claimed : (6, 6) of the pose's systematic errors
    """
    stds = np.sqrt(claimed.diagonal())
    # Rounding may make correlations indefinite, where an unknown rotation is carried over a lever arm.
    values, vectors = np.linalg.eigh(claimed / np.outer(stds, stds))
    roots = np.sqrt(np.maximum(values, LEAST_INDEPENDENT))
    from_units, to_units = stds[:, None] * vectors * roots, (vectors / roots).T / stds
    # In units of the claim, along the axes in which both are diagonal.
    variances, axes = np.linalg.eigh(to_units @ earlier @ to_units.T)
    return np.asarray((from_units @ axes / np.maximum(variances, 1.0)) @ axes.T @ to_units)


@dataclass(frozen=True, slots=True)
class PoseNoise:
    """Variances of the camera poses' white errors, as adapted to the innovations."""

    #: the last accepted pose, seen from where the estimate was after it
    last: BodyPose
    #: (3,) as a multiple of the poses' own covariance; of the camera's stamps [s^2]; of the camera's rotation against
    #: the IMU, about each axis [rad^2]. 0 for none
    variances: FloatArray
    #: (3,) about the logarithms of the variances
    information: FloatArray = field(default_factory=lambda: np.zeros(3))
    #: (6,) of the last pose that was compared with the estimate, accepted or not, and its covariance (6, 6)
    innovation: FloatArray = field(default_factory=lambda: np.zeros(6))
    S: FloatArray = field(default_factory=lambda: np.zeros((6, 6)))
    #: (6, 6) as ``map_covariance`` of a pose: by which the map that the estimate is in is off
    of_map: FloatArray = field(default_factory=lambda: np.zeros((6, 6)))

    @classmethod
    def of(cls, first: BodyPose, stamp_jitter: float = 0.0, mount_vibration: float = 0.0) -> 'PoseNoise':
        """Initial values; ``stamp_jitter`` [s] and ``mount_vibration`` [rad] are standard deviations."""
        return cls(first, np.array((_WHITE_AT_FIRST, stamp_jitter**2, mount_vibration**2)), of_map=first.map_covariance)

    @property
    def stds(self) -> list[float]:
        """Roots of the variances [1, s, rad]."""
        stds: list[float] = np.sqrt(self.variances).tolist()
        return stds

    @property
    def lasting(self) -> float:
        """Share of what a pose claims that lasts as long as the view: what is known to be white does not."""
        known = float(self.information[0] / (_PRIOR + self.information[0]))
        return 1.0 - known * min(float(self.variances[0]), 1.0)

    def adapted(self, units: FloatArray, innovation: FloatArray, S: FloatArray) -> 'PoseNoise':
        """Adapt the variances to the change of the innovation since the last pose: one step of Fisher scoring.

        The change does not contain what stays, as a step of the clock or a moved marker. Innovations of a filter are
        independent, so the covariance of the change is the sum of theirs: the first ones, of a robot whose velocity is
        unknown yet, say little.

        Parameters
        ----------
        units : (3, 6, 6) covariances of an innovation by variances of 1
        innovation, S : (6,) and its covariance (6, 6)
        """
        # Scaled to the variance of one white innovation.
        change = (innovation - self.innovation) / math.sqrt(2.0)
        inverse = np.linalg.inv(0.5 * (S + self.S))
        shares = inverse @ (self.variances[:, None, None] * units)
        expected = shares.trace(axis1=1, axis2=2)
        squares = np.minimum(change @ shares @ (inverse @ change), _LARGEST_SQUARE * expected)
        fresh = 0.5 * (shares * shares.swapaxes(1, 2)).sum(axis=(1, 2))
        information = (1.0 - 1.0 / _MEMORY) * self.information + fresh
        learned = self.variances * np.exp(0.5 * (squares - expected) / (_PRIOR + information))
        bounded = np.where(self.variances > 0.0, np.clip(learned, *LIMITS), 0.0)
        return replace(self, variances=bounded, information=information, innovation=innovation, S=S)
