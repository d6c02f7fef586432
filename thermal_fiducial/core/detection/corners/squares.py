"""The constraint that a marker's outline is a square: two pseudo-measurements for its four corners.

A view of a square has 6 unknowns, its four corners have 8 coordinates. The homography ``(h1 h2 h3)`` from a square of
any size to normalised image coordinates has ``h1 . h2 = 0`` and ``|h1| = |h2|`` (Z. Zhang, "A flexible new technique
for camera calibration", 2000, eq. 3 and 4). In homogeneous coordinates ``h1`` and ``h2`` are the sides from the first
corner.
"""

from typing import NamedTuple

import numpy as np

from thermal_fiducial.core.error_model import SQUARE_STD
from thermal_fiducial.core.geometry.camera import ImagePoints, inverse_2x2
from thermal_fiducial.core.geometry.planar_pose import ippe_square, squareness
from thermal_fiducial.core.geometry.reprojection import marker_corners
from thermal_fiducial.core.geometry.se3 import apply
from thermal_fiducial.core.types import FloatArray

# Linearisation error of the constraints as a share of their values.
_BENT = 0.1
# The constraints are nonlinear: largest number of linearisations, and the step below which they are not repeated [px].
_STEPS, _BENDS_PX = 3, 0.05
# Squared Mahalanobis distance (2 d.o.f.) beyond which an outline is inconsistent with a square: a square of the second
# planar pose is tried then. One true square in 400 is as far off.
_INCONSISTENT = 12.0
_EYE = np.eye(2)
# Mean displacement of all corners, for each of them.
_TOGETHER = np.kron(np.ones((4, 4)) / 4, _EYE)


class Squared(NamedTuple):
    """Corners of N markers after the constraints."""

    #: (N, 8, 1) displacements of the corners, and their covariances (N, 8, 8) [px]
    moved: FloatArray
    covariance: FloatArray
    #: (N,) squared Mahalanobis distance from the nearest square
    chi2: FloatArray
    #: (N,) squared residual of the constraints where the outline is inconsistent with a square, else 0
    doubt: FloatArray
    #: (N,) number of the two degrees of freedom that the constraints determine rather than the image
    constrained: FloatArray

    @property
    def corner_covariances(self) -> FloatArray:
        """Covariances (N, 4, 2, 2) of the single corners.

        Corners that constrain one another have correlated errors: as independent ones they would claim too much.
        """
        together = (8 / (8 - self.constrained))[:, None, None, None]
        blocks = self.covariance.reshape(-1, 4, 2, 4, 2).diagonal(axis1=1, axis2=3).transpose(0, 3, 1, 2)
        return np.asarray(together * blocks)


def as_squares(corners: ImagePoints, measured: FloatArray, covariance: FloatArray) -> Squared:
    """Displacements of corners with the constraint of a square.

    Two planar poses of a small square look almost alike. The one nearer to the initial corners, translated, is taken
    unless the image rules it out; then the nearest one of those begun at the measured corners and at their two poses.

    Parameters
    ----------
    corners : (N, 4) initial ones, without what a rolling shutter displaces them by: lag hardly changes the shape of a
        square
    measured, covariance : (N, 8, 1), (N, 8, 8) displacements of the corners [px]
    """
    nearest = _corrected(corners, _TOGETHER @ measured, measured, covariance)
    # Linearised away from a square, the constraints miss that they fold where small squares are viewed from in front.
    # Both poses of the measured corners are squares to begin at.
    for pose in (None, 0, 1):
        refuted = np.flatnonzero(nearest.chi2 > _INCONSISTENT)
        if len(refuted) == 0:
            break
        initial, off = corners.only(refuted), measured[refuted]
        begin = off if pose is None else _square_of(initial, off, pose)
        other = _corrected(initial, begin, off, covariance[refuted])
        better = other.chi2 < nearest.chi2[refuted]
        for kept, new in zip(nearest, other, strict=True):
            kept[refuted[better]] = new[better]
    return nearest


def _square_of(corners: ImagePoints, measured: FloatArray, pose: int) -> FloatArray:
    """Displacements (N, 8, 1) to the squares in one of the two planar poses of the measured corners [px]."""
    T = ippe_square(_displaced(corners, measured), np.ones(len(measured)))[:, pose]
    square = apply(T, marker_corners(1.0))
    return np.asarray(corners.J @ (square[..., :2] / square[..., 2:] - corners.x)[..., None]).reshape(-1, 8, 1)


def _displaced(corners: ImagePoints, px: FloatArray) -> FloatArray:
    """Normalised corners (N, 4, 2) after displacements (N, 8, 1) [px]."""
    return np.asarray(corners.x + (corners.inverse @ px.reshape(-1, 4, 2, 1))[..., 0])


def _corrected(corners: ImagePoints, moved: FloatArray, measured: FloatArray, covariance: FloatArray) -> Squared:
    """Update of an iterated Kalman filter, linearised first at the displacements ``moved`` (N, 8, 1)."""
    for _ in range(_STEPS):
        value, J = squareness(_displaced(corners, moved), corners.inverse)
        error = value + J @ (measured - moved)
        spread = covariance @ J.swapaxes(1, 2)
        variance = SQUARE_STD**2 + (_BENT * value) ** 2
        information = inverse_2x2(J @ spread + variance * _EYE)
        weighted = information @ error
        before, moved = moved, measured - spread @ weighted
        if np.abs(moved - before).max() < _BENDS_PX:
            break
    chi2 = np.einsum('nij,nij->n', error, weighted)
    left = variance * weighted
    constrained = 2.0 - np.einsum('nij,nii->n', variance, information)
    doubt = np.where(chi2 > _INCONSISTENT, np.einsum('nij,nij->n', left, left), 0.0)
    return Squared(moved, covariance - spread @ information @ spread.swapaxes(1, 2), chi2, doubt, constrained)
