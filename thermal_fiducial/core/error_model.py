"""Systematic errors of the map and of camera poses from markers: name, unit, source, and where each enters.

White noise averages out over the corners of a frame and over frames; a systematic error is the same for many of them
and does not. Each is a field of :class:`SystematicErrors`; covariances of the map and of these poses are widened by the
functions here and, for the lens, by those of ``lens_errors``, and nowhere else. Errors of single corners in a frame are
in ``detection/corners/corner_errors.py``, those that the filter adds to its own model in ``filter/pose_noise.py`` and
``filter/imu_noise.py``.

An error that a frame shares with the next ones enters the covariance of a pose after the fit (as a consider parameter;
S. Schmidt, 1966), never the weights frame by frame: weights that change with the markers in view would make the pose
jump by what the markers are wrong by.
"""

from dataclasses import dataclass
import math

import numpy as np

from thermal_fiducial.core.geometry.se3 import lever_arm
from thermal_fiducial.core.measurements import LATE
from thermal_fiducial.core.types import BoolArray, FloatArray


@dataclass(frozen=True)
class SystematicErrors:
    """Standard deviations of the systematic errors; zero leaves one out."""

    #: Corners [px]: model of the lens and bias of the detector, which last as long as the view. Here what a good
    #: calibration leaves; flights begin with more, and learn it from residuals that last (``CornerBias``). Enters poses
    #: from markers, map and new markers (``LensErrors``).
    corner_px: float = 0.1
    #: Common relative error of the markers' sides: ways of measuring tags on one carpet differ by 1.2 %, a laser
    #: cutter's kerf of 0.3 mm is 0.1 %. Enters poses from markers, new markers and the map (:func:`scale_of_map`).
    marker_size_std: float = 0.003
    #: Relative error of the focal length: a calibration with a board is good to 0.1 to 0.3 %. It moves the camera along
    #: its axis by as much of the distance to the markers, in maps with exact sizes too. Enters with the errors of the
    #: lens (``LensErrors``), in poses from markers as part of the map's error.
    focal_length_std: float = 0.002
    #: Error of the ratio of the two focal lengths [share of the difference between them]: pixels are square, so all of
    #: the difference is an error of the calibration (0.3 % in a published one, of a camera whose corners show none). By
    #: 0.3 % a marker seen from the front may look tilted by 4 degrees. Enters with the errors of the lens
    #: (``LensErrors``).
    aspect: float = 1.0
    #: How much of a rolling shutter's readout time is not declared [s]: cores read their rows in 8 to 33 ms, or all at
    #: once. Prior of its estimate, by frames and in an adjustment of the map, whose covariances have what that leaves;
    #: enters corners by that (``UndeclaredReadout``), and with these poses and new markers.
    readout_time_std: float = 0.015
    #: Corners of one marker in all of its views [share of the corners' noise]: its shape and the model of its edges. At
    #: most this on rendered flights with three lenses and 0.5 to 9 K. Enters the covariance of a joint adjustment.
    marker_shape: float = 0.7
    #: The most likely size of what ``corner_px`` is the root mean square of [px]: residuals of a marker are compared
    #: with it. Enters weights of markers.
    likely_corner_px: float = corner_px
    #: What an adjustment of the map has found of the aspect ratio's error, as a share of the declared one, and (K,)
    #: joint draws of what it leaves, None before any. Corners are corrected by it before they enter anything.
    aspect_found: float = 0.0
    aspect_left: FloatArray | None = None


#: Distance over which the error of the corners stays the same [share of the image's width]: a lens model is wrong by a
#: smooth function. On the same board lengths of 0.1 to 0.25 fit, 0.5 leaves NEES 1.1, 1.0 leaves 1.25.
CORNER_LENGTH = 0.25
#: Corners [px] where one hypothesis is weighed against another: as a good calibration leaves them. Enters the weights
#: of views of new markers, the choice between two poses, and weights by the map.
DECISION_PX = SystematicErrors.corner_px
#: 99.9 % quantile of chi square with eight degrees of freedom, of a view of a marker.
CHI2_OF_VIEW = 26.1
#: Errors of successive poses last as long as the view, for seconds: this many count as one. Enters the clock of a
#: second camera (``SecondClock``).
CORRELATED_POSES = 30.0
#: What a calibration leaves of the readout time of a rolling shutter [s]: 0.1 to 0.3 ms where rows are read in 16 ms.
#: Enters the decision to name it as not declared.
READOUT_AS_DECLARED = 5e-4
#: Departure of a marker's outline from a square, by the cut of markers and by lens calibrations [share of a side].
#: Enters the detector's constraint that it is one, and so what corners show of rows that are read late.
SQUARE_STD = 0.003
#: Part of the re-projection error, by bent plates and corner bias, that is no sign of an inconsistent marker [px].
INCONSISTENT_PX = 0.3
#: Largest noise of corners by pixels [px]: markers of twice the noise of a pixel claim 0.35. What a marker claims
#: beyond it in most views is by an object that covers a side, and the same in all views, also in those few in which the
#: outline looks like a square. Enters the covariance of a joint adjustment (:func:`shape_of_corners`).
WHITE_PX = 0.5
#: Covariance of an unknown acceleration of robot and camera in a brisk flight: 3 m/s^2, 4 rad/s^2.
UNKNOWN_ACCELERATION = np.diag([3.0, 3.0, 3.0, 4.0, 4.0, 4.0]) ** 2
#: Standard deviations of a robot's velocity [m/s] and turn rate [rad/s], each along any axis, where nothing measures
#: them: medians over rendered missions are 0.3 and 0.5. Enter poses without odometry, by rows that are read late.
USUAL_SPEED, USUAL_RATE = 0.5, 0.5
#: Joint draws of the errors of a map: standard deviations by 64 are accurate to a tenth, those by the lens exact.
DRAWS = 64
#: Those of a marker whose place is known exactly.
NO_DRAWS: FloatArray = np.zeros((6, DRAWS))
#: (7, K) those of what is not known of rows that are read late, in standard deviations: the readout time is the same in
#: all frames, and so may the motion be in the few that have no odometry.
LATE_DRAWS: FloatArray = math.sqrt(DRAWS) * np.linalg.qr(np.random.default_rng(0).standard_normal((DRAWS, LATE)))[0].T
#: Directions in which a marker's error is smaller than this share of its largest standard deviation inherit nothing.
_LEAST_STD = 1e-6


# Poses from the corners of a frame.


def noise_factor(chi2: float, freedom: int) -> float:
    """Ratio of the variance of residuals to the claimed one, at least 1, by which covariances are scaled.

    Parameters
    ----------
    chi2 : of the residuals
    freedom : number of residuals less the number of estimated parameters
    """
    return max(1.0, chi2 / max(freedom, 1))


def covariance_of_one_error(moved: FloatArray, std: float = 1.0) -> FloatArray:
    """Covariance (m, m) by one scalar error with derivative ``moved`` (m,): clock offset, or the other pose.

    Parameters
    ----------
    std : standard deviation of the error: that of the clock offset [s] for a velocity, 1 for the difference of two
        possible poses
    """
    return np.asarray(std**2 * np.outer(moved, moved))


def covariance_of_motion(twist_covariance: FloatArray, seconds: float) -> FloatArray:
    """Covariance (6, 6) of the displacement in ``seconds`` [s] by a twist (6, 6), while the acceleration is unknown."""
    return np.asarray(seconds**2 * twist_covariance + 0.25 * seconds**4 * UNKNOWN_ACCELERATION)


def covariance_of_mount(position_std: float, orientation_std: float) -> FloatArray:
    """Covariance (6, 6) of a camera on the robot, by what its calibration leaves [m, rad]: the same in all axes."""
    return np.diag(np.repeat([position_std, orientation_std], 3) ** 2)


def at_most_claimed(of_map: FloatArray, covariance: FloatArray) -> FloatArray:
    """The map's error ``of_map`` (6, 6), at most what the ``covariance`` (6, 6) of a pose contains along any axis."""
    root = np.linalg.cholesky(covariance)
    units = np.linalg.inv(root)
    shares, axes = np.linalg.eigh(units @ of_map @ units.T)
    if shares[-1] <= 1.0:
        return of_map
    along = root @ axes
    return np.asarray((along * np.clip(shares, 0.0, 1.0)) @ along.T)


# The map, from a joint adjustment.


def shape_of_corners(variances: FloatArray, typical: FloatArray, errors: SystematicErrors) -> FloatArray:
    """Standard deviations (M,) [px] of the corner errors of M markers that are the same in all views.

    Parameters
    ----------
    variances : (M,) of the corners of a marker, harmonic mean over its views [px^2]
    typical : (M,) median over the views
    """
    covered = np.maximum(typical - WHITE_PX**2, 0.0)
    return np.asarray(np.sqrt(errors.marker_shape**2 * variances + covered))


def arms_of_scale(positions: FloatArray, held: FloatArray) -> FloatArray:
    """Derivatives (M, 3) of the ``positions`` (M, 3) of markers by the map's scale: from the nearest of ``held``.

    Parameters
    ----------
    held : (H, 3) positions of held markers, at least one
    """
    arms = positions[:, None] - held
    nearest = np.argmin(np.sum(arms**2, axis=-1), axis=1)
    return np.asarray(arms[np.arange(len(positions)), nearest])


def scale_of_map(arms: FloatArray, errors: SystematicErrors) -> FloatArray:
    """Covariances (M, 6, 6) of markers by the scale's error; ``arms`` (M, 3) of :func:`arms_of_scale`."""
    covariances = np.zeros((len(arms), 6, 6))
    covariances[:, :3, :3] = errors.marker_size_std**2 * arms[:, :, None] * arms[:, None, :]
    return covariances


def assumed_draws(positions: FloatArray, covariances: FloatArray, placed: BoolArray) -> FloatArray:
    """Joint draws (M, 6, K) of the errors of a map's M markers, of which only the covariance of each is known.

    Those that a mapper has placed are assumed to have been placed by their nearest better-known marker: they have the
    error of that, moved rigidly, as far as their own covariance allows, and the rest by themselves. Markers that were
    measured one by one have errors of their own.

    Parameters
    ----------
    positions, covariances : (M, 3), (M, 6, 6)
    placed : (M,) whether a mapper has placed them by what cameras saw
    """
    rng, draws = np.random.default_rng(0), np.zeros((len(positions), 6, DRAWS))
    order = np.argsort(np.trace(covariances, axis1=1, axis2=2), kind='stable')
    for place, index in enumerate(order.tolist()):
        inherited = NO_DRAWS
        if place and placed[index]:
            arms = positions[index] - positions[order[:place]]
            nearest = int(np.argmin(np.sum(arms**2, axis=1)))
            inherited = lever_arm(arms[nearest]) @ draws[order[nearest]]
        draws[index] = draws_of(covariances[index], rng, inherited)
    return draws


def draws_of(covariance: FloatArray, rng: np.random.Generator, inherited: FloatArray = NO_DRAWS) -> FloatArray:
    """Draws (6, K) of an error whose covariance by these draws is just ``covariance`` (6, 6).

    They are the ``inherited`` draws (6, K) where these are no larger than that, and draws of its own for the rest.
    """
    root = covariance_root(covariance)
    # In units of the covariance, along axes in which what is inherited is uncorrelated.
    whitened = np.linalg.pinv(root, _LEAST_STD) @ inherited / np.sqrt(DRAWS)
    axes, stds, shared = np.linalg.svd(whitened, full_matrices=False)
    stds = np.minimum(stds, 1.0)[:, None]
    # Uncorrelated with what is inherited, so that the squares of both shares add up to one.
    own = np.linalg.qr(np.concatenate([shared, rng.standard_normal(shared.shape)]).T)[0].T[6:]
    return np.asarray(np.sqrt(DRAWS) * root @ axes @ (stds * shared + np.sqrt(1.0 - stds**2) * own))


def divided_prior(covariance: FloatArray, count: int) -> FloatArray:
    """Covariance (6, 6) of one of ``count`` prior markers whose correlations are unknown.

    Covariances times their number bound the joint covariance for any correlations.
    """
    return count * covariance


# Errors that many poses have in common.


def information_of_followed_map(information: FloatArray, bridges: BoolArray) -> FloatArray:
    """Information (F, 6, 6) of keyframes by odometry that follows poses in the map: all count as one measurement.

    They have the errors of the map and of the corners behind those poses in common. With the usual correlation of
    seconds, a map from faint markers took its own error for confirmed: 2.5 degrees at a claim of 0.9.

    Parameters
    ----------
    information : (F, 6, 6) of each, zero without odometry
    bridges : (F,) over a gap, where the map says nothing; each counts in full
    """
    following = information.any(axis=(1, 2)) & ~bridges
    number = np.where(following, np.count_nonzero(following), 1)
    return np.asarray(information / number[:, None, None])


# Weights of markers, and decisions between hypotheses; no published covariance has these in it.


def map_weights(noise: FloatArray, pixels: FloatArray) -> FloatArray:
    """Weights (N,) of markers whose map errors are ``pixels`` (N,) [px] in the present view.

    They depend on each marker alone and change as slowly as the view. With covariances relative to the best marker in
    view, poses over a carpet of 81 markers jittered twice as much as with an exact map.

    Parameters
    ----------
    noise : (N,) standard deviation of the corners [px]
    """
    own = noise**2 + DECISION_PX**2
    return np.asarray(own / (own + pixels**2))


def survey_for_weights(of_survey: FloatArray, noise: FloatArray, errors: SystematicErrors) -> FloatArray:
    """Covariances (N, 8, 8) of corners by errors of a survey, reduced for weights that leave out the corners' bias.

    The bias is the same for all markers, so that alone it changes no weight. Beside it the error that each marker has
    for itself matters less: its variance is divided by the ratio in which the bias would increase that of the noise.

    Parameters
    ----------
    of_survey : (N, 8, 8) by the error of each marker's pose in the map [px^2]
    noise : (N,) standard deviation of the corners [px]
    """
    return np.asarray((noise**2 / (noise**2 + errors.corner_px**2))[:, None, None] * of_survey)


def decision_weights(noise: FloatArray, by_readout: FloatArray) -> FloatArray:
    """Factors (N,) on weights of markers by noise alone, after which bias and unknown readout time count in them, too.

    Parameters
    ----------
    noise, by_readout : (N,) standard deviations of the corners [px]
    """
    return np.asarray(noise**2 / (noise**2 + DECISION_PX**2 + by_readout**2))


def with_corner_errors(covariances: FloatArray) -> FloatArray:
    """Corner covariances (..., 2, 2) [px^2] for decisions between hypotheses: noise and bias."""
    return np.asarray(covariances + DECISION_PX**2 * np.eye(2))


# Helpers.


def independent_sum(gains: FloatArray, covariances: FloatArray) -> FloatArray:
    """Covariance (m, m) of ``sum_i gains_i x_i`` of independent ``x_i``: gains (n, m, p), covariances (n, p, p)."""
    return np.asarray(np.tensordot(gains, covariances @ np.swapaxes(gains, -1, -2), axes=([0, 2], [0, 1])))


def drawn_sum(gains: FloatArray, draws: FloatArray) -> FloatArray:
    """Draws (m, K) of ``sum_i gains_i x_i`` by joint draws of the ``x_i``: gains (n, m, p), draws (n, p, K)."""
    return np.asarray(np.tensordot(gains, draws, axes=([0, 2], [0, 1])))


def block_diagonal(covariances: FloatArray) -> FloatArray:
    """Covariances (N, 8, 8) of the corners of N markers by those of each corner (N, 4, 2, 2)."""
    whole = np.zeros((len(covariances), 8, 8))
    diagonal_blocks(whole)[...] = covariances
    return whole


def diagonal_blocks(matrices: FloatArray) -> FloatArray:
    """The blocks (N, 4, 2, 2) on the diagonals of (N, 8, 8): a view."""
    return np.asarray(np.einsum('nkikj->nkij', matrices.reshape(-1, 4, 2, 4, 2)))


def covariance_by_draws(draws: FloatArray) -> FloatArray:
    """Covariances (..., m, m) of draws (..., m, K) of errors whose mean is zero."""
    return np.asarray(draws @ np.swapaxes(draws, -1, -2) / draws.shape[-1])


def covariance_root(covariances: FloatArray) -> FloatArray:
    """Roots R (..., 6, 6) of covariances R R', of the nearest positive semidefinite ones."""
    values, vectors = np.linalg.eigh(0.5 * (covariances + np.swapaxes(covariances, -1, -2)))
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :])
