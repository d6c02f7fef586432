"""Every systematic error that the covariances allow for: name, unit, source, and where it enters.

White noise averages out over the corners of a frame and over frames; a systematic error is the same for many of them
and does not. Each is a field of :class:`SystematicErrors`; a covariance is widened by the functions here and nowhere
else. An error that a frame shares with the next ones enters the covariance of a pose after the fit (as a consider
parameter; S. Schmidt, 1966), never the weights frame by frame: weights that change with the markers in view would make
the pose jump by what the markers are wrong by.
"""

from dataclasses import dataclass

import numpy as np

from thermal_fiducial.core.geometry.reprojection import lever_arm
from thermal_fiducial.core.types import FloatArray, IntArray


@dataclass(frozen=True)
class SystematicErrors:
    """Standard deviations of the systematic errors; zero leaves one out."""

    #: Corners [px]: model of the lens and bias of the detector, which last as long as the view. To begin with what a
    #: published calibration leaves of a board of 36 tags (means over cells of 60 px: 0.08 and 0.09 px; body poses from
    #: two cameras differ by 6.6 mm, NEES 2.4 without it, 0.9 with it, correlation 0.86 after 0.1 s, 0.36 after 4 s);
    #: learned in flight from residuals that last (``CornerBias``). Enters poses from markers (:func:`corners_of_pose`).
    corner_px: float = 0.1
    #: Distance over which that error stays the same [share of the image's width]: a lens model is wrong by a smooth
    #: function. On the same board lengths of 0.1 to 0.25 fit, 0.5 leaves NEES 1.1, 1.0 leaves 1.25.
    corner_length: float = 0.25
    #: Corners [px] where one hypothesis is weighed against another, and the limit below which no marker is worth more
    #: than its neighbours. Enters the fit of new markers, the choice between two poses, and weights.
    decision_px: float = 0.1
    #: Common relative error of the markers' sides and of the focal length: ways of measuring tags on one carpet differ
    #: by 1.2 %, a laser cutter's kerf of 0.3 mm is 0.1 %, and a calibration with a board is good to 0.1 to 0.3 %.
    #: Enters poses from markers (:func:`of_single_error`) and the map (:func:`scale_of_map`).
    marker_size_std: float = 0.003
    #: Corners of one marker in all of its views [share of the corners' noise]: its shape and the model of its edges.
    #: As measured on rendered flights with three lenses and 0.5 to 9 K. Enters the covariance of a joint adjustment.
    marker_shape: float = 0.7


#: 99.9 % of chi square of six and of eight degrees of freedom, of a pose and of a view of a marker: what is farther off
#: than promised errors come.
CHI2_OF_POSE, CHI2_OF_VIEW = 22.5, 26.1
#: For data that have no systematic errors: simulated corners.
NO_SYSTEMATIC_ERRORS = SystematicErrors(0.0, 0.25, 0.0, 0.0, 0.0)
#: Share of the variance of the best marker in view that all others have in common with it, as parts of a rigid map: the
#: place where they all come from, the gauge. Of maps from flights past eight markers nearly all is common; the rest
#: covers markers that were surveyed one by one.
MAP_COMMON = 0.75
#: Poses of the odometry in succession are wrong alike: so many are worth one, as its errors last for seconds.
CORRELATED_ODOMETRY = 30.0
#: However uncertain odometry says it is, it is no worse than this while it agrees with the markers [m, rad].
ODOMETRY_AT_WORST = np.repeat([0.3, 0.2], 3)
#: Re-projection error to allow for before a marker counts as inconsistent [px]: bent plates, and the corners' bias.
INCONSISTENT_PX = 0.3


# Poses from the corners of a frame.


def noise_of_pose(gains: FloatArray, covariances: FloatArray, chi2: float) -> FloatArray:
    """Covariance (6, 6) that the noise of n corners makes of a pose, at least as large as its residuals say.

    Parameters
    ----------
    gains : (n, 6, 2) what a pixel of each corner moves the pose by
    covariances : (n, 2, 2) [px^2]
    chi2 : of the residuals
    """
    white = np.tensordot(gains, covariances @ np.swapaxes(gains, -1, -2), axes=([0, 2], [0, 1]))
    return noise_factor(chi2, 2 * len(gains) - 6) * white


def noise_factor(chi2: float, freedom: int) -> float:
    """Ratio of the variance of residuals to the promised one, at least 1: covariances that promise too much grow by it.

    Parameters
    ----------
    chi2 : of the residuals
    freedom : residuals less what was estimated from them
    """
    return max(1.0, chi2 / max(freedom, 1))


def corner_correlations(corners: FloatArray, width: int, errors: SystematicErrors) -> FloatArray:
    """Correlations (n, n) of the systematic errors of n corners, of either axis alone.

    Parameters
    ----------
    corners : (n, 2) [px]
    width : of the image [px]
    """
    u, v = corners[:, 0], corners[:, 1]
    squared = (u[:, None] - u) ** 2 + (v[:, None] - v) ** 2
    return np.asarray(np.exp(squared * (-0.5 / (errors.corner_length * width) ** 2)))


def corners_of_pose(gains: FloatArray, correlations: FloatArray, errors: SystematicErrors) -> FloatArray:
    """Covariance (m, m) that the systematic errors of n corners make of a pose.

    Parameters
    ----------
    gains : (n, m, 2) what a pixel of each corner moves the pose by
    correlations : (n, n) of the errors
    """
    n, m, _ = gains.shape
    mixed = (correlations @ gains.reshape(n, 2 * m)).reshape(n, m, 2)
    return np.asarray(errors.corner_px**2 * np.tensordot(gains, mixed, axes=([0, 2], [0, 2])))


def visible_share(J: FloatArray, correlations: FloatArray) -> float:
    """Share of the variance of the corners' systematic errors that a pose fitted to them leaves in the residuals.

    Parameters
    ----------
    J : (n, 2, 6) derivatives of n corners with respect to the pose
    correlations : (n, n) of the errors
    """
    n = len(J)
    mixed = (correlations @ J.reshape(n, 12)).reshape(2 * n, 6)
    of_coordinates = J.reshape(2 * n, 6)
    taken_up = np.linalg.solve(of_coordinates.T @ of_coordinates, of_coordinates.T @ mixed)
    return 1.0 - float(np.trace(taken_up)) / (2.0 * n)


def map_of_pose(
    gains: FloatArray, covariances: FloatArray, positions: FloatArray, camera_position: FloatArray
) -> FloatArray:
    """Covariance (6, 6) of a camera pose by the errors of the map, its scale aside.

    What the markers have in common moves the camera as if it hung on the same rigid map; for the rest any correlations
    are allowed for.

    Parameters
    ----------
    gains : (N, 6, 6) what a displacement of each marker moves the pose by; all together moved rigidly take it along
    covariances, positions : (N, 6, 6), (N, 3) of the markers
    camera_position : (3,)
    """
    best = int(np.argmin(np.trace(covariances, axis1=1, axis2=2)))
    arms = np.concatenate([positions, camera_position[None]]) - positions[best]
    A = lever_arm(arms)
    common = MAP_COMMON * A @ covariances[best] @ np.swapaxes(A, -1, -2)
    return np.asarray(common[-1] + correlated_sum(gains, positive(covariances - common[:-1])))


def of_single_error(moved: FloatArray, std: float = 1.0) -> FloatArray:
    """Covariance (m, m) of what moves by ``moved`` (m,) for each unit of one error: scale, clock, or another pose.

    Parameters
    ----------
    std : of the error: ``marker_size_std`` of poses that move as all markers grow to twice their size [share], how far
        a clock may be off of poses by their velocity [s]; of a pose that may as well be another one, 1 of what is
        between them
    """
    return np.asarray(std**2 * np.outer(moved, moved))


# The map, from a joint adjustment.


def shape_of_corners(precisions: FloatArray, views: IntArray, errors: SystematicErrors) -> FloatArray:
    """Standard deviations (M,) [px] of what corners of M markers are off by in all of their views alike.

    Parameters
    ----------
    precisions : (M,) sum over the views of a marker of its corners' inverse variance [1/px^2]
    views : (M,) how many they are
    """
    return np.asarray(errors.marker_shape * np.sqrt(views / precisions))


def arms_of_scale(positions: FloatArray, held: FloatArray) -> FloatArray:
    """What markers at ``positions`` (M, 3) move by as the scale grows by 1 (M, 3): from the nearest of ``held``.

    Parameters
    ----------
    held : (H, 3) positions that are given, at least one: they carry the scale
    """
    arms = positions[:, None] - held
    nearest = np.argmin(np.sum(arms**2, axis=-1), axis=1)
    return np.asarray(arms[np.arange(len(positions)), nearest])


def scale_of_map(arms: FloatArray, errors: SystematicErrors) -> FloatArray:
    """Covariances (M, 6, 6) of markers that move by ``arms`` (M, 3) as the scale grows by 1."""
    covariances = np.zeros((len(arms), 6, 6))
    covariances[:, :3, :3] = errors.marker_size_std**2 * arms[:, :, None] * arms[:, None, :]
    return covariances


def divided_prior(covariance: FloatArray, count: int) -> FloatArray:
    """Covariance (6, 6) of one of ``count`` markers that are known from before, without how their errors hang together.

    Each so many times as large, they are an upper bound of the joint covariance whatever that is.
    """
    return count * covariance


# Odometry.


def alike_odometry(covariance: FloatArray) -> FloatArray:
    """Covariance (6, 6) of one of many poses by the odometry whose errors are the same for seconds."""
    return CORRELATED_ODOMETRY * covariance


def bounded_odometry(covariance: FloatArray) -> FloatArray:
    """Covariance (6, 6) of odometry that has agreed with the markers so far: no worse than at its worst."""
    scale = float(np.min(ODOMETRY_AT_WORST**2 / np.maximum(np.diag(covariance), 1e-12)))
    return np.asarray(min(1.0, scale) * covariance)


# Weights of markers, and decisions between hypotheses; no published covariance has these in it.


def map_weights(noise: FloatArray, pixels: FloatArray, errors: SystematicErrors) -> FloatArray:
    """Weights (N,) of markers whose places in the map are uncertain by ``pixels`` (N,) [px] in the view at hand.

    They depend on each marker alone and change as slowly as the view does. Weighing with the covariance relative to the
    best marker in view, poses over a carpet of 81 markers jittered twice as much as with the map taken for exact.

    Parameters
    ----------
    noise : (N,) standard deviation of the corners [px]
    """
    own = noise**2 + errors.decision_px**2
    return np.asarray(own / (own + pixels**2))


def decision_weights(noise: FloatArray, errors: SystematicErrors) -> FloatArray:
    """Weights (N,) of markers with corner noise (N,) [px] that make it what decisions rest on: noise and bias."""
    return np.asarray(noise**2 / (noise**2 + errors.decision_px**2))


def with_corner_errors(covariances: FloatArray, errors: SystematicErrors) -> FloatArray:
    """Corner covariances (..., 2, 2) [px^2] to decide between hypotheses with: noise, and what corners are off by."""
    return np.asarray(covariances + errors.decision_px**2 * np.eye(2))


# What the others are made of.


def correlated_sum(gains: FloatArray, covariances: FloatArray) -> FloatArray:
    """Covariance (m, m) of ``sum_i gains_i x_i`` that holds whatever the correlations of the ``x_i`` are.

    Errors of the markers of a map, and of camera poses that rest on the same map, are correlated by an amount that
    nobody keeps. For any weights a_i that sum to one, ``sum_i gains_i P_i gains_i' / a_i`` is an upper bound (as in
    covariance intersection; S. Julier, J. Uhlmann, 1997); these a_i make its trace the smallest.

    Parameters
    ----------
    gains : (n, m, 6)
    covariances : (n, 6, 6)
    """
    terms = gains @ covariances @ np.swapaxes(gains, -1, -2)
    # Rotations and metres are made comparable by the terms' own mean variances.
    variances = np.diagonal(terms, axis1=-2, axis2=-1)
    total = np.sum(variances, axis=0)
    shares = np.sqrt(np.sum(variances / np.where(total > 0.0, total, 1.0), axis=-1))
    used = shares > 0.0
    if not np.any(used):
        return np.zeros(terms.shape[1:])
    weights = shares[used] / np.sum(shares[used])
    return np.asarray(np.sum(terms[used] / weights[:, None, None], axis=0))


def positive(covariances: FloatArray) -> FloatArray:
    """The nearest covariances (..., 6, 6): negative variances become none."""
    values, vectors = np.linalg.eigh(0.5 * (covariances + np.swapaxes(covariances, -1, -2)))
    return np.asarray((vectors * np.maximum(values, 0.0)[..., None, :]) @ np.swapaxes(vectors, -1, -2))
